"""What the page shows: bodies where the layer has them, poses, time, and the distance of two results."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core.choices import Lod, Product
from soma_core.errors import InputError
from soma_core.io.joint_order import USER_JOINTS
from soma_core.motion import load_clip, write
from soma_core.motion.options import ConvertOptions
from soma_core.motion.poses import POSES, named_pose
from soma_core.options import FrameRange, ViewOptions
from soma_core.viewer.session import Session
from soma_core.viewer.sources import escaped, settings_of

FLOOR_MM = 8.0
"""How far soles that stand give below the floor: soft heels, as ``animate`` places them."""

SAME_MM = 1e-3
"""Float32 rounding at the size of a body."""

TURN_TOLERANCE = 1e-5


@pytest.fixture(scope="module")
def layers():
    return {}


@pytest.fixture
def session(layers):
    session = Session(ViewOptions(lod=Lod.low))
    session._layers = layers
    session.add("soma")
    return session


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clip") / "clip.npz"
    write(load_clip(frames=FrameRange(start=30, stop=90, step=20)), path)
    return path


@pytest.mark.parametrize("name", POSES)
def test_named_poses_stand_on_the_floor_and_are_symmetric_but_for_the_stride(session, name):
    session.show(named_pose(name))
    shape = session.shape(session.figures[0])
    assert abs(shape.vertices[:, 1].min()) * 1000 < FLOOR_MM
    turns = {joint: session.rotation(joint) for joint in ("LeftArm", "RightArm", "LeftLeg", "RightLeg")}
    mirrored = all(
        np.allclose(turns[f"Left{part}"], turns[f"Right{part}"] * [1, -1, -1], atol=1e-3)
        for part in ("Arm", "Leg")
    )
    assert mirrored == (name != "stride")


def test_an_unknown_pose_is_refused():
    with pytest.raises(InputError, match=r"pose: got handstand, expected one of T-pose"):
        named_pose("handstand")


def test_a_body_is_where_the_layer_has_it(session, clip):
    session.load(clip)
    figure = session.figures[0]
    session.place = 1.4
    shape, played = session.shape(figure), session.played(figure)
    posed = played.layer.pose(
        played.identity, torch.as_tensor(played.motion.rotations[1:2]), torch.as_tensor(figure.path[1:2])
    )
    assert session.frame == 1
    np.testing.assert_array_equal(shape.vertices, posed.vertices[0].numpy())
    np.testing.assert_array_equal(shape.joints, posed.joints[0].numpy())


@pytest.mark.slow
def test_moving_bodies_have_some_of_the_vertices_of_still_ones():
    session = Session(ViewOptions())
    figure = session.add("soma")
    still, moving = session.shape(figure), session.shape(figure, moving=True)
    assert len(moving.vertices) < len(still.vertices)
    np.testing.assert_array_equal(still.vertices[: len(moving.vertices)], moving.vertices)


def test_sliders_change_the_body_and_usual_brings_it_back(session):
    figure = session.figures[0]
    before = session.shape(figure).vertices
    session.change(figure, "shape", 2.0, 1)
    assert session.value(figure, "shape", 1) == 2.0
    session.settle(rest=False)
    assert np.abs(session.shape(figure).vertices - before).max() > 1e-2
    assert abs(session.shape(figure).vertices[:, 1].min()) * 1000 < FLOOR_MM
    session.usual(figure)
    session.settle(rest=True)
    np.testing.assert_allclose(session.shape(figure).vertices, before, atol=SAME_MM / 1000)
    session.usual(figure, seed=3)
    assert session.value(figure, "shape", 0) != 0


def test_a_joint_turns_as_its_gizmo_was_turned(session):
    session.show(named_pose("stride"))
    figure = session.figures[0]
    wanted = Rotation.from_euler("xyz", (20, -50, 35), degrees=True).as_matrix()
    session.turn_in_world(figure, "LeftForeArm", wanted)
    assert (
        np.abs(session.shape(figure).turns[USER_JOINTS.index("LeftForeArm")] - wanted).max() < TURN_TOLERANCE
    )
    session.turn("LeftForeArm", np.array([0.0, -40.0, 10.0]))
    np.testing.assert_allclose(session.rotation("LeftForeArm"), [0, -40, 10], atol=1e-4)


def test_time_passes_and_ends_or_begins_again(session, clip):
    session.load(clip)
    assert session.playing
    second = 1 / session.motion.fps
    session.advance(1.5 * second)
    assert session.frame == 1
    session.advance(2 * second)
    assert session.frame == 0
    session.loop, session.speed = False, 2.0
    session.advance(10 * second)
    assert (session.frame, session.playing) == (session.frame_count - 1, False)


def test_switches_take_correctives_and_twist_away(session):
    session.show(named_pose("squat"))
    figure = session.figures[0]
    whole = session.shape(figure).vertices
    session.correctives = False
    plain = session.shape(figure).vertices
    session.procedural = False
    untwisted = session.shape(figure).vertices
    assert np.abs(whole - plain).max() > 1e-3
    assert np.abs(plain - untwisted).max() > 1e-4


@pytest.mark.parametrize("kind", ["motion", "vertices"])
def test_a_result_is_as_near_to_itself_as_numbers_are(session, clip, tmp_path, kind):
    session.load(clip)
    figure = session.figures[0]
    session.translation = "motion"
    session.change(figure, "shape", 1.0, 2)
    figure.path = None
    path = tmp_path / "other.npz"
    session.write(figure, Product.npz if kind == "motion" else Product.vertices, path)
    other = session.compare(path)
    assert (other.recorded is None) == (kind == "motion")
    session.place = 2.0
    errors = session.errors_mm(*map(session.shape, session.figures))
    assert errors.max() < SAME_MM
    session.turn("LeftForeArm", session.rotation("LeftForeArm") - np.array([0, 20, 0]))
    shape, there = map(session.shape, session.figures)
    errors = session.errors_mm(shape, there)
    assert errors.max() > 50
    legs = shape.vertices[:, 1] < shape.joints[USER_JOINTS.index("LeftShin"), 1]
    assert errors[legs].max() < SAME_MM
    assert session.offset(figure) == session.offset(other)


def test_the_body_of_a_motion_comes_back(session, clip, tmp_path):
    figure = session.figures[0]
    session.change(figure, "shape", 1.5, 0)
    path = tmp_path / "kept.npz"
    session.write(figure, Product.npz, path)
    session.usual(figure)
    with pytest.raises(InputError, match=r"identity: got arms lowered without a body"):
        session.own_body(figure)
    session.load(path)
    session.own_body(figure)
    assert session.value(figure, "shape", 0) == pytest.approx(1.5)


def test_bodies_stand_side_by_side(session):
    session.add("soma")
    session.add("toy")
    names = [figure.name for figure in session.figures]
    assert names == ["soma", "soma 2", "toy"]
    places = [session.offset(figure) for figure in session.figures]
    np.testing.assert_allclose(np.diff(places), session.spacing)
    session.remove(session.figures[1])
    assert sum(session.offset(figure) for figure in session.figures) == pytest.approx(0)


def test_settings_that_are_typed():
    assert settings_of(" fps=60  up=-y unit=cm") == ConvertOptions(fps=60, up="-y", unit="cm")
    with pytest.raises(InputError, match=r"settings: got fsp=60"):
        settings_of("fsp=60")
    with pytest.raises(InputError, match=r"unit: got 'ell'"):
        settings_of("unit=ell")


def test_a_name_on_the_page_is_text():
    shown = escaped("<img src=x onerror=a()> ![b](//c)\n**走路**_1")
    assert shown == r"\<img src\=x onerror\=a\(\)\> \!\[b\]\(\/\/c\) \*\*走路\*\*\_1"
