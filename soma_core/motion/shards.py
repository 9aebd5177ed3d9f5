"""A folder or a Parquet data set to Parquet shards: planned, converted by an engine, never done twice."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from soma_core.cache import UnwritableError, atomic_text, atomic_write, file_sha256
from soma_core.errors import AssetError, InputError
from soma_core.files import refuse_unreadable
from soma_core.motion.chunks import refuse_other_settings
from soma_core.motion.clips import Clips, need_pyarrow, refused, row_tables, write_rows
from soma_core.motion.engines import need_ray, pool_settings, run_job
from soma_core.motion.files import motion_suffixes
from soma_core.motion.folder import is_one_motion, motion_paths
from soma_core.motion.options import ConvertOptions, DatasetOptions
from soma_core.parquet_file import look_through
from soma_core.paths import expanded
from soma_core.progress import progress
from soma_core.rig import load_canonical

if TYPE_CHECKING:
    import pyarrow as pa
    from ray.data import Dataset

__all__ = ["ShardJob", "ShardsConverted", "clip_count", "convert_dataset", "convert_shards"]

Entry = tuple[str, int, int]
"""What a shard is made from: a file by its name; of a Parquet file of clips also which rows, else 0, 0."""

_NOT_DECISIVE = ("engine", "output", "workers", "num_gpus", "address", "picture", "write")
"""Settings that change nothing about a row."""


@dataclass(frozen=True, kw_only=True)
class ShardsConverted:
    """What became of a data set.

    Attributes:
        shards: the Parquet files, in the order of the plan.
        counts: how many clips were ``converted``, ``failed`` and ``skipped``, by all runs.
        failed: why those that failed did, by name.
        earlier: shards that were there already.
    """

    shards: Sequence[Path]
    counts: Mapping[str, int]
    failed: Mapping[str, str]
    earlier: int


def convert_shards(
    source: str | Path, out: str | Path, *, options: DatasetOptions | None = None
) -> ShardsConverted:
    """Convert a folder, or a Parquet file of clips, to Parquet shards with a row a clip.

    ``out/shards`` holds the plan and for each shard that is finished a Parquet file and a record of what it
    was made from, by content: the same call goes on where an earlier one was stopped. Files that are new
    make new shards; of files that changed, the shards are made again.

    Args:
        source: motion files and Parquet files of clips at any depth, or one such Parquet file.
        out: folder of the results, which all workers reach.
        options: of the conversion, and who does it.

    Raises:
        InputError: no file may hold a motion, or `out` belongs to a run with other settings, which are named.
        UnwritableError: the disk is full; what is finished stays.
    """
    source, out, options = expanded(source).resolve(), Path(out).resolve(), DatasetOptions.of(options)
    need_pyarrow()
    one = not source.is_dir() or is_one_motion(source, options)
    root = source.parent if one else source
    job = ShardJob(folder=root, out=out, options=options)
    shards = _planned(source, root, out, options)
    missing = [(number, entries) for number, entries in shards.items() if not _finished(job, number, entries)]
    done = len(shards) - len(missing)
    results = run_job(job, missing, options)
    for _ in progress(results, label="shard", total=len(shards), done=done) if missing else ():
        pass
    shutil.rmtree(out / "work", ignore_errors=True)
    rows: dict[str, Any] = {}
    for number in shards:
        rows |= job.record(number)["rows"]
    rows = dict(sorted(rows.items()))
    atomic_text(out / "report.json", json.dumps({"input": str(source), "files": rows}, indent=2) + "\n")
    return ShardsConverted(
        shards=[job.shard(number) for number in shards], earlier=done,
        counts=Counter(row["state"] for row in rows.values()),
        failed={name: row["reason"] for name, row in rows.items() if row["state"] == "failed"},
    )  # fmt: skip


def _settings(source: Path, options: DatasetOptions) -> dict[str, Any]:
    """What decides the rows, by the names on the command line."""
    plain = json.loads(json.dumps(asdict(options), default=str))
    plain = {name: value for name, value in plain.items() if name not in _NOT_DECISIVE}
    for name in [name for name, value in plain.items() if isinstance(value, dict)]:
        plain |= {f"{name}.{key}": value for key, value in plain.pop(name).items()}
    return {"input": str(source), "rig": load_canonical("mid")[1].revision, **plain}


def _planned(source: Path, root: Path, out: Path, options: DatasetOptions) -> dict[int, list[Entry]]:
    """The shards by number: those of an earlier run as they were, and new ones for what is new.

    Raises:
        InputError: the earlier run had other settings, or there is no file.
    """
    here, settings = dict.fromkeys(_entries(source, root, out, options.shard)), _settings(source, options)
    if not here:
        raise InputError(
            str(source), got=f"no file ending in {' or '.join(motion_suffixes())}",
            expected="motion files, at any depth", fix="Name the folder that holds them.",
        )  # fmt: skip
    file, lines = out / "shards/plan.jsonl", [json.dumps(settings)]
    if file.is_file():
        lines = file.read_text(encoding="utf-8").splitlines()
        refuse_other_settings(out, json.loads(lines[0]), settings)
    before = [[(name, start, stop) for name, start, stop in json.loads(line)] for line in lines[1:]]
    known = {entry for entries in before for entry in entries}
    new = _shards([entry for entry in here if entry not in known], options.shard)
    lines += [json.dumps(entries) for entries in new]
    atomic_text(file, "\n".join(lines) + "\n")
    left = [[entry for entry in entries if entry in here] for entries in before]
    return {number: entries for number, entries in enumerate([*left, *new]) if entries}


def _shards(entries: Sequence[Entry], size: int) -> list[list[Entry]]:
    """Entries by shards: rows of a Parquet file are one already, files come `size` together."""
    files = [entry for entry in entries if not entry[2]]
    return [
        *(files[start : start + size] for start in range(0, len(files), size)),
        *([entry] for entry in entries if entry[2]),
    ]


def _entries(source: Path, root: Path, out: Path, size: int) -> Iterator[Entry]:
    """What there is to convert, in the order of the names."""
    for file in motion_paths(root) if source == root else [source]:
        if file.is_relative_to(out):
            continue
        name = file.relative_to(root).as_posix()
        rows = clip_count(file)
        if rows is None:
            yield name, 0, 0
        for start in range(0, rows or 0, size):
            yield name, start, min(start + size, rows or 0)


def clip_count(file: Path) -> int | None:
    """Rows of a Parquet file of clips; None for other files: frames of one person are a file as any other."""
    if file.suffix.lower() != ".parquet" or not file.is_file():
        return None
    need_pyarrow()
    try:
        names, rows = look_through(file)
    except AssetError:
        return None  # said when it is converted
    return None if "pred_vertices" in names else rows


def _finished(job: ShardJob, number: int, entries: Sequence[Entry]) -> bool:
    """Whether a shard is there, whole, and made from what is there now; a stale record is deleted."""
    record = job.record(number)
    if not record:
        return False
    file = job.shard(number)
    whole = file.is_file() and file.stat().st_size == record["bytes"]
    same = [list(entry) for entry in entries] == record["entries"]
    if (
        whole
        and same
        and all(_unchanged(job.folder / name, state) for name, state in record["inputs"].items())
    ):
        return True
    job.record_file(number).unlink()
    return False


def _unchanged(file: Path, state: Mapping[str, Any]) -> bool:
    """Whether a file is as it was, by size and time of change, or else by content."""
    if _stat(file) == [state["bytes"], state["changed"]]:
        return True
    return _stat(file)[0] == state["bytes"] and _digest(file) == state["sha256"]


def _parts(file: Path) -> list[Path]:
    """A file, or those of a folder that is one motion."""
    return sorted(part for part in file.rglob("*") if part.is_file()) if file.is_dir() else [file]


def _stat(file: Path) -> list[int]:
    """Size [bytes] and time of change."""
    found = [part.stat() for part in _parts(file)]
    return [sum(each.st_size for each in found), max((each.st_mtime_ns for each in found), default=0)]


def _digest(file: Path) -> str:
    """SHA-256 of the content, of a folder of the names and contents in it."""
    if not file.is_dir():
        return file_sha256(file)
    told = "\n".join(f"{part.relative_to(file).as_posix()} {file_sha256(part)}" for part in _parts(file))
    return hashlib.sha256(told.encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class ShardJob:
    """The conversion of shards by their entries, as plain values.

    Attributes:
        folder: that the entries lie in.
        out: of the results; each finished shard is there whole, with its record.
        options: of the conversion.
        run: its name.
    """

    folder: Path
    out: Path
    options: DatasetOptions
    run: str = field(default_factory=lambda: uuid.uuid4().hex)

    def shard(self, number: int) -> Path:
        """Where a shard is."""
        return self.out / f"shards/{number:06d}.parquet"

    def record_file(self, number: int) -> Path:
        """Where its record is, which is written last."""
        return self.shard(number).with_suffix(".json")

    def record(self, number: int) -> dict[str, Any]:
        """What a finished shard was made from and holds; nothing of one that is not finished."""
        try:
            return dict(json.loads(self.record_file(number).read_text(encoding="utf-8")))
        except (OSError, ValueError):
            return {}

    def opened(self) -> Callable[[tuple[int, list[Entry]]], int]:
        """Load what all shards need."""
        clips = Clips(self.options, self.run)

        def do(item: tuple[int, list[Entry]]) -> int:
            number, entries = item
            if not self.record(number):
                _Shard(self, clips, number, entries).write()
            return number

        return do


@dataclass(frozen=True)
class _Shard:
    """One shard in the making; what is finished of its clips is kept in a folder until its end."""

    job: ShardJob
    clips: Clips
    number: int
    entries: Sequence[Entry]

    def write(self) -> None:
        """Convert the clips; write the shard, then its record."""
        inputs, rows = dict[str, Any](), dict[str, Any]()
        file, work = self.job.shard(self.number), self.job.out / f"work/{self.number:06d}"
        atomic_write(file, lambda path: write_rows(path, self._tables(work, inputs, rows)))
        record = {"entries": self.entries, "inputs": inputs, "bytes": file.stat().st_size,
                  "sha256": file_sha256(file), "rows": rows}  # fmt: skip
        atomic_text(self.job.record_file(self.number), json.dumps(record) + "\n")
        shutil.rmtree(work, ignore_errors=True)

    def _tables(self, work: Path, inputs: dict[str, Any], rows: dict[str, Any]) -> Iterator[pa.Table]:
        for number, (name, start, stop) in enumerate(self.entries):
            file, place = self.job.folder / name, work / str(number)
            try:
                if not file.is_dir() and not file.is_file():
                    refuse_unreadable(file)
                size, changed = _stat(file)
                inputs[name] = {"bytes": size, "changed": changed, "sha256": _digest(file)}
            except OSError as error:
                yield from refused(name, error, rows)
                continue
            except AssetError as error:  # whose path is that of this machine
                yield from refused(name, AssetError(name, cause=error.cause, fix=error.fix), rows)
                continue
            if not stop:
                yield from self.clips(file, name, place, rows, inputs[name]["sha256"])
                continue
            try:
                for row, columns in enumerate(_rows(file, start, stop), start):
                    yield from row_tables(self.clips, columns, f"{name}/{row}", place / str(row), rows)
            except UnwritableError:
                raise
            except Exception as error:  # what pyarrow raises of a damaged file is of many kinds
                yield from refused(f"{name}/{start}-{stop}", error, rows)


def _rows(file: Path, start: int, stop: int) -> Iterator[dict[str, pa.Array]]:
    """Some rows of a Parquet file, each as columns of one entry; a few are in memory at a time."""
    with need_pyarrow().parquet.ParquetFile(file) as stored:
        counts = [stored.metadata.row_group(group).num_rows for group in range(stored.num_row_groups)]
        begins = [sum(counts[:group]) for group in range(len(counts))]
        groups = [n for n, at in enumerate(begins) if at < stop and start < at + counts[n]]
        at = begins[groups[0]]
        for batch in stored.iter_batches(batch_size=8, row_groups=groups, use_threads=False):
            for row in range(max(start - at, 0), min(stop - at, len(batch))):
                yield {name: batch.column(name).slice(row, 1) for name in batch.schema.names}
            at += len(batch)


def convert_dataset(ds: Dataset, options: ConvertOptions | None = None) -> Dataset:
    """Convert a data set of clips with Ray Data: a row a clip, in the schema of the shards.

    Lazy, as Ray's own transforms; a pool of actors holds the models, and Ray does again what a lost one did.
    A clip that cannot be converted is a row whose ``state`` says so and ``reason`` why.

    Args:
        ds: rows of ``path``, a file that every node reaches; or of ``bytes``, a file's content, beside a
            ``path`` or ``name`` that tells its format; or of the arrays of a motion file. Read Parquet with
            ``override_num_blocks``, or it is one block, which one actor does.
        options: of the conversion; of :class:`DatasetOptions` also ``workers`` and ``num_gpus``.

    Raises:
        InputError: Ray is not installed.
    """
    need_ray()
    chosen = DatasetOptions.of(options, engine="ray", output="parquet")
    settings = pool_settings(chosen)
    return ds.map_batches(
        _ClipActor, fn_constructor_args=(chosen, uuid.uuid4().hex), batch_size=1, batch_format="pyarrow",
        **settings,
    )  # fmt: skip


class _ClipActor:
    """A pool's actor: rows in, rows out."""

    def __init__(self, options: DatasetOptions, run: str) -> None:
        import torch

        torch.set_num_threads(1)
        self._clips, self._work = Clips(options, run), Path(tempfile.gettempdir()) / f"soma-{run}"

    def __call__(self, table: pa.Table) -> Iterator[pa.Table]:
        """The rows of each row."""
        for number in range(len(table)):
            row = {name: table.column(name).combine_chunks().slice(number, 1) for name in table.column_names}
            content = repr([(name, value.to_pylist()) for name, value in row.items()])
            work = self._work / hashlib.sha256(content.encode()).hexdigest()[:32]
            yield from self._one(row, work)
            shutil.rmtree(work, ignore_errors=True)

    def _one(self, row: Mapping[str, pa.Array], work: Path) -> Iterator[pa.Table]:
        if set(row) != {"path"}:
            yield from row_tables(self._clips, row, "", work, {})
            return
        name = str(row["path"][0].as_py())
        try:
            digest = _digest(expanded(name))
        except OSError as error:
            yield from refused(name, error, {})
            return
        yield from self._clips(expanded(name), name, work, {}, digest)
