"""A data set to shards: what a row holds, what is never done again, what is refused; engines that agree."""

from __future__ import annotations

import errno
import importlib.util
import os
import pickle
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_core import load_canonical
from soma_core.cache import UnwritableError, file_sha256
from soma_core.errors import InputError, SomaError
from soma_core.io import read_motion, write_motion
from soma_core.motion import DatasetOptions, clips, convert_folder, convert_shards, engines, folder, shards
from soma_core.motion.converter import Converted
from soma_core.motion.files import ResultFiles
from soma_core.paths import assets_dir
from tests.hostile.corpus import FILES
from tests.motion.test_converter import motion

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

VECTOR_RADIANS = 2e-6
"""A rotation vector in float32, up to a half turn long, keeps this of a matrix in float32."""


@pytest.fixture
def here(monkeypatch):
    """Shards are made in this process; the numbers of those that were."""
    made = []

    def run(job, items, options):
        do = job.opened()
        for item in items:
            made.append(item[0])
            yield do(item)

    monkeypatch.setattr(shards, "run_job", run)
    return made


@pytest.fixture
def data(tmp_path):
    """Five files, one broken and one without a motion."""
    root = tmp_path / "data"
    (root / "sub").mkdir(parents=True)
    for number, name in enumerate(("a", "b", "sub/c")):
        identity = {
            "backend": "soma", "params": {"shape": [float(number)]}, "options": {"a": 1},
            "rest": np.ones((4, 3)), "scale_params": np.ones((1, 68)),
        }  # fmt: skip
        recorded = {"contacts": np.eye(number + 3, 4, dtype=bool), "skeleton": np.ones((77, 3))}
        write_motion(motion(frames=number + 3, identity=identity, **recorded), root / f"{name}.npz")
    (root / "broken.bvh").write_text("HIERARCHY\nno")
    np.savez(root / "shape.npz", betas=np.zeros(3))
    return root


def options(**changes):
    return DatasetOptions(**{"output": "parquet", "shard": 2, **changes})


def rows_of(out):
    return [row for file in sorted(out.glob("shards/*.parquet")) for row in pq.read_table(file).to_pylist()]


def digests(out):
    return {file.name: file_sha256(file) for file in out.glob("shards/*.parquet")}


def test_a_row_is_the_motion_with_its_body(data, tmp_path, here):
    found = convert_shards(data, tmp_path / "out", options=options())
    assert (found.counts, found.earlier, here) == ({"converted": 3, "failed": 1, "skipped": 1}, 0, [0, 1, 2])
    rows = {row["name"]: row for row in rows_of(tmp_path / "out")}
    assert set(rows) == {"a.npz", "b.npz", "sub/c.npz", "broken.bvh", "shape.npz"}
    row, given = rows["sub/c.npz"], read_motion(data / "sub/c.npz")
    turns = Rotation.from_matrix(given.rotations.reshape(-1, 3, 3).astype(float))
    kept = Rotation.from_rotvec(np.asarray(row["poses"]).reshape(-1, 3))
    assert (turns.inv() * kept).magnitude().max() < VECTOR_RADIANS
    np.testing.assert_array_equal(np.float32(row["transl"]), given.translation)
    assert (row["frames"], row["clip_frames"], row["start"], row["fps"]) == (5, 5, 0, 24.0)
    assert (row["identity_model_type"], row["identity_params"]) == ("soma", '{"shape": [2.0]}')
    assert row["sha256"] == file_sha256(data / "sub/c.npz")
    assert load_canonical("mid")[1].revision.startswith(row["rig_hash"])
    assert (rows["broken.bvh"]["poses"], rows["broken.bvh"]["state"]) == (None, "failed")
    assert "broken.bvh" in rows["broken.bvh"]["reason"]
    assert str(data) not in rows["broken.bvh"]["reason"]
    assert pq.ParquetFile(found.shards[0]).metadata.row_group(0).column(0).compression == "ZSTD"


