"""Training: it learns, stops, goes on after a kill to the last bit, and shares its work."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from soma_core.correctives.data import ClipPlan, LessonStore, split_clips
from soma_core.correctives.network import CorrectivesNetwork
from soma_core.correctives.plot import plot_history
from soma_core.correctives.processes import Processes
from soma_core.correctives.training import Trainer, TrainingOptions, reduction
from soma_core.errors import InputError
from tests.correctives.conftest import CHANNELS

SHARED_SUMS = 1e-4  # relative: two processes add up batches in another order, over some steps of Adam


class KilledError(Exception):
    pass


def quick(**changes) -> TrainingOptions:
    return TrainingOptions(**{"batch": 16, "epochs": 4, "rate": 0.02, "ridge": 1e-3, "seed": 1, **changes})


@pytest.fixture(scope="module")
def lessons(body, tmp_path_factory):
    from tests.correctives.conftest import KnownTeacher

    store = LessonStore(tmp_path_factory.mktemp("lessons"), KnownTeacher(body), body.mesh, body.rig)
    plan = ClipPlan(random_clips=8, hanging_clips=0, poses=16, seed=0)
    clips = [store.teach(plan.clip(number, body.rig.user_joint_names)) for number in range(len(plan))]
    return store, split_clips(clips, held_out=0.125, seed=0)


@pytest.fixture
def trainer(body, lessons):
    store, clips = lessons

    def make(processes=None, **changes) -> Trainer:
        vertices = np.arange(0, body.mesh.vertex_count, 3)
        network = CorrectivesNetwork(
            body.masks.joints, body.masks.vertices[:, vertices].tocsr(), channels=CHANNELS, seed=1
        )
        return Trainer(
            network, store, train=clips["train"], validation=clips["validation"], vertices=vertices,
            options=quick(**changes), processes=processes,
        )  # fmt: skip

    return make


def _run(trainer, path, *, resume=False, kill_after=None, key="run"):
    def steps(epochs, _done):
        for epoch in epochs:
            if epoch == kill_after:
                raise KilledError
            yield epoch

    trainer.run(state=path, key=key, resume=resume, progress=steps)
    return trainer


def test_training_learns_more_than_the_closed_form_of_random_activations(trainer, tmp_path):
    trained = trainer(epochs=12)
    trained.warm_start()
    first, _ = trained.validate()
    _run(trained, tmp_path / "state.pt")
    best = max(line["reduction"] for line in trained.history)
    assert first > 0
    assert best > first + 0.02  # few poses, and a teacher without structure: little can be learnt
    assert trained.validate()[0] == pytest.approx(best, abs=0.02)  # the best weights are the ones kept
    assert not (tmp_path / "state.pt").exists()


def test_the_same_seed_gives_the_same_weights(trainer, tmp_path):
    first, second = (_run(trainer(epochs=2), tmp_path / name).network.first for name in ("a", "b"))
    assert torch.equal(first, second)


def test_a_killed_run_goes_on_to_the_last_bit(trainer, tmp_path, caplog):
    whole = _run(trainer(), tmp_path / "whole.pt")
    with pytest.raises(KilledError):
        _run(trainer(), tmp_path / "state.pt", kill_after=2)
    with caplog.at_level(logging.INFO):
        resumed = _run(trainer(), tmp_path / "state.pt", resume=True)
    assert "going on after epoch 2 and 0 batches" in caplog.text
    assert resumed.history == whole.history
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, resumed.network.state_dict()[name]), name


def test_a_run_killed_within_an_epoch_goes_on_to_the_last_bit(trainer, tmp_path, caplog, monkeypatch):
    whole = _run(trainer(save_every=2), tmp_path / "whole.pt")
    save, saved = Trainer._save, []

    def killing(self, path, key):
        save(self, path, key)
        saved.append(self._state.batch)
        if len(saved) == 9:
            raise KilledError

    monkeypatch.setattr(Trainer, "_save", killing)
    with pytest.raises(KilledError):
        _run(trainer(save_every=2), tmp_path / "state.pt")
    assert saved[-1] > 0  # within an epoch
    monkeypatch.setattr(Trainer, "_save", save)
    with caplog.at_level(logging.INFO):
        resumed = _run(trainer(save_every=2), tmp_path / "state.pt", resume=True)
    assert f"and {saved[-1]} batches" in caplog.text
    assert resumed.history == whole.history
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, resumed.network.state_dict()[name]), name


def test_a_state_of_another_run_is_left_alone(trainer, tmp_path, caplog):
    with pytest.raises(KilledError):
        _run(trainer(epochs=2), tmp_path / "state.pt", kill_after=1, key="other")
    fresh = _run(trainer(epochs=2), tmp_path / "state.pt", resume=True)
    assert "belongs to another configuration" in caplog.text
    assert len(fresh.history) == 2


def test_training_stops_when_nothing_improves(trainer, tmp_path):
    stopped = _run(trainer(epochs=30, rate=0.0, patience=2), tmp_path / "state.pt")
    assert len(stopped.history) == 3  # one to set the mark, two without improvement


@pytest.mark.parametrize("batch", [0, 10**6])
def test_a_batch_that_cannot_be_is_named(trainer, batch):
    with pytest.raises(InputError, match=f"batch: got {batch}, expected a multiple of 1 processes"):
        trainer(batch=batch)
    with pytest.raises(InputError, match="batch: got 15, expected a multiple of 2"):
        trainer(processes=Processes(rank=0, count=2), batch=15)


def test_reduction_looks_at_what_the_teacher_moves():
    taught = torch.tensor([[[0.01, 0, 0], [0.0005, 0, 0]]])
    share, left = reduction([(taught * torch.tensor([[0.9], [0.0]]), taught)])
    assert share == pytest.approx(0.9)
    assert left == pytest.approx(1e3 * np.sqrt((0.001**2 + 0.0005**2) / 2))


def test_the_plot(trainer, tmp_path):
    pytest.importorskip("matplotlib")
    trained = _run(trainer(epochs=2), tmp_path / "state.pt")
    assert plot_history(trained.history, tmp_path / "loss.png")
    assert (tmp_path / "loss.png").read_bytes().startswith(b"\x89PNG")


SCRIPT = """
import sys, numpy as np, torch
from pathlib import Path
from tests.correctives.conftest import CHANNELS, KnownTeacher, made_body
from soma_core.correctives.data import ClipPlan, LessonStore, split_clips
from soma_core.correctives.network import CorrectivesNetwork
from soma_core.correctives.processes import joined_processes
from soma_core.correctives.training import Trainer, TrainingOptions

