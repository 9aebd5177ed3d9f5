"""Write native.obj and SOMA_wrap.obj of the toy: ``python make_wrap.py`` (some seconds).

``native.obj`` is the default figure: all its vertices, and the faces that do not lie inside the body.
``SOMA_wrap.obj`` is the canonical mesh laid on it: each vertex goes to the closest point of the outside, and
the displacements are evened out between neighbours, so that the surface does not fold where capsules meet.
``soma wrap`` is for bodies less simple.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.sparse
from soma_backend_toy._figure import SEGMENTS, Segment, figure, figure_triangles

from soma_core import load_canonical
from soma_core.plugin import ClosestFaces, closest_point_on_triangle, write_obj

FOLDER = Path(__file__).parent / "soma_backend_toy"
TO_NATIVE = 100 * np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # metres, +Y up, facing +Z, to the toy's frame
ROUNDS, SMOOTHINGS = 6, 5


def inside(points: np.ndarray, segment: Segment) -> np.ndarray:
    """Which of the points (n, 3) lie inside one capsule."""
    length = np.linalg.norm(np.subtract(segment.end, segment.start))
    along, across, front = segment.frame() @ (points - segment.start).T
    share = np.clip(along / length, 0, 1)
    radius = segment.radii[0] + share * (segment.radii[1] - segment.radii[0])
    return (along - share * length) ** 2 + across**2 + (front / segment.depth) ** 2 < 0.99 * radius**2


def outside() -> tuple[np.ndarray, np.ndarray]:
    """All vertices of the figure, and the triangles that do not lie within one of its capsules."""
    vertices, triangles = figure(), figure_triangles()
    hidden = [inside(vertices, segment)[triangles].all(1) for segment in SEGMENTS]
    return vertices, triangles[~np.any(hidden, axis=0)]


def wrapped(points: np.ndarray, neighbours: scipy.sparse.csr_array) -> np.ndarray:
    """Lay the canonical vertices (v, 3) on the outside of the figure."""
    vertices, triangles = outside()
    surface = ClosestFaces(vertices, triangles)
    wrap = points
    for _ in range(ROUNDS):
        for _ in range(SMOOTHINGS):
            wrap = points + (neighbours @ (wrap - points) + wrap - points) / 2
        wrap = closest_point_on_triangle(wrap, vertices[triangles[surface.query(wrap)]])
    return wrap


def neighbour_mean(triangles: np.ndarray) -> scipy.sparse.csr_array:
    """Matrix (v, v) that takes the mean over the neighbours of each vertex."""
    a, b, c = triangles.T
    pairs = (np.concatenate([a, b, c]), np.concatenate([b, c, a]))  # on a closed mesh, each edge both ways
    adjacency = scipy.sparse.csr_array((np.ones(len(pairs[0])), pairs))
    return scipy.sparse.diags_array(1 / adjacency.sum(1)) @ adjacency


def main() -> None:
    """Write both files into the package."""
    mesh, _ = load_canonical("mid")
    ideal = mesh.vertices @ TO_NATIVE.T
    wrap = wrapped(ideal, neighbour_mean(mesh.triangles))
    wrap[mesh.face_interior] = ideal[mesh.face_interior]  # declared in fill_segments, so never looked at
    write_obj(FOLDER / "native.obj", *outside(), digits=3)  # a hundredth of a millimetre
    write_obj(FOLDER / "SOMA_wrap.obj", wrap, mesh.triangles, digits=3)


if __name__ == "__main__":
    main()
