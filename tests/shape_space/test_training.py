"""Incremental PCA: agrees with the batch decomposition, mirrors, stops and goes on exactly."""

import logging

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.rig import load_canonical
from soma_core.shape_space.report import plot_errors, reconstruction_errors
from soma_core.shape_space.training import TrainingPlan, mirror_shapes, train_components

VERTICES = 30
RANK = 6
PARTNER = np.arange(VERTICES)[::-1].copy()
BIND = np.random.default_rng(5).normal(size=(VERTICES, 3))


class Stream:
    """Shapes that vary in `RANK` directions of falling strength."""

    def __init__(self, noise=0.0):
        random = np.random.default_rng(7)
        self._basis = random.normal(size=(RANK, VERTICES, 3)) * 2.0 ** -np.arange(RANK)[:, None, None]
        self._noise = noise

    def shapes(self, stream, batch, count):
        random = np.random.default_rng([stream, batch])
        exact = BIND + np.tensordot(random.normal(size=(count, RANK)), self._basis, axes=1)
        return exact + self._noise * random.normal(size=exact.shape)


def train(tmp_path, stream=None, *, key="run", resume=False, progress=lambda steps, done: steps, **changes):
    plan = TrainingPlan(**{"count": 90, "components": 4, "batch": 20, "save_every": 1} | changes)
    return train_components(
        stream or Stream(),
        plan,
        bind=BIND,
        partner=PARTNER,
        state=tmp_path / "state.npz",
        key=key,
        resume=resume,
        progress=progress,
    )


def test_agrees_with_the_decomposition_of_all_shapes_at_once(tmp_path):
    got = train(tmp_path, mirror=False)
    sizes = TrainingPlan(count=90, components=4, batch=20).batch_sizes
    shapes = np.concatenate([Stream().shapes(0, number, size) for number, size in enumerate(sizes)])
    centred = (shapes - shapes.mean(0)).reshape(len(shapes), -1)
    _, singular, directions = np.linalg.svd(centred, full_matrices=False)
    np.testing.assert_allclose(got.mean, shapes.mean(0))
    np.testing.assert_allclose(got.eigenvalues, singular[:4] ** 2 / (len(shapes) - 1))
    np.testing.assert_allclose(np.abs(np.sum(got.directions * directions[:4], axis=1)), 1.0)
    assert got.shapes == len(shapes)
    assert got.explained.sum() < 1


def test_directions_are_orthonormal_and_sorted(tmp_path):
    got = train(tmp_path)
    np.testing.assert_allclose(got.directions @ got.directions.T, np.eye(4), atol=1e-12)
    assert (np.diff(got.eigenvalues) <= 0).all()


def test_mirrored_training_gives_a_mirrored_mean(tmp_path):
    mean = train(tmp_path).mean
    np.testing.assert_allclose(mirror_shapes(mean[None], BIND, PARTNER)[0], mean, atol=1e-12)


@pytest.mark.parametrize("stop_after", [1, 3])
def test_interrupted_and_resumed_equals_uninterrupted(tmp_path, stop_after):
    class StoppedError(Exception):
        pass

    def stopping(steps, done):
        for number in steps:
            if number == stop_after:
                raise StoppedError
            yield number

    stream = Stream(noise=0.1)
    expected = train(tmp_path, stream)
    with pytest.raises(StoppedError):
        train(tmp_path, stream, progress=stopping)
    assert (tmp_path / "state.npz").is_file()
    seen = []
    resumed = train(tmp_path, stream, resume=True, progress=lambda steps, done: seen.append(done) or steps)
    assert seen == [stop_after]
    for name in ("mean", "directions", "eigenvalues", "explained"):
        np.testing.assert_array_equal(getattr(resumed, name), getattr(expected, name))
    assert not (tmp_path / "state.npz").exists()


def test_the_state_of_another_run_is_said_and_left_alone(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        np.savez(tmp_path / "state.npz", key=np.array("other"), done=np.array(2))
        train(tmp_path, resume=True)
    assert [record.message.split(" at ")[0] for record in caplog.records] == ["the state"]


def test_batches_are_equal_to_within_one():
    assert TrainingPlan(count=90, components=4, batch=20).batch_sizes == (18, 18, 18, 18, 18)
    assert TrainingPlan(count=11, components=2, batch=4).batch_sizes == (4, 4, 3)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"count": 0}, "count: got 0, expected at least 1"),
        ({"components": 0}, "components: got 0"),
        ({"batch": 3, "components": 8}, r"batch: got 6 shapes .*as components \(8\)"),
    ],
)
def test_unusable_plan_is_named(changes, expected):
    with pytest.raises(InputError, match=expected):
        TrainingPlan(**{"count": 90, "components": 4, "batch": 20} | changes)


def test_mirroring_twice_is_nothing_and_the_bind_shape_is_its_own_mirror():
    mesh, _ = load_canonical("mid")
    np.testing.assert_array_equal(mesh.mirror[mesh.mirror], np.arange(mesh.vertex_count))
    shapes = np.stack(
        (mesh.vertices, mesh.vertices + np.random.default_rng(0).normal(size=mesh.vertices.shape))
    )
    once = mirror_shapes(shapes, mesh.vertices, mesh.mirror)
    np.testing.assert_array_equal(once[0], mesh.vertices)
    np.testing.assert_allclose(mirror_shapes(once, mesh.vertices, mesh.mirror), shapes, atol=1e-12)


def test_held_out_errors_fall_with_components_and_vanish_at_full_rank(tmp_path):
    got = train(tmp_path, mirror=False, components=RANK)
    rows = reconstruction_errors(got.mean, got.directions, Stream().shapes(1, 0, 20), counts=(1, 2, 4, 6, 99))
    assert [row["components"] for row in rows] == [1, 2, 4, 6]
    means = [row["mean_mm"] for row in rows]
    assert means == sorted(means, reverse=True)
    assert rows[-1]["max_mm"] < 1e-6
    assert all(row["mean_mm"] <= row["p95_mm"] <= row["max_mm"] for row in rows)


def test_errors_are_millimetres():
    shapes = np.array([[[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]]])  # 5 cm off at one of two vertices
    (row,) = reconstruction_errors(np.zeros((2, 3)), np.array([[0.0] * 5 + [1.0]]), shapes, counts=(1,))
    assert (row["mean_mm"], row["max_mm"]) == (25.0, 50.0)


def test_plot_is_written_where_matplotlib_is_installed(tmp_path):
    pytest.importorskip("matplotlib")
    rows = reconstruction_errors(np.zeros((2, 3)), np.eye(6), np.ones((1, 2, 3)), counts=(1, 2))
    assert plot_errors(rows, tmp_path / "errors.png")
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")


def test_no_plot_without_matplotlib(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert not plot_errors([], tmp_path / "errors.png")
    assert not list(tmp_path.iterdir())
