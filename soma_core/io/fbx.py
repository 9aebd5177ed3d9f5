"""Read the joints of FBX files over time, by the library ufbx in a process of its own."""

from __future__ import annotations

import io
import json
import logging
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core._lazy import needed
from soma_core.apart import read_apart
from soma_core.errors import AssetError, SomaError
from soma_core.io.skeleton_motion import SkeletonMotion, skeleton_of_worlds
from soma_core.io.skeleton_scenes import DAMAGE, among, by_depth, joints_under

__all__ = ["read_fbx"]

_log = logging.getLogger(__name__)

_SECONDS, _BYTES_A_SECOND = 40, 4 << 20
_MEMORY, _EXPANSION = 1 << 30, 12
_BLENDER = "Open it in Blender and export it as glTF (.glb), or as BVH."
_DIED = "ufbx, the library that reads it, ends, or takes more time or memory than a file of its size can mean"


def read_fbx(path: Path, *, fps: float | None = None, root: str | None = None) -> SkeletonMotion:
    """Read the bones of an FBX file, sampled at its frame rate; metres, +Y up.

    The rest pose is the one that the skin was bound in; without a skin, that of the nodes. Of several
    animations the longest is read.

    Args:
        path: the file.
        fps: what it is sampled at; None: its own rate.
        root: name of the root bone, where there are several skeletons.

    Raises:
        InputError: ufbx is not installed; several skeletons.
        AssetError: damaged, or without bones.
    """
    needed("ufbx", setting=path, pip="[fbx]", otherwise=_BLENDER.rstrip("."))
    size = path.stat().st_size
    found = read_apart(
        "soma_core.fbx_probe", path, fps,
        seconds=_SECONDS + size // _BYTES_A_SECOND, memory=_MEMORY + _EXPANSION * size,
    )  # fmt: skip
    if found is None:
        raise AssetError(path, cause=_DIED, fix=_BLENDER)
    with np.load(io.BytesIO(found), allow_pickle=False) as arrays:
        if "refused" in arrays:
            raise AssetError(path, cause=json.loads(str(arrays["refused"])), fix=_BLENDER)
        try:
            return _skeleton(path, dict(arrays), root)
        except SomaError:
            raise
        except DAMAGE as error:
            raise AssetError(path, cause=f"no usable skeleton ({error})", fix=_BLENDER) from error


def _skeleton(path: Path, arrays: dict[str, np.ndarray], root: str | None) -> SkeletonMotion:
    told, parents = json.loads(str(arrays["told"])), arrays["parents"]
    names, bones = told["names"], np.flatnonzero(arrays["bones"])
    joints = {int(joint) for joint in (bones if len(bones) else np.flatnonzero(parents >= 0))}
    if not joints:
        raise AssetError(path, cause="it holds no bones", fix="Export the skeleton with its animation.")
    if len({*told["takes"]}) > 1:
        _log.warning(
            "%s: holds the animations %s; %s, the longest, is read",
            path.name, ", ".join(told["takes"][1:]), told["takes"][0],
        )  # fmt: skip
    tree = np.where(parents == np.flatnonzero(parents < 0)[0], -1, parents)  # skeletons share the scene alone
    order = by_depth(joints_under(path, joints, tree, names, root), tree)
    worlds = _worlds(arrays["values"], parents)[:, order]
    rest, bound = arrays["worlds"], arrays["bound"]
    for joint in order:
        above = int(parents[joint])
        if not np.isnan(bound[joint, 0, 0]) or above < 0:
            continue
        # What no skin hangs on goes with what lies above it, as the nodes stand.
        if not np.isnan(bound[above, 0, 0]):
            bound[joint] = bound[above] @ np.linalg.inv(rest[above]) @ rest[joint]
    rest = np.where(np.isnan(bound[order]), rest[order], bound[order])
    return skeleton_of_worlds(
        [names[joint] for joint in order], among(order, tree), rest, worlds, fps=told["fps"],
        source=path.name, up="+y", metres=1.0,
    )  # fmt: skip


def _worlds(values: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """World transforms (frames, nodes, 4, 4) of translations, quaternions and scales; parents come first."""
    found = np.zeros((*values.shape[:2], 4, 4))
    turns = Rotation.from_quat(values[..., 3:7].reshape(-1, 4)).as_matrix()
    found[..., :3, :3] = turns.reshape(*values.shape[:2], 3, 3) * values[..., None, 7:]
    found[..., :3, 3], found[..., 3, 3] = values[..., :3], 1
    for node, above in enumerate(parents):
        if above >= 0:
            found[:, node] = found[:, above] @ found[:, node]
    return found
