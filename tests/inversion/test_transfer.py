"""Skeleton transfer: exact for the template moved rigidly, close for posed bodies, clear about its needs."""

from dataclasses import replace

import pytest
import torch

from soma_core import SomaLayer
from soma_core.errors import InputError
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error
from soma_core.inversion import PoseInversion
from soma_core.inversion.problem import Problem
from soma_core.inversion.transfer import SkeletonTransfer
from soma_core.skeleton.identity import Identity
from soma_core.skeleton.joints import joint_regressor
from tests.bodies import CPU, generator, randn
from tests.inversion.small_problem import pose_about, real, synthetic

FRAMES = 4
PULLED = 1e-3
"""Radians by which the weak pull towards no rotation rolls a slender limb."""
ORTHONORMAL = {torch.float64: 1e-12, torch.float32: 5e-6}
POSED_MM = 12.0
"""Mean vertex error of the shipped rig at 0.2 rad an axis; bends move the joints that are regressed."""


def template(body, dtype=torch.float64):
    rest = torch.tensor(body.mesh.vertices, dtype=dtype)[None]
    bind = torch.tensor(body.rig.bind_world, dtype=dtype)[None]
    return Identity(rest=rest, bind_world=bind, fitted_rest=rest, fitted_world=bind)


def problem(body, vertices, *, identity=None, weights=None):
    identity = identity or template(body, vertices.dtype)
    weights = body.plain_weights(vertices.dtype) if weights is None else weights
    rest = body.rest(identity, weights)
    target, origin = body.moments(vertices.dtype).target(vertices, rest)
    return Problem(
        vertices=vertices, weights=weights, identity=identity, rest=rest, target=target, origin=origin
    )


def transfer(body, dtype=torch.float64):
    return SkeletonTransfer(body.structure, body.mesh, body.rig, dtype=dtype, device=CPU)


@pytest.mark.parametrize("make", [synthetic, real])
def test_a_rigid_motion_of_the_template_turns_the_hips_alone(make):
    body = make()
    bind = body.animation().kinematics.bind_relative
    turns = axis_angle_to_matrix(2 * randn(FRAMES, 3))
    vertices = template(body).rest @ turns.transpose(-1, -2) + 5 * randn(FRAMES, 1, 3, seed=1)
    found = transfer(body)(problem(body, vertices))
    known = body.structure.variables
    torch.testing.assert_close(found[:, 1], turns @ bind[0], atol=PULLED, rtol=0)
    other = known[known > 1]
    expected = bind[other - 1].expand(FRAMES, -1, 3, 3)
    torch.testing.assert_close(found[:, other], expected, atol=PULLED, rtol=0)
    assert torch.equal(found[:, 0], torch.eye(3, dtype=torch.float64).expand(FRAMES, 3, 3))


def test_each_identity_brings_its_own_bones():
    """Bodies of other proportions, posed at random, one identity a frame: as each alone."""
    layer = SomaLayer("soma", lod="low", dtype=torch.float64, procedural=False)
    body, identity = real(), layer.identity({"shape": 0.8 * randn(2, 128, seed=2)})
    rotations, hips = body.poses(2, spread=0.2)
    vertices = layer.pose(identity, rotations, hips).vertices
    both = transfer(body)(problem(body, vertices, identity=identity))
    for frame in range(2):
        who = replace(identity, rest=identity.rest[frame, None], bind_world=identity.bind_world[frame, None])
        alone = transfer(body)(problem(body, vertices[frame, None], identity=who))
        torch.testing.assert_close(alone[0], both[frame], atol=1e-10, rtol=0)


def test_a_posed_body_is_met_better_than_by_its_points_alone():
    layer = SomaLayer("soma", lod="low", procedural=False)
    identity = layer.identity()
    rotations, hips = real().poses(16, spread=0.2, dtype=torch.float32)
    vertices = layer.pose(identity, rotations, hips).vertices
    fitted = torch.tensor(real().structure.fitted)
    error = {
        stage: 1e3 * PoseInversion(layer, stages=(stage,))(vertices, identity).vertex_error[:, fitted].mean()
        for stage in ("transfer", "procrustes")
    }
    assert error["transfer"] < POSED_MM
    assert error["transfer"] < error["procrustes"]


@pytest.mark.parametrize("kind", ["point", "plane", "line", "mirrored", "noise"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_degenerate_targets_give_proper_rotations(kind, dtype):
    body = synthetic()
    vertices = body.posed(template(body, dtype), *body.poses(FRAMES, dtype=dtype))
    scale = {"plane": [1, 1, 0], "line": [0, 1, 0], "mirrored": [-1, 1, 1]}.get(kind, [0, 0, 0])
    vertices = vertices * torch.tensor(scale, dtype=dtype)
    if kind == "noise":
        vertices = randn(*vertices.shape, seed=3, dtype=dtype)
    found = transfer(body, dtype)(problem(body, vertices))
    assert orthonormality_error(found).max() < ORTHONORMAL[dtype]


def test_a_joint_without_children_is_turned_by_its_weighted_points():
    """Against the covariance about the regressed joint, by its definition."""
    body = real()
    weights = 0.5 + torch.rand(1, body.mesh.vertex_count, generator=generator(6), dtype=torch.float64)
    weights = weights * body.plain_weights()
    vertices = body.posed(template(body), *body.poses(1))
    given = problem(body, vertices, weights=weights)
    nowhere = torch.zeros(1, 3, dtype=torch.float64)
    found = pose_about(transfer(body)(given)[:, 1:], nowhere, nowhere)
    turns, _ = body.solver().walk(found, given.rest)
    jaw, structure = body.rig.joint_names.index("Jaw"), body.structure
    mine = structure.joints[structure.influence_joint] == jaw
    vertex = structure.influence_vertex[mine]
    share = torch.tensor(structure.influence_weight[mine]) * weights[0, vertex]
    place = torch.tensor(joint_regressor(body.mesh, body.rig).toarray()[jaw]) @ vertices[0]
    local = body.moments().local_points(given.identity)[0, mine]
    expected = rotation_from_covariance((share[:, None] * (vertices[0, vertex] - place)).T @ local)
    torch.testing.assert_close(turns[0, jaw], expected, atol=1e-9, rtol=0)


def test_a_vertex_that_locates_joints_must_have_weight():
    body, stage = real(), transfer(real())
    weights = body.plain_weights().clone()
    weights[:, stage.read[[3, 40]]] = 0
    vertices = body.posed(template(body), *body.poses(1))
    expected = rf"weights: got 0 at 2 of the {len(stage.read)} vertices .*stages=\('procrustes', \.\.\.\)"
    with pytest.raises(InputError, match=expected):
        stage(problem(body, vertices, weights=weights))


def test_the_default_weights_serve_and_the_advice_of_the_error_helps():
    layer = SomaLayer("soma", lod="low", procedural=False)
    identity = layer.identity()
    vertices = layer.pose(identity, *real().poses(2, dtype=torch.float32)).vertices
    weights = real().plain_weights(torch.float32)[0].clone()
    weights[::10] = 0
    vertices[:, ::10] = torch.nan
    with pytest.raises(InputError, match=r"weights: got 0 at \d+ of the \d+ vertices"):
        PoseInversion(layer, stages=("transfer", "analytical"))(vertices, identity, weights=weights)
    found = PoseInversion(layer, stages=("procrustes", "analytical"))(vertices, identity, weights=weights)
    assert found.valid.all()
