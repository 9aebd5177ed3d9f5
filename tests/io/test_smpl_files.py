"""Motions of the SMPL family under other names: the layouts of tools, kinds of rotations, people, gaps."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_core.errors import AssetError, InputError
from soma_core.io.amass import SmplMotion
from soma_core.io.smpl_files import SmplChoices, people_of, read_smpl, smpl_layout
from tests.io.smpl_layouts import (
    BETAS,
    FRAMES,
    LAYOUTS,
    MANY,
    PATH,
    SMPL,
    TURNS,
    easymocap,
    flat,
    matrices,
    save_frames,
    save_npy,
    save_npz,
    save_pickle,
    six,
    smplx_names,
    wham,
)

SINGLE = 2e-6
"""Single precision of rotations and places of about 1, and a way through matrices."""

each_layout = pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)


def same_turns(found, expected):
    """Compare rotations, not the vectors that stand for them."""
    difference = Rotation.from_rotvec(found.reshape(-1, 3)).inv() * Rotation.from_rotvec(
        expected.reshape(-1, 3)
    )
    assert difference.magnitude().max() < SINGLE


@each_layout
def test_layouts_of_tools_are_read(layout, tmp_path):
    path = tmp_path / f"m{layout.suffix}"
    layout.save(path, layout.content())
    assert smpl_layout(path) in ("smpl", "amass")
    assert len(people_of(path)) == layout.people
    motion = read_smpl(path, SmplChoices(**layout.choices or {}))
    told = (motion.model, motion.up, motion.fps, motion.gender, motion.about)
    assert told == (layout.model, layout.up, layout.fps, layout.gender, layout.about)
    same_turns(motion.rotations, layout.turns)
    np.testing.assert_allclose(motion.translation, layout.path, atol=SINGLE)
    np.testing.assert_allclose(motion.betas, BETAS, atol=SINGLE)


def read(tmp_path, content, **choices):
    save_npz(tmp_path / "m.npz", content)
    return read_smpl(tmp_path / "m.npz", SmplChoices(**choices))


QUATERNIONS = {"xyzw": slice(None), "wxyz": [3, 0, 1, 2]}


@pytest.mark.parametrize("order", QUATERNIONS)
def test_quaternions_in_either_order_are_told_by_their_size(tmp_path, order):
    quaternions = Rotation.from_rotvec(TURNS[:, :22].reshape(-1, 3)).as_quat()[:, QUATERNIONS[order]]
    values = quaternions.reshape(FRAMES, 22, 4)
    content = smplx_names(TURNS, global_orient=values[:, 0], body_pose=values[:, 1:])
    same_turns(read(tmp_path, content).rotations[:, :22], TURNS[:, :22])
    given = read(tmp_path, content, rotation_layout=order).rotations
    same_turns(given[:, :22], TURNS[:, :22])


def test_quaternions_whose_order_cannot_be_told_are_refused(tmp_path):
    wild = Rotation.random(21 * FRAMES, random_state=0).as_quat().reshape(FRAMES, 21, 4)
    with pytest.raises(
        InputError, match=r"body_pose: got quaternions whose order.*Pass rotation_layout=wxyz"
    ):
        read(tmp_path, smplx_names(TURNS, body_pose=wild))


@pytest.mark.parametrize("layout", ["rows", "columns", None])
def test_six_numbers_are_rows_or_columns(tmp_path, layout):
    columns = matrices(TURNS[:, :22])[..., :2].swapaxes(-1, -2).reshape(FRAMES, 22, 6)
    values = columns if layout == "columns" else six(TURNS[:, :22])
    content = smplx_names(TURNS, global_orient=values[:, 0], body_pose=flat(values[:, 1:]))
    same_turns(read(tmp_path, content, rotation_layout=layout).rotations[:, :22], TURNS[:, :22])


def test_six_numbers_that_are_three_rows_of_two_are_told(tmp_path):
    values = matrices(TURNS[:, :22])[..., :2].reshape(FRAMES, 22, 6)
    content = smplx_names(TURNS, global_orient=values[:, 0], body_pose=values[:, 1:])
    same_turns(read(tmp_path, content).rotations[:, :22], TURNS[:, :22])


def test_matrices_with_scale_are_refused(tmp_path):
    scaled = 1.1 * matrices(SMPL)
    with pytest.raises(InputError, match=r"poses: got nine numbers a joint that are no rotation"):
        read(tmp_path, smplx_names(TURNS) | {"poses": scaled, "body_pose": "none"})


def test_people_must_be_chosen(tmp_path):
    save_pickle(tmp_path / "m.pkl", wham())
    with pytest.raises(InputError, match=r"person: got 2 people: 0, 4.*Pass person=0, or person=all"):
        read_smpl(tmp_path / "m.pkl")
    with pytest.raises(InputError, match=r"person: got '9', expected one of 0, 4"):
        read_smpl(tmp_path / "m.pkl", SmplChoices(person="9"))
    second = read_smpl(tmp_path / "m.pkl", SmplChoices(person="4"))
    np.testing.assert_allclose(second.translation, PATH + 1, atol=SINGLE)
    with pytest.raises(InputError, match=r"person: got '1'.*leave person out"):
        read(tmp_path, smplx_names(TURNS), person="1")


def test_the_world_is_preferred_and_the_camera_chosen(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    save_pickle(tmp_path / "m.pkl", {0: wham()[0]})
    assert read_smpl(tmp_path / "m.pkl").up == "+y"
    assert "motion in the world; coordinates=camera" in caplog.text
    camera = read_smpl(tmp_path / "m.pkl", SmplChoices(coordinates="camera"))
    np.testing.assert_allclose(camera.translation, PATH + np.array([0, 0, 5]), atol=SINGLE)
    assert camera.up == "-y"
    local = {name: value for name, value in wham()[0].items() if "world" not in name}
    save_pickle(tmp_path / "m.pkl", local)
    with pytest.raises(InputError, match="coordinates: got world, which is not in the file, expected camera"):
        read_smpl(tmp_path / "m.pkl", SmplChoices(coordinates="world"))


@pytest.mark.parametrize(("how", "expected"), [("mean", 1.0), ("median", 0.5), ("first", 0.0)])
def test_betas_of_every_frame_are_one_body(tmp_path, caplog, how, expected):
    rows = np.zeros((FRAMES, 10))
    rows[:, 0] = [0, 0.25, 0.5, 1.25, 3]
    motion = read(tmp_path, smplx_names(TURNS, betas=rows), betas_from=how)
    assert motion.betas[0] == expected
    assert f"their {how} is the body; betas_from=" in caplog.text


@pytest.mark.parametrize(
    ("lacking", "said"),
    [
        ("gender", r"gender: got only the keys .*poses.* Pass gender=neutral"),
        ("betas", r"betas: got none.*Pass betas=\[0,0,0,"),
        ("mocap_framerate", "mocap_framerate: got no frame rate.*Pass fps="),
    ],
)
def test_what_a_file_lacks_is_a_setting(tmp_path, lacking, said):
    content = {"poses": flat(SMPL), "trans": PATH, "betas": BETAS, "gender": "male", "mocap_framerate": 60.0}
    del content[lacking]
    with pytest.raises(InputError, match=said):
        read(tmp_path, content)
    motion = read(tmp_path, content, gender="female", betas=[1.0], fps=24)
    assert (motion.gender, motion.fps, motion.betas.tolist()) == ("female", 24, [1.0])


def test_no_translation_is_no_refusal_but_said(tmp_path, caplog):
    content = {"poses": flat(SMPL), "betas": BETAS, "gender": "male", "fps": 60.0}
    assert not read(tmp_path, content).translation.any()
    assert "no translation in the file: the body stays at the origin" in caplog.text


def gapped(**changes):
    kept = np.array([0, 1, 4])
    content = {"pose": flat(SMPL)[kept], "trans": PATH[kept], "betas": BETAS, "frame_ids": kept + 20}
    return content | {"verts": np.zeros((3, 1)), "fps": 10.0} | changes


def test_gaps_are_interpolated_or_left_out(tmp_path, caplog):
    save_pickle(tmp_path / "m.pkl", gapped())
    motion = read_smpl(tmp_path / "m.pkl")
    assert "2 missing frames are interpolated, at most 2 in a row; gaps=drop" in caplog.text
    assert motion.frame_count == FRAMES
    np.testing.assert_allclose(motion.translation, PATH, atol=SINGLE)  # which is a straight line
    same_turns(motion.rotations[[0, 1, 4]], SMPL[[0, 1, 4]])
    turned = Rotation.from_rotvec(motion.rotations[:, 3])
    steps = (turned[1:4].inv() * turned[2:5]).magnitude()
    np.testing.assert_allclose(steps, steps[0], atol=SINGLE)
    assert read_smpl(tmp_path / "m.pkl", SmplChoices(gaps="drop")).frame_count == 3
    with pytest.raises(
        InputError, match=r"2 frames missing \(0.2 s\) after frame 1.*longest_gap=0.2 .*gaps=drop"
    ):
        read_smpl(tmp_path / "m.pkl", SmplChoices(longest_gap=0.1))


def test_frames_of_nan_are_gaps(tmp_path, caplog):
    poses, path = flat(SMPL).copy(), PATH.copy()
    poses[1, 5], path[0] = np.nan, np.inf
    poses[4] = np.nan
    motion = read(tmp_path, {"poses": poses, "trans": path, "betas": BETAS, "gender": "male", "fps": 10.0})
    assert motion.frame_count == 2
    assert "3 frames at the ends are NaN and left out" in caplog.text
    poses[0], path[0] = 0, 0
    motion = read(tmp_path, {"poses": poses, "trans": path, "betas": BETAS, "gender": "male", "fps": 10.0})
    assert motion.frame_count == 4
    np.testing.assert_allclose(motion.translation[1], (path[0] + path[2]) / 2, atol=1e-3 + abs(path[1]).max())


def test_rows_in_any_order_are_brought_into_time(tmp_path):
    mixed = np.array([3, 0, 4, 1, 2])
    content = {"pose": flat(SMPL)[mixed], "trans": PATH[mixed], "betas": BETAS, "frame_ids": mixed}
    save_pickle(tmp_path / "m.pkl", content | {"verts": 0})
    np.testing.assert_allclose(read_smpl(tmp_path / "m.pkl").translation, PATH, atol=SINGLE)
    save_pickle(tmp_path / "m.pkl", content | {"verts": 0, "frame_ids": np.array([0, 0, 1, 2, 3])})
    with pytest.raises(InputError, match="frame 0 twice, expected one row a frame"):
        read_smpl(tmp_path / "m.pkl")


@pytest.mark.parametrize(("rest", "up"), [(0, "+y"), (90, "+z"), (180, "-y"), (-90, "-z")])
def test_the_axes_of_a_world_are_told_by_how_the_body_stands(tmp_path, caplog, rest, up):
    turns = TURNS.copy()
    turns[:, 0] = (
        Rotation.from_euler("x", rest, degrees=True) * Rotation.from_rotvec(TURNS[:, 0])
    ).as_rotvec()
    motion = read(tmp_path, smplx_names(turns))
    assert motion.up == up
    assert f"the file does not say its axes: {up} is taken for up" in caplog.text
    assert read(tmp_path, smplx_names(turns), up="+z").up == "+z"


def test_hands_as_components_are_kept_for_the_model(tmp_path):
    left, right = np.ones((FRAMES, 12)), np.full((FRAMES, 6), 2.0)
    motion = read(tmp_path, smplx_names(TURNS, left_hand_pose=left, right_hand_pose=right))
    assert not motion.rotations[:, 25:].any()
    expected = np.concatenate([left, right, np.zeros((FRAMES, 6))], axis=1)
    np.testing.assert_array_equal(motion.hand_components, expected)
    assert not motion.flat_hands  # as the models' own code has it, unless the file says otherwise
    assert not read(tmp_path, smplx_names(TURNS)).hand_components.size


@pytest.mark.parametrize(
    ("own", "asked", "flat_hands"), [(None, None, True), (False, None, False), (True, False, False)]
)
def test_what_zero_means_for_hands_is_kept(tmp_path, own, asked, flat_hands):
    content = smplx_names(TURNS) | ({} if own is None else {"flat_hand_mean": own})
    assert read(tmp_path, content, flat_hand_mean=asked).flat_hands is flat_hands


@pytest.mark.parametrize(
    ("name", "model", "said"),
    [
        ("smplx_locked_head", "smplx", "locked head"),
        ("SMPL-X", "smplx", ""),
        (b"smplh", "smplh", ""),
        ("mano", None, "model_type: got 'mano'.*Pass model="),
    ],
)
def test_the_model_is_the_file_s_word(tmp_path, caplog, name, model, said):
    content = smplx_names(TURNS, model_type=name)
    if model is None:
        with pytest.raises(InputError, match=said):
            read(tmp_path, content)
    else:
        assert read(tmp_path, content).model == model
        assert said in caplog.text
    assert read(tmp_path, content, model="smplh").model == "smplh"


def test_joints_that_a_model_lacks_are_said(tmp_path, caplog):
    motion = read(tmp_path, smplx_names(TURNS, jaw_pose=TURNS[:, 22]), model="smpl")
    assert motion.rotations.shape == (FRAMES, 24, 3)
    assert "smpl has no joints for the face of the file, which are dropped" in caplog.text


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"body_pose": np.zeros((FRAMES, 60))},
            r"body_pose: got shape \(5, 60\), expected 72 values \(smpl\)",
        ),
        (
            {"global_orient": np.zeros((2, 3))},
            r"global_orient: got shape \(2, 3\), expected 5 frames of 1 joints",
        ),
        ({"transl": np.zeros((4, 3))}, r"transl: got shape \(4, 3\), expected 3 numbers a frame"),
        ({"transl": np.array(["a"] * FRAMES)}, r"transl: got shape \(5,\), dtype <U1, expected numbers"),
        ({"betas": np.zeros((2, 10))}, "betas: got 2 rows, expected one row"),
        ({"fps": -2}, "fps: got -2, expected a positive number"),
    ],
)
def test_what_is_no_motion_is_refused_by_its_key(tmp_path, changes, said):
    with pytest.raises(InputError, match=said):
        read(tmp_path, smplx_names(TURNS, **changes))


def test_other_names_are_listed_beside_the_wanted_ones(tmp_path):
    with pytest.raises(
        InputError, match=r"pose: got only the keys joints \(5, 3\), expected .*keys: pose: .*poses"
    ):
        read(tmp_path, {"joints": np.zeros((FRAMES, 3))})
    assert smpl_layout(tmp_path / "m.npz") is None


def test_pickles_that_ask_for_more_than_data_are_refused_by_name(tmp_path):
    save_pickle(tmp_path / "m.pkl", {"pose": flat(SMPL), "x": dataclasses.field})
    with pytest.raises(
        AssetError, match=r"asks for dataclasses.field, which is no part of a motion.*np.savez"
    ):
        read_smpl(tmp_path / "m.pkl")


@pytest.mark.parametrize("method", ["zlib", "gzip", "bz2", "lzma", "xz"])
def test_compressed_files_of_joblib_are_read(tmp_path, method):
    joblib = pytest.importorskip("joblib")
    joblib.dump({0: wham()[0]}, tmp_path / "m.pkl", compress=(method, 3))
    np.testing.assert_allclose(read_smpl(tmp_path / "m.pkl").translation, PATH, atol=SINGLE)


def test_one_row_of_shapes_is_not_each_frame_s(tmp_path):
    assert read(tmp_path, smplx_names(TURNS, betas=MANY[:1])).betas.tolist() == pytest.approx(BETAS)


@pytest.mark.parametrize("about", ["pelvis", "origin"])
def test_a_root_about_another_point_moves_every_point_alike(about):
    """By the definition: points turn about the origin, or turn about the pelvis before the camera does."""
    random, pelvis = np.random.default_rng(5), np.array([0.01, -0.3, 0.02])
    point, turns = random.standard_normal(3), random.standard_normal((FRAMES, 24, 3))
    camera = random.standard_normal((FRAMES, 3))
    root, seen = Rotation.from_rotvec(turns[:, 0]), Rotation.from_rotvec(camera)
    if about == "pelvis":
        expected = seen.apply(root.apply(point - pelvis) + pelvis + PATH) + 1.0
        turns[:, 0], path = (seen * root).as_rotvec(), seen.apply(PATH) + 1.0
    else:
        expected, path = root.apply(point) + PATH, PATH
    motion = SmplMotion(
        model="smpl", rotations=turns, translation=path, betas=BETAS, gender="neutral", fps=30, about=about,
        camera_turns=camera if about == "pelvis" else None,
    )  # fmt: skip
    placed = Rotation.from_rotvec(turns[:, 0]).apply(point - pelvis) + pelvis + motion.about_pelvis(pelvis)
    np.testing.assert_allclose(placed, expected, atol=SINGLE)


def tram(tmp_path, **camera):
    """A track, seen in all frames but the second, beside the path of a camera."""
    seen = np.delete(np.arange(FRAMES), 1)
    (tmp_path / "hps").mkdir(exist_ok=True)
    path = tmp_path / "hps" / "hps_track_0.npy"
    content = {"pred_rotmat": matrices(SMPL)[seen], "pred_shape": MANY[seen], "pred_trans": PATH[seen, None]}
    save_npy(path, content | {"pred_cam": np.ones((len(seen), 3)), "frame": seen})
    turns = Rotation.from_rotvec(np.linspace([0, 0, 0], [0.2, 0.4, -0.1], FRAMES))
    content = {"pred_cam_R": turns.as_matrix(), "pred_cam_T": PATH[::-1], "img_focal": np.array(500.0)}
    save_npy(tmp_path / "camera.npy", content | camera)
    return path, turns, seen


def test_a_camera_beside_tram_s_tracks_brings_them_into_the_world(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    path, turns, seen = tram(tmp_path)
    found = read_smpl(path)
    assert "in the world by" in caplog.text
    same_turns(found.rotations[seen, 0], (turns[seen] * Rotation.from_rotvec(SMPL[seen, 0])).as_rotvec())
    same_turns(found.rotations[seen, 1:], SMPL[seen, 1:])
    np.testing.assert_allclose(
        found.translation[seen], turns[seen].apply(PATH[seen]) + PATH[::-1][seen], atol=SINGLE
    )
    same_turns(found.camera_turns[seen], turns[seen].as_rotvec())
    before = read_smpl(path, SmplChoices(coordinates="camera"))
    same_turns(before.rotations[seen], SMPL[seen])
    assert before.camera_turns is None
    assert before.up == "-y"
    assert read_smpl(path, SmplChoices(coordinates="world")).camera_turns is not None


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        ({"pred_cam_R": np.ones((FRAMES, 3, 3))}, "RᵀR"),
        ({"pred_cam_R": np.zeros((FRAMES, 4))}, "shapes"),
        (
            {"pred_cam_R": np.tile(np.eye(3), (2, 1, 1)), "pred_cam_T": PATH[:2]},
            "2 frames, and a motion up to frame 4",
        ),
        ({"pred_cam_T": np.full((FRAMES, 3), np.nan)}, "NaN"),
        ({"pred_cam_T": "far"}, "camera.npy"),
    ],
)
def test_a_camera_that_is_none_is_refused_by_its_name(tmp_path, camera, said):
    path, *_ = tram(tmp_path, **camera)
    with pytest.raises(InputError, match=said) as caught:
        read_smpl(path)
    assert "camera.npy" in str(caught.value)
    assert "coordinates=camera" in str(caught.value)


def frames(tmp_path, **changes):
    """A folder of three frames, the last of which is changed."""
    people = [frame[:1] for frame in easymocap(72)][:3]
    people[2] = [people[2][0] | changes]
    save_frames(tmp_path / "smpl", people)
    return tmp_path / "smpl"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"poses": [[0.0] * 69]}, r"000002\.json: person 4.*69 poses"),
        ({"Th": "here"}, r"000002\.json: Th.*numbers"),
        ({"shapes": [[0.0] * 5000]}, r"000002\.json: shapes.*5000"),
        ({"Rh": [[1e999, 0, 0]]}, None),
    ],
)
def test_frames_that_are_none_are_refused_by_their_file(tmp_path, changes, said):
    folder = frames(tmp_path, **changes)
    if said is None:  # what is not finite is a gap, as in other files: here at the end
        assert read_smpl(folder).frame_count == 2
        return
    with pytest.raises(InputError, match=said):
        read_smpl(folder)


def test_numbers_in_the_names_of_frames_are_time(tmp_path):
    folder = frames(tmp_path)
    (folder / "000002.json").rename(folder / "000004.json")
    assert read_smpl(folder).frame_count == 5
    assert smpl_layout(folder) == "smpl"
    (folder / "000000.json").write_text("{")
    with pytest.raises(AssetError, match=r"000000\.json: not valid JSON"):
        read_smpl(folder)
