"""The way back to SMPL-X, on a stand-in in the official format: a body of this project in another rig."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch

from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from soma_core.inversion import PoseInversion
from soma_core.native import NativeFit
from soma_core.plugin.registry import default_registry
from tests.native.conftest import BETAS

ROUND_TRIP = 1.0
"""Millimetres on average: a motion to parameters of SMPL-X, to that model's mesh, and back to a motion."""
OTHER_SKIN = 2.0
"""Millimetres on average between the two meshes: correctives and twist joints are not in the stand-in."""
SAME = 1e-4
"""Metres: float32, and steps until the energy moves by less than a hundredth of a millimetre, squared."""
POSES_OF_SAME = 5e-3
"""Radians and metres, of parameters that give the same mesh to that precision."""
LEFT = 0.02
"""Slope left at the result, relative to the slope a hundredth of a radian away."""
NO_WORSE = 1.05
"""Error with fitted over that with known parameters; the fit looks at some of the frames only."""


def posed(fit, motion):
    pose = {"rotations": motion.rotations, "translation": motion.translation}
    return fit._generator.posed(motion.params, pose)


@pytest.mark.slow
def test_parameters_give_the_vertices_under_the_model_itself(fit, motion):
    torch.testing.assert_close(posed(fit, motion), motion.vertices, atol=2e-6, rtol=0)
    target = fit.transfer
    assert motion.joint_names == fit.joint_names
    assert len(motion.joint_names) == 55
    assert motion.rotations.shape == (4, 55, 3)
    assert motion.vertex_error.shape == (4, target.count)
    assert bool(motion.valid.all())
    assert bool(motion.converged.all())


def test_round_trip(fit, layer, body, vertices, motion):
    inversion = PoseInversion(layer)
    outside = np.setdiff1d(np.arange(layer.mesh.vertex_count), layer.mesh.face_interior)
    back = inversion.canonical(motion.vertices, "native")
    assert 1e3 * float((back - vertices).norm(dim=-1)[:, outside].mean()) < OTHER_SKIN
    result = inversion(motion.vertices, body, topology="native")
    again = layer.pose(body, result.rotations, result.translation).vertices
    assert 1e3 * float((again - vertices).norm(dim=-1)[:, outside].mean()) < ROUND_TRIP


def test_no_slope_is_left_under_the_model_itself(fit, vertices, motion):
    target, counted = fit.transfer(vertices), fit.transfer.covered.float()

    def slope(shift):
        turns = (motion.rotations + shift).requires_grad_()
        place = motion.translation.clone().requires_grad_()
        mesh = fit._generator.posed(motion.params, {"rotations": turns, "translation": place})
        energy = (counted * (mesh - target).square().sum(-1)).sum()
        by_turns, by_place = torch.autograd.grad(energy, (turns, place))
        return torch.cat((by_turns[:, motion.determined].flatten(), by_place.flatten())).norm()

    noise = 0.01 * torch.randn(motion.rotations.shape, generator=torch.Generator().manual_seed(0))
    assert float(slope(0.0)) < LEFT * float(slope(noise))


def test_frames_do_not_depend_on_each_other(fit, vertices, motion):
    params = {"betas": torch.tensor([BETAS])}
    other = fit(vertices.flip(0)[:3], params=params)
    torch.testing.assert_close(other.vertices.flip(0), motion.vertices[1:], atol=SAME, rtol=0)
    gap = vertices[:2].clone()
    gap[0, 5000] = torch.nan
    found = fit(gap, params=params)
    assert found.valid.tolist() == [False, True]
    assert not found.rotations[0].any()
    assert not found.translation[0].any()
    assert bool(found.vertex_error[0].isnan().all())
    assert bool(found.residual[0].isnan())
    torch.testing.assert_close(found.vertices[1], motion.vertices[1], atol=SAME, rtol=0)


def test_joints_without_a_counterpart_keep_still(motion):
    eyes = [name.endswith("eye_smplhf") for name in motion.joint_names]
    assert (~motion.determined).tolist() == eyes
    assert not motion.rotations[:, eyes].any()


def test_parameters_of_a_known_body_are_found(fit, vertices, motion):
    params = fit.fit_params(vertices, frames=2, iterations=3)
    found = fit(vertices, params=params)
    assert float(found.residual.mean()) < NO_WORSE * float(motion.residual.mean())
    assert found.params["betas"].shape == (1, 10)


def test_weights_leave_vertices_out(fit, vertices, motion):
    count = fit.transfer.count
    weights = torch.ones(count)
    left_hand = motion.joint_names.index("left_wrist")
    skin = fit._generator.skinning(motion.params).weights
    weights[skin[:, left_hand] > 0.5] = 0
    found = fit(vertices[:1], params=motion.params, weights=weights)
    assert bool(found.vertex_error[0, weights == 0].isnan().all())
    left, before = (one.vertex_error[0, weights > 0].nan_to_num().square().sum() for one in (found, motion))
    assert float(left) < float(before)


