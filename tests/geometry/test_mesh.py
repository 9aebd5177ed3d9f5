import numpy as np
import pytest

from soma_core.geometry.mesh import split_polygons


@pytest.mark.parametrize(("stretch", "diagonal"), [(0.5, {0, 2}), (2.0, {1, 3})])
def test_quads_split_along_the_shorter_diagonal(stretch, diagonal):
    kite = np.array([[-1.0, 0, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0]]) * [stretch, 1, 1]
    triangles = split_polygons(np.arange(4), np.array([4]), kite)
    assert set(triangles[0]) & set(triangles[1]) == diagonal
    normals = np.cross(
        kite[triangles[:, 1]] - kite[triangles[:, 0]], kite[triangles[:, 2]] - kite[triangles[:, 0]]
    )
    assert (normals[:, 2] > 0).all()
