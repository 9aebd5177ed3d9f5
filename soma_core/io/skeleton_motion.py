"""A motion of any skeleton: its joints at rest, and how they turn and move from there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.io.motion import Motion
from soma_core.rig.skeleton import Rig

__all__ = ["SkeletonMotion", "skeleton_of_worlds", "soma_skeleton"]

_RIGID = 1e-8
"""Change of a bone [m] that counts as rounding of double precision."""

_FLAT = 1e-18


@dataclass(frozen=True, kw_only=True, eq=False)
class SkeletonMotion:
    """Joints over time; column vectors, metres unless said otherwise.

    Rotations are relative to the rest pose, in world axes at rest: identity everywhere is the rest pose, and
    ``turns = rotations[root] @ ... @ rotations[j]`` takes joint j and its bones from rest to the frame,
    whatever axes the joint itself has.

    Attributes:
        names: of the joints, parents before children.
        parents: (J,) index of each joint's parent, -1 for the one root.
        rest: (J, 3) joint positions in the rest pose [m].
        rotations: (frames, J, 3, 3).
        root: (frames, 3) positions of the root joint [m].
        fps: frames per second.
        ends: (J, 3) from a joint to the end of its bone at rest [m], where the file tells; else NaN.
        moves: index of a joint -> (frames, 3) from its parent to it, in the parent's axes at rest [m]; for
            bones that change.
        up: upward axis of the world, where the file tells.
        metres: length of the unit [m], where the file tells.
        source: where it came from.

    Raises:
        InputError: a shape, a value or the frame rate cannot be a motion.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    rest: np.ndarray
    rotations: np.ndarray
    root: np.ndarray
    fps: float
    ends: np.ndarray | None = None
    moves: Mapping[int, np.ndarray] = field(default_factory=dict)
    up: str | None = None
    metres: float | None = None
    source: str = ""

    def __post_init__(self) -> None:
        """Check everything."""
        count, frames = len(self.names), len(self.rotations)
        for name, array, shape in (
            ("parents", self.parents, (count,)), ("rest", self.rest, (count, 3)),
            ("rotations", self.rotations, (frames, count, 3, 3)), ("root", self.root, (frames, 3)),
        ):  # fmt: skip
            if np.shape(array) != shape or not np.isfinite(array).all() or not frames:
                got = "NaN or infinity" if np.shape(array) == shape and frames else f"shape {np.shape(array)}"
                raise InputError(name, got=got, expected=f"finite numbers of shape {shape}",
                                 fix="Give one entry a joint and frame.")  # fmt: skip
        if (
            self.parents[0] != -1
            or not ((self.parents[1:] >= 0) & (self.parents[1:] < np.arange(1, count))).all()
        ):
            raise InputError("parents", got="another order", expected="one root, parents before children",
                             fix="Sort the joints by depth.")  # fmt: skip
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise InputError(
                "fps", got=self.fps, expected="a positive number", fix="Pass fps=30 (the true rate)."
            )

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.rotations)

    def turns(self) -> np.ndarray:
        """Turns of each joint from rest, in world axes, (frames, J, 3, 3)."""
        found = np.array(self.rotations, np.float64)
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                found[:, joint] = found[:, parent] @ found[:, joint]
        return found

    def positions(self, turns: np.ndarray | None = None) -> np.ndarray:
        """Joint positions in the world [m], (frames, J, 3)."""
        turns = self.turns() if turns is None else turns
        found = np.empty((self.frame_count, len(self.names), 3))
        for joint, parent in enumerate(self.parents):
            if parent < 0:
                found[:, joint] = self.root
                continue
            bone = self.moves.get(joint, (self.rest[joint] - self.rest[parent])[None])
            found[:, joint] = found[:, parent] + (turns[:, parent] @ bone[..., None])[..., 0]
        return found

    def placed(self, turn: np.ndarray, metres: float = 1.0, up: str | None = None) -> SkeletonMotion:
        """The same in other axes and another unit: ``x' = metres * turn @ x``."""
        scaled = metres * turn.T
        return replace(
            self,
            rest=self.rest @ scaled,
            root=self.root @ scaled,
            ends=None if self.ends is None else self.ends @ scaled,
            moves={joint: bone @ scaled for joint, bone in self.moves.items()},
            rotations=turn @ self.rotations @ turn.T,
            up=up or self.up,
            metres=None if self.metres is None else self.metres / metres,
        )

    def rebased(self, rest: np.ndarray, turns: np.ndarray) -> SkeletonMotion:
        """The same motion from another pose as rest.

        Args:
            rest: (J, 3) joint positions in that pose [m].
            turns: (J, 3, 3) of each joint from the rest pose of now to that pose.
        """
        above = np.concatenate([np.eye(3)[None], turns[self.parents[1:]]])
        return replace(
            self,
            rest=rest,
            rotations=above @ self.rotations @ np.swapaxes(turns, -1, -2),
            ends=None if self.ends is None else np.einsum("jab,jb->ja", turns, self.ends),
            moves={joint: bone @ above[joint].T for joint, bone in self.moves.items()},
        )

    def subset(self, names: Sequence[str]) -> SkeletonMotion:
        """Some joints, each under the nearest of its ancestors that is kept.

        World positions and turns stay; a bone over joints that turned and are left out changes its length,
        and goes to `moves`.

        Raises:
            InputError: a name that is none, or more than one root is left.
        """
        kept = [joint for joint, name in enumerate(self.names) if name in names]
        if len(kept) != len(set(names)):
            raise InputError("names", got=sorted(set(names) - set(self.names))[:5],
                             expected="joints of the skeleton", fix="Correct the names.")  # fmt: skip
        place = {joint: index for index, joint in enumerate(kept)}
        parents = []
        for joint in kept:
            above = int(self.parents[joint])
            while above >= 0 and above not in place:
                above = int(self.parents[above])
            parents.append(place.get(above, -1))
        turns = self.turns()
        positions = self.positions(turns)[:, kept]
        turns, rest = turns[:, kept], self.rest[kept]
        rotations, moves = _relative(turns, positions, rest, parents)
        return replace(
            self, names=tuple(self.names[joint] for joint in kept), parents=np.array(parents), rest=rest,
            rotations=rotations, root=positions[:, 0], moves=moves,
            ends=None if self.ends is None else self.ends[kept],
        )  # fmt: skip