def test_errors_of_a_fit_stand_in_the_row(smplh_models, amass_file, tmp_path, here):
    (tmp_path / "in").mkdir()
    amass_file.rename(tmp_path / "in/walk.npz")
    convert_shards(tmp_path / "in", tmp_path / "out", options=options(lod="low"))
    (row,) = rows_of(tmp_path / "out")
    assert 0 < row["error_median_mm"] <= row["error_p95_mm"] <= row["error_max_mm"]
    assert row["layout"] == "amass"
    assert not (tmp_path / "out/work").exists()


def test_a_long_clip_is_several_rows(tmp_path):
    given, file = motion(frames=10, contacts=np.arange(40).reshape(10, 4) % 3 == 0), tmp_path / "motion.npz"
    write_motion(given, file)
    found = Converted(report={"settings": {}}, files=ResultFiles.of_folder(tmp_path))
    outcome = folder.Outcome(name="x", row={"state": "converted"}, told="", converted=found)
    tables = [*clips.clip_rows(outcome, "", longest=4)]
    assert [(row["start"].to_pylist(), row["frames"].to_pylist()) for row in tables] == [
        ([0], [4]), ([4], [4]), ([8], [2]),
    ]  # fmt: skip
    whole = pa.concat_tables(tables)
    assert whole["clip_frames"].to_pylist() == [10] * 3
    np.testing.assert_array_equal(np.concatenate(whole["foot_contacts"].to_pylist()), given.contacts)
    np.testing.assert_array_equal(np.float32(np.concatenate(whole["transl"].to_pylist())), given.translation)


def test_what_is_finished_is_not_done_again(data, tmp_path, here):
    convert_shards(data, tmp_path / "out", options=options())
    before = digests(tmp_path / "out")
    here.clear()
    for file in data.rglob("*.npz"):
        os.utime(file)  # as a copy has other times and the same content
    again = convert_shards(data, tmp_path / "out", options=options(workers=3))
    assert (here, again.earlier, digests(tmp_path / "out")) == ([], 3, before)
    write_motion(motion(frames=9), data / "sub/c.npz")
    write_motion(motion(frames=2), data / "0_first.npz")
    convert_shards(data, tmp_path / "out", options=options())
    assert here == [1, 3] or here == [2, 3]
    changed = {name for name, digest in digests(tmp_path / "out").items() if before.get(name) != digest}
    assert len(changed) == 2
    names = [row["name"] for row in rows_of(tmp_path / "out")]
    assert sorted(names) == sorted({*names})
    assert "0_first.npz" in names


def test_files_that_went_and_shards_that_were_damaged(data, tmp_path, here):
    found = convert_shards(data, tmp_path / "out", options=options())
    before = digests(tmp_path / "out")
    found.shards[2].write_bytes(b"cut")
    convert_shards(data, tmp_path / "out", options=options())
    assert here == [0, 1, 2, 2]
    assert digests(tmp_path / "out") == before
    (data / "a.npz").unlink()
    convert_shards(data, tmp_path / "out", options=options())
    assert "a.npz" not in {row["name"] for row in rows_of(tmp_path / "out")}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"up": "z"}, "up: got 'z', expected None, as in the run that"),
        ({"lod": "low"}, "lod: got 'low', expected 'mid'"),
    ],
)
def test_other_settings_are_refused_by_name(data, tmp_path, here, changes, told):
    convert_shards(data, tmp_path / "out", options=options())
    with pytest.raises(InputError, match=told):
        convert_shards(data, tmp_path / "out", options=options(**changes))


def test_a_full_disk_ends_the_run_and_keeps_what_is_finished(data, tmp_path, here, monkeypatch):
    convert_shards(data, tmp_path / "plain", options=options())
    write, done = shards.write_rows, []

    def full(path, tables):
        if done:
            raise OSError(errno.ENOSPC, "No space left on device")
        done.append(path)
        write(path, tables)

    monkeypatch.setattr(shards, "write_rows", full)
    with pytest.raises(UnwritableError, match=r"000001\.parquet: cannot be written \(No space left"):
        convert_shards(data, tmp_path / "out", options=options())
    monkeypatch.setattr(shards, "write_rows", write)
    here.clear()
    convert_shards(data, tmp_path / "out", options=options())
    assert here == [1, 2]
    assert digests(tmp_path / "out") == digests(tmp_path / "plain")


