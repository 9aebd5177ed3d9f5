"""Fit our own parametric body to a surface: shape, pose and place by Gauss-Newton on closest points.

Model vertices are drawn to the surface and points of the surface to the model, both along normals, so that
the model may slide while it settles. Residuals far beyond the current scale count little (Geman-McClure),
and the scale shrinks.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from soma_core.registration.body_model import BodyModel, BodyPose
from soma_core.registration.digits import Digits, digit_guide
from soma_core.registration.surface import Surface

__all__ = ["BodyFit", "fit_body", "place_hands"]

_SHAPE_STRENGTH = 2e-3
"""Residual [m] of all vertices that one standard deviation of a component is worth."""

_POSE_STRENGTH = 6e-3
"""Residual [m] of all vertices that a turn of one radian is worth at strength 1."""

_FACING = 0.3
"""Cosine between normals below which two surfaces do not belong together."""

_TANGENT = 0.1
"""Weight of the distance along the surface: little, so that parts slide into place."""

_HOLD = 30.0
"""Weight of a landmark and of the middle of a part of a finger against a vertex."""

_ASTRAY = 6.5e-3
"""Mean distance [m] of the parts of a hand's fingers from where they belong beyond which it is placed anew;
open hands have 4 to 6, relaxed ones 7."""

_NEARER = 0.5
"""Share of that distance that may be left; else the hand stays as it was."""

_ROUND = 5
"""Vertices of a part of a finger from which on their mean is its middle; a mesh of 2,000 faces has one."""

_HAND_STEPS, _HAND_TURN, _HAND_STIFF = 24, 0.3, 4e-3
"""Steps of a hand, how far one turns a joint [rad], and what a turn of one radian is worth [m]."""

_ACROSS = math.sqrt(1 + _TANGENT**2) - _TANGENT
"""What the distance across it weighs more: the root of ``n n^T + t^2`` is ``t + _ACROSS n n^T``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyFit:
    """What came out.

    Attributes:
        pose: the parameters.
        vertices: (v, 3) [m] of the model's LOD.
        cost: mean robust distance both ways, for comparing starts.
    """

    pose: BodyPose
    vertices: np.ndarray
    cost: float


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pull:
    """Points of the model (convex combinations of vertices) and where they should be.

    Attributes:
        vertices, shares: (m, k) ids and weights.
        points: (m, 3) where the combinations are now.
        targets, normals: (m, 3).
        weights: (m,).
    """

    vertices: np.ndarray
    shares: np.ndarray
    points: np.ndarray
    targets: np.ndarray
    normals: np.ndarray
    weights: np.ndarray


