"""The experiment on feet: what it measures, and what it runs on without recordings."""

from dataclasses import replace

import numpy as np
import pytest
from omegaconf import OmegaConf

from soma_core.errors import AssetError
from soma_core.evaluation import ground_contact
from soma_core.io.joint_order import CONTACT_JOINTS
from soma_core.layer import SomaLayer
from soma_core.motion import animate, load_clip, write
from soma_core.options import FrameRange

PLACE = 1e-5
"""Joints of two forward kinematics [m], one of them in float32."""


def config(data):
    return OmegaConf.create({"experiment": {"backend": "soma", "data": data}, "device": "cpu"})


def test_joints_of_the_recorded_skeleton_are_those_of_the_layer():
    layer = SomaLayer("soma", lod="low")
    motion = load_clip(frames=FrameRange(stop=60, step=20))
    played = animate(layer, layer.identity({}), motion)
    joints = ground_contact.recorded_joints(played.motion, played.motion.skeleton)
    np.testing.assert_allclose(joints, played.feet.joints, atol=PLACE)


def test_slide_is_the_level_speed_of_what_stands():
    joints = np.zeros((5, len(CONTACT_JOINTS), 3))
    joints[:, 0] = np.arange(5)[:, None] * [0.3, 9.0, 0.4]
    contacts = np.zeros((5, 4), bool)
    contacts[1:4, :2] = True
    assert ground_contact.slide_of(joints, contacts, 30) == pytest.approx(30 * 0.5 / 2)
    assert ground_contact.slide_of(joints, contacts & False, 30) == 0


def test_a_short_clip_on_the_native_body(tmp_path, monkeypatch):
    motion = load_clip(frames=FrameRange(stop=20))
    write(replace(motion, contacts=np.ones((20, 4), bool)), tmp_path / "short.npz")
    report = ground_contact.run(config(str(tmp_path)))
    assert not report.failed
    assert [row[0] for row in report.tables[0].rows] == ["short, native"]
    empty = tmp_path / "none"
    empty.mkdir()
    monkeypatch.setenv("SOMA_TEST_DATA", str(empty))
    assert ground_contact.motion_files(None) == []
    with pytest.raises(AssetError, match="no motion files"):
        ground_contact.run(config(str(empty)))
