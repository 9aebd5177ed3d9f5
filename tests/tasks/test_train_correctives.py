"""``soma train-correctives``: from a configuration to a checkpoint that loads, with a report beside it."""

import json

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation

from soma_core.config.schema import CorrectivesData, TrainCorrectivesConfig
from soma_core.correctives.model import load_correctives
from soma_core.correctives.processes import Processes
from soma_core.correctives.weights import read_weights
from soma_core.errors import InputError
from soma_core.io import read_motion, write_motion
from soma_core.io.motion import Motion
from soma_core.motion import DatasetOptions, clips, convert_shards
from soma_core.motion import shards as convert
from soma_core.tasks import train_correctives
from tests.bodies import CPU, tiny_canonical
from tests.correctives.conftest import CHANNELS, KnownTeacher, made_body

ROUNDING = 1e-6  # rotation vectors in float32

SMALL = {
    "data": {"random_clips": 6, "hanging_clips": 0, "poses": 12},
    "channels": CHANNELS,
    "batch": 16,
    "epochs": 2,
    "rate": 0.02,
    "mebibytes": 0.6,
}


@pytest.fixture
def config(monkeypatch, tmp_path):
    monkeypatch.setattr(train_correctives, "load_canonical", lambda _lod: tiny_canonical())
    monkeypatch.setattr(
        train_correctives, "make_teacher", lambda _name, _mesh, _rig: KnownTeacher(made_body())
    )
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path / "cache"))
    return OmegaConf.merge(OmegaConf.structured(TrainCorrectivesConfig), SMALL)


def test_writes_a_checkpoint_that_loads_and_its_report(config, tmp_path):
    train_correctives.run(config, tmp_path)
    mesh, rig = tiny_canonical()
    path, report = tmp_path / "correctives_model.pt", json.loads((tmp_path / "report.json").read_text())
    assert load_correctives(path, mesh, rig, dtype=torch.float32, device=CPU) is not None
    meta = read_weights(path).meta
    assert (meta["teacher"], meta["clips"]) == ("known", {"train": 4, "validation": 1, "test": 1})
    assert meta["settings"]["epochs"] == 2
    assert meta["rig_revision"] == mesh.revision
    assert report["bytes"] == path.stat().st_size <= 0.6 * 2**20
    assert 0 < report["reduction"] < 1
    assert len(report["history"]) == 2
    lessons = list((tmp_path / "cache" / "train_correctives" / "lessons" / "known").glob("*.npz"))
    assert len(lessons) == 6
    assert not list((tmp_path / "cache" / "train_correctives").glob("*.pt"))  # nothing is left to resume


def test_the_same_configuration_gives_the_same_model(config, tmp_path):
    for name in ("first", "second"):
        config.out = str(tmp_path / name / "model.pt")
        train_correctives.run(config, tmp_path / name)
    first, second = (read_weights(tmp_path / name / "model.pt") for name in ("first", "second"))
    np.testing.assert_array_equal(first.second.data, second.second.data)
    assert not (tmp_path / "first" / "correctives_model.pt").exists()


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("reach", 0.0, r"reach: got 0\.0, expected above 0"),
        ("data.held_out", 0.5, r"data\.held_out: got 0\.5, expected above 0 and below 0\.5"),
        ("data.random_clips", 1, r"data: got 1 clips, expected at least 3"),
        ("mebibytes", 0.01, r"mebibytes: got 0\.01"),
        ("batch", 10**6, r"batch: got 1000000"),
        ("smoothness", -0.1, r"smoothness: got -0\.1, expected at least 0"),
    ],
)
def test_what_cannot_be_is_named(config, tmp_path, key, value, text):
    OmegaConf.update(config, key, value)
    with pytest.raises(InputError, match=text):
        train_correctives.run(config, tmp_path)


def clips_of(*paths, count=1, step=4, **changes):
    """What each process reads."""
    small = {"random_clips": 0, "hanging_clips": 0, "motions": list(map(str, paths)), "step": step}
    data = OmegaConf.merge(OmegaConf.structured(CorrectivesData), small | changes)
    names = tiny_canonical()[1].user_joint_names
    return [
        list(train_correctives.read_clips(data, 0, names, Processes(rank=rank, count=count)))
        for rank in range(count)
    ]


def made_motion(frames=9, **changes):
    _, rig = tiny_canonical()
    vectors = np.random.default_rng(frames).normal(size=(frames, 77, 3)) * 0.2
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 77, 3, 3)
    given = {"fps": 30, "joint_names": rig.user_joint_names} | changes
    return Motion(rotations=rotations, translation=np.zeros((frames, 3)), **given)


