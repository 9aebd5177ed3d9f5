"""A small body for tests: canonical mesh, rig, native mesh, wrap pair, and a linear backend made of them.

Everything is built from formulas. The mesh has 602 vertices with three bags pushed inside, the rig has
joints of every kind (fan, chain, leaf, weightless), turned frames and a T-pose that differs from the bind
pose; the native mesh has another resolution, unit and axes than the canonical one.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.sparse
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from soma_core.plugin.hookspecs import hookimpl
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import BackendSpec, LinearBasis, Parameter, WrapPair
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from tests.plugin.fakes import FakeEntryPoint

CPU = torch.device("cpu")
CANONICAL_CELLS, NATIVE_CELLS = 10, 13

TO_NATIVE = 100.0 * np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Canonical metres, +Y up, to native centimetres, +Z up, facing -Y."""

JOINTS: dict[str, tuple[str | None, tuple[float, float, float]]] = {
    "Root": (None, (0.0, 0.0, 0.0)),
    "Hips": ("Root", (0.0, 0.95, 0.0)),
    "Spine": ("Hips", (0.0, 1.15, 0.02)),
    "Head": ("Spine", (0.0, 1.45, 0.01)),
    "HeadEnd": ("Head", (0.0, 1.68, 0.0)),
    "Jaw": ("Head", (0.0, 1.44, 0.07)),
    "LeftArm": ("Spine", (0.12, 1.3, 0.0)),
    "LeftHand": ("LeftArm", (0.22, 1.1, 0.02)),
    "RightArm": ("Spine", (-0.12, 1.3, 0.0)),
    "RightHand": ("RightArm", (-0.22, 1.1, 0.02)),
    "LeftLeg": ("Hips", (0.09, 0.8, 0.0)),
    "LeftFoot": ("LeftLeg", (0.08, 0.3, 0.02)),
    "LeftToeEnd": ("LeftFoot", (0.08, 0.15, 0.09)),
    "RightLeg": ("Hips", (-0.09, 0.8, 0.0)),
    "RightFoot": ("RightLeg", (-0.08, 0.3, 0.02)),
}
WEIGHTLESS = ("Root", "HeadEnd", "LeftToeEnd")
BAGS = {
    "mouth_bag": [((0.0, 0.25, 0.95), 0.3)],
    "eye_bags": [((0.45, 0.8, 0.4), 0.2), ((-0.45, 0.8, 0.4), 0.2)],
}


def generator(seed: int) -> torch.Generator:
    """A seeded CPU generator."""
    return torch.Generator().manual_seed(seed)


def randn(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Normal numbers that do not depend on any global state; the same for both dtypes."""
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64).to(dtype)


def cube_sphere(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (6 c^2 + 2, 3) on the unit sphere and outward quads (6 c^2, 4)."""
    steps = np.linspace(-1, 1, cells + 1)
    u, v = np.meshgrid(steps, steps, indexing="ij")
    points, quads = [], []
    corner = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
    sheet = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], -1).reshape(-1, 4)
    for axis in range(3):
        for sign in (1.0, -1.0):
            point = np.empty((u.size, 3))
            point[:, axis] = sign
            point[:, (axis + 1) % 3], point[:, (axis + 2) % 3] = u.ravel(), v.ravel()
            quads.append((sheet if sign > 0 else sheet[:, ::-1]) + sum(map(len, points)))
            points.append(point)
    merged, inverse = np.unique(np.concatenate(points).round(9), axis=0, return_inverse=True)
    angled = np.tan(merged * np.pi / 4)
    return angled / np.linalg.norm(angled, axis=1, keepdims=True), inverse.ravel()[np.concatenate(quads)]


def body_surface(direction: np.ndarray) -> np.ndarray:
    """The body [m] over the unit sphere: a tall, lumpy, slightly asymmetric blob standing on y = 0."""
    x, y, z = direction.T
    waist = 1 - 0.25 * np.exp(-8 * (y - 0.15) ** 2)
    return np.stack(
        [
            0.27 * x * waist + 0.01 * np.sin(3 * y),
            0.85 * (y + 1),
            0.17 * z * waist + 0.02 * np.cos(2 * x + y),
        ],
        1,
    )