def _relative(
    turns: np.ndarray, positions: np.ndarray, rest: np.ndarray, parents: Sequence[int] | np.ndarray
) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Rotations relative to the parent, and bones that change, of turns and positions in the world."""
    rotations, moves = turns.copy(), {}
    size = _RIGID * max(1.0, float(np.abs(positions).max()))
    for joint, parent in enumerate(parents):
        if parent < 0:
            continue
        back = np.swapaxes(turns[:, parent], -1, -2)
        rotations[:, joint] = back @ turns[:, joint]
        bone = (back @ (positions[:, joint] - positions[:, parent])[..., None])[..., 0]
        if np.abs(bone - (rest[joint] - rest[parent])).max() > size:
            moves[joint] = bone
    return rotations, moves


def soma_skeleton(motion: Motion, rig: Rig, bind_world: np.ndarray | None = None) -> SkeletonMotion:
    """The 77 joints of a motion on a body, with its T-pose as rest.

    Args:
        motion: on this skeleton.
        rig: the canonical rig.
        bind_world: (78, 4, 4) bind transforms of the body, as ``Identity.bind_world`` has them [m]; None for
            the rig's own body.
    """
    bind = np.asarray(rig.bind_world if bind_world is None else bind_world, np.float64)
    parents, orient = rig.parents, rig.t_pose_world[:, :3, :3]
    rest = bind[:, :3, 3].copy()  # Hips hang on the unrotated Root: their bind position is that of the T-pose
    for joint in range(2, rig.joint_count):
        parent = parents[joint]
        bone = bind[parent, :3, :3].T @ (bind[joint, :3, 3] - bind[parent, :3, 3])
        rest[joint] = rest[parent] + orient[parent] @ bone
    # Single precision leaves matrices near SO(3), and products down the tree would add that up.
    rotations = Rotation.from_matrix(motion.rotations.reshape(-1, 3, 3)).as_matrix().reshape(-1, 77, 3, 3)
    if motion.convention == "absolute_local":
        above = np.concatenate([np.eye(3)[None], orient[parents[2:]]])
        rotations = above @ rotations @ np.swapaxes(orient[1:], -1, -2)
    return SkeletonMotion(
        names=motion.joint_names, parents=np.maximum(parents[1:] - 1, -1), rest=rest[1:], rotations=rotations,
        root=motion.translation.astype(np.float64), fps=motion.fps, up="+y", metres=1.0,
        source=motion.source,
    )  # fmt: skip


def skeleton_of_worlds(
    names: Sequence[str],
    parents: np.ndarray,
    rest: np.ndarray,
    worlds: np.ndarray,
    *,
    fps: float,
    source: str,
    up: str = "+y",
    metres: float = 1.0,
) -> SkeletonMotion:
    """A motion from world transforms; scales are left out, whatever they are.

    Args:
        names: of the joints, parents first.
        parents: (J,) -1 for the root.
        rest: (J, 4, 4) world transforms in the rest pose.
        worlds: (frames, J, 4, 4) world transforms.
        fps: frames per second.
        source: where it came from.
        up: upward axis of the world.
        metres: length of the unit.
    """
    turns = _rotations(worlds) @ np.swapaxes(_rotations(rest), -1, -2)
    rotations, moves = _relative(turns, worlds[..., :3, 3], rest[:, :3, 3], parents)
    return SkeletonMotion(
        names=tuple(names), parents=np.asarray(parents), rest=rest[:, :3, 3].copy(), rotations=rotations,
        root=worlds[:, 0, :3, 3].copy(), fps=fps, moves=moves, up=up, metres=metres,
        source=source,
    )  # fmt: skip


def _rotations(transforms: np.ndarray) -> np.ndarray:
    """Nearest rotations of transforms (..., 4, 4); float32 and scales leave them near, not at rotations.

    Raises:
        ValueError: a transform that is flat, or no numbers.
    """
    linear = transforms[..., :3, :3].reshape(-1, 3, 3).astype(np.float64)
    if not np.isfinite(transforms).all() or (np.abs(np.linalg.det(linear)) < _FLAT).any():
        raise ValueError("a joint has no size, or no numbers")
    lengths = np.linalg.norm(linear, axis=1, keepdims=True)
    turns = Rotation.from_matrix(linear / lengths * np.sign(np.linalg.det(linear))[:, None, None])
    return np.asarray(turns.as_matrix().reshape(*transforms.shape[:-2], 3, 3))
