"""Joints alone, read again by numpy and csv, and keypoints against a projection written out by hand."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_core.errors import AssetError, InputError
from soma_core.io.camera import read_camera
from soma_core.io.joint_files import (
    JointFrames,
    JointPiece,
    chosen_joints,
    write_joints_csv,
    write_joints_npz,
    write_keypoints,
)

NAMES, FRAMES, FPS = ("Hips", "LeftForeArm", "LeftHand"), 7, 30.0
PLACES = np.random.default_rng(0).standard_normal((FRAMES, 3, 3)).astype(np.float32)
TURNS = Rotation.from_rotvec(np.deg2rad(100) * np.outer(np.arange(FRAMES * 3), [0, 1, 0]))  # past half turns
MATRICES = TURNS.as_matrix().reshape(FRAMES, 3, 3, 3)


def joints(**changes):
    pieces = [JointPiece(PLACES[part], MATRICES[part]) for part in (slice(0, 3), slice(3, None))]
    shown = {
        "pieces": lambda: iter(pieces), "frame_count": FRAMES, "names": NAMES, "fps": FPS, "up": "+z",
        "rest": JointPiece(PLACES[:1], MATRICES[:1]), "source": "a walk",
    }  # fmt: skip
    return JointFrames(**shown | changes)


def test_an_npz_of_joints(tmp_path):
    write_joints_npz(tmp_path / "j.npz", joints())
    with np.load(tmp_path / "j.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["positions"], PLACES)
        turned = Rotation.from_quat(file["quaternions"].reshape(-1, 4), scalar_first=True)
        assert file["quaternion_order"] == "wxyz"
        assert (turned * TURNS.inv()).magnitude().max() < 1e-6
        steps = (file["quaternions"][1:] * file["quaternions"][:-1]).sum(-1)
        assert steps.min() >= -1e-6  # no flip, over the border of the pieces either
        assert (file["fps"], file["unit"], file["up_axis"]) == (FPS, "meters", "Z")
        assert tuple(file["joint_names"]) == NAMES
        assert file["parents"].tolist() == [-1, 0, 1]
        np.testing.assert_array_equal(file["t_pose_positions"], PLACES[0])
        assert file["t_pose_quaternions"].shape == (3, 4)
    assert [path.name for path in tmp_path.iterdir()] == ["j.npz"]


def test_a_csv_of_joints(tmp_path):
    write_joints_npz(tmp_path / "j.npz", joints())
    write_joints_csv(tmp_path / "j.csv", joints())
    with open(tmp_path / "j.csv", encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == FRAMES
    assert (rows[4]["frame"], float(rows[4]["time_s"]), rows[4]["fps"], rows[4]["up"]) == (
        "4", pytest.approx(4 / FPS), "30", "+z",
    )  # fmt: skip
    places = [[[row[f"{name}_{axis}_m"] for axis in "xyz"] for name in NAMES] for row in rows]
    np.testing.assert_array_equal(np.array(places, np.float32), PLACES)
    turns = [[[row[f"{name}_q{axis}"] for axis in "wxyz"] for name in NAMES] for row in rows]
    with np.load(tmp_path / "j.npz") as file:
        np.testing.assert_array_equal(np.array(turns, np.float32), file["quaternions"])


CAMERA = {
    "fx": 800,
    "fy": 900,
    "cx": 320,
    "cy": 240,
    "extrinsics": [[1, 0, 0, 0.1], [0, -1, 0, 1], [0, 0, -1, 2]],
}


def written(folder, **changes):
    (folder / "camera.json").write_text(json.dumps(CAMERA | changes))
    return folder / "camera.json"


def test_keypoints_are_where_the_camera_sees_them(tmp_path):
    camera = read_camera(written(tmp_path, width=640, height=480))
    write_keypoints(tmp_path / "k.npz", joints(), camera)
    seen = 0
    with np.load(tmp_path / "k.npz", allow_pickle=False) as file:
        for frame, joint in np.ndindex(FRAMES, 3):
            x, y, z = PLACES[frame, joint].astype(float)
            right, down, ahead = x + 0.1, 1 - y, 2 - z
            assert file["depth"][frame, joint] == pytest.approx(ahead, abs=1e-5)
            if ahead <= 0:
                assert np.isnan(file["keypoints"][frame, joint]).all()
                assert not file["visible"][frame, joint]
                continue
            u, v = 800 * right / ahead + 320, 900 * down / ahead + 240
            np.testing.assert_allclose(file["keypoints"][frame, joint], [u, v], rtol=1e-5, atol=1e-3)
            assert file["visible"][frame, joint] == (0 <= u < 640 and 0 <= v < 480)
            seen += file["visible"][frame, joint]
        assert 0 < seen < FRAMES * 3
        assert tuple(file["joint_names"]) == NAMES


def test_a_camera_may_move(tmp_path):
    moving = [np.array(CAMERA["extrinsics"]) + frame * np.eye(3, 4, 3) for frame in range(FRAMES)]
    camera = read_camera(written(tmp_path, extrinsics=np.array(moving).tolist()))
    write_keypoints(tmp_path / "k.npz", joints(), camera)
    with np.load(tmp_path / "k.npz") as file:
        for frame in range(FRAMES):
            still = read_camera(written(tmp_path, extrinsics=moving[frame].tolist()))
            alone = still.project(PLACES[frame : frame + 1])[0][0]
            np.testing.assert_array_equal(file["keypoints"][frame], alone)
    with pytest.raises(
        InputError, match=r"extrinsics: got 7 matrices, expected one, or one for each of the 1 "
    ):
        write_keypoints(tmp_path / "k.npz", joints(frame_count=1), camera)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"fx": -1}, "fx: got -1, expected a positive number"),
        ({"cx": "x"}, "cx: got 'x', expected a number"),
        ({"k1": 0.1}, "got the key k1, .*distortion is not modelled"),
        ({"width": 640}, "got a width or a height alone"),
        ({"extrinsics": [1, 2]}, r"extrinsics: got shape \(2,\), expected a 3 x 4 or 4 x 4 matrix"),
        ({"extrinsics": [[1, 2], [3]]}, r"extrinsics: got shape \(0,\)"),
        ({"extrinsics": np.diag([2, 2, 2, 1]).tolist()}, "extrinsics: got no rotation"),
        ({"extrinsics": np.diag([1e300, 1, 1, 1]).tolist()}, "extrinsics: got no rotation"),
        ({"extrinsics": np.diag([1, -1, 1, 1]).tolist()}, "extrinsics: got a reflection"),
    ],
)
def test_what_is_no_camera_is_refused(tmp_path, changes, said):
    with pytest.raises(InputError, match=said):
        read_camera(written(tmp_path, **changes))


@pytest.mark.parametrize("text", ["", "[1]", "{", "[" * 100000])
def test_what_is_no_json_is_refused(tmp_path, text):
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(AssetError, match=r"camera\.json: "):
        read_camera(tmp_path / "camera.json")


def test_a_camera_needs_to_stand_somewhere(tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps({"fx": 1, "fy": 1, "cx": 0, "cy": 0}))
    with pytest.raises(InputError, match="got no extrinsics, expected fx, fy, cx, cy, extrinsics"):
        read_camera(tmp_path / "camera.json")


@pytest.mark.parametrize(
    ("names", "said"), [(["Hip"], "got 'Hip'"), (["Hips", "Hips"], "got 'Hips' twice"), ([], "got no joint")]
)
def test_joints_that_are_none_are_refused(names, said):
    with pytest.raises(InputError, match=f"joints: {said}, expected names among Hips, LeftForeArm, LeftHand"):
        chosen_joints(names, NAMES)


def test_joints_come_in_the_order_asked_for():
    assert chosen_joints(["LeftHand", "Hips"], NAMES) == [2, 0]
    assert chosen_joints(None, NAMES) == [0, 1, 2]
