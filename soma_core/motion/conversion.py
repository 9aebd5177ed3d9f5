"""Conversion of a file to this skeleton and back."""

from __future__ import annotations

import logging
import re
import tempfile
from dataclasses import fields, replace
from pathlib import Path

from soma_core.choices import FitLod, LengthUnit
from soma_core.errors import InputError, SomaError
from soma_core.io.motion import Motion
from soma_core.io.motion_files import samples_of
from soma_core.io.smpl_files import people_of
from soma_core.motion.back import BackConverter
from soma_core.motion.converter import Converted, Converter
from soma_core.motion.files import ResultFiles, layout_of, read, turn_settings
from soma_core.motion.options import ConvertOptions
from soma_core.motion.poses import POSES, named_pose
from soma_core.motion.questions import Names, of_motion, say
from soma_core.motion.smpl_input import SMPL_LAYOUTS
from soma_core.options import FrameRange, ModelOptions, Picture
from soma_core.paths import expanded, fitting
from soma_core.rig.manifest import shipped_file

__all__ = [
    "EVERYONE",
    "convert",
    "convert_file",
    "convert_people",
    "converter_for",
    "load_clip",
    "people_names",
]

EVERYONE = "all"
"""Value of the option ``person`` that means each of them."""

_log = logging.getLogger(__name__)


def convert(source: str | Path, *, options: ConvertOptions | None = None) -> Motion:
    """Bring a motion of another tool to this skeleton; nothing is kept on disk.

    Args:
        source: a file of AMASS, SAM 3D Body, kimodo or SOMA tools.
        options: of the conversion.

    Raises:
        SomaError: the file, or the backend that it needs, cannot be used, or the fit is none.
        InputError: the options lead to another model, which :func:`convert_file` does.
    """
    options = ConvertOptions.or_default(options)
    if options.to != "soma":
        raise InputError("to", got=options.to, expected="soma", fix="Use convert_file for the way back.")
    with tempfile.TemporaryDirectory() as folder:
        return convert_file(source, folder, options=replace(options, picture=Picture(frames=0))).motion()


def load_clip(
    path: str | Path | None = None,
    *,
    fps: float | None = None,
    person: str | None = None,
    unit: LengthUnit | str | None = None,
    frames: FrameRange | None = None,
    model: ModelOptions | None = None,
) -> Motion:
    """Some frames of a motion file, whatever tool wrote it.

    A motion of another skeleton or body is converted, as :func:`convert` does with the options left out.

    Args:
        path: the file, or the name of a pose as ``T-pose``, see ``soma_core.motion.poses``; None for the clip
            that ships with the project.
        fps: frame rate, where the file has none.
        person: which person, or sample of a file of several, ``0`` for the first.
        unit: ``m``, ``cm`` or ``mm``, where the file does not say or is wrong.
        frames: which; None for all.
        model: that poses are fitted with, where a body has to be fitted.

    Raises:
        SomaError: the file cannot be read.
        InputError: no frame is left.
    """
    motion, frames = _clip(path, fps, person, unit, model or ModelOptions()), frames or FrameRange()
    part = slice(frames.start, frames.stop, frames.step)
    if part.step < 1 or not len(range(motion.frame_count)[part]):
        raise InputError(
            "frames",
            got=f"start={part.start}, stop={part.stop}, step={part.step}",
            expected=f"a step of at least 1 and a range inside the {motion.frame_count} frames",
            fix="Give frames.start, frames.stop and frames.step inside the motion.",
        )
    return replace(motion.cut(part), fps=motion.fps / part.step)


def _clip(
    path: str | Path | None, fps: float | None, person: str | None, unit: str | None, model: ModelOptions
) -> Motion:
    """All frames of a pose or a file."""
    if str(path) in POSES:
        return named_pose(str(path))
    path = expanded(path) if path else shipped_file("motions/range_of_motion.npz")
    layout = layout_of(path)
    if layout not in (None, "soma", "kimodo"):
        return _converted(path, fps, person, unit, model)
    motion = read(path, fps=fps, unit=unit, person=person)
    turns = turn_settings(str(layout))
    names = Names(unit="motion_unit", fps="motion_fps", ups=(), turns=turns, to=" to soma convert")
    say(path.name, of_motion(motion, names))
    return motion


