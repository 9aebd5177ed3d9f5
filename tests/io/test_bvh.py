"""BVH: what is written is read back; what other tools write is read, and what is wrong with it is said."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core import SomaLayer, load_canonical
from soma_core.errors import InputError, SomaError
from soma_core.geometry.euler import euler_from_matrices, matrices_from_euler
from soma_core.io.bvh import read_bvh, write_bvh
from soma_core.io.joint_order import KIMODO_30_JOINTS, USER_JOINTS
from soma_core.io.motion import Motion
from soma_core.io.skeleton_motion import soma_skeleton

ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
PLACE_MM = 1e-4  # seven decimals of centimetres and degrees
TURN = 1e-5
LAYER_MM = 1e-3  # float32 rotations


@pytest.fixture(scope="module")
def rig():
    return load_canonical("low")[1]


@pytest.fixture(scope="module")
def motion():
    rng = np.random.default_rng(3)
    vectors = np.cumsum(0.3 * rng.normal(size=(20, 77, 3)), axis=0)
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(20, 77, 3, 3)
    return Motion(rotations=rotations, translation=rng.normal(size=(20, 3)), fps=30, joint_names=USER_JOINTS)


def turns_apart(first, second):
    return np.abs(first - second).max()


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(("joints", "rest"), [(77, "t_pose"), (78, "t_pose"), (77, "bind")])
def test_what_is_written_is_read_back(motion, rig, order, joints, rest, tmp_path):
    write_bvh(motion, tmp_path / "a.bvh", rig=rig, joints=joints, order=order, rest=rest)
    found, meant = read_bvh(tmp_path / "a.bvh").placed(np.eye(3), 0.01), soma_skeleton(motion, rig)
    assert found.names == (("Root",) if joints == 78 else ()) + USER_JOINTS
    assert found.fps == 30
    assert 1e3 * np.abs(found.positions()[:, -77:] - meant.positions()).max() < PLACE_MM
    if rest == "t_pose":
        assert turns_apart(found.rotations[:, -77:], meant.rotations) < TURN
    again = tmp_path / "b.bvh"
    write_bvh(found, again, order=order)
    second = read_bvh(again).placed(np.eye(3), 0.01)
    assert 1e3 * np.abs(second.positions() - found.positions()).max() < PLACE_MM
    assert turns_apart(second.rotations, found.rotations) < TURN


@pytest.mark.parametrize("order", ORDERS)
def test_thirty_joints_keep_their_places(motion, rig, order, tmp_path):
    whole = soma_skeleton(motion, rig)
    part = whole.subset(KIMODO_30_JOINTS)
    write_bvh(part, tmp_path / "a.bvh", order=order, unit="m")
    found = read_bvh(tmp_path / "a.bvh")
    kept = [USER_JOINTS.index(name) for name in found.names]
    assert sorted(found.names) == sorted(KIMODO_30_JOINTS)
    assert 1e3 * np.abs(found.positions() - whole.positions()[:, kept]).max() < PLACE_MM
    assert (
        turns_apart(found.rotations, part.rotations[:, [part.names.index(each) for each in found.names]])
        < TURN
    )


@pytest.mark.parametrize("rest", ["t_pose", "bind"])
def test_joints_lie_where_the_layer_puts_them(motion, rest, tmp_path):
    layer = SomaLayer("soma", lod="low", dtype=torch.float64, kernels="torch")
    identity = layer.identity(
        {"shape": 1.5 * torch.randn(128, generator=torch.Generator().manual_seed(1)).double()}
    )
    posed = layer.pose(
        identity, torch.tensor(motion.rotations).double(), torch.tensor(motion.translation).double()
    )
    write_bvh(motion, tmp_path / "a.bvh", rig=layer.rig, bind_world=identity.bind_world[0].numpy(), rest=rest)
    found = read_bvh(tmp_path / "a.bvh").placed(np.eye(3), 0.01)
    assert 1e3 * np.abs(found.positions() - posed.joints.numpy()).max() < LAYER_MM


@pytest.mark.parametrize("order", ORDERS)
def test_angles_go_on_without_jumps(order):
    time = np.linspace(0, 20, 2000)[:, None]
    vectors = time * [0.9, 0.4, 0.7] + np.sin(time * [1, 2, 3])
    matrices = matrices_from_euler(vectors, order)
    angles = euler_from_matrices(matrices, order)
    assert np.abs(matrices_from_euler(angles, order) - matrices).max() < 1e-12
    assert np.abs(np.diff(angles, axis=0)).max() < 0.1


@pytest.mark.parametrize("order", ORDERS)
def test_a_quarter_turn_of_the_middle_angle_is_exact(order):
    angles = np.array([[0.3, 0.5, 0.7], [0.3, np.pi / 2, 0.7], [0.4, np.pi / 2, 0.6], [0.2, -np.pi / 2, 1.0]])
    matrices = matrices_from_euler(angles, order)
    assert np.abs(matrices_from_euler(euler_from_matrices(matrices, order), order) - matrices).max() < 1e-12


JOINT = "ROOT Hips\n{{\nOFFSET 0 90 0\n{root}\n{inner}}}\n"
LEG = "JOINT LeftUpLeg\n{\nOFFSET 10 0 0\nCHANNELS 1 Xrotation\nEnd Site\n{\nOFFSET 0 -40 0\n}\n}\n"
SIX = "CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation"


def written(
    path, rows, *, root=SIX, head="Frames: 2\nFrame Time: 0.033333\n", roots=1, joint=JOINT, end="\n"
):
    text = "HIERARCHY\n" + roots * joint.format(root=root, inner=LEG) + "MOTION\n" + head + rows
    path.write_bytes(text.replace("\n", end).encode())
    return path


def test_what_tools_write_differently_is_read(tmp_path):
    row = "1 90 2 10 20 30 40\n"
    plain = read_bvh(written(tmp_path / "a.bvh", 2 * row))
    assert plain.fps == 30
    assert plain.root[1].tolist() == [1, 90, 2]
    assert plain.ends[1].tolist() == [0, -40, 0]
    expected = Rotation.from_euler("ZYX", [10, 20, 30], degrees=True).as_matrix()
    assert np.abs(plain.rotations[0, 0] - expected).max() < 1e-12
    lines = read_bvh(written(tmp_path / "b.bvh", 2 * row.replace(" ", "\t"), end="\r\n"))
    assert np.array_equal(lines.rotations, plain.rotations)
    noted = read_bvh(written(tmp_path / "c.bvh", "# a note\n" + row + "// another\n" + row))
    assert np.array_equal(noted.rotations, plain.rotations)
    swapped = read_bvh(
        written(
            tmp_path / "d.bvh",
            2 * "30 2 20 90 10 1 40\n",
            root="CHANNELS 6 Xrotation Zposition Yrotation Yposition Zrotation Xposition",
        )
    )
    assert swapped.root[0].tolist() == [1, 90, 2]
    assert (
        np.abs(
            swapped.rotations[0, 0] - Rotation.from_euler("XYZ", [30, 20, 10], degrees=True).as_matrix()
        ).max()
        < 1e-12
    )
    few = read_bvh(written(tmp_path / "e.bvh", "5\n6\n", root="CHANNELS 0"))
    assert few.root[0].tolist() == [0, 90, 0]
    assert few.frame_count == 2


@pytest.mark.parametrize(
    "changed",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace(".", ","),
        lambda text: text.replace(".5 ", ",5;").replace(".", ","),
        lambda text: text.replace(".5 ", ".5, "),
        lambda text: text.replace("1.5 90.5 2.5 10.5 20.5 30.5 40.5", "1.5,90.5,2.5,10.5,20.5,30.5,40.5"),
    ],
    ids=["mark", "returns", "decimal commas", "semicolons", "commas and blanks", "commas"],
)
def test_numbers_of_other_countries_and_programs_are_read(changed, tmp_path, caplog):
    path = written(tmp_path / "a.bvh", 2 * "1.5 90.5 2.5 10.5 20.5 30.5 40.5\n")
    plain = read_bvh(path)
    path.write_bytes(changed(path.read_text()).encode())
    found = read_bvh(path)
    assert found.fps == plain.fps == 30
    np.testing.assert_array_equal(found.rest, plain.rest)
    np.testing.assert_array_equal(found.root, plain.root)
    np.testing.assert_array_equal(found.rotations, plain.rotations)
    assert not caplog.records


@pytest.mark.parametrize(
    ("head", "fps", "said"),
    [
        ("Frames: 2\nFrame Time: 0.0083333\n", 120, ""),
        ("Frames: 2\nFrame Time: 0.033367\n", 30 / 1.001, ""),
        ("Frames: 2\nFrame Time: 0.02\n", 50, ""),
        ("Frames: 2\nFrame Time: 0.0371\n", 1 / 0.0371, ""),
        ("Frames: 2\nFrame Time: 30\n", 30, "read as a rate of 30"),
        ("Frames: 7\nFrame Time: 0.04\n", 25, "announces 7 frames and holds 2"),
        ("Frame Time: 0.04\nFrames: 2\n", 25, ""),
    ],
)
def test_frame_times_and_counts(head, fps, said, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        found = read_bvh(written(tmp_path / "a.bvh", 2 * "0 90 0 1 2 3 4\n", head=head))
    assert found.fps == pytest.approx(fps, rel=1e-9)
    assert found.frame_count == 2
    assert (said in caplog.text) if said else not caplog.records


def test_a_frame_that_is_cut_off_is_left_out(tmp_path, caplog):
    found = read_bvh(written(tmp_path / "a.bvh", "0 90 0 1 2 3 4\n0 90 0 1"))
    assert found.frame_count == 1
    assert "4 of the 7 numbers" in caplog.text


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"head": "Frames: 2\n"}, r"Frame Time: got none.*fps=30"),
        ({"head": "Frames: 2\nFrame Time: 2\n"}, r"Frame Time: got 2.*fps=30"),
        ({"roots": 2}, r"root: got 2 skeletons.*root=Hips"),
        ({"rows": "0 90 0 1 nan 3 4\n"}, r"MOTION: got 'nan'"),
        ({"rows": "0 90 0 1 1e300 3 4\n"}, r"a\.bvh: MOTION: got 1e\+300 degrees, expected at most 1e\+06"),
        ({"rows": "0 -1e300 0 1 2 3 4\n"}, r"MOTION: got 1e\+300 units of length, expected at most 1e\+09"),
        ({"rows": "0.5 90 0 1 -1.#IND00 3 4\n"}, r"MOTION: got '-1.#IND00'"),
        ({"root": "CHANNELS 3 Xrotation"}, r"unreadable CHANNELS of 'Hips'"),
        ({"joint": JOINT.replace("{root}", "OFFSET 1 2 x")}, r"unreadable OFFSET of 'Hips'"),
    ],
)
def test_what_cannot_be_read_is_refused(change, match, tmp_path):
    options = {"rows": 2 * "0 90 0 1 2 3 4\n"} | change
    with pytest.raises(SomaError, match=match):
        read_bvh(written(tmp_path / "a.bvh", options.pop("rows"), **options))


def test_writing_refuses_what_is_no_choice(motion, rig, tmp_path):
    with pytest.raises(InputError, match="order: got 'ZXZ'"):
        write_bvh(motion, tmp_path / "a.bvh", rig=rig, order="ZXZ")
    with pytest.raises(InputError, match="rig: got none"):
        write_bvh(motion, tmp_path / "a.bvh")
    with pytest.raises(InputError, match="names: got"):
        soma_skeleton(motion, rig).subset(["Hips", "Tail"])
