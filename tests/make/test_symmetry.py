import numpy as np
import pytest

from assets.make.symmetry import mirror_vertices
from soma_core.errors import InputError

# Two boxes side by side: symmetric across x = 0, with four vertices on the midline.
VERTICES = np.array([[x, y, z] for x in (-1.0, 0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
FACES = [
    [0, 1, 3, 2],
    [8, 10, 11, 9],
    *([a, a + 4, a + 5, a + 1] for a in (0, 4)),
    *([a + 2, a + 3, a + 7, a + 6] for a in (0, 4)),
    *([a, a + 2, a + 6, a + 4] for a in (0, 4)),
    *([a + 1, a + 5, a + 7, a + 3] for a in (0, 4)),
]


def test_partners_mirror_the_positions():
    mirror = mirror_vertices(FACES, VERTICES, midline=0.1)
    np.testing.assert_allclose(VERTICES[mirror], VERTICES * [-1, 1, 1])


def test_partners_do_not_depend_on_the_positions_away_from_the_midline():
    bent = VERTICES.copy()
    bent[8:] += [0.7, 0.3, -0.4]
    np.testing.assert_array_equal(
        mirror_vertices(FACES, bent, midline=0.1), mirror_vertices(FACES, VERTICES, midline=0.1)
    )


def test_a_mesh_with_unlike_sides_is_refused():
    lopsided = [face for face in FACES if face != [8, 10, 11, 9]] + [[8, 10, 11], [8, 11, 9]]
    with pytest.raises(InputError, match="11 faces"):
        mirror_vertices(lopsided, VERTICES, midline=0.1)
