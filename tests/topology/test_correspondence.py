"""Building a correspondence: exact, deterministic, and clear about pairs that cannot be meant."""

import numpy as np
import pytest
import scipy.sparse
import torch

from soma_core.errors import AssetError, InputError
from soma_core.geometry.barycentric import raised_normal
from soma_core.plugin.spec import WrapPair
from soma_core.topology import correspondence as module
from soma_core.topology.correspondence import affine_matrix, build_correspondence, load_correspondence
from tests.bodies import native_body, tiny_canonical, wrap_vertices, write_obj
from tests.topology.test_closest import brute_force

REPRODUCTION_CM = 1e-11
"""float64 rounding on a body of 170 cm."""
MESH, _ = tiny_canonical()


@pytest.fixture(scope="module")
def made():
    return build_correspondence(*native_body(), wrap_vertices())


def evaluate(correspondence, native):
    """The definition, vertex by vertex: plane part plus offset times raised normal."""
    raised = raised_normal(torch.as_tensor(native[correspondence.corners])).numpy()
    return affine_matrix(correspondence) @ native + correspondence.coordinates[:, 2:] * raised


def test_reproduces_the_wrap(made):
    np.testing.assert_allclose(evaluate(made, native_body()[0]), wrap_vertices(), atol=REPRODUCTION_CM)


def test_distances_are_those_of_brute_force(made):
    vertices, triangles = native_body()
    some = np.arange(0, MESH.vertex_count, 7)
    expected = brute_force(wrap_vertices()[some], vertices, triangles).min(1)
    np.testing.assert_allclose(made.distances[some], expected, atol=REPRODUCTION_CM)


def test_coordinates_are_small(made):
    """Lengths, not areas, scale the offset: coordinates stay of order one."""
    covered = np.setdiff1d(np.arange(MESH.vertex_count), MESH.face_interior)
    assert np.abs(made.coordinates[covered]).max() < 3


def test_result_does_not_depend_on_repetition_or_integer_type(made):
    vertices, triangles = native_body()
    again = build_correspondence(vertices, triangles.astype(np.int32), wrap_vertices())
    np.testing.assert_array_equal(again.corners, made.corners)
    np.testing.assert_array_equal(again.coordinates, made.coordinates)


def test_degenerate_faces_are_no_candidates():
    vertices, triangles = native_body()
    line = [[a, b, b] for a, b, _ in triangles[:200]] + [[a, a, a] for a in range(50)]
    sliver = [[0, 1, len(vertices)]]  # three points on a line, up to rounding
    vertices_more = np.concatenate([vertices, [(vertices[0] + vertices[1]) / 2]])
    polluted = np.concatenate([line, sliver, triangles])  # the lowest ids win ties, if they are candidates
    made = build_correspondence(vertices_more, polluted, wrap_vertices())
    clean = build_correspondence(vertices, triangles, wrap_vertices())
    assert np.isfinite(made.coordinates).all()
    np.testing.assert_array_equal(made.corners, clean.corners)


def test_a_mesh_of_degenerate_faces_is_refused():
    with pytest.raises(
        InputError, match=r"wrap.native: got 2 faces, all degenerate, expected .*positive area"
    ):
        build_correspondence(native_body()[0], np.array([[0, 0, 1], [2, 2, 2]]), wrap_vertices())


def test_subset_of_a_lower_lod(made):
    ids = np.array([3, 5, 100])
    part = made.at(ids)
    np.testing.assert_allclose(evaluate(part, native_body()[0]), wrap_vertices()[ids], atol=REPRODUCTION_CM)
    assert part.native_count == made.native_count
    assert part.key != made.key or not made.key
    np.testing.assert_array_equal(part.distances, made.distances[ids])


def test_affine_matrix_has_rows_that_sum_to_one(made):
    matrix = affine_matrix(made)
    assert matrix.shape == (MESH.vertex_count, len(native_body()[0]))
    np.testing.assert_allclose(matrix.sum(1), 1, atol=1e-12)
    assert isinstance(matrix, scipy.sparse.csr_array)


