"""``soma convert``: motions of other tools to this skeleton, one file or a folder of them."""

from __future__ import annotations

import json
import logging
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from soma_core.cache import atomic_write
from soma_core.errors import AssetError, InputError, SomaError
from soma_core.tasks.convert_back import BackConverter
from soma_core.tasks.convert_file import SUFFIXES, Converter, layout_of
from soma_core.tasks.fit_job import ResultFiles

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["run"]

_log = logging.getLogger(__name__)

_CONVERTED, _SKIPPED, _FAILED = "converted", "skipped", "failed"


def run(config: DictConfig, output: Path) -> None:
    """Convert ``config.input``.

    A file gives motion.npz and report.json in `output`, and frames.npz and errors.png where a body was
    fitted. A folder is mirrored: ``motions`` and ``reports`` hold a file for each of its files, and
    report.json lists them all. What is there already from a run with the same settings is not done again.

    Raises:
        SomaError: the input, or the backend that it needs, cannot be used; in a folder, after the others.
    """
    path = _input(config)
    try:
        if path.is_dir():
            _convert_folder(config, path, output)
        else:
            converted = _converter(config)(path, ResultFiles.of_folder(output), output / "chunks")
            _log.info("%s: %s", path.name, converted)
    except KeyboardInterrupt:
        _log.warning("stopped; the same command with out=%s goes on from here", output)
        raise


def _converter(config: DictConfig) -> Converter | BackConverter:
    return Converter(config) if config.to == "soma" else BackConverter(config)


def _input(config: DictConfig) -> Path:
    if config.chunk < 1:
        raise InputError("chunk", got=config.chunk, expected="at least 1", fix="Try chunk=256.")
    if not config.input:
        raise InputError(
            "input", got="none", expected="a motion file, or a folder of them", fix="Pass input=FILE."
        )
    _refuse_unused(config)
    path = Path(config.input).expanduser()
    if not path.exists():
        raise AssetError(path, cause="file is missing", fix="Check the path.")
    return path


def _refuse_unused(config: DictConfig) -> None:
    """Refuse settings of the other direction, which would change nothing."""
    back, method = config.to != "soma", str(config.identity.method)
    sought = None if method == "known" else method
    if back:
        unused, why = {"identity.method": sought, "most_betas": config.most_betas}, f"to={config.to}"
    else:
        placed = None if str(config.translation) == "motion" else str(config.translation)
        unused = {"betas": config.betas, "result": config.result, "translation": placed}
        if config.backend is not None and sought is None and config.backend.name != "mhr":
            unused["backend"] = config.backend.name  # a file tells its own model
        why = "to=soma" if sought else "to=soma and identity=known"
    for name, value in unused.items():
        if value is not None:
            raise InputError(
                name, got=str(value), expected=f"none with {why}", fix=f"Leave {name.partition('.')[0]} out."
            )


def _convert_folder(config: DictConfig, folder: Path, output: Path) -> None:
    """Convert every file in a folder; those that cannot be are left out and listed."""
    files = [file for file in _files(folder) if not file.is_relative_to(output.resolve())]
    if not files:
        raise InputError(
            str(folder),
            got=f"no file ending in {' or '.join(SUFFIXES)}",
            expected="motion files, at any depth",
            fix="Name the folder that holds them.",
        )
    convert, rows, errors = _converter(config), {}, []
    try:
        for number, file in enumerate(files, start=1):
            name = file.relative_to(folder.resolve()).as_posix()
            rows[name], told = _row(convert, file, output, name, errors)
            level = logging.WARNING if rows[name]["state"] == _FAILED else logging.INFO
            _log.log(level, "%d of %d: %s: %s", number, len(files), name, told)
    finally:
        _write_rows(output / "report.json", folder, rows)
    shutil.rmtree(output / "chunks", ignore_errors=True)
    counts = Counter(row["state"] for row in rows.values())
    told = [f"{counts[state]} {state}" for state in (_CONVERTED, _SKIPPED, _FAILED) if counts[state]]
    _log.info("%s: %s", folder, ", ".join(told))
    if counts[_SKIPPED] == counts.total():
        raise InputError(
            str(folder), got=f"{counts.total()} files without a motion", expected="motion files",
            fix="soma convert input=FILE says what is missing in one of them.",
        )  # fmt: skip
    if not counts[_FAILED]:
        return
    if len(errors) == counts.total():
        raise errors[0]
    report, failed = output / "report.json", f"{counts[_FAILED]} of {counts.total()} files"
    raise SomaError(f"{failed} could not be converted, {report} lists them. The first: {errors[0]}")


def _files(folder: Path) -> Iterator[Path]:
    """Files that may hold a motion, hidden ones apart, in the order of their names."""
    for file in sorted(folder.resolve().rglob("*")):
        hidden = any(part.startswith(".") for part in file.relative_to(folder.resolve()).parts)
        if file.suffix.lower() in SUFFIXES and not hidden and file.is_file():
            yield file


def _row(
    convert: Converter | BackConverter, file: Path, output: Path, name: str, errors: list[SomaError]
) -> tuple[dict[str, Any], str]:
    """Convert one file of a folder; what becomes of it as a row of the report, and in words."""
    try:
        if layout_of(file) is None:
            return {"state": _SKIPPED, "reason": "holds no motion"}, "holds no motion"
        converted = convert(file, _mirrored(output, name), output / "chunks" / name)
    except SomaError as error:
        errors.append(error)
        return {"state": _FAILED, "reason": str(error)}, str(error)
    report = converted.report
    row = {"state": _CONVERTED, "layout": report["settings"]["layout"], "frames": report["frames"],
           "fps": report["settings"]["fps"], "error_mm": converted.error_mm}  # fmt: skip
    return row, str(converted)


def _mirrored(output: Path, name: str) -> ResultFiles:
    """Where the results of the file `name` of a folder go."""
    if not name.lower().endswith(".npz"):
        name = f"{name}.npz"
    report = output / "reports" / name
    return ResultFiles(
        motion=output / "motions" / name,
        vertices=output / "vertices" / name,
        frames=report.with_suffix(".frames.npz"),
        report=report.with_suffix(".json"),
        picture=report.with_suffix(".png"),
    )


def _write_rows(path: Path, folder: Path, rows: dict[str, Any]) -> None:
    document = {"input": str(folder.resolve()), "files": rows}
    text = json.dumps(document, indent=2) + "\n"
    atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8") and None)
