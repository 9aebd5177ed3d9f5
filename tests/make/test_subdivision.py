import numpy as np
import pytest

from assets.make.subdivision import recover_low
from soma_core.errors import InputError


def subdivided() -> np.ndarray:
    """One split of a tetrahedron with one corner cut into a quad face: a prism (2 triangles, 3 quads)."""
    faces = [[0, 2, 1], [3, 4, 5], [0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]]
    edges = {}
    for face in faces:
        for first, second in zip(face, face[1:] + face[:1], strict=True):
            edges.setdefault(frozenset((first, second)), 6 + len(edges))
    quads = []
    for index, face in enumerate(faces):
        for before, vertex, after in zip(face[-1:] + face[:-1], face, face[1:] + face[:1], strict=True):
            point = 6 + len(edges) + index
            quads.append(
                [edges[frozenset((before, vertex))], vertex, edges[frozenset((vertex, after))], point]
            )
    return np.array(quads, np.int32)


def test_polygons_come_back_with_their_winding():
    low = recover_low(subdivided()[::-1].copy())
    assert low.vertex_count == 6
    assert low.face_vert_counts.tolist() == [3, 3, 4, 4, 4]
    starts = np.cumsum(low.face_vert_counts) - low.face_vert_counts
    first = low.face_vert_indices[starts[2] : starts[2] + 4].tolist()
    turn = first.index(0)
    assert first[turn:] + first[:turn] == [0, 1, 4, 3]


def test_corner_quads_hold_the_low_vertex():
    quads = subdivided()
    low = recover_low(quads)
    np.testing.assert_array_equal(quads[low.corner_quads, 1], low.face_vert_indices)


def test_scrambled_corners_are_refused():
    quads = subdivided()
    quads[0, [0, 2]] = quads[0, [2, 0]]
    with pytest.raises(InputError, match=f"face point {quads[0, 3]}"):
        recover_low(quads)
