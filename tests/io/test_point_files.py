"""Files of points: arrays, tables, JSON of keypoint tools, HumanML3D's vectors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.io.point_files import read_points
from soma_core.points.point_set import load_point_set

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
    for between in ("\t", ";"):
        lines = [between.join(f"{value:.12f}".replace(".", ",") for value in row) for row in rows]
        (tmp_path / "c.csv").write_text("\n".join([head.replace(",", between), *lines]))
        _same(read_points(tmp_path / "c.csv", NAMES).positions, known)


def test_numbers_that_a_folder_skips_are_frames_of_nobody(tmp_path: Path) -> None:
    for number, frame in zip((0, 2, 8, 10), POINTS, strict=True):
        content = [{"id": 0, "keypoints3d": frame.tolist()}]
        (tmp_path / f"clip3_{number:06d}_keypoints.json").write_text(json.dumps(content))
    found = read_points(tmp_path, NAMES).positions
    assert len(found) == 6
    _same(found[[0, 1, 4, 5]])
    assert np.isnan(found[[2, 3]]).all()


def test_a_body_comes_before_its_hands_and_face(tmp_path: Path) -> None:
    whole = np.random.default_rng(1).normal(size=(2, 553, 3))
    np.save(tmp_path / "a.npy", whole)
    names = load_point_set("mediapipe33").names
    _same(read_points(tmp_path / "a.npy", names).positions, whole[:, :33])


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
        (np.zeros((4, 3, 2)), "camera=FILE.json"),
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


@pytest.mark.parametrize(
    ("beside", "said"),
    [
        ({"points": np.array([{"a": 1}], object)}, "Python objects: a dict"),
        ({"scores": np.zeros(7)}, "could not be broadcast"),
        ({"scores": np.full((4, 3), "a")}, "could not convert string"),
        ({"fps": np.zeros(0)}, "index 0 is out of bounds"),
    ],
)
def test_what_is_beside_the_points_is_no_foreign_error(tmp_path: Path, beside, said: str) -> None:
    path = tmp_path / "points.npz"
    np.savez(path, **{"points": np.ones((4, 3, 3))} | beside)
    with pytest.raises(InputError, match=rf"points\.npz: got values of another kind \(.*{said}"):
        read_points(path, ("a", "b", "c"))


def test_points_of_pictures(tmp_path: Path) -> None:
    """Arrays, tables, OpenPose's folders, COCO's results and MMPose's frames; the person of most score."""
    flat = POINTS[..., :2]
    scored = np.concatenate((flat, np.full((4, 3, 1), 0.5)), -1)
    np.save(tmp_path / "a.npy", scored)
    found = read_points(tmp_path / "a.npy", NAMES, views=1)
    _same(found.positions, flat)
    _same(found.confidence, np.full((4, 3), 0.5))
    head = ",".join(f"{name}_{axis}" for name in NAMES for axis in "xy")
    np.savetxt(tmp_path / "a.csv", flat.reshape(4, -1), delimiter=",", header=head, comments="")
    _same(read_points(tmp_path / "a.csv", NAMES, views=1).positions, flat)
    pose = tmp_path / "pose"
    pose.mkdir()
    for number, frame in enumerate(scored):
        people = {"people": [{"pose_keypoints_2d": frame.ravel().tolist()}]}
        (pose / f"clip_{number}_keypoints.json").write_text(json.dumps(people), encoding="utf-8")
    _same(read_points(pose, NAMES, views=1).positions, flat)
    coco = [
        {"image_id": 10 + number, "keypoints": (frame + wrong).ravel().tolist(), "score": 1.0 - wrong}
        for number, frame in enumerate(scored) for wrong in (0.25, 0.0) if number != 2
    ]  # fmt: skip
    (tmp_path / "coco.json").write_text(json.dumps(coco), encoding="utf-8")
    found = read_points(tmp_path / "coco.json", NAMES, views=1).positions
    _same(found[[0, 1, 3]], flat[[0, 1, 3]])
    assert np.isnan(found[2]).all()
    frames = [{"instances": [{"keypoints": frame.tolist(), "keypoint_scores": [0.5] * 3}]} for frame in flat]
    (tmp_path / "mm.json").write_text(json.dumps({"instance_info": frames}), encoding="utf-8")
    found = read_points(tmp_path / "mm.json", NAMES, views=1)
    _same(found.positions, flat)
    _same(found.confidence, np.full((4, 3), 0.5))


def test_several_views(tmp_path: Path) -> None:
    views = np.stack([POINTS[..., :2], 2 * POINTS[..., :2]])
    np.save(tmp_path / "a.npy", views)
    _same(read_points(tmp_path / "a.npy", NAMES, views=2).positions, views)
    folder = tmp_path / "views"
    folder.mkdir()
    for name, view in zip("ab", views, strict=True):
        np.save(folder / f"{name}.npy", view)
    _same(read_points(folder, NAMES, views=2).positions, views)
    with pytest.raises(InputError, match="got 2 views of 4 frames, expected 3"):
        read_points(folder, NAMES, views=3)
    np.save(folder / "b.npy", views[1, :3])
    with pytest.raises(InputError, match="2 views of 3, 4 frames"):
        read_points(folder, NAMES, views=2)