def test_a_full_disk_is_told_in_another_process():
    error = UnwritableError("out/a.npz", OSError(errno.ENOSPC, "No space left on device"))
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.path, type(again)) == (str(error), "out/a.npz", UnwritableError)
    assert "cannot be written (No space left on device)" in str(again)


def test_a_full_disk_below_a_clip_is_no_broken_clip(data, tmp_path, here, monkeypatch):
    def full(path):
        if path.is_file():
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(folder, "layout_of", full)
    with pytest.raises(UnwritableError):
        convert_shards(data, tmp_path / "out", options=options())


def test_a_file_that_ends_its_process_is_left_out_at_last(tmp_path):
    chunks = tmp_path / "clip/chunks"
    begun = [folder._begun(tmp_path / "f.bvh", chunks, "run") for _ in range(3)]
    for one in begun:
        one.__enter__()  # and the process is gone: nothing is left
    with pytest.raises(SomaError, match=r"f\.bvh: ended the process that converted it 3 times"):
        folder._begun(tmp_path / "f.bvh", chunks, "run").__enter__()
    with folder._begun(tmp_path / "f.bvh", chunks, "another run"):
        pass
    chunks.mkdir()
    (chunks / "000000.npz").touch()  # a chunk was finished: others than the file ended it
    with folder._begun(tmp_path / "f.bvh", chunks, "run"):
        pass
    assert [path.name for path in chunks.parent.iterdir()] == ["chunks"]


def test_rows_come_as_files_as_arrays_and_as_shards(data, tmp_path, here):
    convert_shards(data, tmp_path / "first", options=options())
    again = convert_shards(tmp_path / "first/shards", tmp_path / "again", options=options())
    assert again.counts == {"converted": 3, "skipped": 2}
    rows = {row["name"].split("/", 2)[2]: row for row in rows_of(tmp_path / "again")}
    for row in rows_of(tmp_path / "first"):
        if row["state"] == "converted":
            np.testing.assert_allclose(rows[row["name"]]["poses"], row["poses"], atol=VECTOR_RADIANS)
            same = {*row} - {"name", "poses", "sha256", "rotation_repr"}
            assert {key: rows[row["name"]][key] for key in same} == {key: row[key] for key in same}
    table = pa.table(
        {"path": ["x/a.npz", "x/a.npz", None], "bytes": [(data / "a.npz").read_bytes(), b"no archive", b""]}
    )
    pq.write_table(table, tmp_path / "files.parquet")
    found = convert_shards(tmp_path / "files.parquet", tmp_path / "packed", options=options())
    assert found.counts == {"converted": 1, "failed": 2}
    assert [*found.failed] == ["files.parquet/1/x/a.npz", "files.parquet/2"]
    assert found.failed["files.parquet/1/x/a.npz"].startswith("files.parquet/1/x/a.npz: ")


def test_damaged_and_ragged_parquet_are_failed_rows(tmp_path, here):
    (tmp_path / "in").mkdir()
    ragged = pa.table({"name": ["r"], "poses": [[[1.0], [1.0, 2.0]]], "transl": [[[0.0, 0, 0]]]})
    pq.write_table(ragged, tmp_path / "in/ragged.parquet")
    (tmp_path / "in/damaged.parquet").write_bytes((tmp_path / "in/ragged.parquet").read_bytes()[:-9])
    content = bytearray((tmp_path / "in/ragged.parquet").read_bytes())
    content[4:60] = bytes(56)
    (tmp_path / "in/rotten.parquet").write_bytes(content)
    found = convert_shards(tmp_path / "in", tmp_path / "out", options=options())
    assert found.counts == {"failed": 3}
    assert "poses: got lists of 2 lengths" in found.failed["ragged.parquet/0"]


