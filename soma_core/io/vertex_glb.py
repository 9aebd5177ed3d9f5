"""Vertices of an animated GLB mesh: skinned, morphed or both."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy.sparse

from soma_core.errors import AssetError
from soma_core.io.glb_animation import NodeTracks
from soma_core.io.glb_file import GlbFile
from soma_core.io.vertex_sequence import VertexSequence, even_rate

__all__ = ["GlbSequence"]

_Result = TypeVar("_Result")

_MOST_TRANSFORMS = 400_000
"""Of nodes at times, in memory at once."""

_DAMAGE = (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError, struct.error)


class GlbSequence(VertexSequence):
    """World positions of the one mesh in the file; metres and +Y up, as glTF demands.

    Files that this project wrote say how many vertices are canonical; the copies for texture seams that
    follow them are left out. Files of other programs give all vertices.

    Args:
        path: a ``.glb`` with one mesh of one primitive and at most one animation, not compressed.

    Raises:
        AssetError: damaged, or of a kind that is not read; the cause says which.
        InputError: keys at uneven times.
    """

    def __init__(self, path: Path) -> None:
        mesh, tracks = _checked(path, lambda: _open(path))
        self._mesh, self._tracks = mesh, tracks
        self._times = tracks.times if len(tracks.times) else np.zeros(1)
        super().__init__(
            path,
            len(self._times),
            mesh.vertex_count,
            fps=even_rate(path, self._times),
            metres=1.0,
            up="+y",
        )

    def _read(self, start: int, stop: int) -> np.ndarray:
        times = self._times[start:stop]
        return _checked(self.path, lambda: self._mesh.at(self._tracks, times))


def _checked(path: Path, read: Callable[[], _Result]) -> _Result:
    """Call `read`; what a malformed file makes it raise becomes an error that names the file."""
    try:
        return read()
    except _DAMAGE as error:
        cause = f"no usable GLB ({error.__class__.__name__}: {error})"
        fix = "Export the body alone as one mesh with one animation, uncompressed."
        raise AssetError(path, cause=cause, fix=fix) from error


def _open(path: Path) -> tuple[_MovingMesh, NodeTracks]:
    file = GlbFile(path)
    tracks = NodeTracks(file)
    return _MovingMesh(file, _mesh_node(file.document)), tracks


def _mesh_node(document: dict[str, Any]) -> int:
    """Index of the node that holds the only mesh, or the only skinned one."""
    found = [index for index, node in enumerate(document["nodes"]) if "mesh" in node]
    skinned = [index for index in found if "skin" in document["nodes"][index]]
    chosen = skinned or found
    if len(chosen) != 1:
        raise ValueError(f"it holds {len(chosen)} meshes, expected one")
    return chosen[0]


class _MovingMesh:
    """Positions, morph targets and skin of one mesh node."""

    def __init__(self, file: GlbFile, node: int) -> None:
        document = file.document
        self._node = node
        primitives = document["meshes"][document["nodes"][node]["mesh"]]["primitives"]
        shared = {primitive["attributes"]["POSITION"] for primitive in primitives}
        if len(shared) != 1:
            raise ValueError(f"its mesh is cut into {len(shared)} parts")
        primitive = primitives[0]
        kept = slice(_canonical_count(document))
        self._rest = file.accessor(primitive["attributes"]["POSITION"])[kept].astype(np.float64)
        self.vertex_count = len(self._rest)
        targets = primitive.get("targets", ())
        file.check_expansion(24 * len(targets) * self.vertex_count, f"{len(targets)} morph targets")
        self._targets = np.array([file.accessor(each["POSITION"])[kept] for each in targets], np.float64)
        self._joints = np.empty(0, int)
        if "skin" in document["nodes"][node]:
            self._read_skin(file, document["skins"][document["nodes"][node]["skin"]], primitive, kept)

    def _read_skin(self, file: GlbFile, skin: dict[str, Any], primitive: dict[str, Any], kept: slice) -> None:
        self._joints = np.array(skin["joints"], np.int64)
        count = len(self._joints)
        if count and not 0 <= self._joints.min() <= self._joints.max() < len(file.document["nodes"]):
            raise ValueError("its skin has joints that are no nodes")
        inverse = np.tile(np.eye(4), (count, 1, 1))
        if "inverseBindMatrices" in skin:
            inverse = file.accessor(skin["inverseBindMatrices"]).astype(np.float64)
        self._inverse_bind = inverse
        self._weights = scipy.sparse.csr_array((self.vertex_count, count))
        rows = np.repeat(np.arange(self.vertex_count), 4)
        for name, index in primitive["attributes"].items():
            if name.startswith("JOINTS_"):
                ids = file.accessor(index)[kept].astype(np.int64).ravel()
                if len(ids) and ids.max() >= count:
                    raise ValueError(f"its skin has {count} joints, and vertices that hang on others")
                values = file.fractions(primitive["attributes"][name.replace("JOINTS", "WEIGHTS")])[kept]
                pairs = (values.astype(np.float64).ravel(), (rows, ids))
                self._weights = self._weights + scipy.sparse.csr_array(pairs, shape=self._weights.shape)
        self._weights.eliminate_zeros()

    def at(self, tracks: NodeTracks, times: np.ndarray) -> np.ndarray:
        """World positions (times, vertices, 3) float32."""
        morphs = tracks.weights(self._node, times, len(self._targets))
        nodes = [self._node, *map(int, self._joints)]
        found = np.empty((len(times), self.vertex_count, 3), np.float32)
        some = max(_MOST_TRANSFORMS // len(nodes), 1)
        worlds = (tracks.worlds(times[at : at + some], nodes) for at in range(0, len(times), some))
        for frame, world in enumerate(itertools.chain.from_iterable(worlds)):
            rest = self._rest
            if len(self._targets):
                rest = rest + np.tensordot(morphs[frame], self._targets, 1)
            found[frame] = self._placed(rest, world)
        return found

    def _placed(self, rest: np.ndarray, world: np.ndarray) -> np.ndarray:
        """Put vertices into the world by the skin, if there is one, else by the node, which comes first."""
        if not len(self._joints):
            return rest @ world[0, :3, :3].T + world[0, :3, 3]
        transforms = world[1:] @ self._inverse_bind
        blended = (self._weights @ transforms[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        return np.einsum("vab,vb->va", blended[:, :, :3], rest) + blended[:, :, 3]


def _canonical_count(document: dict[str, Any]) -> int | None:
    """How many vertices lead those of our own files; None for other files."""
    extras = document["asset"].get("extras")
    count = extras.get("canonical_vertex_count") if isinstance(extras, dict) else None
    return count if isinstance(count, int) else None