@pytest.fixture
def folder(tmp_path):
    for name, frames in (("one", 9), ("two", 5)):
        write_motion(made_motion(frames), tmp_path / f"motions/{name}.npz")
    return tmp_path / "motions"


def test_motions_are_read_from_files_and_folders(folder):
    for given, wanted in ((folder, {"one.npz": 3, "two.npz": 2}), (folder / "two.npz", {"two.npz": 2})):
        (found,) = clips_of(given)
        assert {clip.name: len(clip.rotations) for clip in found} == wanted
    assert read_motion(folder / "one.npz").frame_count == 9


def test_long_motions_come_in_pieces_that_stay_together(folder, monkeypatch):
    monkeypatch.setattr(train_correctives, "_LONGEST", 2)
    (found,) = clips_of(folder / "one.npz")
    assert [(clip.name, clip.part_of, len(clip.rotations)) for clip in found] == [
        ("one.npz/0", "one.npz", 2), ("one.npz/2", "one.npz", 1),
    ]  # fmt: skip


def test_motions_that_cannot_be_used_are_named(folder, monkeypatch, config):
    config.data.step = 0
    with pytest.raises(InputError, match=r"data\.step: got 0"):
        train_correctives.run(config, folder)
    absolute = made_motion(convention="absolute_local")
    monkeypatch.setattr(train_correctives, "read_motion", lambda _path: absolute)
    with pytest.raises(InputError, match=r"data\.motions: got .*one\.npz with the convention absolute"):
        clips_of(folder)


@pytest.fixture
def shards(folder, tmp_path, monkeypatch):
    pytest.importorskip("pyarrow")
    monkeypatch.setitem(clips.clip_rows.__kwdefaults__, "longest", 4)  # several rows of a clip
    monkeypatch.setattr(convert, "run_job", lambda job, items, options: map(job.opened(), items))
    convert_shards(folder, tmp_path / "out", options=DatasetOptions(output="parquet", shard=1))
    return tmp_path / "out"


def test_shards_give_the_poses_of_the_files(folder, shards):
    (files,), (rows,) = clips_of(folder, step=3), clips_of(shards, step=3)
    assert [clip.name for clip in rows] == ["one.npz 0", "one.npz 4", "two.npz 0"]  # frames 0, 3, 6; 0, 3
    assert len({clip.seed for clip in rows}) == len(rows)
    for clip in files:
        parts = [each.rotations for each in rows if each.part_of == clip.name]
        np.testing.assert_allclose(np.concatenate(parts), clip.rotations, atol=ROUNDING)


def test_processes_share_the_clips(folder, shards):
    whole = [clip.name for part in clips_of(folder, shards, random_clips=3) for clip in part]
    parts = clips_of(folder, shards, random_clips=3, count=2)
    assert sorted(clip.name for part in parts for clip in part) == sorted(whole)
    assert len(whole) == 10
    assert [len(part) for part in parts] == [5, 5]


def test_shards_are_trained_on(config, shards, tmp_path):
    config.data.motions, config.data.step, config.batch = [str(shards)], 1, 8
    train_correctives.run(config, tmp_path / "run")
    meta = read_weights(tmp_path / "run/correctives_model.pt").meta
    assert sum(meta["clips"].values()) == 6 + 2
    assert sum(meta["poses"].values()) == 6 * 12 + 9 + 5


def test_the_teacher_is_chosen_by_one_word():
    mesh, rig = tiny_canonical()
    elastic, bone = (train_correctives.make_teacher(name, mesh, rig) for name in ("elastic", "bone"))
    assert (elastic.name, bone.name) == ("elastic", "bone")
    assert elastic.key != bone.key  # nor are their lessons
    with pytest.raises(InputError, match="teacher: got soma, whose generator offers no posed meshes"):
        train_correctives.make_teacher("soma", mesh, rig)


def test_a_kept_first_stage_leaves_the_second_to_be_solved(config, tmp_path):
    train_correctives.run(config, tmp_path / "one")
    config.first = str(tmp_path / "one" / "correctives_model.pt")
    train_correctives.run(config, tmp_path / "two")
    one, two = (read_weights(tmp_path / name / "correctives_model.pt") for name in ("one", "two"))
    assert (one.first != two.first).nnz == 0
    assert abs(one.second - two.second).max() < 1e-6  # metres: the same lessons, in closed form both times
    assert two.meta["epochs"] == 0
    config.channels = CHANNELS + 1
    with pytest.raises(InputError, match="first: got .*Set channels"):
        train_correctives.run(config, tmp_path / "three")
