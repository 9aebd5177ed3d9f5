"""Checks of the fitted skeleton and of poses."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, orthonormality_error
from soma_core.inversion import PoseInversion
from soma_core.plugin.checks import CheckFailedError, check
from soma_core.skeleton.identity import Identity
from soma_core.testing.context import Context
from soma_core.testing.samples import at_range_ends, changed_rows

__all__ = ["CHECKS"]

_OUTSIDE = 0.01
"""How far outside the surface a joint may lie, relative to stature: 17 mm of 1.7 m, a finger."""

_LOOKED_AT = 3
"""Bodies whose joints are looked at: the default and two random ones; a second each on the shipped mesh."""

_ROTATION = 1e-6
"""Largest entry of |R^T R - I|, float64: far above rounding, far below what a pose shows."""

_BONE_DEG = 20.0
"""Degrees. Other proportions spread hips and palm by up to ten; a wrong joint by far more."""
_SHORT_BONE = 0.01
"""Bones shorter than this part of the stature have no direction worth comparing."""

_BEND = 0.2
"""Standard deviation [rad] of the rotations in the round trip: every joint bent, none folded."""
_RECOVERED_DEG = 10.0
"""Degrees. Twenty steps leave next to nothing on the shipped mesh and three on one of a thousand vertices."""
_DETERMINED_DEG = 1.0
"""Degrees to which the canonical body must give a rotation back for a backend to be held to it: on a coarse
mesh the spin of a finger is open."""
_STEPS, _REST_M = 20, 1e-9
"""Steps of the solver, and the change of its error [m] at which it may rest: more than its defaults, so that
what is left is the body's fault."""

_CHUNK = 8
"""Bodies prepared at a time, to bound memory."""


def _winding(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """How often a surface winds around each point: 1 inside, 0 outside; (p, 3) -> (p,).

    Sum of signed solid angles (van Oosterom and Strackee 1983) over 4 pi; small holes hardly change it.
    """
    total = np.empty(len(points))
    for index, point in enumerate(points):
        a, b, c = (vertices[triangles[:, corner]] - point for corner in range(3))
        la, lb, lc = (np.linalg.norm(edge, axis=1) for edge in (a, b, c))
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        spread = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        total[index] = np.arctan2(volume, spread).sum() / (2 * np.pi)
    return total


@check("joints-inside", mend="look at the wrap around that joint", needs=("transfer-random",))
def joints_inside(context: Context) -> None:
    """Joints that lie inside the canonical body lie inside every body."""
    mesh, rig = context.mesh, context.rig
    triangles = mesh.triangles[~np.isin(mesh.triangles, mesh.face_interior).any(1)]
    inner = np.flatnonzero(_winding(rig.bind_world[:, :3, 3], mesh.vertices, triangles) > 0.5)
    identity = context.bodies.identity
    for row, (body, world) in enumerate(
        zip(
            identity.fitted_rest[:_LOOKED_AT].numpy(), identity.fitted_world[:_LOOKED_AT].numpy(), strict=True
        )
    ):
        places = world[inner, :3, 3]
        for joint in inner[_winding(places, body, triangles) < 0.5]:
            away = float(np.linalg.norm(body - world[joint, :3, 3], axis=1).min())
            if away > _OUTSIDE * np.ptp(body[:, 1]):
                raise CheckFailedError(
                    f"{context.bodies.label(row)}, joint {rig.joint_names[joint]}",
                    got=f"a place outside the body, {1000 * away:.0f} mm from its nearest vertex",
                    expected="a place inside, as on the canonical body",
                    fix="Look at the wrap around this joint: its vertices must enclose the limb there.",
                )


def _prepared_worlds(context: Context) -> list[tuple[str, Tensor]]:
    """Label and joint transforms (J, 4, 4), fitted and reposed, of bodies and of the ends of ranges.

    Of parameters in a group only what random bodies have of them: there may be hundreds.
    """
    identity = context.bodies.identity
    found = [
        (context.bodies.label(row), world[row])
        for row in range(identity.batch_size)
        for world in (identity.fitted_world, identity.bind_world)
    ]
    ends = at_range_ends([item for item in context.parameters if not item.group])
    for start in range(0, len(ends), _CHUNK):
        part = ends[start : start + _CHUNK]
        with torch.no_grad():
            made = context.layer.identity(changed_rows(context.parameters, part, dtype=torch.float64))
        for row, change in enumerate(part):
            found += [(f"the body at {change}", world[row]) for world in (made.fitted_world, made.bind_world)]
    return found


@check("rotations-so3", mend="narrow the range", needs=("transfer-random",))
def rotations_so3(context: Context) -> None:
    """Fitted joint rotations are rotations, also at the ends of the ranges."""
    for label, world in _prepared_worlds(context):
        error = orthonormality_error(world[:, :3, :3]).nan_to_num(torch.inf)
        error = torch.where(torch.isfinite(world).flatten(1).all(1), error, torch.inf)
        worst = int(error.argmax())
        if not error[worst] <= _ROTATION:
            raise CheckFailedError(
                f"{label}, joint {context.rig.joint_names[worst]}",
                got=f"a matrix {float(error[worst]):.2g} away from a rotation",
                expected=f"at most {_ROTATION:g}",
                fix="The body collapses or explodes there: narrow the range of the parameter.",
            )


@check("zero-is-t-pose", mend="look at the wrap around both joints", level="core", needs=("transfer-random",))
def zero_is_t_pose(context: Context) -> None:
    """Zero rotations give the T-pose: every bone points as on the canonical rig."""
    rig, bodies = context.rig, context.bodies
    turns = torch.zeros(bodies.identity.batch_size, rig.joint_count - 1, 3, dtype=torch.float64)
    with torch.no_grad():
        world = context.layer.pose(bodies.identity, turns).transforms.numpy()
    stature = float(np.ptp(context.mesh.vertices[:, 1]))
    for row, joint in np.ndindex(len(world), rig.joint_count):
        parent = rig.parents[joint]
        if parent < 1:
            continue
        bone = world[row, joint, :3, 3] - world[row, parent, :3, 3]
        target = rig.t_pose_world[joint, :3, 3] - rig.t_pose_world[parent, :3, 3]
        if min(np.linalg.norm(target), np.linalg.norm(bone)) < _SHORT_BONE * stature:
            continue
        angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(bone, target)), bone @ target))
        if not angle <= _BONE_DEG:
            raise CheckFailedError(
                f"{bodies.label(row)}, bone {rig.joint_names[parent]} to {rig.joint_names[joint]}",
                got=f"{angle:.0f} degrees away from the T-pose",
                expected=f"at most {_BONE_DEG:g} degrees",
                fix="Look at the wrap around both joints: vertices there belong to another part of the body.",
            )


