"""A small body, its masks, and a teacher that knows the answer, shared by all tests of correctives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from soma_core.correctives.features import PoseFeatures
from soma_core.correctives.finish import Masks
from soma_core.correctives.masks import Creases, find_creases, joint_mask, vertex_mask
from soma_core.correctives.network import CorrectivesNetwork
from soma_core.correctives.teacher import Clip, Lesson
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from tests.bodies import tiny_canonical

CHANNELS = 2


@dataclass(frozen=True, kw_only=True)
class Body:
    """The synthetic body with everything that its rig says about correctives."""

    mesh: CanonicalMesh
    rig: Rig
    creases: Creases
    masks: Masks


class KnownTeacher:
    """Offsets by a network of the same kind with other weights: there is an answer to find."""

    name = "known"
    key = "known"

    def __init__(self, body: Body) -> None:
        self.network = CorrectivesNetwork(body.masks.joints, body.masks.vertices, channels=CHANNELS, seed=7)
        drawn = torch.randn(self.network.second.shape, generator=torch.Generator().manual_seed(7))
        self.network.second.data.copy_(drawn)
        self.features = PoseFeatures(body.rig, dtype=torch.float32, device="cpu")
        self.provenance = {"teacher": "known"}
        self.taught: list[str] = []

    @torch.no_grad()
    def teach(self, clip: Clip) -> Lesson:
        self.taught.append(clip.name)
        features = self.features(torch.as_tensor(clip.rotations).float())
        return Lesson(rotations=clip.rotations, offsets=self.network(features).numpy() / 100)


def made_body() -> Body:
    """The synthetic body and its masks."""
    mesh, rig = tiny_canonical()
    creases = find_creases(rig)
    masks = Masks(joints=joint_mask(rig, creases), vertices=vertex_mask(mesh, rig, creases))
    return Body(mesh=mesh, rig=rig, creases=creases, masks=masks)


@pytest.fixture(scope="session")
def body() -> Body:
    return made_body()


@pytest.fixture
def teacher(body: Body) -> KnownTeacher:
    return KnownTeacher(body)


@pytest.fixture(scope="session")
def bind_pose(body: Body) -> torch.Tensor:
    """T-pose-relative rotations (1, J - 1, 3, 3) of the bind pose."""
    rig = body.rig
    parents, bind = np.maximum(rig.parents, 0), rig.bind_world[:, :3, :3]
    orient = rig.t_pose_world[:, :3, :3].copy()
    orient[0] = np.eye(3)
    local = bind[parents].transpose(0, 2, 1) @ bind
    return torch.as_tensor(orient[parents] @ local @ orient.transpose(0, 2, 1))[None, 1:]
