import numpy as np
import pytest

from soma_core.geometry.mesh import (
    enclosed_volume,
    following_corners,
    polygon_sides,
    split_polygons,
    triangle_sides,
    unique_edges,
)


@pytest.mark.parametrize(("stretch", "diagonal"), [(0.5, {0, 2}), (2.0, {1, 3})])
def test_quads_split_along_the_shorter_diagonal(stretch, diagonal):
    kite = np.array([[-1.0, 0, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0]]) * [stretch, 1, 1]
    triangles = split_polygons(np.arange(4), np.array([4]), kite)
    assert set(triangles[0]) & set(triangles[1]) == diagonal
    normals = np.cross(
        kite[triangles[:, 1]] - kite[triangles[:, 0]], kite[triangles[:, 2]] - kite[triangles[:, 0]]
    )
    assert (normals[:, 2] > 0).all()


CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
CUBE_QUADS = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]], np.int32
)
COUNTS = np.full(6, 4, np.int32)
TRIANGLES = split_polygons(CUBE_QUADS.ravel(), COUNTS, CUBE)


def test_each_edge_of_a_closed_surface_is_met_once_each_way():
    sides = polygon_sides(CUBE_QUADS.ravel(), COUNTS)
    edges = unique_edges(sides)
    assert len(edges) == 12
    assert (edges[:, 0] < edges[:, 1]).all()
    assert edges.tolist() == sorted(edges.tolist())
    directed = {tuple(side) for side in sides.tolist()}
    assert all(side[::-1] in directed for side in directed)


def test_corners_follow_within_polygons_of_any_size():
    assert following_corners(np.array([3, 4, 1])).tolist() == [1, 2, 0, 4, 5, 6, 3, 7]


def test_sides_of_triangles_are_those_of_polygons():
    counts = np.full(len(TRIANGLES), 3)
    ours, theirs = triangle_sides(TRIANGLES), polygon_sides(TRIANGLES.ravel(), counts)
    assert sorted(ours.tolist()) == sorted(theirs.tolist())


def test_volume_turns_its_sign_with_the_faces_and_ignores_a_shift():
    assert enclosed_volume(CUBE, TRIANGLES) == pytest.approx(1)
    assert enclosed_volume(CUBE + 3, TRIANGLES) == pytest.approx(1)
    assert enclosed_volume(CUBE, TRIANGLES[:, ::-1]) == pytest.approx(-1)
