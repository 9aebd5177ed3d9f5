"""``soma train-correctives``: from a configuration to a checkpoint that loads, with a report beside it."""

import json

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from soma_core.config.schema import TrainCorrectivesConfig
from soma_core.correctives.model import load_correctives
from soma_core.correctives.weights import read_weights
from soma_core.errors import InputError
from soma_core.io import read_motion, write_motion
from soma_core.io.motion import Motion
from soma_core.tasks import train_correctives
from tests.bodies import CPU, tiny_canonical
from tests.correctives.conftest import CHANNELS, KnownTeacher, made_body

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
    ],
)
def test_what_cannot_be_is_named(config, tmp_path, key, value, text):
    OmegaConf.update(config, key, value)
    with pytest.raises(InputError, match=text):
        train_correctives.run(config, tmp_path)


@pytest.fixture
def motion(tmp_path):
    _, rig = tiny_canonical()
    rotations = np.tile(np.eye(3), (9, 77, 1, 1))
    made = Motion(rotations=rotations, translation=np.zeros((9, 3)), fps=30, joint_names=rig.user_joint_names)
    write_motion(made, tmp_path / "motions" / "still.npz")
    return made


def test_motions_are_read_from_files_and_folders(motion, tmp_path):
    folder = tmp_path / "motions"
    for given in (folder, folder / "still.npz"):
        found = train_correctives.read_motions([str(given)], 4)
        assert {name: len(rotations) for name, rotations in found.items()} == {"still.npz": 3}
    assert read_motion(folder / "still.npz").frame_count == 9


def test_motions_that_cannot_be_used_are_named(motion, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"data\.step: got 0"):
        train_correctives.read_motions([str(tmp_path)], 0)
    absolute = Motion(
        rotations=motion.rotations, translation=motion.translation, fps=30,
        joint_names=motion.joint_names, convention="absolute_local",
    )  # fmt: skip
    monkeypatch.setattr(train_correctives, "read_motion", lambda _path: absolute)
    with pytest.raises(InputError, match=r"data\.motions: got .*still\.npz with the convention absolute"):
        train_correctives.read_motions([str(tmp_path / "motions")], 1)


def test_the_teacher_is_chosen_by_one_word():
    mesh, rig = tiny_canonical()
    assert train_correctives.make_teacher("elastic", mesh, rig).name == "elastic"
    with pytest.raises(InputError, match="teacher: got soma, whose generator offers no posed meshes"):
        train_correctives.make_teacher("soma", mesh, rig)
