"""Clips of Parquet shards as a stream: in a seeded order, a part for each process, a row group in memory."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import IterableDataset, get_worker_info

from soma_core.cache import content_key
from soma_core.errors import AssetError, InputError
from soma_core.motion.clips import need_pyarrow, row_array
from soma_core.paths import expanded

__all__ = ["ClipStream", "shard_files"]


def shard_files(source: str | Path) -> list[Path]:
    """The Parquet files of a folder that ``soma convert output=parquet`` wrote, or of its shards; sorted."""
    path = expanded(source)
    if path.is_file():
        return [path] if path.suffix.lower() == ".parquet" else []
    return sorted(path.glob("*.parquet")) or sorted(path.glob("shards/*.parquet"))


class ClipStream(IterableDataset[dict[str, Any]]):
    """Rows of shards as ``{column: value}``, and ``row``, a number of their own; what is null is left out.

    Text and numbers are Python's, lists are arrays. Rows come a row group after the other, of which one is
    in memory: the groups in an order drawn from `seed`, and the rows of each. Workers of a ``DataLoader``
    share the rows among them.

    Args:
        sources: files and folders as :func:`shard_files` takes them.
        columns: to read.
        seed: of the order; None: that of the files.
        setting: that names the sources, for errors.

    Attributes:
        key: changes with names, sizes and rows of the files.
        rows: (n,) numbers of the rows in their order.

    Raises:
        InputError: no shards, a column that is missing, or pyarrow is not installed.
        AssetError: a file that cannot be read.
    """

    def __init__(
        self,
        sources: Sequence[str | Path],
        columns: Sequence[str],
        *,
        seed: int | None = None,
        setting: str = "sources",
    ) -> None:
        self._columns = list(columns)
        files = [file for source in sources for file in shard_files(source)]
        if not files:
            raise InputError(
                setting, got=f"{', '.join(map(str, sources))} without a Parquet file",
                expected="folders that soma convert output=parquet wrote", fix="Name them.",
            )  # fmt: skip
        self._groups: list[tuple[Path, int]] = []
        sizes: list[int] = []
        for file in files:
            counts = _group_sizes(file, self._columns, setting)
            self._groups += [(file, number) for number in range(len(counts))]
            sizes += counts
        self._begins = np.cumsum([0, *sizes])
        self.key = content_key(*([file.name, file.stat().st_size] for file in files), sizes)
        self.rows = np.arange(self._begins[-1])
        if seed is not None:
            random = np.random.default_rng(seed)
            parts = [self._begins[n] + random.permutation(sizes[n]) for n in random.permutation(len(sizes))]
            self.rows = np.concatenate([self.rows[:0], *parts])

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows)

    def of(self, rows: np.ndarray) -> ClipStream:
        """The stream of these rows alone, in the order of this one."""
        return self._with(self.rows[np.isin(self.rows, rows)])

    def part(self, start: int, stop: int) -> ClipStream:
        """Rows from a place in the order to another."""
        return self._with(self.rows[start:stop])

    def share(self, rank: int, count: int) -> ClipStream:
        """What one of `count` processes reads: as many rows as the others, and none of theirs."""
        return self.part(rank * len(self) // count, (rank + 1) * len(self) // count)

    def _with(self, rows: np.ndarray) -> ClipStream:
        other = copy.copy(self)
        other.rows = rows
        return other

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Read the rows."""
        worker = get_worker_info()
        own = self if worker is None else self.share(worker.id, worker.num_workers)
        groups = np.searchsorted(self._begins, own.rows, side="right") - 1
        ends = [*(np.flatnonzero(np.diff(groups)) + 1).tolist(), len(groups)]
        start = 0
        for stop in ends if len(groups) else ():
            group = int(groups[start])
            yield from self._read(group, own.rows[start:stop])
            start = stop

    def _read(self, group: int, rows: np.ndarray) -> Iterator[dict[str, Any]]:
        pa, (file, number) = need_pyarrow(), self._groups[group]
        try:
            with pa.parquet.ParquetFile(file) as stored:
                table = stored.read_row_group(number, columns=self._columns, use_threads=False)
        except (pa.ArrowException, OSError) as error:
            raise AssetError(file, cause=f"cannot be read ({error})", fix="Convert it again.") from error
        for row in rows.tolist():
            place = int(row - self._begins[group])
            found: dict[str, Any] = {"row": row}
            for name in self._columns:
                column = table.column(name).slice(place, 1).combine_chunks()
                if column[0].is_valid:
                    value = row_array(str(file), name, column)
                    found[name] = value.copy() if value.ndim else value.item()
            yield found


def _group_sizes(file: Path, columns: Sequence[str], setting: str) -> list[int]:
    """Rows of each row group of a file that has the columns."""
    pa = need_pyarrow()
    try:
        with pa.parquet.ParquetFile(file) as stored:
            missing = [name for name in columns if name not in stored.schema_arrow.names]
            sizes = [stored.metadata.row_group(n).num_rows for n in range(stored.num_row_groups)]
    except (pa.ArrowException, OSError) as error:
        raise AssetError(file, cause=f"cannot be read ({error})", fix="Convert it again.") from error
    if missing:
        raise InputError(
            setting, got=f"{file} without the column {missing[0]!r}",
            expected="shards that soma convert output=parquet wrote", fix="Convert the motions first.",
        )  # fmt: skip
    return sizes