@pytest.mark.parametrize(("wrong", "factor"), [(0.01, "100"), (100.0, "0.01"), (0.1, "10"), (10.0, "0.1")])
def test_unit_errors_name_the_factor(wrong, factor):
    with pytest.raises(
        InputError, match=rf"wrap: got a median distance .*Scale the wrap by {factor}: .*units"
    ):
        build_correspondence(*native_body(), wrong * wrap_vertices())


@pytest.mark.parametrize("swap", [[2, 0, 1], [0, 2, 1]])
def test_axis_errors_name_the_axes(swap):
    with pytest.raises(InputError, match="same axes and pose") as caught:
        build_correspondence(*native_body(), wrap_vertices()[:, swap])
    assert "Scale" not in str(caught.value)


# --- loading from files ---------------------------------------------------------------------------------


def test_load_equals_build(own_cache, pair, made):
    loaded = load_correspondence(pair, MESH)
    np.testing.assert_array_equal(loaded.corners, made.corners)
    np.testing.assert_array_equal(loaded.coordinates, made.coordinates)
    assert (loaded.native_count, loaded.corners.dtype) == (made.native_count, np.int64)


def forbid_building(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("built again")

    monkeypatch.setattr(module, "build_correspondence", refuse)


def test_cache_is_reused(own_cache, pair, monkeypatch):
    first = load_correspondence(pair, MESH)
    forbid_building(monkeypatch)
    second = load_correspondence(pair, MESH)
    np.testing.assert_array_equal(second.coordinates, first.coordinates)
    assert second.key == first.key


def test_cache_follows_the_content_of_both_files(own_cache, pair, tmp_path, monkeypatch):
    load_correspondence(pair, MESH)
    forbid_building(monkeypatch)
    for name in ("native", "wrap"):
        copy = tmp_path / f"{name}.obj"
        copy.write_bytes(getattr(pair, name).read_bytes())
        same = WrapPair(**{"native": pair.native, "wrap": pair.wrap, name: copy})
        load_correspondence(same, MESH)  # another place, the same bytes
        copy.write_bytes(copy.read_bytes() + b"# edited\n")
        with pytest.raises(AssertionError, match="built again"):
            load_correspondence(same, MESH)


@pytest.mark.parametrize("damage", [b"", b"no archive", b"PK\x03\x04 half an archive"])
def test_damaged_cache_files_are_rebuilt(own_cache, pair, made, damage, caplog):
    load_correspondence(pair, MESH)
    (file,) = own_cache.rglob("*.npz")
    file.write_bytes(damage)
    rebuilt = load_correspondence(pair, MESH)
    np.testing.assert_array_equal(rebuilt.coordinates, made.coordinates)
    assert str(file) in caplog.text
    assert file.stat().st_size > len(damage)


def test_truncated_cache_files_are_rebuilt(own_cache, pair, made):
    load_correspondence(pair, MESH)
    (file,) = own_cache.rglob("*.npz")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    np.testing.assert_array_equal(load_correspondence(pair, MESH).coordinates, made.coordinates)


def test_writing_the_cache_leaves_nothing_else(own_cache, pair):
    load_correspondence(pair, MESH)
    assert len([path for path in own_cache.rglob("*") if path.is_file()]) == 1


def test_a_cache_that_cannot_be_written_costs_only_time(tmp_path, pair, made, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("SOMA_CACHE_DIR", str(blocked))
    np.testing.assert_array_equal(load_correspondence(pair, MESH).coordinates, made.coordinates)


@pytest.mark.parametrize("name", ["native", "wrap"])
def test_missing_files_are_named(own_cache, pair, tmp_path, name):
    broken = WrapPair(**{"native": pair.native, "wrap": pair.wrap, name: tmp_path / "gone.obj"})
    with pytest.raises(AssetError, match=r"gone.obj: file is missing.*Reinstall"):
        load_correspondence(broken, MESH)


def test_refused_pairs_leave_no_cache(own_cache, pair, tmp_path):
    wrong = write_obj(tmp_path / "wrap.obj", 0.01 * wrap_vertices(), MESH.triangles)
    for _ in range(2):
        with pytest.raises(InputError, match="Scale the wrap by 100"):
            load_correspondence(WrapPair(native=pair.native, wrap=wrong), MESH)
    assert not list(own_cache.rglob("*.npz"))
