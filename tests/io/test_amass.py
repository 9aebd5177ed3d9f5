"""Motions of the SMPL family: each layout of AMASS is read, ours are read again, others are refused."""

from __future__ import annotations

import numpy as np
import pytest

from soma_core.errors import AssetError, InputError
from soma_core.io.amass import SMPL_JOINTS, SmplMotion, write_amass
from soma_core.io.smpl_files import read_amass

FRAMES = 4


def poses(model: str) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((FRAMES, 3 * SMPL_JOINTS[model]))


def smplh_file(**changes: object) -> dict[str, object]:
    return {
        "poses": poses("smplh"), "trans": np.ones((FRAMES, 3)), "betas": np.arange(16.0), "gender": b"male",
        "mocap_framerate": 120.0, "dmpls": np.zeros((FRAMES, 8)), "marker_labels": np.array([{}], object),
    } | changes  # fmt: skip


def smplx_file(**changes: object) -> dict[str, object]:
    whole = poses("smplx")
    return {
        "root_orient": whole[:, :3], "pose_body": whole[:, 3:66], "pose_jaw": whole[:, 66:69],
        "pose_eye": whole[:, 69:75], "pose_hand": whole[:, 75:], "trans": np.zeros((FRAMES, 3)),
        "betas": np.arange(16.0), "num_betas": 16, "gender": "neutral", "surface_model_type": "smplx",
        "mocap_frame_rate": 60.0, "mocap_time_length": FRAMES / 60,
    } | changes  # fmt: skip


def written(tmp_path, keys):
    np.savez(tmp_path / "m.npz", **{key: value for key, value in keys.items() if value is not None})
    return tmp_path / "m.npz"


@pytest.mark.parametrize(
    ("keys", "model", "fps", "gender"),
    [
        (smplh_file(), "smplh", 120, "male"),
        (smplh_file(poses=poses("smpl"), gender=np.array(["Female"])), "smpl", 120, "female"),
        (smplx_file(), "smplx", 60, "neutral"),
        (smplh_file(poses=poses("smplx"), mocap_framerate=None, fps=30), "smplx", 30, "male"),
    ],
)
def test_every_layout_is_read(tmp_path, keys, model, fps, gender):
    motion = read_amass(written(tmp_path, keys))
    assert (motion.model, motion.fps, motion.gender, motion.up) == (model, fps, gender, "+z")
    np.testing.assert_array_equal(motion.rotations.reshape(FRAMES, -1), poses(model).astype(np.float32))
    np.testing.assert_array_equal(motion.translation, keys["trans"])
    np.testing.assert_array_equal(motion.betas, np.arange(16))
    assert motion.frame_count == FRAMES


def test_what_is_given_overrides_the_file(tmp_path):
    keys = smplh_file(mocap_framerate=None, gender="unknown")
    motion = read_amass(written(tmp_path, keys), fps=25, gender="neutral", up="+y")
    assert (motion.fps, motion.gender, motion.up) == (25, "neutral", "+y")


def test_betas_that_are_repeated_for_each_frame_are_one_body(tmp_path):
    repeated = np.tile(np.arange(10.0), (FRAMES, 1))
    np.testing.assert_array_equal(
        read_amass(written(tmp_path, smplh_file(betas=repeated))).betas, repeated[0]
    )
    assert not read_amass(written(tmp_path, smplh_file(betas=np.zeros((1, 0))))).betas.size


@pytest.mark.parametrize("model", SMPL_JOINTS)
def test_what_is_written_is_read_again(tmp_path, model):
    motion = SmplMotion(
        model=model, rotations=poses(model).reshape(FRAMES, -1, 3), translation=np.ones((FRAMES, 3)),
        betas=np.arange(10), gender="female", fps=24,
    )  # fmt: skip
    write_amass(motion, tmp_path / "m.npz", extra={"vertex_error": np.zeros(FRAMES)})
    again = read_amass(tmp_path / "m.npz")
    for name in ("rotations", "translation", "betas"):
        np.testing.assert_array_equal(getattr(again, name), getattr(motion, name))
    assert (again.model, again.gender, again.fps, again.up) == (model, "female", 24, "+z")
    with np.load(tmp_path / "m.npz", allow_pickle=False) as file:
        assert ("mocap_frame_rate" if model == "smplx" else "mocap_framerate") in file
        assert not file["vertex_error"].any()


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (smplh_file(poses=np.zeros((FRAMES, 150))), r"poses: got shape \(4, 150\), expected 72 values"),
        (smplh_file(poses=np.zeros((0, 156))), r"poses: got shape \(0, 156\)"),
        (smplh_file(trans=np.zeros((FRAMES, 2))), r"trans: got shape \(4, 2\)"),
        (smplh_file(trans=np.full((FRAMES, 3), np.nan)), r"trans: got NaN or infinity in every frame"),
        (smplh_file(mocap_framerate=None), "mocap_framerate: got no frame rate.*Pass fps=120"),
        (smplh_file(mocap_framerate=-1), "mocap_framerate: got -1, expected a positive number"),
        (smplh_file(gender="unknown"), "gender: got 'unknown'.*Pass gender=neutral"),
        (smplh_file(gender=None), "gender: got only the keys.*expected a key 'gender'"),
        (smplh_file(betas=np.zeros((2, 10))), "betas: got 2 rows, expected one row"),
        (smplh_file(betas=np.zeros((2, 3, 4))), r"betas: got shape \(2, 3, 4\)"),
        (smplx_file(pose_eye=np.zeros((FRAMES, 3))), r"pose_eye: got shape \(4, 3\)"),
        (smplh_file(poses=np.array([{}], object)), "poses: got an unreadable array .Python objects"),
    ],
)  # fmt: skip
def test_what_is_no_motion_is_refused(tmp_path, keys, said):
    with pytest.raises(InputError, match=said):
        read_amass(written(tmp_path, keys))