def _converted(
    path: Path, fps: float | None, person: str | None, unit: str | None, model: ModelOptions
) -> Motion:
    """A motion of another skeleton or body, brought to this one.

    Raises:
        SomaError: it cannot be, or needs settings that a conversion alone has.
    """
    lod = FitLod.mid if model.lod == "mid" else FitLod.low
    chosen = {each.name: getattr(model, each.name) for each in fields(ModelOptions)}
    options = ConvertOptions(
        **{**chosen, "lod": lod}, fps=fps, person=person, unit=None if unit is None else LengthUnit(unit)
    )
    try:
        return convert(path, options=options)
    except SomaError:
        _log.warning(
            "%s: soma convert takes all settings of such a file, and soma animate its motion.npz; here fps= "
            "and unit= are motion_fps= and motion_unit=", path.name,
        )  # fmt: skip
        raise


def convert_file(source: str | Path, out: str | Path, *, options: ConvertOptions | None = None) -> Converted:
    """Convert a file; write the motion, the errors and a report.

    Finished chunks stay in ``out/chunks`` until the end: the same call goes on after them. A body that was
    fitted before, with the same settings, is not fitted again.

    Args:
        source: a file of AMASS, SAM 3D Body, kimodo or SOMA tools; for the way back, one of this skeleton.
        out: folder of the results: ``motion.npz``, or ``vertices.npz`` on the way back to vertices.
        options: of the conversion.

    Raises:
        SomaError: the file, or the backend that it needs, cannot be used, or the fit is none.
        InputError: it holds no motion, or was converted before with other settings.
    """
    out = Path(out)
    convert = converter_for(ConvertOptions.or_default(options))
    return convert(expanded(source), ResultFiles.of_folder(out), out / "chunks")


def convert_people(
    source: str | Path, out: str | Path, *, options: ConvertOptions | None = None
) -> dict[str, Converted]:
    """Convert the motion of every person or sample in a file, each into a folder of its own.

    Args:
        source: the file, of the SMPL family, GEM-X or kimodo.
        out: folder of the results, in which each person has one.
        options: of the conversions; ``person`` does not count.

    Raises:
        SomaError: the file, or the backend that it needs, cannot be used, or a fit is none.
    """
    source, out = Path(source).expanduser(), Path(out)
    convert = Converter(ConvertOptions.or_default(options))
    return {
        person: convert.of_person(person)(source, ResultFiles.of_folder(out / name), out / name / "chunks")
        for person, name in people_names(source).items()
    }


def people_names(source: Path) -> dict[str, str]:
    """Whose motions a file holds, and what their results are called; the only one has no name.

    Raises:
        InputError: it holds none of the SMPL family.
    """
    layout, people = layout_of(source), []
    if layout in SMPL_LAYOUTS:
        people = people_of(source)
    elif layout in ("kimodo", "soma"):
        count = samples_of(source)
        people = [str(number) for number in range(count)] if count > 1 else [""]
    if not people:
        raise InputError(
            f"{source}: person", got="all, of a file without people to choose from",
            expected="one of the SMPL family, of GEM-X or kimodo", fix="Leave person out.",
        )  # fmt: skip
    names = {person: fitting(re.sub(r"[^\w.-]+", "_", person).strip(".") or "person") for person in people}
    taken = dict.fromkeys(names.values())
    return (
        names
        if len(taken) == len(names)
        else {person: f"{n}_{name}" for n, (person, name) in enumerate(names.items())}
    )


def converter_for(options: ConvertOptions, *, refuse_unused: bool = True) -> Converter | BackConverter:
    """What converts in the direction of the options."""
    return Converter(options, refuse_unused=refuse_unused) if options.to == "soma" else BackConverter(options)
