"""Conversion of the files of a folder, which is mirrored: here, by processes, or by Ray."""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import shutil
import traceback
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from soma_core.cache import UnwritableError, atomic_text
from soma_core.errors import InputError, SomaError
from soma_core.files import refuse_unreadable
from soma_core.io.json_frames import holds_pose_frames
from soma_core.io.point_files import is_one
from soma_core.motion.back import BackConverter
from soma_core.motion.conversion import EVERYONE, converter_for, people_names
from soma_core.motion.converter import Converted, Converter
from soma_core.motion.engines import run_job, usual_workers
from soma_core.motion.files import ResultFiles, layout_of, motion_suffixes, no_motion
from soma_core.motion.options import ConvertOptions, DatasetOptions
from soma_core.paths import expanded, fitting

__all__ = [
    "FolderConverted", "FolderJob", "Outcome", "convert_folder", "converters_of",
    "is_one_motion", "motion_paths", "outcome",
]  # fmt: skip

_log = logging.getLogger(__name__)

_FOR_A_PROCESS = 32
"""Files that are worth the seconds in which a process starts."""

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)

_TIMES = 3
"""How often a file may end the process that converts it: others than the file do so too."""


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
    files = [file for file in motion_paths(folder) if not file.is_relative_to(out.resolve())]
    if not files:
        raise InputError(
            str(folder),
            got=f"no file ending in {' or '.join(motion_suffixes())}",
            expected="motion files, at any depth",
            fix="Name the folder that holds them.",
        )
    options = DatasetOptions.of(options, **({} if isinstance(options, DatasetOptions) else {"workers": 1}))
    root, rows = folder.resolve(), dict[str, Outcome]()
    job = FolderJob(folder=root, out=out.resolve(), options=options)
    names = [file.relative_to(root).as_posix() for file in files]
    try:
        for number, outcomes in enumerate(_outcomes(job, names, options), start=1):
            for one in outcomes:
                rows[one.name] = one
                level = logging.WARNING if one.error is not None else logging.INFO
                _log.log(level, "%d of %d: %s: %s", number, len(files), one.name, one.told)
    finally:
        rows = dict(sorted(rows.items()))
        document = {"input": str(root), "files": {name: one.row for name, one in rows.items()}}
        atomic_text(out / "report.json", json.dumps(document, indent=2) + "\n")
    shutil.rmtree(out / "chunks", ignore_errors=True)
    return FolderConverted(
        converted={name: one.converted for name, one in rows.items() if one.converted is not None},
        errors={name: one.error for name, one in rows.items() if one.error is not None},
        skipped=[name for name, one in rows.items() if one.row["state"] == "skipped"],
    )