def test_what_is_no_file_is_refused(tmp_path):
    (tmp_path / "m.npz").write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(AssetError, match=r"m\.npz: is a git-LFS pointer"):
        read_amass(tmp_path / "m.npz")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"model": "mano"}, "model: got 'mano', expected one of 'smpl', 'smplh', 'smplx'"),
        ({"gender": "any"}, "gender: got 'any'"),
        ({"up": "+x"}, r"up: got '\+x'"),
        ({"about": "head"}, "about: got 'head'"),
        ({"fps": 0}, "fps: got 0, expected a positive number"),
        ({"rotations": np.zeros((FRAMES, 24, 3))}, r"rotations: got shape \(4, 24, 3\), .* \(4, 52, 3\)"),
        ({"rotations": np.zeros((0, 52, 3))}, r"rotations: got shape \(0, 52, 3\)"),
        ({"translation": np.zeros((1, 3))}, r"translation: got shape \(1, 3\)"),
        ({"betas": np.full(10, np.inf)}, "betas: got NaN or infinity"),
    ],
)
def test_what_cannot_be_a_motion_is_refused(changes, said):
    good = {
        "model": "smplh", "rotations": np.zeros((FRAMES, 52, 3)), "translation": np.zeros((FRAMES, 3)),
        "betas": np.zeros(10), "gender": "male", "fps": 30,
    }  # fmt: skip
    with pytest.raises(InputError, match=said):
        SmplMotion(**good | changes)


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ({"poses": np.zeros(1)}, "extra: got 'poses', which the layout has"),
        ({"a": np.array([{}], object)}, "extra: got Python objects under 'a'"),
    ],
)
def test_extra_arrays_that_are_refused(tmp_path, extra, said):
    motion = SmplMotion(
        model="smpl", rotations=np.zeros((1, 24, 3)), translation=np.zeros((1, 3)), betas=np.zeros(10),
        gender="male", fps=30,
    )  # fmt: skip
    with pytest.raises(InputError, match=said):
        write_amass(motion, tmp_path / "m.npz", extra=extra)
    assert not (tmp_path / "m.npz").exists()


@pytest.mark.parametrize(
    ("changes", "fps", "told"),
    [
        ({}, 60, None),
        ({"mocap_time_length": (FRAMES - 1) / 60}, 60, None),  # the last frame takes no time
        ({"mocap_framerate": 120.0}, 60, "mocap_frame_rate=60 is taken for the frame rate, against mocap_f"),
        ({"mocap_framerate": 120.0, "mocap_time_length": FRAMES / 120}, 120, "mocap_framerate=120 is taken"),
        (
            {"mocap_time_length": 5.0},
            60,
            "against mocap_time_length=5, which 4 frames last at 0.8; pass fps=",
        ),
        ({"mocap_framerate": 240.0, "mocap_time_length": None}, 240, "against mocap_frame_rate=60;"),
    ],
)
def test_rates_that_disagree_are_told(tmp_path, caplog, changes, fps, told):
    file = written(tmp_path, smplx_file(**changes))
    assert read_amass(file).fps == fps
    assert (told in caplog.text) if told else not caplog.text
    caplog.clear()
    read_amass(file, fps=24)
    assert "m.npz: fps=24 is taken in place of the file's own" in caplog.text


@pytest.mark.parametrize(
    ("own", "told"),
    [
        ("smplx_locked_head", "with a locked head"),
        ("smplh", "smplh has no joints for the face"),
        ("smplx", ""),
    ],
)
def test_betas_of_another_model_or_gender_are_told(tmp_path, caplog, own, told):
    file = written(tmp_path, smplx_file(surface_model_type=own))
    read_amass(file, gender="neutral")
    assert told in caplog.text
    assert bool(caplog.text) == bool(told)
    assert "gender" not in caplog.text
    read_amass(file, gender="male")
    assert "gender=male is taken in place of neutral" in caplog.text
