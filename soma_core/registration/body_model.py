"""Our own parametric body as a fit sees it: vertices and their derivatives, in numpy."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from soma_core.geometry.tree import descendants
from soma_core.layer import SomaLayer

__all__ = ["BodyModel", "BodyPose"]

_COMPONENTS = 80
"""Leading shape components that are fitted."""

_STIFF = {
    "Toe": 3.0, "Jaw": 3.0, "Eye": 10.0, "HeadEnd": 10.0, "Spine": 1.0, "Chest": 1.0, "Neck": 0.6,
    "Hand": 0.25, "Shoulder": 0.3, "Foot": 1.0,
}  # fmt: skip
"""Strength of the pull to the starting pose, by part of the joint's name; the rest has the strength below."""
_SUPPLE = 0.1

_PLAUSIBLE = 2e-4
"""Distance [m] of all vertices that one standard deviation of a component is worth where a body is sized."""

_ENDS = re.compile("Hand[A-Z]|Foot|Toe")
"""Joints of fingers and feet, which wait until limbs are in place."""

_HANDS_AND_FEET = re.compile("Hand|Foot|Toe")

_MIRROR = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyPose:
    """Parameters of the fit: shape (k,), rotations (J - 1, 3, 3) and the position of the hips (3,)."""

    shape: np.ndarray
    rotations: np.ndarray
    hips: np.ndarray

    def at(self, hips: np.ndarray) -> BodyPose:
        """The same body with its hips elsewhere."""
        return replace(self, hips=hips)


