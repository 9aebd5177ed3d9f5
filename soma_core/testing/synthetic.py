"""A body made of formulas: canonical mesh, rig, native mesh and wrap pair, for tests that need no asset.

The surface is a smooth union of rounded cones along the bones, sampled by two surface nets of different
spacing and orientation: one plays the canonical mesh, the other a foreign model with its own vertices,
unit and axes. The rig has the names and the tree of the real one. Everything is made in a fraction of a
second and is the same on every machine; float64 and int32, in metres, +Y up, facing +Z, the canonical
frame, unless said otherwise.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import scipy.sparse
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from soma_core.io.joint_order import PARENT_NAMES
from soma_core.obj import write_obj
from soma_core.plugin.spec import WrapPair
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = [
    "NATIVE_FROM_CANONICAL",
    "synthetic_canonical",
    "synthetic_native",
    "write_wrap_pair",
]

NATIVE_FROM_CANONICAL = 100.0 * np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Matrix from metres, +Y up, facing +Z, to the native frame: centimetres, +Z up, facing -Y."""

_CANONICAL_STEP, _NATIVE_STEP = 0.05, 0.048  # other steps can pinch the net; a test sees to these
_NATIVE_TURN = Rotation.from_rotvec([0.3, 0.5, -0.2]).as_matrix()
_ARM_ANGLE = np.radians(40)  # below the horizontal at bind; the T-pose has the arms raised by it
_CENTRE, _BOX = np.array([0.0, 0.9, 0.0]), np.array([0.75, 1.0, 0.25])  # what the grids cover [m]
_SKINNING_WIDTH = 0.04  # metres from a bone at which its weight has dropped to 60 %
_SMOOTHINGS, _NEWTON_STEPS = 6, 8
_ROUNDING = 0.02  # metres over which two cones melt into each other

_SPINE = {
    "Root": 0.0, "Hips": 0.95, "Spine1": 1.02, "Spine2": 1.1, "Chest": 1.2, "Neck1": 1.39, "Neck2": 1.45,
    "Head": 1.55, "HeadEnd": 1.66,
}  # fmt: skip
_LIMBS = {
    "Shoulder": (0.04, 1.35, 0.0), "Arm": (0.17, 1.35, 0.0),
    "Leg": (0.1, 0.9, 0.0), "Shin": (0.15, 0.48, 0.01), "Foot": (0.19, 0.09, -0.02),
    "ToeBase": (0.19, 0.06, 0.09), "ToeEnd": (0.19, 0.055, 0.16),
}  # fmt: skip
_ALONG_ARM = {"Arm": 0.0, "ForeArm": 0.25, "Hand": 0.47}
_FINGERS = {
    "Thumb": (0.03, -0.015), "Index": (0.015, 0.005), "Middle": (0.0, 0.01), "Ring": (-0.015, 0.005),
    "Pinky": (-0.03, -0.005),
}  # fmt: skip
"""How far a finger lies in front of the arm's axis and above it [m]."""

_CONES = (
    # from joint, to joint, radius there and here [m]
    ("Hips", "Chest", 0.13, 0.13), ("Chest", "Neck1", 0.13, 0.06), ("Neck1", "Head", 0.06, 0.06),
    ("Head", "HeadEnd", 0.105, 0.1), ("LeftShoulder", "LeftArm", 0.09, 0.08),
    ("LeftArm", "LeftForeArm", 0.075, 0.065), ("LeftForeArm", "LeftHand", 0.065, 0.055),
    ("LeftHand", "LeftHandMiddleEnd", 0.06, 0.055), ("Hips", "LeftLeg", 0.12, 0.09),
    ("LeftLeg", "LeftShin", 0.09, 0.07), ("LeftShin", "LeftFoot", 0.07, 0.06),
    ("LeftFoot", "LeftToeBase", 0.06, 0.055), ("LeftToeBase", "LeftToeEnd", 0.055, 0.05),
)  # fmt: skip
_INSIDE_HEAD = np.array([0.0, 1.6, 0.0])
_BAGS = {
    "mouth_bag": [((0.0, 1.5, 0.09), 0.05)],
    "eye_bags": [((0.08, 1.67, 0.05), 0.045), ((-0.08, 1.67, 0.05), 0.045)],
}
"""Segment -> spheres (centre, radius) [m]; what lies in them on the surface is pushed into the head."""


def _left_position(name: str) -> tuple[float, float, float]:
    """Bind position of a joint of the left side; `name` comes without the side."""
    if name in _LIMBS:
        return _LIMBS[name]
    along, front, above = _ALONG_ARM.get(name, 0.0), 0.0, 0.0
    if name.startswith("Hand") and name != "Hand":
        finger = next(finger for finger in _FINGERS if finger in name)
        place = 4 if name.endswith("End") else int(name[-1]) - 1
        along, (front, above) = 0.52 + 0.02 * place, _FINGERS[finger]
    x, y, z = _LIMBS["Arm"]
    cos, sin = np.cos(_ARM_ANGLE), np.sin(_ARM_ANGLE)
    return x + along * cos + above * sin, y - along * sin + above * cos, z + front


