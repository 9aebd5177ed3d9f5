"""Conversion of a file, or of a folder of them, to this skeleton and back."""

from __future__ import annotations

import json
import logging
import re
import shutil
import tempfile
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from soma_core.cache import atomic_text
from soma_core.choices import FitLod, LengthUnit
from soma_core.errors import InputError, SomaError
from soma_core.io.json_frames import holds_pose_frames
from soma_core.io.motion import Motion
from soma_core.io.motion_files import samples_of
from soma_core.io.smpl_files import people_of
from soma_core.motion.back import BackConverter
from soma_core.motion.bodies import SMPL_LAYOUTS
from soma_core.motion.converter import Converted, Converter
from soma_core.motion.files import ResultFiles, layout_of, motion_suffixes, no_motion, read
from soma_core.motion.options import ConvertOptions
from soma_core.motion.poses import POSES, named_pose
from soma_core.motion.questions import Names, of_motion, say
from soma_core.options import FrameRange, ModelOptions, Picture
from soma_core.paths import expanded
from soma_core.rig.manifest import shipped_file

__all__ = ["FolderConverted", "convert", "convert_file", "convert_folder", "convert_people", "load_clip"]

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
    options = options or ConvertOptions()
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
    if layout_of(path) not in (None, "soma", "kimodo"):
        return _converted(path, fps, person, unit, model)
    motion = read(path, fps=fps, unit=unit, person=person)
    say(path.name, of_motion(motion, Names(unit="motion_unit", fps="motion_fps", ups=())))
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
    convert = _converter(options or ConvertOptions())
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
    convert = Converter(options or ConvertOptions())
    return {
        person: convert.of_person(person)(source, ResultFiles.of_folder(out / name), out / name / "chunks")
        for person, name in _people(source).items()
    }


def _people(source: Path) -> dict[str, str]:
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
    names = {person: re.sub(r"[^\w.-]+", "_", person).strip(".") or "person" for person in people}
    taken = dict.fromkeys(names.values())
    return (
        names
        if len(taken) == len(names)
        else {person: f"{n}_{name}" for n, (person, name) in enumerate(names.items())}
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class FolderConverted:
    """What became of the files of a folder, by their names in it.

    Attributes:
        converted: those that were converted, by this call or an earlier one.
        errors: what was wrong with those that were not.
        skipped: those that hold nothing of a motion; files with poses that cannot be read are errors.
    """

    converted: dict[str, Converted] = field(default_factory=dict)
    errors: dict[str, SomaError] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.converted) + len(self.errors) + len(self.skipped)


def convert_folder(
    folder: str | Path, out: str | Path, *, options: ConvertOptions | None = None
) -> FolderConverted:
    """Convert every file in a folder; those that cannot be are left out and listed.

    The folder is mirrored: ``motions`` and ``reports`` in `out` hold a file for each of its files, and
    ``report.json`` lists them all. The same call goes on where an earlier one was stopped; what is there
    already is not done again.

    Args:
        folder: motion files at any depth.
        out: folder of the results; it may lie in `folder`.
        options: of the conversions.

    Raises:
        InputError: no file may hold a motion.
    """
    folder, out = expanded(folder), Path(out)
    if not folder.is_dir():
        raise InputError(
            str(folder), got="no folder", expected="one that holds motion files",
            fix="Correct the path; one file is what convert_file takes.",
        )  # fmt: skip
    files = [file for file in _files(folder) if not file.is_relative_to(out.resolve())]
    if not files:
        raise InputError(
            str(folder),
            got=f"no file ending in {' or '.join(motion_suffixes())}",
            expected="motion files, at any depth",
            fix="Name the folder that holds them.",
        )
    convert = _converter(options or ConvertOptions(), refuse_unused=False)
    found, rows = FolderConverted(), {}
    everyone = options is not None and options.person == EVERYONE
    try:
        for number, file in enumerate(files, start=1):
            name = file.relative_to(folder.resolve()).as_posix()
            for one, converter in _converters(convert, file, name, everyone=everyone):
                rows[one], told = _row(converter, file, out, one, found)
                level = logging.WARNING if one in found.errors else logging.INFO
                _log.log(level, "%d of %d: %s: %s", number, len(files), one, told)
    finally:
        document = {"input": str(folder.resolve()), "files": rows}
        atomic_text(out / "report.json", json.dumps(document, indent=2) + "\n")
    shutil.rmtree(out / "chunks", ignore_errors=True)
    return found


def _converters(
    convert: Converter | BackConverter, file: Path, name: str, *, everyone: bool
) -> list[tuple[str, Converter | BackConverter]]:
    """What to convert of a file of a folder: the file, or each of its people where all are asked for."""
    try:
        people = _people(file) if everyone and isinstance(convert, Converter) else {}
    except SomaError:
        people = {}  # said when the file is converted
    if not people or not isinstance(convert, Converter):
        return [(name, convert)]
    if len(people) == 1:
        return [(name, convert.of_person(""))]
    return [(f"{name}/{called}", convert.of_person(person)) for person, called in people.items()]


def _converter(options: ConvertOptions, *, refuse_unused: bool = True) -> Converter | BackConverter:
    return Converter(options, refuse_unused=refuse_unused) if options.to == "soma" else BackConverter(options)


def _files(folder: Path) -> Iterator[Path]:
    """Files that may hold a motion, and folders of JSON frames, hidden ones apart, by their names."""
    suffixes = motion_suffixes()
    for file in sorted(folder.resolve().rglob("*")):
        hidden = any(part.startswith(".") for part in file.relative_to(folder.resolve()).parts)
        known = file.suffix.lower() in suffixes and file.is_file()
        if not hidden and (known or holds_pose_frames(file)):
            yield file


def _unforeseen(file: Path, error: Exception) -> SomaError:
    """What was not foreseen, as a sentence that names the file and the module where it happened."""
    _log.debug("%s", file, exc_info=error)
    module = next(
        (
            name
            for frame, _ in reversed([*traceback.walk_tb(error.__traceback__)])
            if (name := str(frame.f_globals.get("__name__"))).startswith("soma_core.")
        ),
        __name__,
    )
    told = " ".join(str(error).split())[:200] or "no text"
    return SomaError(
        f"{file}: {module} failed in a way that was not foreseen ({type(error).__name__}: {told}). "
        "Leave the file out, and report it with the file."
    )


def _row(
    convert: Converter | BackConverter, file: Path, out: Path, name: str, found: FolderConverted
) -> tuple[Mapping[str, Any], str]:
    """Convert one file of a folder; what becomes of it as a row of the report, and in words."""
    try:
        if layout_of(file) is None:
            reason, poses = no_motion(file)
            if poses:
                raise reason
            found.skipped.append(name)
            told = f"holds no motion: {reason.got}"
            return {"state": "skipped", "reason": told}, told
        converted = convert(file, ResultFiles.mirrored(out, name), out / "chunks" / name)
    except Exception as error:  # one file never ends a batch
        refusal = error if isinstance(error, SomaError) else _unforeseen(file, error)
        found.errors[name] = refusal
        return {"state": "failed", "reason": str(refusal)}, str(refusal)
    found.converted[name] = converted
    report = converted.report
    row = {"state": "converted", "layout": report["settings"]["layout"], "frames": report["frames"],
           "fps": report["settings"]["fps"], "error_mm": converted.error_mm}  # fmt: skip
    row |= {key: report[key] for key in ("warnings", "foot_slopes_degrees") if report.get(key)}
    return row, str(converted)
