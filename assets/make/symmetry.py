"""Left/right partners of the canonical mesh, from its topology alone.

Positions are symmetric only to rounding, and a wrapped mesh is not symmetric at all, so nearest
mirrored points are no safe definition. The mesh does have an automorphism that swaps the sides:
starting from one edge of the midline, both sides are walked in lockstep.
"""

from __future__ import annotations

import numpy as np

from soma_core.errors import InputError

__all__ = ["mirror_vertices"]

_HalfEdges = dict[tuple[int, int], tuple[int, int]]


def _half_edges(faces: list[list[int]]) -> _HalfEdges:
    return {
        (face[corner], face[(corner + 1) % len(face)]): (index, corner)
        for index, face in enumerate(faces)
        for corner in range(len(face))
    }


def _walk(faces: list[list[int]], edges: _HalfEdges, seed: tuple[int, int]) -> dict[int, int] | None:
    """Walk both sides of the edge `seed` in lockstep; None when they are not mirror images."""
    partner: dict[int, int] = {}
    done: dict[int, int] = {}
    pending = [(seed, (seed[1], seed[0]))]
    while pending:
        edge, image = pending.pop()
        (face, corner), (other, other_corner) = edges[edge], edges[image]
        if face in done:
            if done[face] != other:
                return None
            continue
        done[face] = other
        left, right = faces[face], faces[other]
        size = len(left)
        if size != len(right):
            return None
        for step in range(size):
            here = left[(corner + step) % size]
            there = right[(other_corner + 1 - step) % size]
            if partner.setdefault(here, there) != there:
                return None
            following = left[(corner + step + 1) % size]
            # The far side of this edge, and of its image, comes next.
            pending.append(((following, here), (there, right[(other_corner - step) % size])))
    return partner


def mirror_vertices(faces: list[list[int]], vertices: np.ndarray, *, midline: float) -> np.ndarray:
    """Find the left/right partner of every vertex: an involution that maps faces to faces.

    Args:
        faces: polygons of a closed, connected, consistently oriented mesh.
        vertices: (v, 3), +X left; only used to find candidate edges of the midline.
        midline: largest absolute x of a vertex on the midline, in the unit of `vertices`.

    Returns:
        (v,) int32.

    Raises:
        InputError: no edge of the midline extends to a mirror automorphism.
    """
    edges = _half_edges(faces)
    on_midline = np.abs(vertices[:, 0]) <= midline
    seeds = [edge for edge in sorted(edges) if on_midline[edge[0]] and on_midline[edge[1]]]
    for seed in seeds:
        found = _walk(faces, edges, seed)
        if found is not None and len(found) == len(vertices):
            return np.array([found[vertex] for vertex in range(len(vertices))], np.int32)
    raise InputError(
        "faces",
        got=f"{len(faces)} faces whose two sides do not match at any of {len(seeds)} midline edges",
        expected="a mesh with a mirror automorphism",
        fix="Check the faces, or raise `midline` if no edge was tried.",
    )
