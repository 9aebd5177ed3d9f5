"""Motion files: exact round trip, the files of other tools, and refusals that name the key."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.errors import AssetError, InputError
from soma_core.io import USER_JOINTS, Motion, check_rig, read_motion, write_motion, write_motion_parts
from soma_core.io.joint_order import KIMODO_30_JOINTS, PARENT_NAMES, nearest_ancestors
from soma_core.motion import layout_of

ROTVEC_TOLERANCE = 2e-6
"""Matrix entries after a trip through float32 rotation vectors of up to 3 rad."""

KIMODO_TOLERANCE = 2e-6
"""World rotations rebuilt from float32 files over up to ten joints."""

RECORDED = sorted(Path(os.environ.get("SOMA_TEST_DATA", "/nonexistent")).glob("motions/kimodo_*.npz"))
"""Recordings that are not part of the project; SOMA_TEST_DATA names the folder that holds motions/."""


def random_rotations(frames, joints, seed=0):
    quaternions = np.random.default_rng(seed).normal(size=(frames * joints, 4))
    return Rotation.from_quat(quaternions).as_matrix().reshape(frames, joints, 3, 3)


@pytest.fixture
def motion():
    generator = np.random.default_rng(1)
    return Motion(
        rotations=random_rotations(5, 77),
        translation=generator.normal(size=(5, 3)),
        fps=29.97,
        joint_names=USER_JOINTS,
        rig_revision="0123456789abcdef",
        source="a test",
        licence="CC0-1.0",
        identity={
            "backend": "anny",
            "params": {"age": 0.2, "local": [0.1, -0.3]},
            "options": {"local_changes": True},
        },
    )


def save(path, **arrays):
    np.savez(path, **arrays)
    return path


def tools_file(path, **changes):
    """A file as the SOMA tools write it: centimetres, rotation vectors, T-pose-relative."""
    rotations = random_rotations(4, 77, seed=2)
    arrays = {
        "poses": Rotation.from_matrix(rotations.reshape(-1, 3, 3))
        .as_rotvec()
        .reshape(4, 77, 3)
        .astype(np.float32),
        "transl": np.tile(np.float32([10, 100, -20]), (4, 1)),
        "joint_names": np.array(USER_JOINTS),
        "identity_model_type": np.array(b"soma"),
        "identity_coeffs": np.zeros((1, 128), np.float32),
        "keep_root": False,
        "absolute_pose": False,
        "rotation_repr": "rotvec",
        "unit": "centimeters",
        "joint_orient": np.tile(np.eye(3), (78, 1, 1)),
        "allow_pickle": False,
    } | changes
    save(path, **{name: value for name, value in arrays.items() if value is not None})
    return rotations


def kimodo_file(path, **changes):
    arrays = {
        "posed_joints": np.random.default_rng(0).normal(size=(6, 30, 3)),
        "global_rot_mats": random_rotations(6, 30, seed=3),
        "foot_contacts": np.zeros((6, 4), bool),
    } | changes
    return save(path, **{name: value for name, value in arrays.items() if value is not None})


# -- our schema ---------------------------------------------------------------------------------------


def test_round_trip_is_exact(motion, tmp_path):
    write_motion(motion, tmp_path / "motion.npz")
    again = read_motion(tmp_path / "motion.npz")
    np.testing.assert_array_equal(again.rotations, motion.rotations)
    np.testing.assert_array_equal(again.translation, motion.translation)
    for name in ("fps", "joint_names", "convention", "rig_revision", "source", "licence", "identity"):
        assert getattr(again, name) == getattr(motion, name), name


def test_a_rest_shape_goes_with_its_motion(motion, tmp_path):
    rest = np.arange(12, dtype=np.float32).reshape(4, 3)
    write_motion(replace(motion, identity={**motion.identity, "rest": rest}), tmp_path / "m.npz")
    found = read_motion(tmp_path / "m.npz").identity
    assert found["params"] == motion.identity["params"]
    np.testing.assert_array_equal(found["rest"], rest)


def test_contacts_and_skeleton_go_with_their_motion(motion, tmp_path):
    contacts = np.random.default_rng(0).random((5, 4)) > 0.5
    skeleton = np.random.default_rng(1).normal(size=(77, 3)).astype(np.float32)
    skeleton[3] = np.nan
    kept = replace(motion, contacts=contacts, skeleton=skeleton)
    write_motion(kept, tmp_path / "m.npz")
    write_motion_parts(
        lambda: iter([kept.cut(slice(0, 2)), kept.cut(np.arange(2, 5))]),
        tmp_path / "parts.npz",
        frame_count=5,
    )
    for name in ("m.npz", "parts.npz"):
        again = read_motion(tmp_path / name)
        np.testing.assert_array_equal(again.contacts, contacts)
        np.testing.assert_array_equal(again.skeleton, skeleton)
    write_motion(motion, tmp_path / "m.npz")
    assert read_motion(tmp_path / "m.npz").contacts is None


def test_rotation_vectors_round_trip_to_rounding(motion, tmp_path):
    write_motion(motion, tmp_path / "motion.npz", rotation_repr="rotvec")
    again = read_motion(tmp_path / "motion.npz")
    np.testing.assert_allclose(again.rotations, motion.rotations, atol=ROTVEC_TOLERANCE)


def test_absolute_rotations_stay_absolute(motion, tmp_path):
    write_motion(
        replace(motion, convention="absolute_local"), tmp_path / "m.npz", joint_orient=np.zeros((77, 3, 3))
    )
    assert read_motion(tmp_path / "m.npz").convention == "absolute_local"
    assert "joint_orient" not in np.load(tmp_path / "m.npz")


def test_the_file_speaks_the_keys_of_the_soma_tools(motion, tmp_path):
    orient = random_rotations(1, 77)[0].astype(np.float32)
    write_motion(motion, tmp_path / "motion.npz", joint_orient=orient)
    with np.load(tmp_path / "motion.npz", allow_pickle=False) as file:
        assert file["poses"].shape == (5, 77, 3, 3)
        assert str(file["unit"]) == "meters"
        assert str(file["identity_model_type"]) == "anny"
        np.testing.assert_array_equal(file["joint_orient"], orient)
        np.testing.assert_allclose(file["identity_coeffs"], [[0.2, 0.1, -0.3]], rtol=1e-6)
        assert not file["absolute_pose"]


def test_a_failed_write_leaves_the_old_file(motion, tmp_path, monkeypatch):
    write_motion(motion, tmp_path / "motion.npz")
    before = (tmp_path / "motion.npz").read_bytes()

    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="disk full"):
        write_motion(motion, tmp_path / "motion.npz")
    assert (tmp_path / "motion.npz").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["motion.npz"]


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("schema_version", 99, r"schema_version: got 99, expected 1"),
        ("up_axis", "Z", r"up_axis: got 'Z', expected 'Y'"),
        ("root_translation", "offset", r"root_translation: got 'offset'"),
        ("convention", "bone_aligned", r"convention: got 'bone_aligned'"),
        ("unit", "inches", r"unit: got 'inches', expected 'meters'"),
        ("unit", "", r"unit: got no unit"),
        ("fps", 0.0, r"fps: got 0\.0"),
        ("fps", 20001.0, r"fps: got 20001\.0, expected a positive number, at most 10,000"),
        ("fps", [24.0, 30.0], r"fps: got shape \(2,\), expected one number"),
        ("rotation_repr", "euler", r"rotation_repr: got 'euler'"),
        ("poses", np.zeros((5, 77, 3, 3)), r"poses: got a reflection at frame 0, joint 0"),
        ("poses", np.eye(3) * np.ones((5, 77, 1, 1)) * 1.01, r"poses: got \|RᵀR - I\| = 0\.0201"),
        ("poses", np.zeros((5, 77, 4)), r"poses: got shape \(5, 77, 4\)"),
        ("poses", np.zeros((5, 52, 3)), r"poses: got 52 joints"),
        ("transl", np.zeros((4, 3)), r"transl: got shape \(4, 3\), dtype float64, expected .*\(5, 3\)"),
        ("transl", np.full((5, 3), np.nan), r"transl: got nan at index \(0, 0\)"),
        ("transl", np.array(["a"]), r"transl: got shape \(1,\), dtype <U1"),
        ("source", np.array(["a", "b"]), r"source: got 2 texts"),
        ("source", 3.0, r"source: got dtype float64, expected text"),
        ("identity_options", "[1]", r"identity_options: got '\[1\]', expected a JSON object"),
        ("identity_params", "{age", r"identity_params: got '\{age'"),
        ("identity_params", '{"age": [1, NaN]}', r"motion\.npz: identity_params: got age = \[1, nan\]"),
        ("identity_params", '{"age": {}}', r"identity_params: got age = \{\}, expected finite numbers"),
        ("identity_rest", np.full((4, 3), np.inf), r"motion\.npz: identity_rest: got NaN or infinity"),
        ("foot_contacts", np.zeros((5, 2)), r"foot_contacts: got shape \(5, 2\)"),
        ("skeleton", np.zeros((78, 3)), r"skeleton: got float64 of shape \(78, 3\), expected \(77, 3\)"),
        ("identity_rest", np.zeros((4, 2)), r"identity_rest: got float64 of shape \(4, 2\)"),
    ],
)
def test_a_bad_value_is_refused_by_name(motion, tmp_path, key, value, text):
    path = tmp_path / "motion.npz"
    write_motion(motion, path)
    arrays = dict(np.load(path)) | {key: value}
    if key == "poses" and np.ndim(value) == 3:
        arrays["rotation_repr"] = "rotvec"
    with pytest.raises(InputError, match=text):
        read_motion(save(path, **arrays))


def test_pickled_objects_are_never_loaded(motion, tmp_path):
    path = tmp_path / "motion.npz"
    write_motion(motion, path)
    arrays = dict(np.load(path))
    save(path, **arrays, extra=np.array([{}], dtype=object))  # not needed, so not read
    read_motion(path)
    with pytest.raises(InputError, match=r"transl: got an unreadable array .*Python objects"):
        read_motion(save(path, **arrays | {"transl": np.array([{}], dtype=object)}))


def test_missing_keys_are_named(motion, tmp_path):
    path = tmp_path / "motion.npz"
    write_motion(motion, path)
    arrays = dict(np.load(path))
    del arrays["transl"]
    with pytest.raises(InputError, match=r"transl: got only the keys schema_version, poses"):
        read_motion(save(path, **arrays))


# -- what is not a motion file ------------------------------------------------------------------------


def test_files_that_are_no_motion_are_told_apart(tmp_path):
    path = tmp_path / "m.npz"
    with pytest.raises(AssetError, match=r"m\.npz: file is missing"):
        read_motion(path)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:1234\nsize 7\n")
    with pytest.raises(AssetError, match=r"git-LFS pointer.*git lfs pull"):
        read_motion(path)
    path.write_bytes(b"HIERARCHY\nROOT Hips")
    with pytest.raises(AssetError, match=r"not an NPZ file \(it starts with b'HIERARC"):
        read_motion(path)
    save(path, trans=np.zeros((3, 3)), poses=np.zeros((3, 156)), mocap_framerate=120)
    with pytest.raises(InputError, match=r"layout: got the keys trans, poses, mocap_framerate"):
        read_motion(path)


def test_a_damaged_file_is_refused(motion, tmp_path):
    path = tmp_path / "m.npz"
    write_motion(motion, path)
    content = bytearray(path.read_bytes())
    where = content.index(b"poses.npy") + 200
    content[where : where + 50] = bytes(50)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"poses: got an unreadable array .Bad CRC"):
        read_motion(path)


# -- the SOMA tools -----------------------------------------------------------------------------------


def test_soma_tools_file(tmp_path):
    rotations = tools_file(tmp_path / "m.npz")
    motion = read_motion(tmp_path / "m.npz", fps=60)
    np.testing.assert_allclose(motion.rotations, rotations, atol=ROTVEC_TOLERANCE)
    np.testing.assert_allclose(motion.translation[0], [0.1, 1.0, -0.2], rtol=1e-6)
    assert motion.identity["backend"] == "soma"
    assert (motion.fps, motion.convention) == (60, "t_pose_relative")


def test_soma_tools_file_needs_its_frame_rate_and_unit(tmp_path):
    tools_file(tmp_path / "m.npz", unit=None)
    with pytest.raises(InputError, match=r"fps: got no frame rate.*fps=30"):
        read_motion(tmp_path / "m.npz", unit="meters")
    with pytest.raises(InputError, match=r"unit: got no unit.*Pass unit=m, cm or mm"):
        read_motion(tmp_path / "m.npz", fps=30)
    assert read_motion(tmp_path / "m.npz", fps=30, unit="millimeters").translation[0, 1] == np.float32(0.1)


def test_joint_orient_tells_relative_from_absolute(tmp_path):
    path = tmp_path / "m.npz"
    tools_file(path, joint_orient=None, absolute_pose=True)
    assert read_motion(path, fps=30).convention == "absolute_local"
    tools_file(path, absolute_pose=None)
    assert read_motion(path, fps=30).convention == "t_pose_relative"
    tools_file(path, absolute_pose=True)
    with pytest.raises(InputError, match=r"absolute_pose: got absolute_pose=True with joint_orient"):
        read_motion(path, fps=30)
    assert read_motion(path, fps=30, convention="absolute_local").convention == "absolute_local"


def test_a_file_with_root_or_another_order_is_reordered(tmp_path):
    path = tmp_path / "m.npz"
    rotations = tools_file(path)
    order = np.random.default_rng(0).permutation(77)
    with_root = np.concatenate([np.tile(np.eye(3), (4, 1, 1, 1)), rotations[:, order]], axis=1)
    names = np.array(["Root", *(USER_JOINTS[i] for i in order)])
    tools_file(path, poses=with_root, rotation_repr="matrix", joint_names=names, keep_root=True)
    np.testing.assert_allclose(read_motion(path, fps=30).rotations, rotations, atol=1e-6)
    with_root[2, 0] = Rotation.from_euler("y", 1, degrees=True).as_matrix()
    tools_file(path, poses=with_root, rotation_repr="matrix", joint_names=names, keep_root=True)
    with pytest.raises(InputError, match=r"poses: got a rotated Root .*in frame 2"):
        read_motion(path, fps=30)


def test_the_lost_hips_of_the_tools_writer_are_noticed(tmp_path):
    path = tmp_path / "m.npz"
    tools_file(path, poses=np.zeros((4, 76, 3)), joint_names=np.array(USER_JOINTS[1:]))
    with pytest.raises(InputError, match=r"76 joints and 76 names .*'Spine1'.*Hips is not among them"):
        read_motion(path, fps=30)


# -- kimodo -------------------------------------------------------------------------------------------


def test_kimodo_local_rotations_compose_to_the_stored_ones(tmp_path):
    path = kimodo_file(tmp_path / "k.npz")
    stored = np.load(path)
    motion = read_motion(path)
    world = {"Root": np.eye(3)}
    for index, (name, parent) in enumerate(PARENT_NAMES.items()):
        world[name] = world[parent] @ motion.rotations[:, index].astype(np.float64)
    for index, name in enumerate(KIMODO_30_JOINTS):
        if not name.endswith("End"):
            np.testing.assert_allclose(
                world[name], stored["global_rot_mats"][:, index], atol=KIMODO_TOLERANCE
            )
    np.testing.assert_array_equal(motion.translation, stored["posed_joints"][:, 0].astype(np.float32))
    assert motion.fps == 30
    assert read_motion(path, fps=24).fps == 24


def test_kimodo_joints_outside_the_thirty_rest(tmp_path):
    motion = read_motion(kimodo_file(tmp_path / "k.npz"))
    still = [
        i
        for i, name in enumerate(USER_JOINTS)
        if name.endswith(("End", "1")) and "Thumb1" not in name and name != "Spine1" and name != "Neck1"
    ]
    assert len(still) == 1 + 2 * (5 + 4 + 1)  # the head's end; a hand's five ends, four palms, a foot's end
    np.testing.assert_array_equal(
        motion.rotations[:, still], np.broadcast_to(np.eye(3), (6, len(still), 3, 3))
    )


@pytest.mark.parametrize("side", ["Left", "Right"])
@pytest.mark.parametrize(
    ("end", "fingers"), [("ThumbEnd", ["Thumb"]), ("MiddleEnd", ["Index", "Middle", "Ring", "Pinky"])]
)
def test_kimodo_finger_ends_are_the_whole_turn_of_their_fingers(tmp_path, side, end, fingers):
    path = kimodo_file(tmp_path / "k.npz")
    world = np.load(path)["global_rot_mats"]
    hand, tip = (KIMODO_30_JOINTS.index(side + name) for name in ("Hand", "Hand" + end))
    turn = np.swapaxes(world[:, hand], -1, -2) @ world[:, tip]
    rotations = read_motion(path).rotations.astype(np.float64)
    for finger in fingers:
        total = np.eye(3)
        for part in ("1", "2", "3", "4", "End"):
            name = f"{side}Hand{finger}{part}"
            if name in USER_JOINTS:
                total = total @ rotations[:, USER_JOINTS.index(name)]
        np.testing.assert_allclose(total, turn, atol=KIMODO_TOLERANCE)


def posed(path, **changes):
    """A kimodo file whose joints are those of a skeleton, and that skeleton."""
    offsets = np.random.default_rng(8).uniform(-0.4, 0.4, (30, 3))
    world = random_rotations(6, 30, seed=3)
    joints = np.zeros((6, 30, 3))
    joints[:, 0] = np.random.default_rng(9).normal(size=(6, 3))
    for index, above in enumerate(nearest_ancestors(KIMODO_30_JOINTS)):
        if above >= 0:
            joints[:, index] = joints[:, above] + world[:, above] @ offsets[index]
    return kimodo_file(path, **{"global_rot_mats": world, "posed_joints": joints} | changes), offsets


def test_kimodo_keeps_contacts_and_the_skeleton_that_moved(tmp_path):
    contacts = np.random.default_rng(0).random((6, 4)) > 0.5
    path, offsets = posed(tmp_path / "k.npz", foot_contacts=contacts)
    for unit, metres in ((None, 1.0), ("centimeters", 0.01)):
        motion = read_motion(path, unit=unit)
        np.testing.assert_array_equal(motion.contacts, contacts)
        for index, name in enumerate(KIMODO_30_JOINTS):
            found = motion.skeleton[USER_JOINTS.index(name)]
            if PARENT_NAMES[name] in KIMODO_30_JOINTS:
                np.testing.assert_allclose(found, metres * offsets[index], atol=KIMODO_TOLERANCE)
        assert np.isnan(motion.skeleton[USER_JOINTS.index("LeftHandThumbEnd")]).all()
    assert read_motion(posed(tmp_path / "k.npz", foot_contacts=None)[0]).contacts is None


def test_kimodo_joints_in_other_axes_than_the_rotations_are_said(tmp_path, caplog):
    path, _ = posed(tmp_path / "k.npz")
    joints = np.load(path)["posed_joints"]
    for changed in (joints * [-1, 1, 1], joints[..., [0, 2, 1]] * [1, -1, 1]):
        caplog.clear()
        motion = read_motion(posed(tmp_path / "k.npz", posed_joints=changed)[0])
        assert "do not fit the rotations" in caplog.text
        assert motion.skeleton is None


def test_kimodo_extras_that_are_not_as_they_should_be_are_said_and_left_out(tmp_path, caplog):
    hips = np.zeros((6, 3))
    path, _ = posed(
        tmp_path / "k.npz", foot_contacts=np.zeros((6, 2)), posed_joints=hips, root_positions=hips
    )
    motion = read_motion(path)
    assert motion.contacts is None
    assert motion.skeleton is None
    assert "foot_contacts is not used" in caplog.text
    assert "posed_joints is not used" in caplog.text


def test_a_batch_of_kimodo_samples(tmp_path):
    arrays = {"global_rot_mats": random_rotations(12, 30).reshape(2, 6, 30, 3, 3),
              "posed_joints": np.random.default_rng(4).normal(size=(2, 6, 30, 3)),
              "foot_contacts": np.ones((2, 6, 4), bool)}  # fmt: skip
    both = kimodo_file(tmp_path / "both.npz", **arrays)
    with pytest.raises(InputError, match=r"got 2 samples, expected one of 0 to 1. Pass person=0"):
        read_motion(both)
    with pytest.raises(InputError, match=r"got person=2 of 2 samples"):
        read_motion(both, person="2")
    for number in range(2):
        one = {key: value[number : number + 1] for key, value in arrays.items()}
        alone = read_motion(kimodo_file(tmp_path / "one.npz", **one))
        chosen = read_motion(both, person=str(number))
        np.testing.assert_array_equal(chosen.rotations, alone.rotations)
        np.testing.assert_array_equal(chosen.translation, alone.translation)
        np.testing.assert_array_equal(chosen.skeleton, alone.skeleton)


@pytest.mark.parametrize(("count", "name"), [(22, "SMPL-X"), (34, "the Unitree G1 robot")])
def test_other_skeletons_of_kimodo_are_named(tmp_path, count, name):
    with pytest.raises(InputError, match=f"got {count} joints, those of {name}.*kimodo_convert"):
        read_motion(kimodo_file(tmp_path / "k.npz", global_rot_mats=random_rotations(6, count)))


def test_kimodo_77_joints_are_taken_as_they_are(tmp_path):
    local = random_rotations(6, 77, seed=5).astype(np.float32)
    hips = np.random.default_rng(2).normal(size=(6, 3)).astype(np.float32)
    path = kimodo_file(tmp_path / "k.npz", local_rot_mats=local, posed_joints=None, root_positions=hips)
    motion = read_motion(path)
    np.testing.assert_array_equal(motion.rotations, local)
    np.testing.assert_array_equal(motion.translation, hips)


def test_kimodo_refusals(tmp_path):
    with pytest.raises(InputError, match=r"global_rot_mats: got 24 joints, expected the 30 or 77"):
        read_motion(kimodo_file(tmp_path / "k.npz", global_rot_mats=random_rotations(6, 24)))
    with pytest.raises(InputError, match=r"global_rot_mats: got \|RᵀR - I\|"):
        read_motion(kimodo_file(tmp_path / "k.npz", global_rot_mats=2 * random_rotations(6, 30)))
    with pytest.raises(InputError, match=r"posed_joints: got shape \(5, 30, 3\)"):
        read_motion(kimodo_file(tmp_path / "k.npz", posed_joints=np.zeros((5, 30, 3))))


@pytest.mark.skipif(not RECORDED, reason="no motions/kimodo_*.npz under SOMA_TEST_DATA")
@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.stem)
def test_recorded_kimodo_motions(path, tmp_path):
    motion = read_motion(path)
    assert 0.3 < motion.translation[:, 1].min() < motion.translation[:, 1].max() < 1.6  # one of them jumps
    write_motion(motion, tmp_path / "m.npz")
    again = read_motion(tmp_path / "m.npz")
    np.testing.assert_array_equal(again.rotations, motion.rotations)
    np.testing.assert_array_equal(again.contacts, np.load(path)["foot_contacts"])
    np.testing.assert_array_equal(again.skeleton, motion.skeleton)
    bones = [USER_JOINTS.index(side + part) for side in ("Left", "Right") for part in ("Shin", "Foot")]
    assert np.linalg.norm(again.skeleton[bones], axis=1).sum() / 2 == pytest.approx(0.8558, abs=1e-3)


# -- GEM-X --------------------------------------------------------------------------------------------


def gem_x_arrays(people=1):
    """Parameters as ``body_params_global`` of GEM-X holds them, and the rotations that they are of."""
    turns = random_rotations(people * 4, 77, seed=6)
    vectors = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(people, 4, 231)
    random = np.random.default_rng(7)
    arrays = {
        "global_orient": vectors[..., :3], "body_pose": vectors[..., 3:],
        "transl": random.normal(size=(people, 4, 3)), "identity_coeffs": random.normal(size=(people, 4, 45)),
        "scale_params": random.normal(size=(people, 4, 69)),
    }  # fmt: skip
    return arrays, turns.reshape(people, 4, 77, 3, 3)


@pytest.mark.parametrize("layout", ["one", "batch of one", "joints", "matrices"])
def test_gem_x_parameters_are_a_motion_of_this_skeleton(tmp_path, layout):
    arrays, turns = gem_x_arrays()
    if layout != "batch of one":
        arrays = {key: value[0] for key, value in arrays.items()}
    if layout == "joints":
        arrays["body_pose"] = arrays["body_pose"].reshape(4, 76, 3)
    if layout == "matrices":
        arrays |= {"global_orient": turns[0, :, 0], "body_pose": turns[0, :, 1:]}
    path = save(tmp_path / "g.npz", **arrays)
    assert layout_of(path) == "soma"
    motion = read_motion(path, fps=24)
    np.testing.assert_allclose(motion.rotations, turns[0], atol=KIMODO_TOLERANCE)
    np.testing.assert_allclose(motion.translation, arrays["transl"].reshape(4, 3), atol=1e-6)
    assert motion.identity["backend"] == "mhr"
    means = arrays["identity_coeffs"].reshape(4, 45).mean(axis=0, keepdims=True)
    np.testing.assert_allclose(motion.identity["identity_coeffs"], means, atol=1e-6)
    with pytest.raises(InputError, match=r"fps: got no frame rate.*Pass fps=30"):
        read_motion(path)


def test_one_of_the_people_of_gem_x(tmp_path):
    arrays, turns = gem_x_arrays(people=2)
    path = save(tmp_path / "g.npz", **arrays)
    np.testing.assert_allclose(
        read_motion(path, fps=30, person="1").rotations, turns[1], atol=KIMODO_TOLERANCE
    )
    with pytest.raises(InputError, match=r"person: got none of 2 people, expected one of 0, 1"):
        read_motion(path, fps=30)
    arrays["body_pose"][1, 2, 5] = np.nan
    with pytest.raises(InputError, match=r"body_pose: got shape \(2, 4, 228\)"):
        read_motion(save(tmp_path / "g.npz", **arrays), fps=30, person="1")


# -- joints, motions, rigs ----------------------------------------------------------------------------


def test_joint_order():
    assert len(USER_JOINTS) == 77
    assert len(KIMODO_30_JOINTS) == 30
    assert USER_JOINTS.index("LeftShoulder") == 11
    assert USER_JOINTS.index("RightToeEnd") == 76
    parents = nearest_ancestors(KIMODO_30_JOINTS)
    assert parents[0] == -1
    assert KIMODO_30_JOINTS[parents[KIMODO_30_JOINTS.index("LeftHandThumbEnd")]] == "LeftHand"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"rotations": np.zeros((5, 76, 3, 3))},
            r"rotations: got shape \(5, 76, 3, 3\), expected shape \(5, 77",
        ),
        ({"rotations": np.full((5, 77, 3, 3), np.inf)}, r"rotations: got inf at index \(0, 0, 0, 0\)"),
        ({"translation": np.zeros((5, 2))}, r"translation: got shape \(5, 2\)"),
        ({"fps": -1}, r"fps: got -1"),
        ({"convention": "euler"}, r"convention: got 'euler'"),
        ({"rotations": np.zeros((0, 77, 3, 3)), "translation": np.zeros((0, 3))}, r"rotations: got 0 frames"),
    ],
)
def test_a_motion_checks_itself(motion, changes, text):
    with pytest.raises(InputError, match=text):
        replace(motion, **changes)


def test_writing_refuses_what_reading_would(motion, tmp_path):
    with pytest.raises(InputError, match=r"motion\.rotations: got \|RᵀR - I\| = 3"):
        write_motion(replace(motion, rotations=2 * motion.rotations), tmp_path / "m.npz")
    with pytest.raises(InputError, match=r"motion\.joint_names: got 77 names that start with \('Spine1'"):
        write_motion(replace(motion, joint_names=(*USER_JOINTS[1:], "Hips")), tmp_path / "m.npz")
    with pytest.raises(InputError, match=r"motion\.identity: got list"):
        write_motion(replace(motion, identity={"backend": "a", "params": [1.0]}), tmp_path / "m.npz")
    assert not list(tmp_path.iterdir())


def pieces(motion, *sizes):
    """A function that gives consecutive pieces of a motion."""
    ends = np.cumsum(sizes)

    def parts():
        for start, end in zip([0, *ends], ends, strict=False):
            part = slice(start, end)
            yield replace(motion, rotations=motion.rotations[part], translation=motion.translation[part])

    return parts


def test_a_motion_in_pieces_is_the_same_file(motion, tmp_path):
    orient = random_rotations(1, 77)[0]
    write_motion(motion, tmp_path / "whole.npz", joint_orient=orient)
    count = motion.frame_count
    write_motion_parts(
        pieces(motion, 1, count - 1), tmp_path / "m.npz", frame_count=count, joint_orient=orient
    )
    with np.load(tmp_path / "whole.npz") as whole, np.load(tmp_path / "m.npz") as found:
        assert found.files == whole.files
        for name in whole.files:
            np.testing.assert_array_equal(found[name], whole[name], err_msg=name)
            assert found[name].dtype == whole[name].dtype


def test_pieces_that_do_not_fit_are_refused(motion, tmp_path):
    count = motion.frame_count
    with pytest.raises(InputError, match=rf"poses: got {count - 1} frames, expected {count}"):
        write_motion_parts(pieces(motion, 1, count - 2), tmp_path / "m.npz", frame_count=count)
    skewed = replace(motion, rotations=2 * motion.rotations)
    with pytest.raises(InputError, match=r"motion\.rotations: got \|RᵀR - I\| = 3"):
        write_motion_parts(pieces(skewed, count), tmp_path / "m.npz", frame_count=count)
    shuffled = replace(motion, joint_names=(*USER_JOINTS[1:], "Hips"))
    with pytest.raises(InputError, match=r"motion\.joint_names: got 77 names that start with \('Spine1'"):
        write_motion_parts(pieces(shuffled, count), tmp_path / "m.npz", frame_count=count)
    assert not list(tmp_path.iterdir())


def test_rig_revisions(motion):
    assert check_rig(motion, "0123456789abcdef-low")
    assert check_rig(replace(motion, rig_revision=""), "ffff")
    assert not check_rig(motion, "ffffffffffffffff")
    with pytest.raises(InputError, match=r"rig_revision: got 0123456789abcdef, expected ffffffffffffffff"):
        check_rig(replace(motion, convention="absolute_local"), "ffffffffffffffff")


def test_a_file_does_not_say_what_is_trusted(tmp_path, motion):
    """Trust of a model file lets it run code: whoever plays a motion says so himself."""
    given = {"backend": "mhr", "params": {}, "options": {"trust": True, "lod": 6}}
    write_motion(replace(motion, identity=given), tmp_path / "m.npz")
    assert read_motion(tmp_path / "m.npz").identity["options"] == {"lod": 6}


def test_a_result_of_gem_x_is_read_as_its_tool_writes_it(tmp_path):
    """Tensors in a .pt, the world's and the camera's motion side by side."""
    arrays, turns = gem_x_arrays()
    world = {name: torch.as_tensor(value) for name, value in arrays.items()}
    camera = {name: torch.zeros_like(value) for name, value in world.items()}
    torch.save(
        {"body_params_incam": camera, "body_params_global": world, "K": torch.eye(3)}, tmp_path / "r.pt"
    )
    assert layout_of(tmp_path / "r.pt") == "soma"
    motion = read_motion(tmp_path / "r.pt", fps=30)
    np.testing.assert_allclose(motion.rotations, turns.reshape(motion.rotations.shape), atol=1e-6)