@functools.cache
def _positions() -> dict[str, np.ndarray]:
    """Bind position of each joint of the skeleton, Root first."""
    found = {"Root": np.zeros(3)}
    for name in PARENT_NAMES:
        side = next((side for side in ("Left", "Right") if name.startswith(side)), "")
        if name in _SPINE:
            found[name] = np.array([0.0, _SPINE[name], 0.0])
        elif name == "Jaw":
            found[name] = np.array([0.0, 1.53, 0.02])
        elif name.endswith("Eye"):
            found[name] = np.array([0.03 if side == "Left" else -0.03, 1.65, 0.03])
        else:
            found[name] = np.array(_left_position(name.removeprefix(side)))
            found[name][0] *= 1 if side == "Left" else -1
    return found


def _distance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance of (..., 3) points to the surface, smooth where cones meet, and its gradient."""
    places = _positions()
    cones = [*_CONES, *((_other(a), _other(b), ra, rb) for a, b, ra, rb in _CONES if "Left" in a + b)]
    distances, gradients = [], []
    for start, end, start_radius, end_radius in cones:
        axis = places[end] - places[start]
        t = np.clip((points - places[start]) @ axis / (axis @ axis), 0, 1)
        away = points - places[start] - t[..., None] * axis
        length = np.linalg.norm(away, axis=-1)
        distances.append(length - start_radius - t * (end_radius - start_radius))
        gradients.append(away / np.maximum(length, 1e-12)[..., None])
    distance = np.stack(distances)
    least = distance.min(0)
    share = np.exp((least - distance) / _ROUNDING)
    total = share.sum(0)
    return least - _ROUNDING * np.log(total), np.einsum(
        "k...,k...c->...c", share / total, np.stack(gradients)
    )


def _other(name: str) -> str:
    return name.replace("Left", "Right")


def _surface_net(step: float, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) on the surface and outward quads (q, 4); the columns of `turn` are the grid's axes."""
    reach = np.ceil(np.abs(turn.T) @ _BOX / step).astype(int)
    ticks = [step * np.arange(-count, count + 1) for count in reach]
    nodes = np.stack(np.meshgrid(*ticks, indexing="ij"), -1)
    inside = _distance(nodes @ turn.T + _CENTRE)[0] < 0
    found = []
    for axis in range(3):
        leaves = np.diff(inside.astype(np.int8), axis=axis)
        first, second = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        for sign in (-1, 1):  # grid edges that leave the body, then those that enter it
            cell = np.argwhere(leaves == sign)
            found.append(np.stack([cell, cell - first, cell - first - second, cell - second][::-sign], 1))
    cells, ids = np.unique(np.concatenate(found).reshape(-1, 3), axis=0, return_inverse=True)
    quads = ids.reshape(-1, 4)
    vertices = step * (cells + 0.5 - reach) @ turn.T + _CENTRE
    for _ in range(_SMOOTHINGS):  # evens the spacing: towards the neighbours, then back to the surface
        vertices = _on_surface(_neighbour_mean(vertices, quads))
    return vertices, quads


