"""A native mesh is checked before anything is fitted: each fault is named with what was found."""

from __future__ import annotations

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.registration.target import Frame, find_skin, find_unit


def sphere(rings: int = 40, *, centre=(0.0, 0.0, 0.0), size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere of about two `rings` squared vertices, faces outwards."""
    turn, rise = np.meshgrid(
        np.arange(2 * rings) * np.pi / rings, np.linspace(0, np.pi, rings + 1)[1:-1], indexing="ij"
    )
    body = np.stack([np.sin(rise) * np.cos(turn), np.cos(rise), -np.sin(rise) * np.sin(turn)], -1)
    count = rings - 1
    points = np.concatenate([body.reshape(-1, 3), [[0, 1, 0], [0, -1, 0]]])
    top, bottom = len(points) - 2, len(points) - 1
    faces = []
    for i in range(2 * rings):
        a, b = i * count, (i + 1) % (2 * rings) * count
        faces += [(top, a, b), (bottom, b + count - 1, a + count - 1)]
        for j in range(count - 1):
            faces += [(a + j, a + j + 1, b + j + 1), (a + j, b + j + 1, b + j)]
    return size * points + np.array(centre), np.array(faces)


def test_a_closed_surface_is_its_own_skin() -> None:
    vertices, triangles = sphere()
    skin = find_skin(vertices, triangles)
    np.testing.assert_array_equal(skin.vertices, vertices)
    np.testing.assert_array_equal(skin.triangles, triangles)
    assert skin.notes == ()


def test_faces_that_point_inwards_are_turned() -> None:
    vertices, triangles = sphere()
    skin = find_skin(vertices, triangles[:, ::-1])
    assert skin.notes == ("faces point inwards; turned",)
    corners = skin.vertices[skin.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * corners.mean(1)).sum(1) > 0).all()


def test_small_parts_are_left_out_and_said() -> None:
    (body, faces), (eye, lids) = sphere(), sphere(6, size=0.05)
    skin = find_skin(np.concatenate([eye, body]), np.concatenate([lids, faces + len(eye)]))
    np.testing.assert_array_equal(skin.vertices, body)
    assert skin.notes == (f"1 smaller parts of {len(eye)} vertices left out",)


def test_masked_vertices_are_left_out() -> None:
    vertices, triangles = sphere()
    hat = np.flatnonzero(vertices[:, 1] > 0.9)
    skin = find_skin(vertices, triangles, masked=hat)
    assert skin.vertices[:, 1].max() <= 0.9
    assert skin.notes == (f"{len(hat)} masked vertices left out",)
    assert skin.masked
    assert skin.rim.sum() == 80  # the ring of vertices below the hat
    height = skin.vertices[skin.rim, 1]
    assert height.min() == height.max() == skin.vertices[:, 1].max()


def test_what_lies_under_a_mask_is_open() -> None:
    vertices, triangles = sphere()
    skin = find_skin(vertices, triangles, masked=np.flatnonzero(vertices[:, 1] > 0.9))
    frame = Frame(unit="m", up="+y", forward="+z", centre=(0, 0, 0))
    points = np.array([[0, 1.0, 0.1], [0, -1.0, 0.1], [0, 0.1, 1.0]])
    np.testing.assert_array_equal(skin.surface(frame).closest(points).open, [True, False, False])
    np.testing.assert_array_equal(skin.surface(frame).facing(points, points).open, [True, False, False])
    assert not find_skin(vertices, triangles).surface(frame).closest(points).open.any()


def test_two_bodies_are_refused() -> None:
    (one, faces), (two, _) = sphere(), sphere(centre=(3, 0, 0))
    with pytest.raises(InputError, match="got 2 parts, the second with 100% of the first one's area"):
        find_skin(np.concatenate([one, two]), np.concatenate([faces, faces + len(one)]))


def test_half_a_scan_is_refused() -> None:
    vertices, triangles = sphere()
    kept = triangles[vertices[triangles][:, :, 1].mean(1) > 0]
    soup = kept[::3]
    with pytest.raises(InputError, match="of the edges on a border, expected a nearly closed body"):
        find_skin(vertices, kept[np.arange(len(kept)) % 7 != 0])
    with pytest.raises(InputError, match="parts, the second with"):
        find_skin(vertices, soup)


def test_faces_turned_against_each_other_are_refused() -> None:
    vertices, triangles = sphere()
    turned = np.where(np.arange(len(triangles))[:, None] % 2 == 0, triangles, triangles[:, ::-1])
    with pytest.raises(InputError, match="of the edges between more than two faces, or faces turned against"):
        find_skin(vertices, turned)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda v, t: (v[:0], t), "got 0 vertices"),
        (lambda v, t: (v, t[:0]), "and 0 faces"),
        (lambda v, t: (np.where(np.arange(len(v))[:, None] == 7, np.nan, v), t), r"got vertex 7 = \[nan"),
        (lambda v, t: (v, t + 5), "got a face with vertex"),
        (lambda v, t: (v, t - 1), "got a face with vertex -1"),
        (lambda v, t: (v[:, :2], t), r"got arrays of shape \(\d+, 2\)"),
        (lambda v, t: (0 * v, t), "got faces without area"),
    ],
)
def test_broken_arrays_are_refused(change, found: str) -> None:
    with pytest.raises(InputError, match=found):
        find_skin(*change(*sphere()))


def test_a_mesh_too_coarse_is_refused() -> None:
    with pytest.raises(InputError, match="got 114 vertices, expected a body of at least 500"):
        find_skin(*sphere(8))


def test_a_mask_out_of_range_is_refused() -> None:
    with pytest.raises(InputError, match="mask: got vertex 99999"):
        find_skin(*sphere(), masked=[99999])


@pytest.mark.parametrize(
    ("extent", "unit"), [(1.7, "m"), (172.0, "cm"), (1720.0, "mm"), (0.5, "m"), (55, "cm")]
)
def test_the_unit_follows_from_the_height(extent: float, unit: str) -> None:
    assert find_unit(extent) == unit


@pytest.mark.parametrize("extent", [17.0, 0.02, 9000.0])
def test_a_size_that_no_unit_explains_is_refused(extent: float) -> None:
    with pytest.raises(InputError, match=f"got a longest side of {extent:.4g}"):
        find_unit(extent)


def test_a_frame_and_its_way_back() -> None:
    frame = Frame(unit="cm", up="+z", forward="-y", centre=(1.0, 2.0, 3.0))
    points = np.random.default_rng(0).standard_normal((9, 3))
    np.testing.assert_allclose(frame.to_native(frame.to_canonical(points)), points, atol=1e-12)
    np.testing.assert_allclose(frame.to_canonical(np.array([[1.0, 2.0, 103.0]])), [[0, 1, 0]], atol=1e-12)
