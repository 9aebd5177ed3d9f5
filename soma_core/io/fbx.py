"""Joints over time in FBX files, by the library ufbx."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.errors import AssetError, InputError
from soma_core.io.skeleton_motion import SkeletonMotion, skeleton_of_worlds

__all__ = ["read_fbx"]

_MOST_BYTES = 1 << 31
_MOST = 20_000_000
"""Nodes times frames that are evaluated at most."""


def read_fbx(path: Path, *, fps: float | None = None, root: str | None = None) -> SkeletonMotion:
    """Read the bones of an FBX file, sampled at its frame rate; metres, +Y up.

    The rest pose is where the skin was bound; without a skin it is the pose of the nodes themselves. Of several
    animations the first is read.

    Args:
        path: the file.
        fps: what it is sampled at; None: its own rate.
        root: name of the root bone, where there are several skeletons.

    Raises:
        InputError: ufbx is not installed; several skeletons.
        AssetError: damaged, or without bones.
    """
    try:
        import ufbx
    except ImportError as error:
        raise InputError(str(path), got="an FBX file", expected="the package ufbx to read it",
                         fix="pip install 'soma-body-core[fbx]'") from error  # fmt: skip
    if path.stat().st_size > _MOST_BYTES:
        raise AssetError(path, cause="larger than 2 GiB", fix="Export the skeleton without its meshes.")
    try:
        scene = ufbx.load_file(
            str(path), ignore_embedded=True, load_external_files=False, target_axes=ufbx.axes_right_handed_y_up,
            target_unit_meters=1.0,
        )  # fmt: skip
    except ufbx.UfbxError as error:
        raise AssetError(path, cause=f"not a readable FBX file ({error})", fix="Export it again.") from error
    nodes = _bones(path, scene, root)
    index = {node.typed_id: place for place, node in enumerate(nodes)}
    parents = np.array([index.get(node.parent.typed_id, -1) if node.parent else -1 for node in nodes])
    times, rate = _times(path, scene, fps, len(nodes))
    worlds = np.empty((len(times), len(nodes), 4, 4))
    for place, node in enumerate(nodes):
        local = _local([node.evaluate_transform(scene.anim, float(time)) for time in times])
        above = int(parents[place])
        worlds[:, place] = (worlds[:, above] if above >= 0 else _above(node)) @ local
    names = [node.name for node in nodes]
    return skeleton_of_worlds(names, parents, _rest(scene, nodes, parents), worlds, fps=rate, source=path.name)


def _bones(path: Path, scene: Any, root: str | None) -> list[Any]:
    """Bones with what lies between and above them, parents first, below one root."""
    kept = {node.typed_id for node in scene.nodes if node.bone}
    if not kept:
        kept = {node.typed_id for node in scene.nodes if not node.is_root and not node.mesh}
    nodes = sorted((node for node in scene.nodes if node.typed_id in kept), key=lambda node: node.node_depth)
    tops = [node for node in nodes if not node.parent or node.parent.typed_id not in kept]
    if root is not None:
        tops = [node for node in nodes if node.name == root]
    below = {top.typed_id: [node for node in nodes if _is_below(node, top)] for top in tops}
    large = [top for top in tops if len(below[top.typed_id]) > 2] or tops
    if len(large) != 1:
        names = ", ".join(node.name for node in large[:20])
        raise InputError(f"{path}: root", got=root or f"{len(large)} skeletons", expected=f"one of {names}",
                         fix="Pass root=NAME.")  # fmt: skip
    return below[large[0].typed_id]


def _is_below(node: Any, top: Any) -> bool:
    while node is not None and node.typed_id != top.typed_id:
        node = node.parent
    return node is not None


def _times(path: Path, scene: Any, fps: float | None, count: int) -> tuple[np.ndarray, float]:
    rate = float(fps or scene.settings.frames_per_second or 30.0)
    stacks = list(scene.anim_stacks)
    begin, end = (stacks[0].time_begin, stacks[0].time_end) if stacks else (0.0, 0.0)
    frames = (end - begin) * rate + 1
    if not 0 <= frames * count <= _MOST:
        raise AssetError(path, cause=f"{frames:.3g} frames of {count} bones are too many", fix="Cut it into parts.")
    return begin + np.arange(max(int(frames + 1e-6), 1)) / rate, rate


def _local(transforms: list[Any]) -> np.ndarray:
    """Matrices (n, 4, 4) of translations, quaternions xyzw and scales."""
    found = np.tile(np.eye(4), (len(transforms), 1, 1))
    scales = np.array([[each.scale.x, each.scale.y, each.scale.z] for each in transforms])
    quaternions = [[each.rotation.x, each.rotation.y, each.rotation.z, each.rotation.w] for each in transforms]
    found[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix() * scales[:, None]
    found[:, :3, 3] = [[each.translation.x, each.translation.y, each.translation.z] for each in transforms]
    return found


def _matrix(matrix: Any) -> np.ndarray:
    """(4, 4) of ufbx's columns."""
    found = np.eye(4)
    found[:3] = np.stack([[column.x, column.y, column.z] for column in (matrix.c0, matrix.c1, matrix.c2, matrix.c3)], -1)
    return found


def _above(node: Any) -> np.ndarray:
    return _matrix(node.parent.node_to_world) if node.parent else np.eye(4)


def _rest(scene: Any, nodes: list[Any], parents: np.ndarray) -> np.ndarray:
    """World transforms in the pose of binding; nodes without skin follow the node above."""
    bound = {cluster.bone_node.typed_id: _matrix(cluster.bind_to_world)
             for cluster in scene.skin_clusters if cluster.bone_node}  # fmt: skip
    found = np.empty((len(nodes), 4, 4))
    for place, node in enumerate(nodes):
        above = found[parents[place]] if parents[place] >= 0 else _above(node)
        found[place] = bound.get(node.typed_id, above @ _matrix(node.node_to_parent))
    return found
