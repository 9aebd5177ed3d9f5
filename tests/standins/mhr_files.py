"""TorchScript files of the signature of MHR's, holding a body of this project, and their wrap pairs."""

from __future__ import annotations

import functools
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from soma_core import load_canonical
from soma_core.obj import write_obj
from tests.standins.body import Body, make_body, write_wrap

__all__ = ["LODS", "StandIn", "mhr_body", "write_mhr_pair", "write_model"]

LODS = {1: (18439, 36874), 6: (595, 1186)}
"""Vertices and triangles."""

IDENTITY, CENTIMETRES = 45, 100.0
_SHARE = 0.3
"""Share of a scale that a joint takes: sizes are handed down, and add up along a limb."""


class _Mesh(nn.Module):
    def __init__(self, faces: np.ndarray) -> None:
        super().__init__()
        self.register_buffer("faces", torch.as_tensor(faces, dtype=torch.int64))


class _Character(nn.Module):
    def __init__(self, faces: np.ndarray) -> None:
        super().__init__()
        self.mesh = _Mesh(faces)


class StandIn(nn.Module):
    """A skinned body with the inputs and outputs of MHR: centimetres, 127 joints, sizes as powers of 2."""

    def __init__(self, body: Body, *, unit: float = CENTIMETRES) -> None:
        super().__init__()
        skinned = np.flatnonzero(body.weights.any(axis=0))
        parents = load_canonical("low")[1].parents
        turned, scaled, stretched = (np.zeros((n, len(parents))) for n in (42, 68, 74))
        turned[np.arange(42), skinned[:42]] = 1
        scaled[np.arange(68), np.resize(skinned, 68)] = _SHARE
        stretched[np.arange(6), skinned[1:7]] = 1
        head = body.joint_names.index("Head")
        constants = {
            "base_shape": unit * body.vertices,
            "shape_vectors": unit * body.directions,
            "face_direction": unit * 0.01 * body.weights[:, [head]] * np.array([0.0, 0, 1]),
            "joints": unit * body.joints,
            "weights": body.weights,
            "turned": turned,
            "scaled": scaled,
            "stretched": stretched,
        }
        for name, value in constants.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32))
        self.parents = [int(parent) for parent in parents]
        self.character_torch = _Character(body.faces)

    def forward(
        self,
        identity_coeffs: Tensor,
        model_parameters: Tensor,
        face_expr_coeffs: Tensor,
        apply_correctives: bool = True,
    ) -> tuple[Tensor, Tensor]:
        """Vertices (batch, v, 3) and skeleton state (batch, 127, 8)."""
        rest = self.base_shape + torch.einsum("bk,kvc->bvc", identity_coeffs, self.shape_vectors)
        rest = rest + face_expr_coeffs.sum(1)[:, None, None] * self.face_direction
        angles = torch.einsum("bjc,jk->bkc", model_parameters[:, 3:129].view(-1, 42, 3), self.turned)
        sizes = torch.pow(2.0, model_parameters[:, 136:] @ self.scaled)
        lengths = torch.pow(2.0, model_parameters[:, 130:] @ self.stretched)
        turns: list[Tensor] = []
        scales: list[Tensor] = []
        places: list[Tensor] = []
        for joint, parent in enumerate(self.parents):
            turn, size = self.rotation(angles[:, joint]), sizes[:, joint, None]
            if parent < 0:
                turns.append(turn)
                scales.append(size)
                places.append(self.joints[joint] + 10 * model_parameters[:, :3])
            else:
                offset = (self.joints[joint] - self.joints[parent]) * lengths[:, joint, None] * scales[parent]
                turns.append(turns[parent] @ turn)
                scales.append(scales[parent] * size)
                places.append(places[parent] + torch.einsum("brc,bc->br", turns[parent], offset))
        place = torch.stack(places, 1)
        linear = torch.stack(turns, 1) * torch.stack(scales, 1)[..., None]
        shift = place - torch.einsum("bjrc,jc->bjr", linear, self.joints)
        skin = torch.einsum("vj,bjrc->bvrc", self.weights, linear)
        moved = torch.einsum("bvrc,bvc->bvr", skin, rest) + torch.einsum("vj,bjr->bvr", self.weights, shift)
        state = torch.zeros(len(rest), 127, 8, dtype=rest.dtype, device=rest.device)
        state[:, : len(places), :3] = place
        return moved, state

    def rotation(self, angles: Tensor) -> Tensor:
        """Matrices (batch, 3, 3) of Euler angles xyz (batch, 3)."""
        (cx, cy, cz), (sx, sy, sz) = torch.cos(angles).unbind(1), torch.sin(angles).unbind(1)
        rows = [
            cy * cz, sx * sy * cz - cx * sz, cx * sy * cz + sx * sz,
            cy * sz, sx * sy * sz + cx * cz, cx * sy * sz - sx * cz,
            -sy, sx * cy, cx * cy,
        ]  # fmt: skip
        return torch.stack(rows, 1).view(-1, 3, 3)


@functools.cache
def mhr_body(lod: int) -> Body:
    """The body of a LOD [m]."""
    vertices, triangles = LODS[lod]
    if lod == 1:
        return make_body(vertices, triangles, components=IDENTITY)
    return _collapsed(make_body(612, 1220, components=IDENTITY), 612 - vertices)


def _collapsed(body: Body, count: int) -> Body:
    """Drop the last end of `count` edges, one after the other, and close the surface over it."""
    faces, kept = body.faces, np.ones(len(body.vertices), bool)
    for _ in range(count):
        edge = next(edge for edge in faces[:, :2] if _shared(faces, *edge) == 2)
        kept[edge[1]] = False
        faces = np.where(faces == edge[1], edge[0], faces)
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return Body(
        vertices=body.vertices[kept],
        faces=(np.cumsum(kept) - 1)[faces],
        directions=body.directions[:, kept],
        weights=body.weights[kept],
        joints=body.joints,
        joint_names=body.joint_names,
    )


def _shared(faces: np.ndarray, first: int, second: int) -> int:
    """How many vertices are neighbours of both; more than two, and a collapse would pinch the surface."""
    around = [np.unique(faces[(faces == vertex).any(axis=1)]) for vertex in (first, second)]
    return len(np.intersect1d(*around)) - 2


def write_model(path: Path, module: nn.Module) -> Path:
    """Write a module as TorchScript."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of torch.jit.script, from torch 2.10 on
        torch.jit.script(module).save(str(path))
    return path


def write_mhr_pair(folder: Path, lod: int) -> None:
    """Write the neutral mesh and the wrap of a LOD, as ``soma wrap`` would."""
    body = mhr_body(lod)
    name = "mhr_neutral.obj" if lod == 1 else "mhr_lod6_neutral.obj"
    folder.mkdir(parents=True, exist_ok=True)
    write_obj(folder / name, CENTIMETRES * body.vertices, body.faces)
    write_wrap(folder, body, CENTIMETRES)