def _bag(name: str, direction: np.ndarray) -> np.ndarray:
    inside = np.zeros(len(direction), bool)
    for centre, radius in BAGS[name]:
        unit = np.array(centre) / np.linalg.norm(centre)
        inside |= direction @ unit > np.cos(radius)
    return inside


def _canonical_vertices(direction: np.ndarray) -> np.ndarray:
    vertices = body_surface(direction)
    bags = _bag("mouth_bag", direction) | _bag("eye_bags", direction)
    vertices[bags] = 0.75 * vertices[bags] + 0.25 * np.array([0, 1.3, 0])
    return vertices


@functools.cache
def tiny_canonical() -> tuple[CanonicalMesh, Rig]:
    """The small canonical mesh and rig; every array is float64 or int32, in metres."""
    direction, quads = cube_sphere(CANONICAL_CELLS)
    vertices = _canonical_vertices(direction)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
    segments = {name: np.flatnonzero(_bag(name, direction)).astype(np.int32) for name in BAGS}
    mesh = CanonicalMesh(
        vertices=vertices,
        triangles=triangles,
        face_vert_indices=quads.ravel().astype(np.int32),
        face_vert_counts=np.full(len(quads), 4, np.int32),
        uv=np.empty((0, 2), np.float32),
        uv_indices=np.empty(0, np.int32),
        segments=segments,
        mirror=cKDTree(direction).query(direction * [-1, 1, 1])[1].astype(np.int32),
        mid_ids=np.arange(len(vertices), dtype=np.int32),
        lod="mid",
        revision="tiny",
    )
    return mesh, _rig(vertices)


def _rig(vertices: np.ndarray) -> Rig:
    names = tuple(JOINTS)
    parents = np.array(
        [-1 if parent is None else names.index(parent) for parent, _ in JOINTS.values()], np.int32
    )
    bind = np.tile(np.eye(4), (len(names), 1, 1))
    bind[:, :3, 3] = [place for _, place in JOINTS.values()]
    bind[1:, :3, :3] = Rotation.random(len(names) - 1, random_state=3).as_matrix()
    turns = np.random.default_rng(4).normal(scale=0.25, size=(len(names), 3))
    t_pose = bind.copy()
    for joint in range(1, len(names)):
        local = np.linalg.inv(bind[parents[joint]]) @ bind[joint]
        local[:3, :3] = local[:3, :3] @ Rotation.from_rotvec(turns[joint]).as_matrix()
        t_pose[joint] = t_pose[parents[joint]] @ local
    return Rig(
        joint_names=names,
        parents=parents,
        bind_world=bind,
        t_pose_world=t_pose,
        bind_shape=vertices,
        weights=_weights(vertices, names, parents, bind[:, :3, 3]),
        revision="tiny",
    )


def _weights(
    vertices: np.ndarray, names: tuple, parents: np.ndarray, places: np.ndarray
) -> scipy.sparse.csr_array:
    weights = np.zeros((len(vertices), len(names)))
    for joint, name in enumerate(names):
        if name in WEIGHTLESS:
            continue
        ends = places[parents == joint]
        end = ends.mean(0) if len(ends) else places[joint] + [0, -0.1, 0]
        along = end - places[joint]
        t = np.clip((vertices - places[joint]) @ along / (along @ along), 0, 1)
        squared = ((vertices - places[joint] - t[:, None] * along) ** 2).sum(1)
        weights[:, joint] = np.exp(-squared / (2 * 0.11**2))
    weights[weights < 0.003 * weights.max(1, keepdims=True)] = 0
    return scipy.sparse.csr_array(weights / weights.sum(1, keepdims=True))


@functools.cache
def native_body() -> tuple[np.ndarray, np.ndarray]:
    """Native vertices [cm], +Z up, facing -Y, and triangles: the same surface, other vertices."""
    direction, quads = cube_sphere(NATIVE_CELLS)
    turned = Rotation.from_rotvec([0.3, 0.5, -0.2]).apply(direction)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return body_surface(turned) @ TO_NATIVE.T, triangles


