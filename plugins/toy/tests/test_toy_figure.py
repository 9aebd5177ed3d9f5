"""The figure is sound: closed capsules, proportions that do what they say, files of that very shape."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from soma_backend_toy import soma_backend
from soma_backend_toy._figure import SEGMENTS, figure, figure_triangles
from soma_backend_toy._generator import ToyGenerator

from soma_core import SomaLayer, load_canonical
from soma_core.plugin import read_obj

FILE_PRECISION = 0.6e-3
"""Centimetres: the files keep three decimals."""
ROUNDING = 1e-9
"""Centimetres: sums of a few float64 terms of the size of a body."""
SPEC = soma_backend()
NAMES = [parameter.name for parameter in SPEC.params]


def params(**changes: float) -> dict[str, torch.Tensor]:
    values = {**dict.fromkeys(NAMES, 1.0), **changes}
    return {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}


def rest(**changes: float) -> np.ndarray:
    return ToyGenerator(torch.device("cpu"), torch.float64).rest(params(**changes))[0].numpy()


def parts() -> np.ndarray:
    count = len(figure()) // len(SEGMENTS)
    return np.repeat([segment.part for segment in SEGMENTS], count)


def test_each_capsule_is_closed_and_faces_outwards():
    triangles = figure_triangles()
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(edge) for edge in edges} == {(b, a) for a, b in edges}
    corners = figure()[triangles].reshape(len(SEGMENTS), -1, 3, 3)
    volumes = np.einsum("sfc,sfc->s", corners[:, :, 0], np.cross(corners[:, :, 1], corners[:, :, 2])) / 6
    assert (volumes > 0).all()


def test_native_obj_is_the_default_figure():
    vertices, triangles = read_obj(SPEC.wrap.native)
    np.testing.assert_allclose(vertices, rest(), atol=FILE_PRECISION, rtol=0)
    assert {tuple(face) for face in triangles} < {tuple(face) for face in figure_triangles()}


@pytest.mark.parametrize("name", [name for name in NAMES if name != "size"])
def test_the_basis_says_all_about_a_proportion(name):
    for factor in (0.8, 1.3):
        expected = figure(**{name: factor})
        np.testing.assert_allclose(rest(**{name: factor}), expected, atol=ROUNDING, rtol=0)
        np.testing.assert_allclose(rest(**{name: factor}, size=0.9), 0.9 * expected, atol=ROUNDING, rtol=0)


def test_proportions_add_up():
    together = {"girth": 1.2, "legs": 0.9, "arms": 1.1, "shoulders": 1.1, "head": 1.2}
    np.testing.assert_allclose(rest(**together), figure(**together), atol=ROUNDING, rtol=0)


@pytest.mark.parametrize(
    ("name", "moving"),
    [
        ("girth", {"trunk", "shoulder", "arm", "leg"}),
        ("arms", {"arm", "hand"}),
        ("shoulders", {"shoulder", "arm", "hand"}),
        ("head", {"head"}),
    ],
)
def test_a_proportion_moves_its_own_parts_only(name, moving):
    moved = np.abs(rest(**{name: 1.2}) - rest()).max(1) > ROUNDING
    assert set(parts()[moved]) == moving


def test_longer_legs_raise_the_trunk_and_leave_the_soles_on_the_ground():
    longer = rest(legs=1.2) - rest()
    trunk, foot = parts() == "trunk", parts() == "foot"
    np.testing.assert_allclose(longer[trunk], np.tile([0, 0, 0.2 * 91.5], (trunk.sum(), 1)), atol=ROUNDING)
    assert abs(longer[foot][:, 2]).max() < 3  # the feet grow with the legs


def test_the_wrap_pair_is_what_the_script_writes(tmp_path):
    script = runpy.run_path(str(Path(__file__).parents[1] / "make_wrap.py"))
    script["main"].__globals__["FOLDER"] = tmp_path
    script["main"]()
    for made, shipped in (
        (tmp_path / "native.obj", SPEC.wrap.native),
        (tmp_path / "SOMA_wrap.obj", SPEC.wrap.wrap),
    ):
        for ours, theirs in zip(read_obj(made), read_obj(shipped), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=10 * FILE_PRECISION, rtol=0)


def test_the_body_on_the_canonical_mesh_is_human():
    layer = SomaLayer("toy", lod="low", dtype=torch.float64)
    identity = layer.identity({"legs": [1.0, 1.2], "size": [1.0, 0.9]})
    stature = identity.fitted_rest[..., 1].amax(1) - identity.fitted_rest[..., 1].amin(1)
    assert 1.7 < float(stature[0]) < 1.8
    assert float(stature[1] / stature[0]) == pytest.approx(0.9 * (1 + 0.2 * 0.915 / 1.75), abs=0.01)
    rig = load_canonical("low")[1]
    moved = identity.fitted_world[0, :, :3, 3].numpy() - rig.bind_world[:, :3, 3]
    assert np.linalg.norm(moved, axis=1).max() < 0.05  # metres; the figure was drawn around this skeleton