body = made_body()
mesh, rig, masks = body.mesh, body.rig, body.masks
store = LessonStore(Path(sys.argv[1]), KnownTeacher(body), mesh, rig)
plan = ClipPlan(random_clips=8, hanging_clips=0, poses=16, seed=0)
clips = [store.teach(plan.clip(number, rig.user_joint_names)) for number in range(len(plan))]
split = split_clips(clips, held_out=0.125, seed=0)
vertices = np.arange(0, mesh.vertex_count, 3)
network = CorrectivesNetwork(masks.joints, masks.vertices[:, vertices].tocsr(), channels=CHANNELS, seed=1)
options = TrainingOptions(batch=16, epochs=2, rate=0.02, ridge=1e-3, seed=1)
with joined_processes("cpu") as processes:
    trainer = Trainer(network, store, train=split["train"], validation=split["validation"],
                      vertices=vertices, options=options, processes=processes)
    trainer.run(state=Path(sys.argv[2] + ".state"), key="run", resume=False, progress=lambda s, d: s)
    torch.save(network.first.data, f"{sys.argv[2]}{processes.rank}.pt")
"""


@pytest.mark.slow
def test_two_processes_train_like_one(trainer, lessons, tmp_path):
    alone = _run(trainer(epochs=2), tmp_path / "alone.pt").network.first.detach()
    store, _ = lessons
    root = Path(__file__).resolve().parents[2]
    shared = {"MASTER_ADDR": "127.0.0.1", "WORLD_SIZE": "2", "MASTER_PORT": str(20000 + os.getpid() % 20000)}
    command = [sys.executable, "-c", SCRIPT, str(store._folder.parent), str(tmp_path / "rank")]
    running = [
        subprocess.Popen(
            command, env={**os.environ, **shared, "RANK": str(rank), "PYTHONPATH": str(root)},
            stderr=subprocess.PIPE, text=True,
        )
        for rank in range(2)
    ]  # fmt: skip
    for process in running:
        _, errors = process.communicate(timeout=240)
        assert process.returncode == 0, errors[-2000:]
    first, second = (torch.load(tmp_path / f"rank{rank}.pt", weights_only=True) for rank in range(2))
    assert torch.equal(first, second)
    torch.testing.assert_close(first, alone, rtol=0, atol=SHARED_SUMS * float(alone.abs().max()))