def test_joints_are_held_near_what_is_expected(fit, vertices, motion):
    wrist = motion.joint_names.index("left_wrist")
    turns = axis_angle_to_matrix(motion.rotations)
    turns[:, wrist] = turns[:, wrist] @ axis_angle_to_matrix(torch.tensor([0.3, 0.0, 0.0]))
    held = torch.zeros(len(motion.joint_names))
    left = []
    for firmness in (0.0, 1e-2, 1.0):
        held[wrist] = firmness
        found = fit(vertices, params=motion.params, expected=turns, firmness=held)
        apart = turns[:, wrist].transpose(-1, -2) @ axis_angle_to_matrix(found.rotations[:, wrist])
        left.append(float(matrix_to_axis_angle(apart).norm(dim=-1).mean()))
        if not firmness:
            torch.testing.assert_close(found.residual, motion.residual, atol=0.1 * SAME, rtol=0)
    assert left[0] == pytest.approx(0.3, abs=1e-2)
    assert left[0] > left[1] > left[2]
    assert left[2] < 0.02
    parts = fit(vertices[2:], params=motion.params, expected=turns[2:], firmness=held)
    torch.testing.assert_close(parts.residual, found.residual[2:], atol=0.1 * SAME, rtol=0)


@pytest.mark.parametrize("firmness", [None, torch.zeros(3)])
def test_what_is_expected_is_of_all_joints(fit, vertices, firmness):
    turns = torch.eye(3).expand(len(vertices), len(fit.joint_names), 3, 3)
    with pytest.raises(InputError, match=r"expected: got .*expected \(4, 55, 3, 3\) and firmness \(55,\)"):
        fit(vertices, expected=turns, firmness=firmness)


def test_no_frames_are_none(fit, vertices):
    found = fit(vertices[:0])
    assert found.rotations.shape == (0, 55, 3)
    assert found.vertex_error.shape == (0, fit.transfer.count)


def test_refusals(fit, vertices):
    with pytest.raises(InputError, match=r"toy, whose generator has no skinning\(\)"):
        NativeFit("toy", registry=default_registry())
    with pytest.raises(InputError, match="kernels: got 'cuda', expected 'auto', 'torch' or 'warp'"):
        NativeFit("smplx", kernels="cuda")
    with pytest.raises(InputError, match="iterations: got -1, expected at least 0"):
        NativeFit("smplx", iterations=-1)
    with pytest.raises(InputError, match="params: got 2 bodies, expected one body for all frames"):
        fit(vertices, params={"betas": torch.zeros(2, 10)})
    with pytest.raises(InputError, match="frames: got 0, expected at least 1"):
        fit.fit_params(vertices, frames=0)
    with pytest.raises(InputError, match="iterations: got 0, expected at least 1"):
        fit.fit_params(vertices, iterations=0)
    with pytest.raises(InputError, match="vertices: got 4 frames of which none is finite"):
        fit.fit_params(vertices * torch.nan)
    with pytest.raises(InputError, match=r"weights: got \(7,\)"):
        fit(vertices, weights=torch.ones(7))


@pytest.mark.slow
@pytest.mark.usefixtures("data")
def test_it_is_a_module_like_any_other(fit, vertices):
    """Pickled, converted, in a cast network and under autocast: the same bits as one made so."""
    given, known = vertices[:1], {"betas": torch.tensor([BETAS])}

    def same(one, other):
        for name in ("rotations", "translation", "vertices"):
            torch.testing.assert_close(getattr(one, name), getattr(other, name), atol=0, rtol=0)

    other = pickle.loads(pickle.dumps(fit))
    network = torch.nn.Sequential(torch.nn.Linear(2, 2), other).to(torch.bfloat16)
    assert set(network.state_dict()) == {"0.weight", "0.bias"}
    with torch.autocast("cpu", dtype=torch.bfloat16):
        same(other(given, params=known), fit(given, params=known))
    known = {"betas": known["betas"].double()}
    same(other.double()(given, params=known), NativeFit("smplx", dtype=torch.float64)(given, params=known))
    with pytest.raises(InputError, match="vertices: got tensors under a transform of torch.func"):
        torch.func.vmap(fit)(given[None])


@pytest.mark.slow
def test_gradients_reach_the_canonical_vertices(fit, vertices, motion):
    tracked = vertices[:1].clone().requires_grad_()
    found = fit(tracked, params=motion.params)
    assert not found.vertex_error.requires_grad
    shift = torch.tensor([0.3, -0.2, 0.5])
    (slope,) = torch.autograd.grad((found.translation @ shift).sum(), tracked)
    # Moving every vertex moves the body by as much.
    torch.testing.assert_close(slope.sum((0, 1)), shift, atol=1e-3, rtol=0)
    (slope,) = torch.autograd.grad(fit(tracked, params=motion.params).rotations.square().sum(), tracked)
    assert bool(slope.isfinite().all())