def _with_canonical(context: Context) -> Identity:
    """The canonical body itself as row 0, then the default body and one random body where there is one."""
    rig, own = context.rig, context.bodies.identity
    rest = torch.cat((torch.tensor(rig.bind_shape)[None], own.rest[:2]))
    bind = torch.cat((torch.tensor(rig.bind_world)[None], own.bind_world[:2]))
    return Identity(rest=rest, bind_world=bind, fitted_rest=rest, fitted_world=bind)


@check("inversion-round-trip", mend="look at the wrap around that limb", needs=("transfer-random",))
def inversion_round_trip(context: Context) -> None:
    """Rotations that posed a body are recovered from its vertices."""
    identity, rig = _with_canonical(context), context.rig
    random = torch.Generator(device="cpu").manual_seed(0)
    turns = _BEND * torch.randn(
        1, rig.joint_count - 1, 3, generator=random, dtype=torch.float64, device="cpu"
    ).expand(identity.batch_size, -1, -1)
    with torch.no_grad():
        vertices = context.layer.pose(identity, turns).vertices
    solver = PoseInversion(context.layer, iterations=_STEPS, tolerance=_REST_M, kernels="torch")
    found = solver(vertices, identity).rotations
    miss = matrix_to_axis_angle(axis_angle_to_matrix(turns).mT @ found).norm(dim=-1).rad2deg()
    carried = torch.as_tensor(np.diff(rig.weights.tocsc().indptr)[1:] > 0)
    error = torch.where(carried & (miss[0] < _DETERMINED_DEG), miss[1:], 0)
    if not error.max() <= _RECOVERED_DEG:
        row, joint = divmod(int(error.argmax()), error.shape[1])
        raise CheckFailedError(
            f"{context.bodies.label(row)}, joint {rig.user_joint_names[joint]}",
            got=f"{float(error.max()):.0f} degrees from the rotation that posed it",
            expected=f"at most {_RECOVERED_DEG:g} degrees, as on the canonical body",
            fix="The wrap around this joint has no extent to tell a rotation by: register it there again.",
        )


CHECKS = (joints_inside, rotations_so3, zero_is_t_pose, inversion_round_trip)