def test_names_of_rows_are_no_paths(data, tmp_path, here):
    """Too long, upwards, with a NUL: a clip like any other, whose file is called otherwise."""
    names = [
        "x" * 300 + ".npz",
        "走" * 90 + ".npz",
        "x/" * 3000,
        "../../up.npz",
        "..",
        "a\0b.npz",
        " ",
        "last.npz",
    ]
    table = pa.table({"name": names, "bytes": [(data / "a.npz").read_bytes()] * len(names)})
    pq.write_table(table, tmp_path / "clips.parquet")
    found = convert_shards(tmp_path / "clips.parquet", tmp_path / "out", options=options())
    assert found.counts == {"converted": len(names)}
    assert not (tmp_path / "up.npz").exists()


def test_a_row_of_which_nobody_foresaw_what_is_wrong_ends_nothing(data, tmp_path, here, monkeypatch):
    def failing(*_):
        raise RecursionError("too deep")

    monkeypatch.setattr(clips, "clip_file", failing)
    table = pa.table({"name": ["a", "b"], "bytes": [b"", b""]})
    pq.write_table(table, tmp_path / "clips.parquet")
    found = convert_shards(tmp_path / "clips.parquet", tmp_path / "out", options=options())
    assert found.counts == {"failed": 2}


def test_parquet_that_unfolds_without_end_is_a_failed_file(data, tmp_path, here):
    (data / "bomb.parquet").write_bytes(FILES["parquet of a list without end"])
    found = convert_shards(data, tmp_path / "out", options=options())
    assert "more memory than its size can mean" in found.failed["bomb.parquet"]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"address": "auto"}, "address: got auto, expected none with engine=local. Pass engine=ray."),
        ({"engine": "ray", "num_gpus": 1}, "num_gpus: got 1, expected none with device=cpu"),
        ({"output": "parquet", "to": "smplx"}, "to: got smplx, expected none with output=parquet"),
        ({"output": "parquet", "write": ["bvh"]}, "write: got bvh, expected none with output=parquet"),
        ({"shard": 0}, "shard: got 0, expected at least 1"),
        ({"engine": "spark"}, "engine: got 'spark', expected one of local, ray"),
    ],
)
def test_settings_that_do_nothing_are_refused(changes, told):
    with pytest.raises(InputError, match=told):
        DatasetOptions(**changes)


