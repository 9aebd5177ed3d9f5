"""What a model is posed with: fingers, the root about the pelvis; and all people of a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_core import SmplMotion
from soma_core.errors import InputError
from soma_core.motion import ConvertOptions, conversion, convert_people
from soma_core.motion.bodies import _model_pose
from soma_core.motion.smpl_input import smpl_choices
from tests.io.smpl_layouts import save_pickle, wham

FRAMES = 3
PELVIS = np.array([0.01, -0.3, 0.02])
ROUNDING = 1e-6
"""Single precision of metres and radians."""


class Backend:
    """What is asked of the user's model."""

    mean_hands = np.linspace(-1, 1, 90).reshape(30, 3)
    hand_components = np.random.default_rng(1).standard_normal((2, 45, 45))

    def rest_joints(self, params):
        return np.array([PELVIS, [0, 0, 0]])


def motion(**changes):
    turns = np.random.default_rng(0).standard_normal((FRAMES, 52, 3))
    values = {
        "model": "smplh", "rotations": turns, "translation": np.ones((FRAMES, 3)), "betas": np.zeros(10),
        "gender": "male", "fps": 30,
    }  # fmt: skip
    return SmplMotion(**values | changes)


def test_fingers_are_relative_to_the_model_s_mean_hands_where_the_file_says_so():
    flat, relative = (_model_pose(Path("m"), motion(flat_hands=own), Backend(), {}) for own in (True, False))
    difference = relative["rotations"] - flat["rotations"]
    assert not difference[:, :22].any()
    np.testing.assert_allclose(difference[:, 22:], np.tile(Backend.mean_hands, (FRAMES, 1, 1)), atol=ROUNDING)


@pytest.mark.parametrize("count", [6, 12, 24])
@pytest.mark.parametrize("flat", [True, False])
def test_fingers_turn_by_the_model_s_own_components(count, flat):
    values = np.random.default_rng(2).standard_normal((FRAMES, 2 * count))
    plain = _model_pose(Path("m"), motion(flat_hands=flat), Backend(), {})["rotations"]
    found = _model_pose(Path("m"), motion(flat_hands=flat, hand_components=values), Backend(), {})[
        "rotations"
    ]
    difference = found - plain
    assert not difference[:, :22].any()
    for side, rows in enumerate(np.split(values, 2, axis=1)):
        expected = rows @ Backend.hand_components[side, :count]
        fingers = difference[:, 22 + 15 * side : 37 + 15 * side].reshape(FRAMES, -1)
        np.testing.assert_allclose(fingers, expected, atol=20 * ROUNDING)


def test_without_components_fingers_stay_straight_and_the_file_is_asked_for(caplog):
    backend = Backend()
    backend.hand_components = None
    values = {"flat_hands": False, "hand_components": np.ones((FRAMES, 12))}
    found = _model_pose(Path("m"), motion(**values), backend, {})["rotations"]
    np.testing.assert_array_equal(found, motion().rotations)
    assert "hands are 6 components" in caplog.text
    assert "soma backends convert smplh FILE" in caplog.text


def test_a_model_without_mean_hands_is_named():
    backend = Backend()
    backend.mean_hands = None
    with pytest.raises(InputError, match=r"flat_hand_mean: got false, .*soma backends convert smplh FILE"):
        _model_pose(Path("m"), motion(flat_hands=False), backend, {})


def test_a_root_that_turns_about_the_origin_moves_the_pelvis():
    given = motion(about="origin")
    pose = _model_pose(Path("m"), given, Backend(), {})
    root = Rotation.from_rotvec(given.rotations[:, 0])
    vertex = np.array([0.2, 1.0, 0.1])
    about_origin = root.apply(vertex) + given.translation
    about_pelvis = root.apply(vertex - PELVIS) + PELVIS + pose["translation"]
    np.testing.assert_allclose(about_pelvis, about_origin, atol=ROUNDING)
    assert (_model_pose(Path("m"), motion(), Backend(), {})["translation"] == given.translation).all()


def test_every_setting_of_the_reading_reaches_it():
    options = ConvertOptions(
        fps=25, gender="male", up="y", betas=[1.0], betas_from="first", model="smplx", person="3",
        coordinates="camera", rotation_layout="xyzw", flat_hand_mean=False, gaps="drop", longest_gap=2.0,
    )  # fmt: skip
    read = vars(smpl_choices(options))
    assert read.pop("up") == "+y"
    for name, value in read.items():
        assert value == getattr(options, name), name
    assert smpl_choices(ConvertOptions(person="all")).person is None


def test_all_people_have_a_folder_each(tmp_path, monkeypatch):
    save_pickle(tmp_path / "m.pkl", wham())
    asked = []

    def noted(self, path, files, chunks):
        asked.append((self._options.person, files.motion.relative_to(tmp_path).as_posix()))

    monkeypatch.setattr(conversion.Converter, "__call__", noted)
    assert list(convert_people(tmp_path / "m.pkl", tmp_path / "out")) == ["0", "4"]
    assert asked == [("0", "out/0/motion.npz"), ("4", "out/4/motion.npz")]
    np.savez(tmp_path / "n.npz", vertices=np.zeros((1, 3, 3)))
    with pytest.raises(InputError, match=r"person: got all, .*Leave person out"):
        convert_people(tmp_path / "n.npz", tmp_path / "out")
