"""One file to a motion of this skeleton: rotations carried over, or its body fitted."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from soma_core.cache import atomic_text
from soma_core.errors import AssetError, InputError, SomaError
from soma_core.io.motion import Motion
from soma_core.io.motion_files import read_motion
from soma_core.json_file import read_json
from soma_core.motion.bodies import is_fitted, open_body
from soma_core.motion.carried import carried
from soma_core.motion.chunks import refuse_other_settings
from soma_core.motion.files import Layout, ResultFiles, layout_of, no_motion, read, turn_settings, write
from soma_core.motion.fit_job import FitJob, FitPlan, fit_settings, plan_body
from soma_core.motion.models import FitBackends
from soma_core.motion.options import ConvertOptions, FitOptions, InvertOptions
from soma_core.motion.pointed import from_points
from soma_core.motion.products import BodyProducts
from soma_core.motion.questions import Names, heard, of_motion, say, unused_settings
from soma_core.motion.smpl_input import SMPL_LAYOUTS
from soma_core.paths import expanded

__all__ = ["Converted", "Converter", "earlier_report", "finish_fit", "invert", "plan_fit"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class Converted:
    """What became of a file: its report, and whether an earlier run made it.

    Attributes:
        report: as it was written.
        files: where the results lie.
        earlier: whether an earlier run made it.
        vertices: whether they are the result, and no motion.
        written: the results, by what they are.
    """

    report: Mapping[str, Any]
    files: ResultFiles
    earlier: bool = False
    vertices: bool = False
    written: Mapping[str, Path] = field(default_factory=dict)

    def motion(self) -> Motion:
        """Read the motion that came out.

        Raises:
            AssetError: none did, or it is no longer there.
        """
        return read_motion(self.files.motion)

    @property
    def error_mm(self) -> Mapping[str, float | None] | None:
        """Figures of the error over the whole body; None where rotations were carried over."""
        return self.report.get("error_mm", {}).get("all")

    def __str__(self) -> str:
        settings, error, unit = self.report["settings"], self.error_mm, "mm"
        if "error_px" in self.report:
            error, unit = self.report["error_px"]["all"], "px"
        told = f"{settings['layout']}, {self.report['frames']} frames at {settings['fps']:g} fps"
        earlier = " (by an earlier run)" if self.earlier else ""
        if error is None:
            return f"{told}, {'posed' if self.vertices else 'rotations carried over'}{earlier}"
        if error["mean"] is None:
            return f"{told}, of which none could be used{earlier}"
        figures = f"mean {error['mean']:.3g}, P95 {error['p95']:.3g}, max {error['max']:.3g} {unit}"
        return f"{told}, fitted with an error of {figures}{earlier}"


class Converter:
    """Converts one file after another to motions of this skeleton; backends and fits serve all of them.

    Args:
        options: of the conversion.
        refuse_unused: whether settings are refused that do not apply to a file; otherwise it is said.
    """

    def __init__(self, options: ConvertOptions, *, refuse_unused: bool = True) -> None:
        self._options, self._backends, self._refuse_unused = options, FitBackends(options), refuse_unused
        self._products = BodyProducts(options) if options.shown else None

    def of_person(self, person: str) -> Converter:
        """The same for one person of a file of several, with the same backends and fits."""
        other = Converter(replace(self._options, person=person or None), refuse_unused=self._refuse_unused)
        other._backends = self._backends
        return other

    def __call__(self, path: Path, files: ResultFiles, chunks: Path) -> Converted:
        """Convert a file.

        A body that was fitted before, with the same settings, is not fitted again.

        Args:
            path: what to convert.
            files: where the results go.
            chunks: folder for the finished parts of a fit, until its end.

        Raises:
            SomaError: the file, or the backend that it needs, cannot be used.
            InputError: it holds no motion, or was fitted before with other settings.
        """
        before = _products_before(files.report)
        if self._options.points is not None:
            return self._pointed(path, files, before)
        layout, options = _known_layout(path), self._options
        retargeted = layout == "skeleton" or (layout in SMPL_LAYOUTS and options.carry == "skeleton")
        fitted = is_fitted(layout) and not retargeted
        with heard() as said:
            unused_settings(path, layout, options, refuse=self._refuse_unused)
            if retargeted:
                found = _retargeted(path, layout, options, files, said)
            elif not fitted:
                found = self._carry_over(path, layout, files, said)
        if fitted:
            _refuse_chosen(path, options)
            found = self._fitted(path, layout, files, chunks)
        written = {"npz": files.motion}
        if self._products is not None:
            report = dict(found.report)
            written |= self._products(path, files, report, before, fitted=fitted)
            found = replace(found, report=report)
        return replace(found, written=written)

    def _pointed(self, path: Path, files: ResultFiles, before: Mapping[str, Any]) -> Converted:
        """Fit a motion to the points of a file; its products are posed like those of rotations."""
        with heard() as said:
            found = points_to_motion(path, self._options, files, said, person=self._options.person)
        written = dict(found.written)
        if self._products is not None:
            report = dict(found.report)
            written |= self._products(path, files, report, before, fitted=False)
            found = replace(found, report=report)
        return replace(found, written=written)

    def _fitted(self, path: Path, layout: Layout, files: ResultFiles, chunks: Path) -> Converted:
        """Fit the body of a file, or find that it was."""
        options = self._options
        with heard() as said:
            body = open_body(path, layout, options, self._backends)
        earlier = _fitted_before(path, files, fit_settings(path, layout, body, options))
        if earlier is not None:
            return earlier
        with heard() as also:
            plan = plan_body(path, layout, body, options, files, chunks)
        said += also
        return _finished(FitJob(plan=replace(plan, warnings=tuple(said)), body=body))

    def _carry_over(self, path: Path, layout: Layout, files: ResultFiles, said: list[str]) -> Converted:
        """Write the rotations of a file on this skeleton as they are, in metres."""
        options = self._options
        motion = read(
            path, fps=options.fps, unit=options.unit, angles=options.angles, convention=options.convention,
            person=options.person, rotation_layout=options.rotation_layout, swap_sides=options.swap_sides,
        )  # fmt: skip
        say(path.name, of_motion(motion, Names(turns=turn_settings(layout))))
        write(motion, files.motion)
        report = {
            "settings": {"input": str(path.resolve()), "layout": layout, "fps": motion.fps},
            "frames": motion.frame_count,
            "convention": motion.convention,
            "identity": motion.identity.get("backend"),
            "rotations": "carried over as they are",
            "warnings": said,
        }
        atomic_text(files.report, json.dumps(report, indent=2) + "\n")
        return Converted(report=report, files=files)


def _fitted_before(path: Path, files: ResultFiles, settings: Mapping[str, Any]) -> Converted | None:
    """What an earlier run with the same settings made of the file; its doubts are said again.

    Raises:
        InputError: the earlier run had other settings.
        SomaError: its fit is none.
    """
    earlier = earlier_report(files.report, {"npz": files.motion}, settings)
    if earlier is None:
        return None
    _log.info("%s: %s is by an earlier run with the same settings", path.name, files.motion)
    for warning in earlier.get("warnings", ()):
        _log.warning("%s", warning)
    _refuse_failed(path, earlier, files.report)
    return Converted(report=earlier, files=files, earlier=True)


def _products_before(report: Path) -> Mapping[str, Any]:
    """What an earlier report says of products; nothing where there is none of ours."""
    try:
        return dict(_read_report(report)["products"])
    except (SomaError, OSError, ValueError, KeyError, TypeError):
        return {}


def _refuse_chosen(path: Path, options: ConvertOptions) -> None:
    """Refuse a backend for a file that tells its own body; that of SAM 3D Body may need options.

    Raises:
        InputError: one was chosen.
    """
    chosen = options.backend
    if chosen is not None and chosen.name != "mhr" and options.identity.method == "known":
        raise InputError(
            "backend", got=chosen.name, expected=f"none: {path.name} tells whose body it shows",
            fix="Convert it first; then soma animate motion=FILE shows it on another body.",
        )  # fmt: skip


def _retargeted(
    path: Path, layout: Layout, options: ConvertOptions, files: ResultFiles, said: list[str]
) -> Converted:
    """Write the motion of another skeleton, and what became of each of its joints."""
    found = carried(path, layout, options)
    write(found.motion, files.motion)
    settings = {"input": str(path.resolve()), "layout": layout, "fps": found.motion.fps}
    report = {"settings": settings, "frames": found.motion.frame_count, "identity": None,
              "rotations": "carried over by the skeleton", **found.report, "warnings": said}  # fmt: skip
    atomic_text(files.report, json.dumps(report, indent=2) + "\n")
    return Converted(report=report, files=files)


def _known_layout(path: Path) -> Layout:
    """Layout of a file that must hold a motion.

    Raises:
        InputError: it holds none.
    """
    layout = layout_of(path)
    if layout is None:
        raise no_motion(path)[0]
    return layout


def invert(source: str | Path, out: str | Path, *, options: InvertOptions | None = None) -> Converted:
    """Find the pose of every frame of a moving mesh; write the motion, the errors and a report.

    Frames are read, fitted and stored chunk by chunk, so memory does not grow with their number. Finished
    chunks stay in ``out/chunks`` until the end: the same call goes on after them.

    Args:
        source: an ``.npz`` or ``.npy`` of vertices, a folder of meshes, a ``.usd`` or a ``.glb``.
        out: folder of the results.
        options: of the fit.

    Raises:
        SomaError: the backend or the file cannot be used, or the fit is none; what there is of it is
            written all the same.
    """
    source, out, options = expanded(source), Path(out), InvertOptions.or_default(options)
    files = ResultFiles.of_folder(out)
    if options.points is not None:
        with heard() as said:
            return points_to_motion(source, options, files, said)
    with heard() as said:
        body = open_body(source, "vertices", options)
    with body.posed.sequence as shown:
        _log.info(
            "%s: %d frames of %d vertices (%s) at %g fps",
            source.name, shown.frame_count, shown.vertex_count, body.posed.topology, shown.fps,
        )  # fmt: skip
        earlier = _fitted_before(source, files, fit_settings(source, "vertices", body, options))
        if earlier is not None:
            return earlier
        with heard() as also:
            plan = plan_body(source, "vertices", body, options, files, out / "chunks")
        return _finished(FitJob(plan=replace(plan, warnings=(*said, *also)), body=body))


def plan_fit(
    source: str | Path, out: str | Path, *, options: ConvertOptions | InvertOptions | None = None
) -> FitPlan:
    """Plan a fit whose chunks other processes do: :func:`fit_chunks` in them, :func:`finish_fit` at the end.

    Args:
        source: a file of AMASS or SAM 3D Body, or with ``InvertOptions`` vertices over time.
        out: folder of the results, which all processes must reach.
        options: of the conversion, or of the fit to vertices.

    Raises:
        SomaError: the backend or the file cannot be used.
        InputError: the file is of this skeleton, and needs no fit.
    """
    source, out = (
        expanded(source).resolve(),
        Path(out).resolve(),
    )  # another process may stand elsewhere
    if not isinstance(options, InvertOptions):
        options = ConvertOptions.or_default(options)
    layout = "vertices" if isinstance(options, InvertOptions) else _known_layout(source)
    if not is_fitted(layout):
        raise InputError(
            str(source), got=f"the layout {layout}", expected="a body to fit", fix="Convert or read it."
        )
    with heard() as said:
        body = open_body(source, layout, options)
        with body.posed.sequence:
            plan = plan_body(source, layout, body, options, ResultFiles.of_folder(out), out / "chunks")
    return replace(plan, warnings=tuple(said))


def finish_fit(plan: FitPlan) -> Converted:
    """Fit what is missing of a plan, and join its chunks into the files of the result.

    Raises:
        SomaError: the fit is none; what there is of it is written all the same.
    """
    body = open_body(plan.source, plan.layout, plan.options)
    with body.posed.sequence:
        return _finished(FitJob(plan=plan, body=body))


def _finished(job: FitJob) -> Converted:
    job.fit_missing()
    summary, plan = job.write_results(), job.plan
    vertices = plan.layout == "vertices"
    for line in summary.as_text().splitlines() if vertices else ():
        _log.info("%s", line)
    report = _read_report(plan.files.report)
    _refuse_failed(plan.source, report, plan.files.report)
    return Converted(report=report, files=plan.files)


def earlier_report(
    file: Path, results: Mapping[str, Path], settings: Mapping[str, Any]
) -> dict[str, Any] | None:
    """The report `file` if an earlier run left it and `results`, with the same settings for the same input.

    Raises:
        InputError: the earlier run had other settings.
    """
    if not file.is_file() or not all(result.exists() for result in results.values()):
        return None
    try:
        report = _read_report(file)
        before = dict(report["settings"])
    except (AssetError, ValueError, KeyError, TypeError):
        return None  # no report of ours
    now = json.loads(json.dumps(settings, default=str))
    before.pop("found", None)
    if before.pop("content", None) != now.pop("content"):
        return None  # the file was written anew
    refuse_other_settings(file, before, now)
    return report


def points_to_motion(
    path: Path, options: FitOptions, files: ResultFiles, said: list[str], *, person: str | None = None
) -> Converted:
    """Write the motion that was fitted to the points of a file, and a report."""
    found = from_points(path, options, person=person)
    write(found.motion, files.motion)
    settings = {"input": str(path.resolve()), "layout": "points", "fps": found.motion.fps}
    report = {"settings": settings, "frames": found.motion.frame_count, **found.report,
              "warnings": said}  # fmt: skip
    atomic_text(files.report, json.dumps(report, indent=2) + "\n")
    return Converted(report=report, files=files, written={"npz": files.motion})


def _refuse_failed(path: Path, report: Mapping[str, Any], file: Path) -> None:
    """Refuse a fit that is none.

    Raises:
        SomaError: what is wrong with it.
    """
    found = report.get("diagnosis")
    if found and found["failed"]:
        raise SomaError(f"{path}: {found['sentence']}; {file} has the figures.")


def _read_report(path: Path) -> dict[str, Any]:
    return dict(read_json(path, fix="Delete it."))
