"""A skinned animation ready for export: one identity, its T-pose skeleton and local transforms over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.rig.expansion import expanded_rig, helper_bind
from soma_core.rig.influences import padded_influences
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

if TYPE_CHECKING:
    from soma_core.correctives.shapes import CorrectiveShapes
    from soma_core.skeleton.identity import Identity

__all__ = [
    "BODY_COLOUR",
    "SkinnedClip",
    "four_influence_error",
    "linear_colour",
    "skinned_clip",
    "t_pose_world",
]

BODY_COLOUR = (0.80, 0.66, 0.58)
"""sRGB colour of a body that has no other."""

_READ = 4
"""Influences of a vertex that many programs read, and no more."""

_CHUNK = 64
"""Frames whose skin is looked at together."""

_BONE_TOLERANCE = 1e-6
"""Change of a bone relative to the size of the scene that counts as float32 rounding of the transforms."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SkinnedClip:
    """What the exporters write. Metres, +Y up, column vectors, quaternions ``xyzw``.

    The rest mesh stands on y = 0, for programs that show it without its skeleton.

    Attributes:
        mesh: topology and UVs.
        rig: joint names, parents and weights; twist joints are joints like the others.
        rest: bind shape of the identity, (v, 3) float64 [m].
        bind_world: (J, 4, 4) float64 world transforms at `rest` [m].
        t_pose_world: (J, 4, 4) float64 world transforms of the identity's T-pose [m].
        translations: (frames, J, 3) float64 local translations [m].
        quaternions: (frames, J, 4) float64 local rotations, continuous in time.
        fps: frames per second.
        name: name of the body in the file.
        colour: sRGB colour in 0..1.
        metadata: texts stored in the file (licence, backend, rig revision, ...).
        shapes: offsets of `rest` that the pose asks for, before skinning; None for none.
    """

    mesh: CanonicalMesh
    rig: Rig
    rest: np.ndarray
    bind_world: np.ndarray
    t_pose_world: np.ndarray
    translations: np.ndarray
    quaternions: np.ndarray
    fps: float
    name: str = "Body"
    colour: tuple[float, float, float] = BODY_COLOUR
    metadata: Mapping[str, str] = field(default_factory=dict)
    shapes: CorrectiveShapes | None = None

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.translations)

    @property
    def limits(self) -> dict[str, str]:
        """How far a program that shows the file is off the body, in words, by key of the metadata."""
        mean, worst = (1e3 * error for error in four_influence_error(self))
        found = {
            "influences": f"up to {self.influences()[0].shape[1]} a vertex; a program that reads {_READ} of "
            f"them is {mean:.2g} mm off in the mean, {worst:.2g} mm at most"
        }
        if self.shapes is not None:
            count, worst = len(self.shapes), 1e3 * self.shapes.worst
            found["correctives"] = f"{count} morph targets, within {worst:.2g} mm of the model's correctives"
        return found

    def t_pose_local(self) -> np.ndarray:
        """Local transforms of the T-pose, (J, 4, 4) [m]."""
        return _to_local(self.t_pose_world[None], self.rig.parents)[0]

    def influences(self) -> tuple[np.ndarray, np.ndarray]:
        """Joint ids (v, k) int and weights (v, k) float32 of every influence, heaviest first, zero padded."""
        joint_ids, values = padded_influences(self.rig.skin)
        return joint_ids, (values / values.sum(axis=1, keepdims=True)).astype(np.float32)


def four_influence_error(clip: SkinnedClip) -> tuple[float, float]:
    """Mean and largest error [m] over all frames where a program reads four influences of each vertex."""
    joint_ids, weights = clip.influences()
    few = np.where(np.arange(weights.shape[1]) < _READ, weights, 0).astype(np.float64)
    change = few / few.sum(axis=1, keepdims=True) - weights
    rows = np.flatnonzero(np.abs(change).max(axis=1) > 0)
    shape = len(rows), len(clip.bind_world)
    starts = np.arange(len(rows) + 1) * weights.shape[1]
    lost = scipy.sparse.csr_array((change[rows].ravel(), joint_ids[rows].ravel(), starts), shape=shape)
    points = np.column_stack([clip.rest[rows], np.ones(len(rows))])
    inverse, parents = np.linalg.inv(clip.bind_world), clip.rig.parents
    total, worst = 0.0, 0.0
    for start in range(0, clip.frame_count, _CHUNK):
        part = slice(start, start + _CHUNK)
        turns = Rotation.from_quat(clip.quaternions[part].reshape(-1, 4)).as_matrix()
        world = np.tile(np.eye(4), (*clip.translations[part].shape[:2], 1, 1))
        world[..., :3, :3] = turns.reshape(*world.shape[:2], 3, 3)
        world[..., :3, 3] = clip.translations[part]
        for joint in np.flatnonzero(parents >= 0):
            world[:, joint] = world[:, parents[joint]] @ world[:, joint]
        for transforms in (world @ inverse)[..., :3, :].reshape(len(world), shape[1], 12):
            blended = (lost @ transforms).reshape(-1, 3, 4)
            error = np.linalg.norm(np.einsum("vab,vb->va", blended, points), axis=1)
            total, worst = total + error.sum(), max(worst, float(error.max(initial=0)))
    return total / (clip.frame_count * len(clip.rest)), worst