def _neighbour_mean(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    total, count = np.zeros_like(vertices), np.zeros(len(vertices))
    for corner in range(4):  # each edge is met twice, once from each side
        np.add.at(total, quads[:, corner], vertices[quads[:, corner - 1]])
        np.add.at(count, quads[:, corner], 1)
    return total / count[:, None]


def _on_surface(points: np.ndarray) -> np.ndarray:
    for _ in range(_NEWTON_STEPS):
        value, gradient = _distance(points)
        points = points - value[:, None] * gradient / (gradient**2).sum(1, keepdims=True)
    return points


def _triangles(quads: np.ndarray) -> np.ndarray:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def _segment(name: str, vertices: np.ndarray) -> np.ndarray:
    inside = [np.linalg.norm(vertices - centre, axis=1) < radius for centre, radius in _BAGS[name]]
    return np.flatnonzero(np.any(inside, axis=0)).astype(np.int32)


@functools.cache
def synthetic_canonical() -> tuple[CanonicalMesh, Rig]:
    """Make the canonical mesh and rig [m]: about 1,300 vertices, 78 joints, three bags in the head.

    Pass the pair as ``canonical`` to :class:`~soma_core.SomaLayer` or to the conformance suite in place of
    the shipped one. The mesh is closed and exactly symmetric; ``lod`` is "mid" and ``revision``
    "synthetic". Joint frames are turned at random; the T-pose has the arms raised to the horizontal.
    """
    vertices, quads = _surface_net(_CANONICAL_STEP, np.eye(3))
    mirror = cKDTree(vertices).query(vertices * [-1, 1, 1])[1].astype(np.int32)
    vertices = (vertices + vertices[mirror] * [-1, 1, 1]) / 2
    segments = {name: _segment(name, vertices) for name in _BAGS}
    bags = np.concatenate(list(segments.values()))
    vertices[bags] = 0.6 * vertices[bags] + 0.4 * _INSIDE_HEAD
    mesh = CanonicalMesh(
        vertices=vertices,
        triangles=_triangles(quads),
        face_vert_indices=quads.ravel().astype(np.int32),
        face_vert_counts=np.full(len(quads), 4, np.int32),
        uv=np.empty((0, 2), np.float32),
        uv_indices=np.empty(0, np.int32),
        segments=segments,
        mirror=mirror,
        mid_ids=np.arange(len(vertices), dtype=np.int32),
        lod="mid",
        revision="synthetic",
    )
    return mesh, _rig(vertices)


def _rig(vertices: np.ndarray) -> Rig:
    names = tuple(_positions())
    parents = np.array([-1, *(names.index(parent) for parent in PARENT_NAMES.values())], np.int32)
    bind = np.tile(np.eye(4), (len(names), 1, 1))
    bind[:, :3, 3] = list(_positions().values())
    bind[1:, :3, :3] = Rotation.random(len(names) - 1, random_state=3).as_matrix()
    return Rig(
        joint_names=names,
        parents=parents,
        bind_world=bind,
        t_pose_world=_t_pose(names, bind),
        bind_shape=vertices,
        weights=_weights(vertices, names, parents, bind[:, :3, 3]),
        revision="synthetic",
    )


def _t_pose(names: tuple[str, ...], bind: np.ndarray) -> np.ndarray:
    posed = bind.copy()
    for side, angle in (("Left", _ARM_ANGLE), ("Right", -_ARM_ANGLE)):
        parts = (f"{side}Arm", f"{side}ForeArm", f"{side}Hand")
        arm = [joint for joint, name in enumerate(names) if name.startswith(parts)]
        raised = np.eye(4)
        raised[:3, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
        shoulder = _positions()[f"{side}Arm"]
        raised[:3, 3] = shoulder - raised[:3, :3] @ shoulder
        posed[arm] = raised @ bind[arm]
    return posed


def _weights(
    vertices: np.ndarray, names: tuple[str, ...], parents: np.ndarray, places: np.ndarray
) -> scipy.sparse.csr_array:
    """Weights that fall off with the distance to the bones, in units of the body's radius there."""
    weights = np.zeros((len(vertices), len(names)))
    for joint, name in enumerate(names):
        if name == "Root" or name.endswith(("End", "Eye")):
            continue
        ends = places[parents == joint]
        bones = ends - places[joint] if len(ends) else np.array([[0, 0.0, 0.05]])
        for bone in bones:
            t = np.clip((vertices - places[joint]) @ bone / (bone @ bone), 0, 1)
            squared = ((vertices - places[joint] - t[:, None] * bone) ** 2).sum(1)
            weights[:, joint] = np.maximum(weights[:, joint], np.exp(-squared / (2 * _SKINNING_WIDTH**2)))
    weights[weights < 0.01 * weights.max(1, keepdims=True)] = 0
    return scipy.sparse.csr_array(weights / weights.sum(1, keepdims=True))


@functools.cache
def synthetic_native() -> tuple[np.ndarray, np.ndarray]:
    """Make the mesh of a foreign model: vertices (n, 3) [cm], +Z up, facing -Y, and triangles (t, 3).

    The same surface as the canonical mesh, other vertices, no bags.
    """
    vertices, quads = _surface_net(_NATIVE_STEP, _NATIVE_TURN)
    return vertices @ NATIVE_FROM_CANONICAL.T, _triangles(quads)


@functools.cache
def _wrap() -> np.ndarray:
    """Canonical vertices (v, 3) on the native facets [cm]; the bags, which the model lacks, stay put."""
    from soma_core.geometry.barycentric import closest_point_on_triangle
    from soma_core.topology.closest import ClosestFaces

    mesh, _ = synthetic_canonical()
    native, triangles = synthetic_native()
    ideal = mesh.vertices @ NATIVE_FROM_CANONICAL.T
    face = ClosestFaces(native, triangles).query(ideal)
    wrap = closest_point_on_triangle(ideal, native[triangles[face]])
    wrap[mesh.face_interior] = ideal[mesh.face_interior]
    return wrap


def write_wrap_pair(folder: Path | str) -> WrapPair:
    """Write ``native.obj`` and ``wrap.obj`` of the synthetic bodies [cm] into `folder`.

    Declare them with ``unit="cm", up="+z", forward="-y", fill_segments=("mouth_bag", "eye_bags")``.
    """
    mesh, _ = synthetic_canonical()
    return WrapPair(
        native=write_obj(Path(folder) / "native.obj", *synthetic_native()),
        wrap=write_obj(Path(folder) / "wrap.obj", _wrap(), mesh.triangles),
    )