class BodyModel:
    """The native shape space with its rig, evaluated in numpy, with the derivatives that a fit needs."""

    def __init__(self, layer: SomaLayer) -> None:
        self.layer, self.mesh, self.rig = layer, layer.mesh, layer.rig
        self.count = min(_COMPONENTS, layer.spec.params[0].shape[0])
        self.triangles = layer.mesh.triangles.astype(np.int64)
        self.skin = np.setdiff1d(np.arange(layer.mesh.vertex_count), layer.mesh.face_interior)
        parents = layer.rig.parents[1:] - 1
        self.parents = parents
        below = descendants(parents)
        weights = layer.rig.weights.toarray()[:, 1:]
        self.moved = weights @ below.T  # (v, J - 1): share of a vertex that a joint and those below it carry
        self.joints = np.flatnonzero(weights.sum(0) > 0)
        names = layer.joint_names
        self.stiffness = np.array(
            [
                next((value for part, value in _STIFF.items() if part in names[j]), _SUPPLE)
                for j in self.joints
            ]
        )
        self.stiffness[0] = 0.0
        self.ends = np.array([bool(_ENDS.search(names[j])) for j in self.joints])
        self.partner = np.array([names.index(_other_side(name)) for name in names])

    def start(self, left: float, right: float | None = None) -> BodyPose:
        """A mean body, hips at the origin; each side so far from the T-pose (0) to the bind pose (1)."""
        bind, orient = (np.asarray(t)[:, :3, :3] for t in (self.rig.bind_world, self.rig.t_pose_world))
        displaced = bind @ orient.transpose(0, 2, 1)
        parent = np.maximum(self.rig.parents, 0)
        relative = (displaced[parent].transpose(0, 2, 1) @ displaced)[1:]
        others = left if right is None else right
        share = np.array([others if name.startswith("Right") else left for name in self.layer.joint_names])
        part = Rotation.from_rotvec(share[:, None] * Rotation.from_matrix(relative).as_rotvec()).as_matrix()
        part[0] = np.eye(3)
        return BodyPose(shape=np.zeros(self.count), rotations=part, hips=np.zeros(3))

    @functools.cached_property
    def symmetric_components(self) -> np.ndarray:
        """(k,) whether a shape component moves both sides alike."""
        rest = self.layer.identity({"shape": torch.eye(self.count, dtype=self.layer.dtype)}).rest
        mean = self.layer.identity().rest
        change = (rest - mean).double().numpy()
        return (change * (_MIRROR * change[:, self.mesh.mirror])).sum((1, 2)) > 0

    def like(self, pose: BodyPose, side: str) -> BodyPose:
        """A symmetric body about x = 0 whose both sides are as the `side` ("Left" or "Right") of `pose`."""
        turned = _MIRROR[:, None] * pose.rotations[self.partner] * _MIRROR
        names = self.layer.joint_names
        copied = np.array([name.startswith(_other_side(side)) for name in names])
        middle = self.partner == np.arange(len(names))
        rotations = np.where(copied[:, None, None], turned, pose.rotations)
        half = (
            Rotation.from_matrix(turned[middle] @ pose.rotations[middle].transpose(0, 2, 1)).as_rotvec() / 2
        )
        rotations[middle] = Rotation.from_rotvec(half).as_matrix() @ pose.rotations[middle]
        return BodyPose(
            shape=np.where(self.symmetric_components, pose.shape, 0.0),
            rotations=rotations,
            hips=pose.hips * (_MIRROR + 1) / 2,
        )

    def ends_like(self, pose: BodyPose, side: str) -> BodyPose:
        """The same body, hands and feet turned as those of the `side`: the others may sit wrongly."""
        names = self.layer.joint_names
        other = _other_side(side)
        copied = np.array([name.startswith(other) and bool(_HANDS_AND_FEET.search(name)) for name in names])
        turned = _MIRROR[:, None] * pose.rotations[self.partner] * _MIRROR
        return replace(pose, rotations=np.where(copied[:, None, None], turned, pose.rotations))

    def turned(self, start: BodyPose, pose: BodyPose) -> np.ndarray:
        """Turns [rad] about world axes (joints, 3) that lead from the rotations of one pose to another's."""
        world = self.world_turns(pose)
        above = world[self.parents[self.joints]]
        above[0] = np.eye(3)
        away = (pose.rotations @ start.rotations.transpose(0, 2, 1))[self.joints]
        return np.einsum("jab,jb->ja", above, Rotation.from_matrix(away).as_rotvec())

    def spun(self, pose: BodyPose, side: str, angle: float) -> BodyPose:
        """The same body, the hand of a `side` turned about the normal of its palm by `angle` [rad]."""
        _, joints = self.evaluate(pose)
        wrist, middle, first, last = (
            self.layer.joint_names.index(f"{side}Hand{part}") for part in ("", "Middle1", "Index1", "Pinky1")
        )
        normal = np.cross(joints[middle] - joints[wrist], joints[first] - joints[last])
        step = np.zeros(3 * len(self.joints) + 3 + self.count)
        place = 3 * np.searchsorted(self.joints, wrist)
        step[place : place + 3] = angle * normal / np.linalg.norm(normal)
        return self.moved_by(pose, step)

    def sized(self, pose: BodyPose, size: float) -> BodyPose:
        """A body `size` times as large in the same pose, as nearly as shapes go, its box about the origin.

        A fit that begins with another stature takes the neck of a tall body for its head.
        """
        vertices, _ = self.evaluate(pose)
        derivative = self.shape_derivative(pose)
        rows = (derivative - derivative.mean(0)).reshape(-1, self.count)
        wanted = (size - 1) * (vertices - vertices.mean(0)).ravel()
        damped = rows.T @ rows + _PLAUSIBLE**2 * len(vertices) * np.eye(self.count)
        larger = replace(pose, shape=pose.shape + np.linalg.solve(damped, rows.T @ wanted))
        vertices, _ = self.evaluate(larger)
        return larger.at(larger.hips - (vertices.max(0) + vertices.min(0)) / 2)

    @torch.no_grad()
    def evaluate(self, pose: BodyPose) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (v, 3) and user joints (J - 1, 3), [m]."""
        posed = self.layer(*self._tensors(pose.shape[None], pose))
        return posed.vertices[0].double().numpy(), posed.joints[0].double().numpy()

    @torch.no_grad()
    def shape_derivative(self, pose: BodyPose) -> np.ndarray:
        """Change of the vertices by each component, (v, 3, k), in this pose; nearly constant in the shape."""
        around = np.concatenate([pose.shape[None], pose.shape[None] + np.eye(self.count)])
        vertices = self.layer(*self._tensors(around, pose)).vertices.double().numpy()
        return np.ascontiguousarray((vertices[1:] - vertices[:1]).transpose(1, 2, 0))

    def _tensors(self, shapes: np.ndarray, pose: BodyPose) -> tuple:
        dtype = self.layer.dtype
        rotations = torch.as_tensor(pose.rotations[None], dtype=dtype).expand(len(shapes), -1, -1, -1)
        hips = torch.as_tensor(pose.hips, dtype=dtype)
        return {"shape": torch.as_tensor(shapes, dtype=dtype)}, rotations.contiguous(), hips

    def world_turns(self, pose: BodyPose) -> np.ndarray:
        """Rotation of each user joint against the T-pose, in the world, (J - 1, 3, 3)."""
        turns = pose.rotations.copy()
        for joint in range(1, len(turns)):
            turns[joint] = turns[self.parents[joint]] @ turns[joint]
        return turns

    def moved_by(self, pose: BodyPose, step: np.ndarray) -> BodyPose:
        """Apply a step: turns about world axes (joints, 3), hips (3), shape (k,), in one vector."""
        count = len(self.joints)
        turns, hips = step[: 3 * count].reshape(-1, 3), step[3 * count : 3 * count + 3]
        world = self.world_turns(pose)
        rotations = pose.rotations.copy()
        for joint, turn in zip(self.joints, turns, strict=True):
            above = world[self.parents[joint]] if joint else np.eye(3)
            rotations[joint] = above.T @ Rotation.from_rotvec(turn).as_matrix() @ above @ rotations[joint]
        rotations = Rotation.from_matrix(rotations).as_matrix()  # or rounding would grow from step to step
        return BodyPose(shape=pose.shape + step[3 * count + 3 :], rotations=rotations, hips=pose.hips + hips)


def _other_side(name: str) -> str:
    if name.startswith("Left"):
        return name.replace("Left", "Right", 1)
    return name.replace("Right", "Left", 1) if name.startswith("Right") else name
