"""Our forward path against the anny package's own SOMA rig, an independent implementation.

What remains has three parts, each measured by taking our path and swapping one stage for theirs: the
frames of joints with several children (theirs add the normal of the first two children to the Procrustes
problem, ours those of every pair, so that left and right are treated alike), their topology transfer
without normal offsets, and our reposing to the bind pose before skinning.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from soma_core.evaluation.anny_package import anny_package_model
from soma_core.evaluation.random_poses import random_axis_angles
from soma_core.evaluation.report import Figure, Report, distance_figures
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.layer import SomaLayer
from soma_core.shape_space.sampling import sample_parameters
from soma_core.skeleton.identity import Identity

__all__ = ["run"]

_PHENOTYPES = ("gender", "age", "muscle", "weight", "height", "proportions")
"""Anny's six anthropometric phenotypes (paper, section 3.2), uniform from newborn to old age."""

_MEAN_MM = 1.0
_EXPLAINED_MM = 0.01


def _from_hips(points: Tensor, transforms: Tensor) -> Tensor:
    """Points relative to the Hips: the package pins its root to the ground, we place the Hips."""
    return points - transforms[:, 1:2, :3, 3]


def _their_identity(identity: Identity, found: dict[str, Tensor], rest: Tensor) -> Identity:
    """Our identity with the package's rest frames, and `rest` vertices."""
    to_canonical = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
    frames = found["rest_bone_poses"]
    bind = identity.fitted_world.clone()
    bind[:, 1:, :3, :3] = to_canonical @ frames[:, 1:, :3, :3]
    bind[:, 1:, :3, 3] = frames[:, 1:, :3, 3] @ to_canonical.T
    return replace(identity, rest=rest, bind_world=bind)


@torch.no_grad()
def run(config: DictConfig) -> Report:
    """Compare `config.experiment.count` random identities in as many random poses, in float64."""
    count = config.experiment.count
    model = anny_package_model(rig="soma", topology="soma", dtype=torch.float64)
    layer = SomaLayer("anny", dtype=torch.float64, exact=True, procedural=False, correctives=None)
    random = np.random.default_rng(config.seed)
    drawn = sample_parameters(layer.spec, count, random, skip_groups={"local_changes"})
    params = {name: torch.as_tensor(drawn[name]) for name in _PHENOTYPES}
    rotations = axis_angle_to_matrix(torch.as_tensor(random_axis_angles(layer.joint_names, count, random)))
    deltas = torch.eye(4, dtype=torch.float64).repeat(count, len(layer.joint_names) + 1, 1, 1)
    deltas[:, 1:, :3, :3] = rotations
    found = model(pose_parameters=deltas, phenotype_kwargs=params)
    theirs = _from_hips(found["vertices"], found["bone_poses"])

    def distances(identity: Identity) -> np.ndarray:
        posed = layer.pose(identity, rotations)
        return (_from_hips(posed.vertices, posed.transforms) - theirs).norm(dim=-1).numpy()

    identity = layer.identity(params)
    as_fitted = replace(identity, rest=identity.fitted_rest, bind_world=identity.fitted_world)
    to_canonical = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
    their_rest = found["rest_vertices"] @ to_canonical.T
    offset = identity.fitted_rest - their_rest
    offset = (offset - offset.mean(1, keepdim=True)).norm(dim=-1)
    their_frames = _their_identity(identity, found, identity.fitted_rest)
    aligned = _their_identity(identity, found, their_rest)
    figures = [
        *distance_figures("posed vertices", distances(identity), mean=_MEAN_MM),
        Figure(name="without reposing, mean", value=1e3 * distances(as_fitted).mean(), unit="mm"),
        Figure(
            name="rest vertices (their transfer has no normal offset), mean",
            value=1e3 * float(offset.mean()),
            unit="mm",
        ),
        Figure(
            name="our rest vertices on their rest frames, mean",
            value=1e3 * distances(their_frames).mean(),
            unit="mm",
        ),
        Figure(
            name="their rest vertices on their rest frames, mean",
            value=1e3 * distances(aligned).mean(),
            unit="mm",
            bound=_EXPLAINED_MM,
        ),
    ]
    return Report(
        title=f"Against the anny package's own SOMA rig: {count} random identities and poses",
        figures=figures,
        notes=(
            "Distances are relative to the Hips. The last line runs our kinematics and skinning on the "
            "package's rest shape and frames: what is left there would be a difference in section 3.5.1.",
        ),
    )
