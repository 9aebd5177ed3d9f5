"""How joints of this skeleton turn where those of the SMPL family do, and back: what fits are guided by."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.choices import BoneMatch
from soma_core.inversion.priors import expected_firmness
from soma_core.io.amass import SMPL_JOINTS, SmplMotion, SmplName
from soma_core.io.motion import Motion
from soma_core.io.skeleton_motion import soma_skeleton
from soma_core.io.smpl_skeleton import smpl_skeleton
from soma_core.motion.retargeting import retarget
from soma_core.rig import load_canonical

__all__ = ["turns_from_smpl", "turns_to_smpl"]


def turns_from_smpl(motion: SmplMotion, rotations: np.ndarray) -> np.ndarray:
    """About how joints here turn (frames, 77, 3, 3) against their parents: carried over, the root upright.

    Args:
        motion: of the SMPL family.
        rotations: its joints' (frames, J, 3) [rad] from flat hands.
    """
    rotations = np.concatenate([np.zeros_like(rotations[:, :1]), rotations[:, 1:]], axis=1)
    upright = replace(motion, rotations=rotations, up="+y", camera_turns=None)
    return retarget(smpl_skeleton(upright, load_canonical("mid")[1]), match=BoneMatch.limbs).motion.rotations


def turns_to_smpl(motion: Motion, model: SmplName) -> tuple[np.ndarray, np.ndarray]:
    """The other way round: about how joints of a model turn for those here, so that both ways agree.

    Args:
        motion: on this skeleton.
        model: of the SMPL family.

    Returns:
        Local rotations (frames, J, 3, 3), and how firmly each joint is held near its own (J,) [m/rad]: not at
        all where none here is its like.
    """
    rig = load_canonical("mid")[1]
    likes, parents, rest = _likes(model)
    turns = soma_skeleton(motion, rig).turns() @ np.swapaxes(rest, -1, -2)
    local = np.tile(np.eye(3), (motion.frame_count, SMPL_JOINTS[model], 1, 1))
    world, firmness = local.copy(), np.zeros(SMPL_JOINTS[model])
    for joint, parent in enumerate(parents):
        above = world[:, parent] if parent >= 0 else local[:, joint]
        world[:, joint] = above
        if joint in likes:
            first, last = (turns[:, rig.user_joint_names.index(name)] for name in likes[joint])
            between = Rotation.from_matrix(np.swapaxes(first, -1, -2) @ last).as_rotvec() / 2
            world[:, joint] = first @ Rotation.from_rotvec(between).as_matrix()
            local[:, joint] = np.swapaxes(above, -1, -2) @ world[:, joint]
            firmness[joint] = expected_firmness(likes[joint][0])
    return local, firmness


@functools.cache
def _likes(model: SmplName) -> tuple[dict[int, tuple[str, str]], np.ndarray, np.ndarray]:
    """Joint of a model -> first and last joint here that turn as it does; its parents; ours at its rest."""
    rig, joints = load_canonical("mid")[1], SMPL_JOINTS[model]
    still = SmplMotion(
        model=model, rotations=np.zeros((1, joints, 3)), translation=np.zeros((1, 3)), betas=np.zeros(1),
        gender="neutral", fps=30.0, up="+y",
    )  # fmt: skip
    skeleton = smpl_skeleton(still, rig)
    found = retarget(skeleton, match=BoneMatch.limbs)
    places = {name: skeleton.names.index(there) for name, there in found.report["joints"].items()}
    likes = {place: (name, name) for name, place in places.items()}
    spine, neck = ([skeleton.names.index(name) for name in found.report[key]] for key in ("spine", "neck"))
    likes |= {place: (name, name) for place, name in zip(spine, ("Spine1", "Spine2", "Chest"), strict=True)}
    likes |= dict.fromkeys(neck, ("Neck1", "Neck2"))
    return likes, skeleton.parents, soma_skeleton(found.motion, rig).turns()[0]
