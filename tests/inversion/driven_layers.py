"""Layers with twist joints, in any way of reading twists, and motions of their vertices by differences."""

from __future__ import annotations

import functools
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion.model import PoseModel
from soma_core.inversion.problem import Pose, Problem
from soma_core.layer import SomaLayer
from soma_core.paths import assets_dir
from soma_core.rig import load_canonical
from soma_core.rig.manifest import CORRECTIVES_NAME
from soma_core.rig.procedural_json import read_procedural
from tests.bodies import randn

__all__ = ["LIMBS", "MODES", "as_pose", "jacobian", "layer_of", "poses", "problem_of"]

MODES = ("aligned_x_swing_twist", "local_x_swing_twist", "local_x_euler")
LIMBS = tuple(
    f"{side}{joint}"
    for side in ("Left", "Right")
    for joint in ("Arm", "ForeArm", "Hand", "Leg", "Shin", "Foot")
)
_STEP = 1e-5
"""Of central differences [rad, m]: squared below rounding over it."""
_NEARLY_HALF = 179.9
"""Degrees."""
_NUDGE = 0.02
"""Turns of all joints [rad] where twists are read off local rotations: some of the shipped rig's lie at half
a turn in the T-pose itself, where such an angle jumps. With correctives: the T-pose lies on their kink."""


@functools.cache
def layer_of(mode: str = MODES[0], *, correct: bool = False) -> SomaLayer:
    """The float64 layer at low LOD that reads twists by `mode`; with `correct`, as shipped otherwise."""
    mesh, rig = load_canonical("low")
    document = json.loads((assets_dir() / "SOMA_procedural_transforms.json").read_text())
    document["rotation_extraction"] = {"default": mode, "per_procedural_joint": {}}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "definition.json"
        path.write_text(json.dumps(document))
        own = replace(rig.procedural, definition=read_procedural(path))
    return SomaLayer(
        "soma", canonical=(mesh, replace(rig, procedural=own)), dtype=torch.float64, kernels="torch",
        correctives=assets_dir() / CORRECTIVES_NAME if correct else None,
    )  # fmt: skip


def poses(layer: SomaLayer, kind: str) -> Tensor:
    """T-pose-relative rotations (1, J - 1, 3, 3).

    ``rest``; ``random``; ``turned``: every joint of arms and legs nearly half a turn about its bone;
    ``bent``: every second of them nearly half a turn across it.
    """
    names = list(layer.joint_names)
    vectors = torch.zeros(1, len(names), 3, dtype=torch.float64)
    spread = 0.3 if kind == "random" else _NUDGE
    if kind != "random" and layer.correctives is None and _mode_of(layer) == MODES[0]:
        spread = 0.0
    vectors = vectors + spread * randn(*vectors.shape, seed=4)
    for name in LIMBS if kind in ("turned", "bent") else ():
        joint = names.index(name)
        end = layer.rig.t_pose_world[joint + 1, :3, 3] - layer.rig.t_pose_world[joint, :3, 3]
        if name.endswith(("Arm", "Leg", "Shin")):
            child = int((layer.rig.parents == joint + 1).nonzero()[0][0])
            end = layer.rig.t_pose_world[child, :3, 3] - layer.rig.t_pose_world[joint + 1, :3, 3]
        along = torch.tensor(end) / torch.tensor(end).norm()
        if kind == "turned":
            vectors[0, joint] += along * torch.tensor(_NEARLY_HALF).deg2rad()
        elif name.endswith(("ForeArm", "Shin")):
            across = torch.linalg.cross(along, along.new_tensor([0.3, 0.5, 0.8]))
            vectors[0, joint] += across / across.norm() * torch.tensor(_NEARLY_HALF).deg2rad()
    return axis_angle_to_matrix(vectors)


def _mode_of(layer: SomaLayer) -> str:
    (mode,) = set(layer.rig.procedural.definition.modes.values())
    return mode


def as_pose(rotations: Tensor, hips: Tensor) -> Pose:
    """A pose with the root's rotation."""
    eye = torch.eye(3, dtype=rotations.dtype).expand(len(rotations), 1, 3, 3)
    return Pose.begin(torch.cat((eye, rotations), 1), hips)


def problem_of(model: PoseModel, identity, vertices: Tensor, bone_scale: Tensor | None = None) -> Problem:
    """The problem of targets under plain vertex weights."""
    weights = torch.as_tensor(model.fitted, dtype=vertices.dtype)[None]
    return model.problem(vertices, identity, weights, bone_scale, None, None)


def jacobian(layer: SomaLayer, model: PoseModel, identity, rotations: Tensor, hips: Tensor) -> Tensor:
    """Motion (3 n + 3, v, 3) of the fitted vertices of one pose, by the layer's own ``pose``.

    Rows are world-frame turns of the variables' subtrees, then a shift.
    """
    solver = model.solver
    n = solver.variables
    rest = model.rest(identity, torch.ones(1, len(model.fitted), dtype=torch.float64))
    turns, _ = solver.walk_public(as_pose(rotations, hips), rest.offsets)
    above = turns[0, solver.parents[n]]
    steps = _STEP * torch.eye(3 * len(n) + 3, dtype=torch.float64).view(-1, len(n) + 1, 3)
    ends = []
    for sign in (1, -1):
        local = (above.mT @ (sign * steps[:, :-1, :, None])).squeeze(-1)
        moved = rotations[0].repeat(len(steps), 1, 1, 1)
        moved[:, n - 1] = axis_angle_to_matrix(local) @ moved[:, n - 1]
        ends.append(layer.pose(identity, moved, hips + sign * steps[:, -1]).vertices)
    return ((ends[0] - ends[1]) / (2 * _STEP))[:, torch.as_tensor(model.fitted)]
