"""Turns of this skeleton on joints of the SMPL family, and motions that go there and come back by them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core import SomaLayer, read_motion, write_motion
from soma_core.io.amass import SMPL_JOINTS, SmplMotion
from soma_core.io.joint_order import USER_JOINTS
from soma_core.motion import load_clip
from soma_core.motion.smpl_turns import turns_from_smpl, turns_to_smpl
from soma_core.native import NativeFit
from soma_core.options import InversionChoice, PriorChoice
from tests.motion.test_converter import converted

SAME_DEGREES = 0.01
NECK_DEGREES = 12.0
"""Two joints of ours against one of theirs."""
TRIP_MM = 0.6
TRIP_DEGREES = 4.0
"""Limbs, on average."""

_LIMBS = [
    USER_JOINTS.index(side + part)
    for side in ("Left", "Right")
    for part in ("Shoulder", "Arm", "ForeArm", "Hand", "Leg", "Shin", "Foot")
]


@pytest.fixture(scope="module")
def clip():
    return load_clip(None).cut(slice(0, 280, 40))


def degrees(found, true):
    """Angles between local rotations (frames, 77)."""
    turns = np.swapaxes(true, -1, -2) @ found
    return np.degrees(Rotation.from_matrix(turns.reshape(-1, 3, 3)).magnitude()).reshape(turns.shape[:2])


@pytest.mark.parametrize("model", ["smpl", "smplh", "smplx"])
def test_both_ways_agree(clip, model):
    turns, firmness = turns_to_smpl(clip, model)
    frames, joints = clip.frame_count, SMPL_JOINTS[model]
    assert (turns.shape, firmness.shape) == ((frames, joints, 3, 3), (joints,))
    angles = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(frames, joints, 3)
    there = SmplMotion(
        model=model, rotations=angles, translation=np.zeros((frames, 3)), betas=np.zeros(10),
        gender="neutral", fps=30.0, up="+y",
    )  # fmt: skip
    apart = degrees(turns_from_smpl(there, angles), clip.rotations)
    assert apart[:, _LIMBS].max() < SAME_DEGREES
    neck = [USER_JOINTS.index(name) for name in ("Neck1", "Neck2", "Head")]
    assert apart[:, neck].max() < NECK_DEGREES


def test_the_root_and_hands_of_smpl_are_free(clip):
    _, firmness = turns_to_smpl(clip, "smpl")
    assert np.flatnonzero(firmness == 0).tolist() == [0, 22, 23]


def _trip(clip, folder, **changes):
    """Distances (frames, v) [mm] and angles (frames, 77) [degrees] of a motion back from SMPL-H."""
    identity = {"backend": "smplh", "params": {"betas": [0.5, -1.0, 0.3]}, "options": {"gender": "female"}}
    clip = replace(clip, identity=identity)
    folder.mkdir(exist_ok=True)
    write_motion(clip, folder / "m.npz")
    converted(folder / "m.npz", folder / "there", to="smplh", up="y", **changes)
    converted(folder / "there/motion.npz", folder / "back", up="y", **changes)
    back = read_motion(folder / "back/motion.npz")
    layer = SomaLayer("smplh", options={"gender": "female"}, lod="low")
    body = layer.identity(identity["params"])
    with torch.no_grad():
        skins = [
            layer.pose(body, torch.as_tensor(one.rotations), torch.as_tensor(one.translation)).vertices
            for one in (clip, back)
        ]
    seen = np.setdiff1d(np.arange(layer.mesh.vertex_count), layer.mesh.face_interior)
    return 1e3 * (skins[0] - skins[1]).norm(dim=-1)[:, seen].numpy(), degrees(back.rotations, clip.rotations)


def test_a_motion_comes_back_from_smplh(smplh_models, clip, tmp_path):
    apart, angles = _trip(clip, tmp_path)
    assert apart.mean() < TRIP_MM
    assert angles[:, _LIMBS].mean() < TRIP_DEGREES


def test_vertices_of_the_model_weigh_as_those_here(smplh_models, clip, tmp_path, monkeypatch):
    fit, given = NativeFit.forward, []

    def spy(self, vertices, **kind):
        given.append(torch.equal(kind["weights"], self.transfer.shares))
        return fit(self, vertices, **kind)

    monkeypatch.setattr(NativeFit, "forward", spy)
    identity = {"backend": "smplh", "params": {"betas": [0.5]}, "options": {"gender": "female"}}
    write_motion(replace(clip, identity=identity), tmp_path / "m.npz")
    converted(tmp_path / "m.npz", tmp_path / "there", to="smplh", up="y")
    assert given
    assert all(given)


def test_without_expected_turns_a_motion_comes_back_less_well(smplh_models, clip, tmp_path):
    free = InversionChoice(skinning="full", priors=PriorChoice(expected=0.0))
    guided, alone = _trip(clip, tmp_path / "a"), _trip(clip, tmp_path / "b", inversion=free)
    assert guided[0].mean() < 0.8 * alone[0].mean()
    assert guided[1][:, _LIMBS].mean() < 0.7 * alone[1][:, _LIMBS].mean()
