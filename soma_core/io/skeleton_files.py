"""Open the skeleton of a file over time, whatever its format: BVH, FBX, GLB, VRM or USD."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

from soma_core.errors import InputError
from soma_core.files import refuse_far, refuse_unreadable
from soma_core.io.bvh_file import read_bvh
from soma_core.io.fbx import read_fbx
from soma_core.io.skeleton_motion import SkeletonMotion
from soma_core.io.skeleton_scenes import read_glb_skeleton, read_usd_skeleton

__all__ = ["SKELETON_SUFFIXES", "read_skeleton"]


_READERS: dict[str, Callable[..., SkeletonMotion]] = {
    ".bvh": read_bvh, ".fbx": read_fbx, ".glb": read_glb_skeleton, ".vrm": read_glb_skeleton,
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), read_usd_skeleton),
}  # fmt: skip

SKELETON_SUFFIXES = tuple(_READERS)
"""Files that hold a skeleton in motion."""


def read_skeleton(
    path: str | Path,
    *,
    fps: float | None = None,
    root: str | None = None,
    angles: Literal["rad", "deg"] | None = None,
) -> SkeletonMotion:
    """Read the joints of a file over time; lengths and axes are as the file has them.

    Args:
        path: ``.bvh``, ``.fbx``, ``.glb``, ``.vrm`` or ``.usd``. Nothing in it is executed.
        fps: frame rate; overrides that of a BVH, and is what the others are sampled at.
        root: name of the skeleton or its root joint, where a file has several.
        angles: unit of a BVH's rotation channels; None for degrees. The others tell theirs.

    Raises:
        AssetError: missing, damaged, or without a skeleton.
        InputError: several skeletons, or a format that is not read.
    """
    path = Path(path).expanduser()
    refuse_unreadable(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(str(path), got=f"the suffix {path.suffix!r}", expected=", ".join(_READERS),
                         fix="Export the skeleton in one of these formats.")  # fmt: skip
    if angles == "rad":
        if reader is not read_bvh:
            raise InputError("angles", got=f"rad for {path.name}", expected="none: the file tells its angles",
                             fix="Leave angles out.")  # fmt: skip
        reader = partial(read_bvh, angles=angles)
    motion = reader(path, fps=fps, root=root)
    refuse_far(path, motion.rest, "joint")
    refuse_far(path, motion.root, "the root of frame")
    return motion