def _outcomes(job: FolderJob, names: Sequence[str], options: DatasetOptions) -> Iterator[list[Outcome]]:
    """What becomes of each file: by the engine, or here where there are few for a process to start for."""
    worth = options.workers or min(usual_workers(options), len(names) // _FOR_A_PROCESS)
    if options.engine == "local" and worth <= 1:
        return map(job.opened(), names)
    return run_job(job, names, options)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one motion of a folder.

    Attributes:
        name: of the file in the folder, and of the person in it.
        row: of the report.
        told: the same in words.
        converted: where it was.
        error: what was wrong where it could not be.
    """

    name: str
    row: Mapping[str, Any]
    told: str
    converted: Converted | None = None
    error: SomaError | None = None


@dataclass(frozen=True, kw_only=True)
class FolderJob:
    """The conversion of the files of a folder by their names, as plain values."""

    folder: Path
    out: Path
    options: DatasetOptions
    run: str = field(default_factory=lambda: uuid.uuid4().hex)

    def opened(self) -> Callable[[str], list[Outcome]]:
        """Load what all of them need."""
        convert = converter_for(self.options, refuse_unused=False)

        def do(name: str) -> list[Outcome]:
            file = self.folder / name
            return [
                outcome(converter, file, ResultFiles.mirrored(self.out, one),
                        self.out / "chunks" / fitting(one), one, run=self.run)
                for one, converter in converters_of(convert, file, name, self.options)
            ]  # fmt: skip

        return do


def converters_of(
    convert: Converter | BackConverter, file: Path, name: str, options: ConvertOptions
) -> list[tuple[str, Converter | BackConverter]]:
    """What to convert of a file of a folder: the file, or each of its people where all are asked for."""
    if options.person != EVERYONE or not isinstance(convert, Converter):
        return [(name, convert)]
    try:
        people = people_names(file)
    except SomaError:
        return [(name, convert)]  # said when the file is converted
    if len(people) == 1:
        return [(name, convert.of_person(""))]
    return [(f"{name}/{called}", convert.of_person(person)) for person, called in people.items()]


def is_one_motion(folder: Path, options: ConvertOptions) -> bool:
    """Whether a folder is one motion, with a file a frame or a view."""
    if options.points:
        return is_one(folder, views=options.camera is not None)
    return layout_of(folder) is not None


def motion_paths(folder: Path) -> Iterator[Path]:
    """Files that may hold a motion, and folders of JSON frames, hidden ones apart, by their names.

    Pipes, devices and links to nothing are among them, for the report to say so.
    """
    suffixes = motion_suffixes()
    for file in sorted(folder.resolve().rglob("*")):
        hidden = any(part.startswith(".") for part in file.relative_to(folder.resolve()).parts)
        known = file.suffix.lower() in suffixes and not file.is_dir()
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


def outcome(
    convert: Converter | BackConverter, file: Path, files: ResultFiles, chunks: Path, name: str, *, run: str
) -> Outcome:
    """Convert one file of many; what is wrong with it is told, and ends nothing.

    Args:
        convert: with what.
        file: what to convert.
        files: where its results go.
        chunks: folder for the finished parts of a fit, and for what tells how often it was begun.
        name: under which it is listed.
        run: name of the run; a file that ends its process a third time in one is refused.
    """
    try:
        if not file.is_dir():
            refuse_unreadable(file)
        if layout_of(file) is None:
            reason, poses = no_motion(file)
            if poses:
                raise reason
            told = f"holds no motion: {reason.got}"
            return Outcome(name=name, row={"state": "skipped", "reason": told}, told=told)
        with _begun(file, chunks, run):
            converted = convert(file, files, chunks)
    except Exception as error:  # one file never ends a batch
        refusal = error if isinstance(error, SomaError) else _unforeseen(file, error)
        if isinstance(error, OSError) and error.errno in _FULL:
            refusal = UnwritableError(chunks, error)
        row = {"state": "failed", "reason": str(refusal)}
        return Outcome(name=name, row=row, told=str(refusal), error=refusal)
    report = converted.report
    row = {"state": "converted", "layout": report["settings"]["layout"], "frames": report["frames"],
           "fps": report["settings"]["fps"], "error_mm": converted.error_mm}  # fmt: skip
    row |= {key: report[key] for key in ("warnings", "foot_slopes_degrees") if report.get(key)}
    return Outcome(name=name, row=row, told=str(converted), converted=converted)


@contextlib.contextmanager
def _begun(file: Path, chunks: Path, run: str) -> Iterator[None]:
    """Count how often a file was begun in this run and did not end, with no chunk finished in between.

    Raises:
        SomaError: too often: reading it ends the process.
    """
    mark, finished = chunks.with_name(f"{chunks.name}.{run}"), len([*chunks.glob("*.npz")])
    before = mark.read_text().split() if mark.is_file() else ["0", "-1"]
    times = int(before[0]) if int(before[1]) == finished else 0
    if times >= _TIMES:
        raise SomaError(
            f"{file}: ended the process that converted it {times} times. Leave the file out, and report it."
        )
    atomic_text(mark, f"{times + 1} {finished}\n")
    try:
        yield
    finally:
        mark.unlink(missing_ok=True)
