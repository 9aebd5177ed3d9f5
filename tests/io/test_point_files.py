"""Files of points: arrays, tables, JSON of keypoint tools, HumanML3D's vectors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.io.point_files import read_points

NAMES = ("nose", "left_hip", "right_hip")
POINTS = np.random.default_rng(0).normal(size=(4, 3, 3))


def _same(found: np.ndarray, expected: np.ndarray = POINTS) -> None:
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("shape", [(4, 3, 3), (4, 9)])
def test_arrays(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "a.npy", POINTS.reshape(shape))
    np.savez(tmp_path / "a.npz", keypoints_3d=POINTS.reshape(shape), fps=25)
    _same(read_points(tmp_path / "a.npy", NAMES).positions)
    found = read_points(tmp_path / "a.npz", NAMES)
    _same(found.positions)
    assert found.fps == 25


def test_confidence_is_behind_the_points_or_beside_them(tmp_path: Path) -> None:
    score = np.array([1.0, 0.5, 0.0])
    known = POINTS.copy()
    known[:, 2] = np.nan
    np.save(tmp_path / "a.npy", np.concatenate((POINTS, np.broadcast_to(score, (4, 3))[..., None]), -1))
    np.savez(tmp_path / "b.npz", points=POINTS, scores=np.broadcast_to(score, (4, 3)))
    for name in ("a.npy", "b.npz"):
        found = read_points(tmp_path / name, NAMES)
        _same(found.positions, known)
        _same(found.confidence, np.broadcast_to(score, (4, 3)))


def test_tables_by_name_and_without_a_head(tmp_path: Path) -> None:
    names = ("Right Hip", "nose", "thumb")
    head = ",".join(f"{name}_{axis}" for name in names for axis in "xyz")
    rows = POINTS[:, [2, 0, 1]].reshape(4, -1)
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=head, comments="")
    known = POINTS.copy()
    known[:, 1] = np.nan
    _same(read_points(tmp_path / "a.csv", NAMES).positions, known)
    np.savetxt(tmp_path / "b.csv", POINTS.reshape(4, -1), delimiter=",")
    _same(read_points(tmp_path / "b.csv", NAMES).positions)


def test_json_of_keypoint_tools(tmp_path: Path) -> None:
    easy, pose = tmp_path / "easy", tmp_path / "pose"
    easy.mkdir()
    pose.mkdir()
    for number, frame in enumerate(POINTS):
        scored = np.concatenate((frame, np.ones((3, 1))), 1)
        people = [{"id": 7, "keypoints3d": scored.tolist()}]
        (easy / f"{number:06d}.json").write_text(json.dumps(people), encoding="utf-8")
        flat = {"people": [{"pose_keypoints_3d": scored.ravel().tolist()}]}
        (pose / f"clip_{number}_keypoints.json").write_text(json.dumps(flat), encoding="utf-8")
    (pose / "clip_4_keypoints.json").write_text('{"people": []}', encoding="utf-8")
    (tmp_path / "a.json").write_text(json.dumps({"fps": 30, "frames": POINTS.tolist()}), encoding="utf-8")
    _same(read_points(easy, NAMES, person="7").positions)
    found = read_points(pose, NAMES)
    _same(found.positions[:4])
    assert np.isnan(found.positions[4]).all()
    found = read_points(tmp_path / "a.json", NAMES)
    _same(found.positions)
    assert found.fps == 30


def test_vectors_of_humanml3d(tmp_path: Path) -> None:
    """A body of fixed shape that turns and walks: its distances stay, its root follows the velocities."""
    random = np.random.default_rng(1)
    data = np.zeros((6, 263))
    data[:, 3] = 0.9
    data[:, 0] = 0.1  # half the turn of a frame
    data[:, 2] = 0.05  # forward, in the body's own axes
    data[:, 4:67] = random.normal(size=63)
    np.save(tmp_path / "a.npy", data)
    found = read_points(tmp_path / "a.npy", [f"j{k}" for k in range(22)])
    joints = found.positions
    assert found.fps == 20
    away = np.linalg.norm(joints[:, 3] - joints[:, 9], axis=1)
    np.testing.assert_allclose(away, away[0])
    step = np.diff(joints[:, 0], axis=0)
    np.testing.assert_allclose(np.linalg.norm(step, axis=1), 0.05)
    turn = np.arctan2(step[:, 0], step[:, 2])
    np.testing.assert_allclose(np.abs(np.diff(turn)), 0.2)
    # The body turns with its way: what is beside the root stays beside the direction of the step.
    arm = joints[1:, 9] - joints[1:, 0]
    np.testing.assert_allclose((arm * step).sum(1), (arm * step).sum(1)[0])
    np.save(tmp_path / "b.npy", (data - data.mean()) / 1e-3)
    with pytest.raises(InputError, match="median height"):
        read_points(tmp_path / "b.npy", [f"j{k}" for k in range(22)])


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.zeros((4, 3, 2)), "nothing of depth"),
        (np.zeros((4, 5, 3)), "got 5 points"),
        (np.zeros(7), "expected"),
    ],
)
def test_what_is_no_points_is_refused(tmp_path: Path, values: np.ndarray, said: str) -> None:
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(InputError, match=said):
        read_points(tmp_path / "a.npy", NAMES)
    np.savez(tmp_path / "a.npz", vertices=POINTS, faces=POINTS)
    with pytest.raises(InputError, match="faces"):
        read_points(tmp_path / "a.npz", NAMES)
