"""Joints over time in GLB, VRM and USD scenes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.errors import AssetError, InputError, SomaError
from soma_core.io.glb_animation import NodeTracks
from soma_core.io.glb_file import GlbFile
from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.skeleton_motion import SkeletonMotion, skeleton_of_worlds
from soma_core.usd_stage import metres_of, open_stage, usd_errors

__all__ = ["DAMAGE", "among", "by_depth", "joints_under", "read_glb_skeleton", "read_usd_skeleton"]

DAMAGE = (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError, struct.error)
_FPS = 30.0
_MOST = 50_000_000
"""Joints times frames that are read at most: 4 GB of rotations."""

_MOST_JOINTS = 4096
"""As in BVH."""

_CHUNK = 1 << 20


def read_glb_skeleton(path: Path, *, fps: float | None = None, root: str | None = None) -> SkeletonMotion:
    """Read the joints of the skins of a GLB or VRM; without a skin, all its nodes.

    The rest pose is the one that the skin was bound in; for files of this project,
    that of the nodes, which is the T-pose.
    A VRM without animation is one frame.

    Raises:
        AssetError: damaged, of a kind that is not read, or without joints.
    """
    try:
        return _glb(path, fps, root)
    except SomaError:
        raise
    except DAMAGE as error:
        cause = f"no usable GLB ({error.__class__.__name__}: {error})"
        raise AssetError(
            path, cause=cause, fix="Export one skeleton with one animation, uncompressed."
        ) from error


def _glb(path: Path, fps: float | None, root: str | None) -> SkeletonMotion:
    file = GlbFile(path)
    document, tracks = file.document, NodeTracks(file)
    nodes = document.get("nodes", [])
    parents = np.full(len(nodes), -1)
    for index, node in enumerate(nodes):
        parents[list(node.get("children", ()))] = index
    names = [str(node.get("name", f"node {index}")) for index, node in enumerate(nodes)]
    for index, name in _humanoid(document.get("extensions", {})):
        names[index] = name
    skins = document.get("skins", [])
    joints = {int(joint) for skin in skins for joint in skin["joints"]}
    if not joints and tracks.turning:
        joints = set(range(len(nodes)))
    if not joints:
        raise ValueError("it holds no skin and no node that turns: no joints")
    order = by_depth(joints_under(path, joints, parents, names, root), parents)
    times, rate = _times(tracks.times, fps)
    _check_size(path, len(times) * len(order))
    worlds = np.concatenate(list(_glb_worlds(tracks, times, order, len(nodes))))
    rest = _node_rest(nodes, parents)
    if not {"LeftForeArm", "LeftShin"} <= {*names} & {*USER_JOINTS}:
        rest = _bound(file, skins, rest, parents)
    return skeleton_of_worlds(
        [names[joint] for joint in order],
        among(order, parents),
        rest[order],
        worlds,
        fps=rate,
        source=path.name,
    )


def _humanoid(extensions: dict[str, Any]) -> Iterator[tuple[int, str]]:
    """Nodes that a VRM names as bones of a human; thumbs of VRM 0 are called as those of VRM 1."""
    bones = extensions.get("VRMC_vrm", {}).get("humanoid", {}).get("humanBones", {})
    yield from ((int(bone["node"]), name) for name, bone in bones.items())
    older = extensions.get("VRM", {}).get("humanoid", {}).get("humanBones", [])
    renamed = {"ThumbProximal": "ThumbMetacarpal", "ThumbIntermediate": "ThumbProximal"}
    for bone in older:
        name = str(bone["bone"])
        thumb = next((old for old in renamed if name.endswith(old)), "")
        yield int(bone["node"]), name.removesuffix(thumb) + renamed.get(thumb, "")


def joints_under(
    path: Path, joints: set[int], parents: np.ndarray, names: Sequence[str], root: str | None
) -> set[int]:
    """Joints and what lies between them, below one node."""
    for joint in tuple(joints):
        above = int(parents[joint])
        while above >= 0 and above not in joints:
            joints.add(above)
            above = int(parents[above])
    if len(joints) > _MOST_JOINTS:
        raise ValueError(f"it has {len(joints)} joints, more than {_MOST_JOINTS}")
    tops = sorted(joint for joint in joints if parents[joint] not in joints)
    if root is not None:
        tops = [joint for joint in sorted(joints) if names[joint] == root]
    weights: dict[int, set[int]] = {top: set() for top in tops}
    above_each: dict[int, list[int]] = {}  # the tops at a joint and over it
    for joint in by_depth(joints, parents):
        above_each[joint] = above_each.get(int(parents[joint]), []) + [joint] * (joint in weights)
        for top in above_each[joint]:
            weights[top].add(joint)
    large = [top for top, below in weights.items() if len(below) > 2] or list(weights)
    if len(large) != 1:
        raise InputError(
            f"{path}: root",
            got=root or f"{len(large)} skeletons",
            expected="one of " + ", ".join(names[top] for top in large or sorted(joints)[:20]),
            fix="Pass root=NAME.",
        )
    return weights[large[0]]


def _depths(parents: np.ndarray) -> list[int]:
    """How many nodes are over each, in one walk over all of them."""
    above, depths = parents.tolist(), [-1] * len(parents)
    for joint in range(len(above)):
        way = []
        while joint >= 0 and depths[joint] < 0:
            way.append(joint)
            if len(way) > len(above):
                raise ValueError("its joints hang on each other in a circle")
            joint = above[joint]
        over = depths[joint] if joint >= 0 else -1
        for each in reversed(way):
            over += 1
            depths[each] = over
    return depths


def by_depth(joints: Iterable[int], parents: np.ndarray) -> list[int]:
    """Joints with parents before children."""
    depths = _depths(parents)
    return sorted(joints, key=lambda joint: (depths[joint], joint))


def among(order: Sequence[int], parents: np.ndarray) -> np.ndarray:
    """Parents by their place in `order`, -1 for what is not in it."""
    place = {joint: index for index, joint in enumerate(order)}
    return np.array([place.get(int(parents[joint]), -1) for joint in order])


def _times(times: np.ndarray, fps: float | None) -> tuple[np.ndarray, float]:
    """Even times [s] and their rate: that of the keys where they are even, else 30 a second."""
    if len(times) < 2:
        return np.zeros(1), fps or _FPS
    steps = np.diff(times)
    even = np.ptp(steps) < 0.01 * np.median(steps)
    rate = fps or (round(float(1 / np.median(steps)), 3) if even else _FPS)
    if even and fps is None:
        return times, rate
    count = (times[-1] - times[0]) * rate + 1
    if not count < _MOST:
        raise ValueError(f"its keys span {times[-1] - times[0]:.3g} s")
    return times[0] + np.arange(int(count + 1e-6)) / rate, rate


def _check_size(path: Path, size: int) -> None:
    if size > _MOST:
        raise AssetError(
            path, cause=f"frames times joints are {size}, more than {_MOST}", fix="Cut it into parts."
        )


def _glb_worlds(
    tracks: NodeTracks, times: np.ndarray, order: Sequence[int], count: int
) -> Iterator[np.ndarray]:
    step = max(_CHUNK // (16 * max(count, 1)), 1)
    for start in range(0, len(times), step):
        yield tracks.worlds(times[start : start + step])[:, list(order)]


def _node_rest(nodes: Sequence[dict[str, Any]], parents: np.ndarray) -> np.ndarray:
    """World transforms of nodes without the animation, (nodes, 4, 4)."""
    from scipy.spatial.transform import Rotation

    worlds = np.tile(np.eye(4), (len(nodes), 1, 1))
    for index in by_depth(range(len(nodes)), parents):
        node, local = nodes[index], np.eye(4)
        if "matrix" in node:
            local = np.reshape(node["matrix"], (4, 4)).T
        else:
            turn = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
            local[:3, :3] = turn * np.asarray(node.get("scale", (1, 1, 1)))
            local[:3, 3] = node.get("translation", (0, 0, 0))
        worlds[index] = worlds[parents[index]] @ local if parents[index] >= 0 else local
    return worlds


def _bound(
    file: GlbFile, skins: Sequence[dict[str, Any]], rest: np.ndarray, parents: np.ndarray
) -> np.ndarray:
    """Rest transforms where skins were bound; others keep those of the nodes."""
    bound = rest.copy()
    for skin in skins:
        if "inverseBindMatrices" not in skin:
            continue
        inverse, joints = file.accessor(skin["inverseBindMatrices"]).astype(np.float64), list(skin["joints"])
        bound[joints] = _space(rest, parents, joints, np.linalg.inv(inverse)) @ np.linalg.inv(inverse)
    return bound


def _space(rest: np.ndarray, parents: np.ndarray, joints: Sequence[int], bound: np.ndarray) -> np.ndarray:
    """The space that a skin is bound in, which a file does not tell: the scene's, or that above the joints.

    Nodes may stand in a frame of the animation, so that of the two the one is taken in which bones are as
    long as theirs and lie nearer to them; where neither is, that in which the first joint stands as bound.
    """
    above = int(parents[joints[0]])
    places, spaces = rest[joints, :3, 3], [np.eye(4), *([rest[above]] if above >= 0 else [])]
    size = np.linalg.norm(places - places[0], axis=1).max()
    found = []
    for space in spaces:
        moved = (space @ bound)[:, :3, 3]
        longest = np.linalg.norm(moved - moved[0], axis=1).max()
        if 0.5 * size < longest < 2 * size:
            found.append((float(np.linalg.norm(moved - places, axis=1).mean()), space))
    return min(found, key=lambda each: each[0])[1] if found else rest[joints[0]] @ np.linalg.inv(bound[0])


def read_usd_skeleton(path: Path, *, fps: float | None = None, root: str | None = None) -> SkeletonMotion:
    """Read the joints of a UsdSkel skeleton: its animation, or its rest pose as one frame.

    Raises:
        AssetError: no USD file, one that refers to what may not be opened, or without a skeleton.
        InputError: several skeletons.
    """
    stage = open_stage(path, fix="Export it again.")
    with usd_errors(path, fix="Export it again."):
        return _usd(stage, path, fps, root)


def _usd(stage: Any, path: Path, fps: float | None, root: str | None) -> SkeletonMotion:
    from pxr import Usd, UsdGeom, UsdSkel

    found = [prim for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton)]
    found = [prim for prim in found if root in (None, prim.GetName(), str(prim.GetPath()))] if root else found
    if len(found) != 1:
        raise InputError(
            f"{path}: root",
            got=root or f"{len(found)} skeletons",
            expected="one: " + ", ".join(str(prim.GetPath()) for prim in found[:20]),
            fix="Pass root=NAME.",
        )
    query = _skeleton_query(stage, found[0])
    paths = [str(joint) for joint in query.GetJointOrder()]
    names = [joint.rpartition("/")[2] for joint in paths]
    parents = np.array([query.GetTopology().GetParent(index) for index in range(len(names))], int)
    if not len(names) or (parents < 0).sum() != 1 or not (parents[1:] < np.arange(1, len(names))).all():
        raise AssetError(
            path, cause="its skeleton has no single root joint that comes first", fix="Export it again."
        )
    animation = query.GetAnimQuery()
    samples = np.array(animation.GetJointTransformTimeSamples() if animation else [])
    per_second = stage.GetTimeCodesPerSecond()
    times, rate = _times(samples / per_second, fps)
    _check_size(path, len(times) * len(names))
    still = not len(samples)
    metres, place = metres_of(path, stage), UsdGeom.XformCache()
    worlds = np.empty((len(times), len(names), 4, 4))
    for frame, time in enumerate(times):
        code = Usd.TimeCode.Default() if still else Usd.TimeCode(time * per_second)
        place.SetTime(code)
        body = np.array(place.GetLocalToWorldTransform(found[0])).T
        joints = query.ComputeJointSkelTransforms(code, still)
        worlds[frame] = body @ np.swapaxes(
            np.array(joints), -1, -2
        )  # USD multiplies row vectors from the left
    rest = _usd_rest(query, worlds[0], np.array(place.GetLocalToWorldTransform(found[0])).T, names)
    up = "+z" if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else "+y"
    return skeleton_of_worlds(names, parents, rest, worlds, fps=rate, source=path.name, up=up, metres=metres)


def _skeleton_query(stage: Any, prim: Any) -> Any:
    """The query of a skeleton, with the animation that is bound to it."""
    from pxr import Usd, UsdSkel

    cache = UsdSkel.Cache()
    for scope in stage.Traverse():
        if scope.IsA(UsdSkel.Root):
            cache.Populate(UsdSkel.Root(scope), Usd.PrimDefaultPredicate)
    return cache.GetSkelQuery(UsdSkel.Skeleton(prim))


def _usd_rest(query: Any, first: np.ndarray, body: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Rest transforms: the rest pose of our own skeletons, a T-pose; else where the skin was bound."""
    own = {"LeftForeArm", "LeftShin"} <= {*names} & {*USER_JOINTS}
    bound: Callable[[], Any] = query.GetJointWorldBindTransforms
    if query.HasBindPose() and not (own and query.HasRestPose()):
        return np.swapaxes(np.array(bound()), -1, -2).copy()
    if query.HasRestPose():
        from pxr import Usd

        rest = query.ComputeJointSkelTransforms(Usd.TimeCode.Default(), atRest=True)
        return body @ np.swapaxes(np.array(rest), -1, -2)
    return first.copy()
