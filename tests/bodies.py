"""The synthetic body for tests of the core, and a linear backend made of it."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from soma_core.obj import write_obj
from soma_core.plugin.hookspecs import hookimpl
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import BackendSpec, LinearBasis, Parameter, WrapPair
from soma_core.testing.synthetic import NATIVE_FROM_CANONICAL as TO_NATIVE
from soma_core.testing.synthetic import synthetic_canonical as tiny_canonical
from soma_core.testing.synthetic import synthetic_native as native_body
from tests.plugin.fakes import FakeEntryPoint

__all__ = [
    "CPU", "TO_NATIVE", "LinearBody", "TinyPlugin", "cube_sphere", "native_body", "randn", "tiny_canonical",
    "tiny_registry", "tiny_spec", "wrap_vertices", "write_obj", "write_pair",
]  # fmt: skip

CPU = torch.device("cpu")


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