def skinned_clip(
    mesh: CanonicalMesh,
    rig: Rig,
    identity: Identity,
    transforms: Any,
    *,
    fps: float,
    helpers: Any = None,
    name: str = "Body",
    colour: tuple[float, float, float] = BODY_COLOUR,
    metadata: Mapping[str, str] | None = None,
    shapes: CorrectiveShapes | None = None,
) -> SkinnedClip:
    """Gather what the exporters need from one identity and its posed world transforms.

    Args:
        mesh: canonical mesh at the level of detail of `identity`.
        rig: canonical rig at the same level of detail.
        identity: one identity (batch size 1).
        transforms: ``Posed.transforms``, (frames, J, 4, 4) world transforms [m], tensor or array.
        fps: frames per second.
        helpers: world transforms of the rig's twist joints, (frames, H, 4, 4) [m], as
            ``SomaLayer.helper_transforms`` gives them; they become joints of the file, with the skin on
            them. Default: the skin on the public joints alone.
        name: name of the body in the file.
        colour: sRGB colour in 0..1.
        metadata: texts to store in the file.
        shapes: of the correctives, one row of weights a frame; they become morph targets.

    Raises:
        InputError: a shape does not fit the rig, or the identity is a batch.
    """
    joints, vertices = rig.joint_count, mesh.vertex_count
    rest = _array("identity.rest", identity.rest, (1, vertices, 3))[0]
    bind_world = _array("identity.bind_world", identity.bind_world, (1, joints, 4, 4))[0]
    world = _array("transforms", transforms, (len(transforms), joints, 4, 4))
    if rig.procedural is not None and helpers is not None:
        count = len(rig.procedural.joint_names)
        world = np.concatenate([world, _array("helpers", helpers, (len(world), count, 4, 4))], axis=1)
        rig, bind_world = expanded_rig(rig), np.concatenate([bind_world, helper_bind(rig, bind_world)])
    lift = np.array([0.0, -rest[:, 1].min(), 0.0])
    rest, bind_world = rest + lift, bind_world.copy()
    bind_world[1:, :3, 3] += lift  # Root, which is virtual and carries no skin, stays at the origin
    t_pose = t_pose_world(rig, bind_world)
    local = _to_local(world, rig.parents)
    return SkinnedClip(
        mesh=mesh,
        rig=rig,
        rest=rest,
        bind_world=bind_world,
        t_pose_world=t_pose,
        translations=_steady(local[..., :3, 3], _to_local(t_pose[None], rig.parents)[0, :, :3, 3], world),
        quaternions=_continuous(local[..., :3, :3]),
        fps=float(fps),
        name=name,
        colour=colour,
        metadata=dict(metadata or {}),
        shapes=shapes if shapes is not None and len(shapes) else None,
    )


def _array(argument: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Float64 array of a tensor or array; refuses another shape."""
    array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(
            argument,
            got=f"shape {array.shape}, {int((~np.isfinite(array)).sum())} not finite",
            expected=f"finite numbers of shape {shape}",
            fix="Pass one identity and transforms of the same rig and level of detail.",
        )
    return array


def t_pose_world(rig: Rig, bind_world: np.ndarray) -> np.ndarray:
    """World transforms (J, 4, 4) [m] of an identity's T-pose: the rig's rotations there, its own bones.

    Args:
        rig: joint tree and T-pose.
        bind_world: (J, 4, 4) of the identity in the bind pose [m].
    """
    bones = _to_local(bind_world[None], rig.parents)[0, :, :3, 3]
    world = np.tile(np.eye(4), (rig.joint_count, 1, 1))
    world[:, :3, :3] = rig.t_pose_world[:, :3, :3]
    for joint, parent in enumerate(rig.parents):
        if parent < 0:
            world[joint, :3, 3] = bind_world[joint, :3, 3]
            continue
        # Hips hang on the unrotated Root, so their bind position is also their T-pose position.
        world[joint, :3, 3] = world[parent, :3, :3] @ bones[joint] + world[parent, :3, 3]
    return world


def _to_local(world: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Local transforms of world transforms (frames, J, 4, 4)."""
    local = world.copy()
    rotation, position = world[..., :3, :3], world[..., :3, 3]
    child = np.flatnonzero(parents >= 0)
    parent = parents[child]
    to_parent = np.swapaxes(rotation[:, parent], -1, -2)
    offset = position[:, child] - position[:, parent]
    local[:, child, :3, :3] = to_parent @ rotation[:, child]
    local[..., :3, 3][:, child] = np.einsum("fjab,fjb->fja", to_parent, offset)
    return local


def _steady(translations: np.ndarray, rest: np.ndarray, world: np.ndarray) -> np.ndarray:
    """Replace bones that only jitter by rounding with their length at rest."""
    size = 1.0 + np.abs(world[..., :3, 3]).max()
    still = np.abs(translations - rest).max(axis=(0, 2)) < _BONE_TOLERANCE * size
    return np.where(still[None, :, None], rest[None], translations)


def _continuous(rotations: np.ndarray) -> np.ndarray:
    """Quaternions xyzw (frames, J, 4) without sign flips between frames, so that players interpolate."""
    flat = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat(canonical=True)
    quaternions = flat.reshape(*rotations.shape[:2], 4)
    flips = (quaternions[1:] * quaternions[:-1]).sum(-1) < 0
    signs = np.concatenate([np.ones_like(quaternions[:1, :, 0]), np.where(flips, -1.0, 1.0)])
    return quaternions * np.cumprod(signs, axis=0)[..., None]


def linear_colour(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    """Linear-light value of an sRGB colour, which is what USD and glTF materials store."""
    red, green, blue = ((c + 0.055) ** 2.4 / 1.055**2.4 if c > 0.04045 else c / 12.92 for c in colour)
    return red, green, blue