@functools.cache
def wrap_vertices() -> np.ndarray:
    """Canonical vertices on the native surface [cm]: half of them on it, the others up to millimetres off."""
    import trimesh

    mesh, _ = tiny_canonical()
    vertices, triangles = native_body()
    ideal = mesh.vertices @ TO_NATIVE.T
    on, _, face = trimesh.proximity.closest_point_naive(
        trimesh.Trimesh(vertices, triangles, process=False), ideal
    )
    corners = vertices[triangles[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    third = np.arange(len(ideal)) % 3
    # By turns: on the surface; 4 micrometres off, which is linearised; where the smooth surface runs.
    wrap = np.where(third[:, None] == 0, on, np.where(third[:, None] == 1, on + 4e-4 * normal, ideal))
    wrap[mesh.face_interior] = ideal[mesh.face_interior]
    return wrap


def write_obj(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> Path:
    """Write an OBJ that reads back bit for bit."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(triangles) + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_pair(folder: Path) -> WrapPair:
    """The wrap pair of the small body as two OBJ files."""
    mesh, _ = tiny_canonical()
    return WrapPair(
        native=write_obj(folder / "native.obj", *native_body()),
        wrap=write_obj(folder / "wrap.obj", wrap_vertices(), mesh.triangles),
    )


def tiny_spec(pair: WrapPair | None, **changes: object) -> BackendSpec:
    """Declaration of the small backend; `changes` replace fields."""
    spec = BackendSpec(
        name="tiny",
        unit="cm",
        up="+z",
        forward="-y",
        wrap=pair,
        params=(Parameter(name="shape", shape=(4,), default=0.3), Parameter(name="size", default=1.0)),
        fill_segments=("eye_bags", "mouth_bag"),
    )
    return replace(spec, **changes)


class LinearBody:
    """``template + coefficients @ fields``; the coefficients are a non-linear function of the parameters."""

    def __init__(self, *, device: torch.device = CPU, dtype: torch.dtype = torch.float64) -> None:
        vertices, _ = native_body()
        x, y, z = vertices.T / 100
        zero = np.zeros_like(x)
        fields = [
            vertices,  # uniform growth
            100 * np.stack([0.1 * x * np.sin(3 * z), zero, 0.1 * z], 1),
            100 * np.stack([0.02 * np.exp(-20 * (z - 1) ** 2), 0.3 * y * np.cos(2 * z), 0.1 * x * z], 1),
            100 * np.stack([0.05 * z * z, 0.03 * np.sin(5 * z), 0.05 * x], 1),
            100 * np.stack([0.3 * x, 0.3 * y, zero], 1),
        ]
        self.template = torch.as_tensor(vertices, dtype=dtype, device=device)
        self.fields = torch.as_tensor(np.stack(fields), dtype=dtype, device=device)

    def coefficients(self, params: Mapping[str, Tensor]) -> Tensor:
        """Growth from the logarithm of `size`, then `shape`, saturating; (batch, 5)."""
        return torch.cat((params["size"].log()[:, None], torch.tanh(params["shape"])), 1)

    def rest(self, params: Mapping[str, Tensor]) -> Tensor:
        """Native vertices (batch, n, 3) [cm]."""
        return self.template + torch.einsum("bk,knc->bnc", self.coefficients(params), self.fields)

    def linear_basis(self) -> LinearBasis:
        """The linear capability."""
        return LinearBasis(template=self.template, basis=self.fields, coefficients=self.coefficients)


class TinyPlugin:
    """The small backend as a plugin."""

    def __init__(self, spec: BackendSpec) -> None:
        self.declared = spec

    @hookimpl
    def soma_backend(self) -> BackendSpec:
        return self.declared

    @hookimpl
    def soma_generator(self, device: torch.device, dtype: torch.dtype) -> LinearBody:
        return LinearBody(device=device, dtype=dtype)


def tiny_registry(folder: Path) -> Registry:
    """A registry whose only backend is ``tiny``; its wrap pair is written to `folder`."""
    return Registry([FakeEntryPoint("tiny", TinyPlugin(tiny_spec(write_pair(folder))))])