def fit_body(
    model: BodyModel,
    surface: Surface,
    start: BodyPose,
    *,
    scales: Iterator[float] | list[float],
    shaped: bool = True,
    ends: float = 1.0,
    samples: int = 3000,
    landmarks: tuple[np.ndarray, np.ndarray] | None = None,
    digits: Digits | None = None,
) -> BodyFit:
    """Fit from one start, one Gauss-Newton step for each entry of `scales`.

    Args:
        model: the body.
        surface: the target [m], +Y up, +Z forward.
        start: where to begin; its pose is the one the prior pulls to.
        scales: distances [m] beyond which residuals count little, one a step.
        shaped: fit the shape too.
        ends: factor of the pull of fingers and feet to their start.
        samples: how many points of the surface are drawn to the model.
        landmarks: ids of vertices of the model's LOD and their positions (m, 3).
        digits: fingers and toes of the surface, whose labels it has.
    """
    stride = max(1, len(surface.vertices) // samples)
    chosen = np.arange(0, len(surface.vertices), stride)
    pose, derivative, cost = start, None, np.inf
    labels = None if digits is None else digits.own[: model.mesh.vertex_count]
    for number, scale in enumerate(scales):
        vertices, joints = model.evaluate(pose)
        if shaped and number % 4 == 0:
            derivative = model.shape_derivative(pose)
        pulls = [*_pulls(model, surface, vertices, chosen, scale, labels)]
        cost = float(np.mean([_robust_cost(pull, scale) for pull in pulls]))
        if landmarks is not None:
            pulls.append(
                _held(vertices, landmarks[0][:, None], np.ones((len(landmarks[0]), 1)), landmarks[1])
            )
        pulls += [
            _held(vertices, *digit_guide().rings(limb, len(vertices)), middles)
            for limb, middles in (digits.middles.items() if digits is not None else ())
            if limb.endswith("Hand")
        ]
        step = _step(model, pose, start, vertices, joints, derivative, pulls, ends)
        pose = model.moved_by(pose, step)
    vertices, _ = model.evaluate(pose)
    return BodyFit(pose=pose, vertices=vertices, cost=cost)


def place_hands(model: BodyModel, pose: BodyPose, digits: Digits) -> BodyPose:
    """Turn arms, hands and fingers until fingers far from their places are there: closest points do not.

    Args:
        model: the body.
        pose: hands roughly in place.
        digits: fingers of the surface.
    """
    for limb, middles in digits.middles.items():
        if not limb.endswith("Hand") or digits.least(limb) < _ROUND:
            continue
        before = _apart(model, pose, limb, middles)
        placed = _placed_hand(model, pose, limb, middles) if before > _ASTRAY else pose
        pose = placed if _apart(model, placed, limb, middles) < _NEARER * before else pose
    return pose


def _apart(model: BodyModel, pose: BodyPose, limb: str, middles: np.ndarray) -> float:
    """Mean distance [m] of the parts of a hand's fingers from where they belong."""
    vertices, _ = model.evaluate(pose)
    ids, shares = digit_guide().rings(limb, len(vertices))
    return float(np.linalg.norm(middles - np.einsum("mk,mkc->mc", shares, vertices[ids]), axis=1).mean())


def _placed_hand(model: BodyModel, start: BodyPose, limb: str, middles: np.ndarray) -> BodyPose:
    names = [model.layer.joint_names[joint] for joint in model.joints]
    side = limb.removesuffix("Hand")
    own = np.array([bool(re.match(f"{side}(Arm|ForeArm|Hand)", name)) for name in names])
    columns = np.flatnonzero(np.repeat(own, 3))
    pose, step = start, np.zeros(3 * len(names) + 3 + model.count)
    for _ in range(_HAND_STEPS):
        vertices, joints = model.evaluate(pose)
        held = _held(vertices, *digit_guide().rings(limb, len(vertices)), middles)
        rows = _jacobian(model, held, vertices[:, None] - joints[None, model.joints], None)
        rows = (held.normals[:, None] @ rows).squeeze(1)[:, columns]
        gap = (held.normals * (held.targets - held.points)).sum(1)
        away = model.turned(start, pose)[own].ravel()
        matrix = rows.T @ rows + _HAND_STIFF**2 * np.eye(len(columns))
        turn = np.linalg.solve(matrix, rows.T @ gap - _HAND_STIFF**2 * away)
        step[columns] = turn * min(1.0, _HAND_TURN / np.abs(turn).max())
        pose = model.moved_by(pose, step)
    return pose


def _robust_cost(pull: _Pull, scale: float) -> float:
    squared = ((pull.points - pull.targets) ** 2).sum(1)
    return float(np.mean(squared / (squared + scale**2)))


def _pulls(
    model: BodyModel,
    surface: Surface,
    vertices: np.ndarray,
    chosen: np.ndarray,
    scale: float,
    labels: np.ndarray | None,
) -> Iterator[_Pull]:
    own = Surface(vertices, model.triangles, labels=labels)
    ids = model.skin
    there = surface.facing(vertices[ids], own.normals[ids], None if labels is None else labels[ids])
    yield _Pull(
        vertices=np.repeat(ids[:, None], 3, 1), shares=np.tile([1.0, 0.0, 0.0], (len(ids), 1)),
        points=vertices[ids], targets=there.points, normals=there.normals,
        weights=~there.open * _weights(vertices[ids], there.points, own.normals[ids], there.normals, scale),
    )  # fmt: skip
    points, normals = surface.vertices[chosen], surface.normals[chosen]
    here = own.facing(points, normals, None if surface.labels is None else surface.labels[chosen])
    weights = _weights(here.points, points, here.normals, normals, scale)
    yield _Pull(
        vertices=model.triangles[here.faces], shares=here.shares, points=here.points,
        targets=points, normals=normals, weights=weights * len(ids) / max(len(chosen), 1),
    )  # fmt: skip


def _weights(
    points: np.ndarray, targets: np.ndarray, normals: np.ndarray, others: np.ndarray, scale: float
) -> np.ndarray:
    squared = ((points - targets) ** 2).sum(1)
    agree = np.clip(((normals * others).sum(1) - _FACING) / (1 - _FACING), 0, 1)
    return agree * (scale**2 / (squared + scale**2)) ** 2


def _held(vertices: np.ndarray, ids: np.ndarray, shares: np.ndarray, targets: np.ndarray) -> _Pull:
    """Combinations (m, k) of vertices held at targets (m, 3): thrice, with one axis each as the normal."""
    axes = np.repeat(np.eye(3), len(ids), 0)
    points = np.einsum("mk,mkc->mc", shares, vertices[ids])
    return _Pull(
        vertices=np.tile(ids, (3, 1)), shares=np.tile(shares, (3, 1)), points=np.tile(points, (3, 1)),
        targets=np.tile(targets, (3, 1)), normals=axes, weights=np.full(len(axes), _HOLD),
    )  # fmt: skip


def _step(
    model: BodyModel,
    pose: BodyPose,
    start: BodyPose,
    vertices: np.ndarray,
    joints: np.ndarray,
    derivative: np.ndarray | None,
    pulls: list[_Pull],
    ends: float,
) -> np.ndarray:
    """Solve the normal equations of all pulls and priors."""
    count, free = len(model.joints), 0 if derivative is None else model.count
    size = 3 * count + 3 + free
    matrix, right = np.zeros((size, size)), np.zeros(size)
    lever = vertices[:, None] - joints[None, model.joints]
    for pull in pulls:
        rows = _jacobian(model, pull, lever, derivative)
        offset = pull.targets - pull.points
        normals = pull.normals.astype(np.float32)
        along = (normals[:, None] @ rows).squeeze(1)
        rows = _TANGENT * rows + _ACROSS * normals[..., None] * along[:, None]
        wanted = _TANGENT * offset + _ACROSS * pull.normals * (pull.normals * offset).sum(1, keepdims=True)
        share = np.sqrt(pull.weights)[:, None]
        flat = (share[..., None].astype(np.float32) * rows).reshape(-1, size)
        matrix += flat.T @ flat
        right += flat.T @ (share * wanted).ravel().astype(np.float32)
    _add_priors(model, pose, start, matrix, right, free, ends)
    solved = scipy.linalg.cho_solve(scipy.linalg.cho_factor(matrix), right)
    return solved if free else np.concatenate([solved, np.zeros(model.count)])


def _jacobian(model: BodyModel, pull: _Pull, lever: np.ndarray, derivative: np.ndarray | None) -> np.ndarray:
    """Motion (m, 3, n) float32 of the points of a pull by turns of the joints, the hips, and the shape."""
    count, joints = len(pull.points), len(model.joints)
    free = 0 if derivative is None else derivative.shape[2]
    motion = np.zeros((count, 3, 3 * joints + 3 + free), np.float32)
    moved = np.einsum("mk,mkj->mj", pull.shares, model.moved[pull.vertices][..., model.joints])
    arms = moved[..., None] * np.einsum("mk,mkjc->mjc", pull.shares, lever[pull.vertices])
    for axis, (after, last) in enumerate(((1, 2), (2, 0), (0, 1))):
        motion[:, after, axis : 3 * joints : 3] = -arms[..., last]
        motion[:, last, axis : 3 * joints : 3] = arms[..., after]
        motion[:, axis, 3 * joints + axis] = 1
    if derivative is not None:
        motion[:, :, -free:] = np.einsum("ma,mack->mck", pull.shares, derivative[pull.vertices])
    return motion


def _add_priors(
    model: BodyModel,
    pose: BodyPose,
    start: BodyPose,
    matrix: np.ndarray,
    right: np.ndarray,
    free: int,
    ends: float,
) -> None:
    """Pull rotations to their start and the shape to the mean; a little damping for all."""
    count, scale = len(model.joints), len(model.skin)
    for place, away in enumerate(model.turned(start, pose)):
        stiffness = model.stiffness[place] * (ends if model.ends[place] else 1.0)
        strength = scale * (_POSE_STRENGTH * stiffness) ** 2
        block = slice(3 * place, 3 * place + 3)
        matrix[block, block] += strength * np.eye(3)
        right[block] -= strength * away
    if free:
        strength = scale * _SHAPE_STRENGTH**2 / model.count
        matrix[-free:, -free:] += strength * np.eye(free)
        right[-free:] -= strength * pose.shape
    matrix[np.diag_indices_from(matrix)] += (
        1e-6 * scale * np.concatenate([np.full(3 * count, 0.1), np.full(3, 1.0), np.full(free, 1e-3)])
    )
