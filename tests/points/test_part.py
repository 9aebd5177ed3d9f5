"""Bodies in part: the same as the whole, for one identity, for many, and from parameters."""

from __future__ import annotations

import pytest
import torch

from soma_core import SomaLayer
from soma_core.errors import InputError
from tests.bodies import randn

IDS = torch.tensor([4400, 3, 777, 3])
TOLERANCE = 1e-9
"""Of float64 [m]."""


def _layer(**kind: object) -> SomaLayer:
    return SomaLayer("soma", lod="low", dtype=torch.float64, **kind)


@pytest.mark.parametrize("kernels", ["torch", "auto"])
@pytest.mark.parametrize("absolute", [False, True])
def test_a_part_is_the_whole_in_part(kernels: str, absolute: bool) -> None:
    layer = _layer(kernels=kernels)
    params = {"coefficients": randn(3, 8, seed=1)} if "coefficients" in layer.spec.params else {}
    rotations, shift = 0.4 * randn(3, 77, 3), randn(3, 3, seed=2)
    scale = 1 + 0.1 * randn(3, 77, seed=3).tanh()
    more = {"absolute": absolute, "bone_scale": scale}
    whole = layer(params, rotations, shift, **more)
    identity, part = layer.identity(params), layer.subset(IDS)
    seen = (
        part(params, rotations, shift, **more),
        part.pose(identity, rotations, shift, **more),
        layer.pose(identity, rotations, shift, vertices=IDS, **more),
    )
    for one in seen:
        torch.testing.assert_close(one.vertices, whole.vertices[:, IDS], atol=TOLERANCE, rtol=0)
        torch.testing.assert_close(one.transforms, whole.transforms, atol=TOLERANCE, rtol=0)
    for one in (
        layer.joints(params, rotations, shift, **more),
        layer.joints(identity, rotations, shift, **more),
    ):
        assert one.vertices.shape == (3, 0, 3)
        torch.testing.assert_close(one.joints, whole.joints, atol=TOLERANCE, rtol=0)


def test_parts_carry_gradients() -> None:
    layer = _layer()
    identity, part = layer.identity(), layer.subset(IDS)
    slopes = []
    for pose in (part.pose, layer.pose, layer.joints):
        rotations = (0.3 * randn(2, 77, 3)).requires_grad_()
        posed = pose(identity, rotations)
        seen = posed.vertices[:, IDS] if pose == layer.pose else posed.vertices
        seen = posed.joints if pose == layer.joints else seen
        slopes.append(torch.autograd.grad(seen.square().sum(), rotations)[0])
    torch.testing.assert_close(slopes[0], slopes[1], atol=1e-8, rtol=0)
    assert slopes[2].abs().sum() > 0


@pytest.mark.parametrize("ids", [[4505], [-1], [0.5]])
def test_ids_that_the_mesh_has_not_are_refused(ids: list) -> None:
    with pytest.raises(InputError, match="vertices: got"):
        _layer().subset(ids)
