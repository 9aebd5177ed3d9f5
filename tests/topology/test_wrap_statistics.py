"""Figures of a wrap pair, on a pair whose distances are known."""

import numpy as np
import pytest

from soma_core.obj import read_obj, write_obj
from soma_core.plugin.spec import BackendSpec, WrapPair
from soma_core.testing.synthetic import synthetic_canonical, synthetic_native, write_wrap_pair
from soma_core.topology.correspondence import load_correspondence
from soma_core.topology.wrap_statistics import wrap_statistics

MESH = synthetic_canonical()[0]
LIFT_MM = 3.0
ROUNDING_MM = 1e-6
"""float64, centimetres."""


def spec(pair, **changes):
    fields = {"fill_segments": ("mouth_bag", "eye_bags"), **changes}
    return BackendSpec(name="x", unit="cm", up="+z", forward="-y", params=(), wrap=pair, **fields)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path / "cache"))


def test_a_wrap_on_the_surface_has_no_distance_and_bags_do_not_count(tmp_path):
    found = wrap_statistics(spec(write_wrap_pair(tmp_path)), MESH)
    assert (found.native_count, found.wrap_count) == (len(synthetic_native()[0]), MESH.vertex_count)
    assert found.filled_count == len(np.unique(np.concatenate(list(MESH.segments.values()))))
    assert found.max_mm < ROUNDING_MM
    everything = wrap_statistics(spec(write_wrap_pair(tmp_path), fill_segments=()), MESH)
    assert everything.filled_count == 0
    assert everything.max_mm > 10


@pytest.mark.parametrize("sign", [1, -1])
def test_a_vertex_off_the_surface_is_measured_in_millimetres_with_its_side(tmp_path, sign):
    pair = write_wrap_pair(tmp_path)
    points, triangles = read_obj(pair.wrap)
    made = load_correspondence(pair, MESH)
    # A vertex well inside its face, so that the nearest point stays on that face.
    c1, c2 = made.coordinates[:, 0], made.coordinates[:, 1]
    inside = np.minimum(np.minimum(c1, c2), 1 - c1 - c2)
    vertex = int(np.argmax(inside))
    a, b, c = made.native_vertices[made.corners[vertex]]
    normal = np.cross(b - a, c - a)
    points[vertex] += sign * 0.1 * LIFT_MM * normal / np.linalg.norm(normal)
    lifted = WrapPair(native=pair.native, wrap=write_obj(tmp_path / "lifted.obj", points, triangles))
    found = wrap_statistics(spec(lifted), MESH)
    assert found.max_mm == pytest.approx(LIFT_MM, abs=ROUNDING_MM)
    assert found.mean_mm < LIFT_MM / 100
    assert found.p95_mm < ROUNDING_MM
    side = found.highest_mm if sign > 0 else -found.lowest_mm
    assert side == pytest.approx(LIFT_MM, abs=ROUNDING_MM)
