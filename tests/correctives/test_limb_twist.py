"""The twist of a limb that skinning does not tell, and what bends in activations along it."""

import numpy as np
import pytest
import torch

from soma_core.correctives.bind_body import BindBody
from soma_core.correctives.finish import Masks
from soma_core.correctives.limb_twist import limb_bones, slope_changes, twisted
from soma_core.correctives.masks import find_creases, joint_mask, vertex_mask
from soma_core.correctives.network import CorrectivesNetwork
from soma_core.correctives.poses import random_rotations
from soma_core.rig import load_canonical
from tests.bodies import tiny_canonical
from tests.correctives.conftest import CHANNELS

UNTOLD = 0.1  # of what the turn alone moves: a few vertices at the shoulder and hip follow the bone itself


@pytest.fixture(scope="module")
def canonical():
    return load_canonical("low")


def test_skinning_does_not_tell_how_a_straight_limbs_twist_is_shared(canonical):
    body, names = BindBody(canonical[1]), canonical[1].user_joint_names
    bones = limb_bones(canonical[1])
    assert {names[own] for own, _, _ in bones} == {"LeftArm", "RightArm", "LeftLeg", "RightLeg"}
    rest = torch.eye(3, dtype=torch.float64).expand(1, len(names), 3, 3)
    straight = body.skin(body.transforms(rest))
    angle = torch.tensor([0.5], dtype=torch.float64)
    for bone in bones:
        both = twisted(rest, bone, angle)
        alone = both.clone()
        alone[:, bone[1]] = rest[:, bone[1]]
        moved, told = (
            float((body.skin(body.transforms(pose)) - straight).norm(dim=-1).max()) for pose in (both, alone)
        )
        assert moved < UNTOLD * told


def test_slope_changes_are_those_of_folds_that_a_twist_crosses(canonical):
    """Activations that read no limb bend nowhere, those that read one do; without limbs none does."""
    mesh, rig = canonical
    creases = find_creases(rig)
    masks = Masks(joints=joint_mask(rig, creases), vertices=vertex_mask(mesh, rig, creases))
    network = CorrectivesNetwork(masks.joints, masks.vertices, channels=CHANNELS, seed=1)
    motion = random_rotations(rig.user_joint_names, 6, np.random.default_rng(1))
    found = slope_changes(network, rig, [motion], np.random.default_rng(0))
    assert torch.equal(found, found.T)
    assert torch.linalg.eigvalsh(found).min() > -1e-6 * found.diagonal().max()
    reads = {int(joint) for own, end, _ in limb_bones(rig) for joint in (own + 1, end + 1)}  # the root is 0
    blind = [not reads & set(row.tolist()) for row in network.reads]
    bends = found.diagonal().view(-1, CHANNELS).sum(1)
    assert bends[blind].abs().max() == 0
    assert bends[[not one for one in blind]].max() > 0.1
    assert float(slope_changes(network, tiny_canonical()[1], [motion], np.random.default_rng(0)).max()) == 0