def test_without_ray_it_is_said_how_to_install_it(data, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'soma-body-core\[ray\]'; or pass engine=local"):
        convert_shards(data, tmp_path / "out", options=options(engine="ray"))


@pytest.mark.parametrize(
    ("address", "error", "told"),
    [
        (None, Exception("The current node timed out during startup."),
         r"engine: got ray, which does not start \(Exception: The current node timed out during startup\), "
         r"expected Ray to start\. Try again when .*pass engine=local"),
        ("auto", RuntimeError(""), r"engine: got ray, which does not start \(RuntimeError: no text\)"),
        ("auto", ConnectionError("none"), "address: got auto, expected the address of a Ray cluster"),
    ],
)  # fmt: skip
def test_ray_that_does_not_start_is_one_sentence(data, tmp_path, monkeypatch, address, error, told):
    def start(*_given, **_settings):
        raise error

    ray = SimpleNamespace(is_initialized=lambda: False, init=start, shutdown=lambda: None)
    monkeypatch.setattr(engines, "need_ray", lambda: ray)
    chosen = options(engine="ray", workers=1) if address is None else options(engine="ray", address=address)
    with pytest.raises(InputError, match=told):
        convert_shards(data, tmp_path / "out", options=chosen)


@pytest.mark.usefixtures("here")
def test_a_pipe_is_a_failed_row(tmp_path):
    (tmp_path / "in").mkdir()
    os.mkfifo(tmp_path / "in/a.npz")
    os.mkfifo(tmp_path / "in/b.parquet")
    found = convert_shards(tmp_path / "in", tmp_path / "out", options=options())
    assert found.failed == {
        name: f"{name}: is a pipe, not a file. Name the file itself." for name in ("a.npz", "b.parquet")
    }


class Ending:
    """A job one of whose items ends its process until it was begun three times, beside one that does not."""

    def __init__(self, place):
        self.place = place

    def opened(self):
        def do(item):
            with open(self.place / str(item), "ab") as stream:
                stream.write(b".")
            if item == 3 and (self.place / "3").stat().st_size < 3:
                os._exit(1)
            return item, (self.place / str(item)).stat().st_size

        return do


@pytest.mark.slow
def test_a_process_that_ends_is_replaced(tmp_path):
    found = dict(engines.run_job(Ending(tmp_path), range(6), DatasetOptions(workers=2)))
    assert sorted(found) == [0, 1, 2, 3, 4, 5]
    assert found[3] == 3
    assert max(found[item] for item in found if item != 3) <= 2


@pytest.mark.slow
def test_processes_mirror_a_folder_as_one_does(data, tmp_path):
    plain = convert_folder(data, tmp_path / "one")
    found = convert_folder(data, tmp_path / "two", options=DatasetOptions(workers=2))
    assert (list(found.converted), list(found.errors), found.skipped) == (
        list(plain.converted), list(plain.errors), plain.skipped,
    )  # fmt: skip
    for name, one in plain.converted.items():
        np.testing.assert_array_equal(found.converted[name].motion().rotations, one.motion().rotations)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs soma-body-core[ray]")
def test_ray_up_takes_the_example_of_a_cluster():
    code = (
        "import sys, yaml; from ray.autoscaler._private.util import prepare_config, validate_config; "
        "validate_config(prepare_config(yaml.safe_load(open(sys.argv[1]))))"
    )
    file = assets_dir().parent / "docs/cluster.yaml"
    found = subprocess.run([sys.executable, "-c", code, file], capture_output=True, text=True)
    assert found.returncode == 0, found.stderr


_ON_RAY = """
import sys
from pathlib import Path
import ray
from soma_core.motion import DatasetOptions, convert_dataset, convert_folder, convert_shards

if __name__ == "__main__":
    data, out = map(Path, sys.argv[1:])
    for engine in ("local", "ray"):
        options = DatasetOptions(engine=engine, output="parquet", shard=2, workers=2)
        convert_shards(data, out / engine, options=options)
    ray.init("local", num_cpus=4, include_dashboard=False, log_to_driver=False)
    found = convert_folder(data, out / "folder", options=DatasetOptions(engine="ray", workers=1))
    assert (len(found.converted), len(found.errors), found.skipped) == (3, 1, ["shape.npz"]), found
    packed = ray.data.read_binary_files(str(data), include_paths=True, override_num_blocks=4)
    rows = convert_dataset(packed, DatasetOptions(workers=1)).take_all()
    assert sorted(row["state"] for row in rows) == ["converted"] * 3 + ["failed", "skipped"], rows
    named = ray.data.from_items([{"path": str(data / "a.npz")}, {"path": str(data / "none.npz")}])
    rows = convert_dataset(named, DatasetOptions(workers=1)).take_all()
    assert sorted(row["state"] for row in rows) == ["converted", "failed"], rows
"""


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs soma-body-core[ray]")
def test_ray_gives_the_same_bytes(data, tmp_path):
    (tmp_path / "run.py").write_text(_ON_RAY)
    root = assets_dir().parent
    paths = [str(root), *map(str, (root / "plugins").glob("*")), os.environ.get("PYTHONPATH", "")]
    found = subprocess.run(
        [sys.executable, tmp_path / "run.py", data, tmp_path],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)}, capture_output=True, text=True,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    assert digests(tmp_path / "ray") == digests(tmp_path / "local")
    assert len(digests(tmp_path / "ray")) == 3


@pytest.mark.parametrize(("package", "ask"), [("pyarrow", clips.need_pyarrow), ("ray", engines.need_ray)])
def test_a_package_that_is_missing_is_named_with_its_extra(monkeypatch, package, ask):
    monkeypatch.setitem(sys.modules, package, None)
    extra = {"pyarrow": "parquet", "ray": "ray"}[package]
    with pytest.raises(InputError, match=rf"got no {package}, .*pip install 'soma-body-core\[{extra}\]'"):
        ask()
