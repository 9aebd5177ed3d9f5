"""Shards as a stream: every row once, in a seeded order, in parts that processes share, in bounded memory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from torch.utils.data import DataLoader

from soma_core.errors import AssetError, InputError
from soma_core.motion.clip_stream import ClipStream, shard_files

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

ROWS, GROUP = 23, 3


@pytest.fixture
def folder(tmp_path):
    """Three files of rows with a name, a number that may be null, and frames of vectors."""
    for file in range(3):
        names = [f"{file}-{row}" for row in range(ROWS)]
        frames = [[[float(row)] * 3] * (row % 4 + 1) for row in range(ROWS)]
        rate = [None if row % 5 == 0 else 30.0 for row in range(ROWS)]
        kind = pa.list_(pa.list_(pa.float32(), 3))
        table = pa.table({"name": names, "fps": rate, "transl": pa.array(frames, kind)})
        (tmp_path / "shards").mkdir(exist_ok=True)
        pq.write_table(table, tmp_path / f"shards/{file:06d}.parquet", row_group_size=GROUP)
    return tmp_path


def stream(folder, columns=("name", "fps", "transl"), seed=None):
    return ClipStream([folder], columns, seed=seed, setting="shards")


def names(rows):
    return [row["name"] for row in rows]


def test_rows_come_in_the_order_of_the_files_or_of_a_seed(folder):
    plain = list(stream(folder))
    assert names(plain) == [f"{file}-{row}" for file in range(3) for row in range(ROWS)]
    assert [row["row"] for row in plain] == list(range(3 * ROWS))
    assert "fps" not in plain[5]
    assert plain[6]["fps"] == 30.0
    assert plain[6]["transl"].shape == (3, 3)
    assert (plain[6]["transl"] == 6).all()
    first, again, other = (names(stream(folder, seed=seed)) for seed in (1, 1, 2))
    assert first == again
    assert first != other != names(plain)
    assert sorted(first) == sorted(names(plain))


@pytest.mark.parametrize("count", [1, 2, 5, 100])
def test_processes_share_all_rows_evenly(folder, count):
    shares = [names(stream(folder, seed=3).share(rank, count)) for rank in range(count)]
    assert [name for share in shares for name in share] == names(stream(folder, seed=3))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_workers_of_a_loader_share_the_rows_too(folder):
    whole = stream(folder, columns=["name"], seed=3)
    loaded = [row["name"] for row in DataLoader(whole, batch_size=None, num_workers=0)]
    assert loaded == names(whole)


@pytest.mark.slow
def test_workers_in_processes_share_the_rows_too(folder):
    whole = stream(folder, columns=["name"], seed=3)
    loader = DataLoader(whole, batch_size=None, num_workers=2, multiprocessing_context="spawn")
    assert sorted(row["name"] for row in loader) == sorted(names(whole))


def test_a_part_and_chosen_rows_keep_the_order(folder):
    whole = stream(folder, seed=4)
    assert names(whole.part(10, 17)) == names(whole)[10:17]
    chosen = np.array([5, 1, 60])
    order = [row["row"] for row in whole.of(chosen)]
    assert order == [row["row"] for row in whole if row["row"] in chosen]
    assert list(whole.part(4, 4)) == []


def test_one_row_group_is_in_memory(tmp_path):
    frames, rows = 2000, 40
    kind = pa.list_(pa.list_(pa.float32(), 3))
    one = pa.array(np.zeros((frames, 3), np.float32).tolist()).cast(pa.list_(pa.float32(), 3))
    with pq.ParquetWriter(tmp_path / "a.parquet", pa.schema({"transl": kind})) as writer:
        for _ in range(rows):
            writer.write_table(pa.table({"transl": pa.ListArray.from_arrays([0, frames], one).cast(kind)}))
    size = frames * 12
    before = pa.total_allocated_bytes()
    tracemalloc.start()
    most = 0
    for row in ClipStream([tmp_path], ["transl"], seed=0, setting="shards"):
        assert row["transl"].shape == (frames, 3)
        most = max(most, pa.total_allocated_bytes() - before)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 6 * size < rows * size / 4
    assert peak < 12 * size


def test_the_key_tells_other_shards(folder):
    key = stream(folder).key
    assert stream(folder, seed=9).key == key
    (folder / "shards/000001.parquet").unlink()
    assert stream(folder).key != key


def test_what_is_no_shard_is_named(folder, tmp_path):
    assert [file.name for file in shard_files(folder)] == [f"{file:06d}.parquet" for file in range(3)]
    assert shard_files(folder / "shards/000001.parquet") == [folder / "shards/000001.parquet"]
    with pytest.raises(InputError, match=r"shards: got .*none without a Parquet file, expected folders"):
        ClipStream([tmp_path / "none"], ["name"], seed=None, setting="shards")
    with pytest.raises(InputError, match=r"shards: got .*000000.parquet without the column 'poses'"):
        stream(folder, columns=["name", "poses"])
    (folder / "shards/000001.parquet").write_bytes(b"PAR1 no")
    with pytest.raises(AssetError, match=r"000001.parquet: cannot be read"):
        stream(folder)
