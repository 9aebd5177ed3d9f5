"""Posed vertices for a fit: which mesh they are, and their way into the unit and axes that it expects."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from soma_core.choices import Topology
from soma_core.errors import InputError
from soma_core.io.vertex_sequence import UpAxis, VertexSequence
from soma_core.rig import load_canonical
from soma_core.topology.correspondence import load_correspondence
from soma_core.topology.frames import METRES, METRIC, native_to_canonical

if TYPE_CHECKING:
    from soma_core.layer import SomaLayer
    from soma_core.plugin.spec import Axis
    from soma_core.skeleton.identity import Identity

__all__ = ["PosedInput", "world_axes"]

_FORWARD: dict[str, Axis] = {
    "+y": "+z", "+z": "-y", "-y": "-z", "-z": "+y", "+x": "+z", "-x": "+z",
}  # fmt: skip
"""Where a body looks whose file says only which way is up: -Y up is a camera's view of one who faces it."""

_NEARBY = 4
"""How many frames are looked at for one without gaps."""

_SAME_SIZE, _OTHER_AGE = 3.0, 5.0
"""A body curls up to half its extent; three times more or less is another unit, if there is one that fits, or
an adult in place of a newborn, and five times no body."""


_RARE = 1.3
"""How close inches and feet must be, to be taken for the unit: a child in centimetres is larger in inches."""


class PosedInput:
    """Vertices of a sequence in the mesh, unit and axes that ``PoseInversion`` takes.

    Args:
        sequence: where they come from. It stays open.
        layer: the backend, the level of detail and the canonical mesh.
        topology: ``canonical``, ``native``, or ``auto`` to tell them apart by their vertex count.

    Raises:
        InputError: a vertex count that is neither, or both; a unit that the file does not say.
    """

    def __init__(self, sequence: VertexSequence, layer: SomaLayer, *, topology: Topology | str) -> None:
        self.sequence, self._spec = sequence, layer.spec
        counts = _vertex_counts(layer)
        found = _told_apart(sequence, layer, counts) if topology == "auto" else Topology(topology)
        _check_count(sequence, layer, counts, found)
        self.topology = found
        self._kept = slice(None)
        if found == "canonical":
            self._frame = _canonical_frame(sequence)
            if sequence.vertex_count != layer.mesh.vertex_count:
                self._kept = layer.mesh.mid_ids
        else:
            self._frame = _native_frame(sequence, layer)

    def read(self, start: int, stop: int) -> np.ndarray:
        """Vertices (stop - start, n, 3) float32 or float64 of a range of frames."""
        vertices = self.sequence.read(start, stop)[:, self._kept]
        if np.array_equal(self._frame, np.eye(3)):
            return vertices
        return vertices @ self._frame.T.astype(vertices.dtype)

    @property
    def axes(self) -> np.ndarray:
        """Rotation (3, 3) from the axes of the file to +Y up, +Z forward."""
        spec = self._spec
        native = native_to_canonical(spec.up, spec.forward) if self.topology == "native" else np.eye(3)
        turn: np.ndarray = native @ self._frame
        return turn / np.cbrt(np.linalg.det(turn))

    def spread(self, count: int, among: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Up to `count` frames, evenly spread; one with gaps gives way to a neighbour without.

        Args:
            count: how many.
            among: numbers of the frames to choose from, ascending; None for all.

        Returns:
            Numbers (n,) of the frames, and their vertices (n, v, 3).
        """
        frames = np.arange(self.sequence.frame_count) if among is None else among
        places = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int))
        numbers, kept = [], []
        for place, end in zip(places, [*places[1:], len(frames)], strict=True):
            number, vertices = self._whole(frames[place : min(end, place + _NEARBY)])
            numbers.append(number)
            kept.append(vertices)
        return np.array(numbers), np.concatenate(kept)

    def _whole(self, frames: np.ndarray) -> tuple[int, np.ndarray]:
        """The first of some frames without gaps, or the first of them."""
        first = self.read(int(frames[0]), int(frames[0]) + 1)
        found = int(frames[0]), first
        for frame in frames[1:].tolist():
            if np.isfinite(found[1]).all():
                return found
            found = frame, self.read(frame, frame + 1)
        return found if np.isfinite(found[1]).all() else (int(frames[0]), first)

    def check_size(self, layer: SomaLayer, identity: Identity) -> None:
        """Refuse a body of another size than its identity, if another unit would do better.

        The usual mistake is a unit wrong by 100. An adult is three to four times as large as a newborn,
        and a fit says so.

        Raises:
            InputError: another unit fits where the size is off threefold, or none where it is off fivefold.
        """
        unit = METRES[layer.spec.unit] if self.topology == "native" else 1.0
        expected = _extent(identity.fitted_rest[:1].detach().cpu().double().numpy())[0]
        sizes = unit * _extent(self.read(0, min(8, self.sequence.frame_count)))
        sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
        if not len(sizes) or 1 / _SAME_SIZE < sizes[0] / expected < _SAME_SIZE:
            return
        told = _metres(self.sequence, layer, self.topology)
        name = next((unit for unit, metres in METRES.items() if metres == told), f"units of {told:g} m")
        off = {unit: abs(np.log(sizes[0] / told * metres / expected)) for unit, metres in METRES.items()}
        fitting = min(
            (unit for unit in METRES if unit in METRIC or off[unit] < np.log(_RARE)),
            key=lambda unit: off[unit],
        )
        close = off[fitting] < np.log(_SAME_SIZE)
        if not close and abs(np.log(sizes[0] / expected)) < np.log(_OTHER_AGE):
            return
        mend = f"If the file is in {fitting}, pass unit={fitting}"
        other = "No unit fits: look at backend= and its parameters, or at the scale of the export"
        raise InputError(
            str(self.sequence.path),
            got=f"a body {sizes[0] / expected:.3g} times as large as its identity, for lengths in {name}",
            expected="about the same size",
            fix=f"{mend if close else other}.",
        )


def _vertex_counts(layer: SomaLayer) -> dict[str, int]:
    """Vertex counts that mean something: the canonical LODs and the native mesh."""
    mid = layer.mesh if layer.mesh.lod == "mid" else load_canonical("mid")[0]
    native = mid.vertex_count
    if layer.spec.wrap is not None:
        native = load_correspondence(layer.spec.wrap, mid).native_count
    low = layer.mesh if layer.mesh.lod == "low" else load_canonical("low")[0]
    return {"native": native, "mid": mid.vertex_count, "low": low.vertex_count}


def _told_apart(sequence: VertexSequence, layer: SomaLayer, counts: dict[str, int]) -> Topology:
    """Topology that the vertex count tells."""
    count = sequence.vertex_count
    canonical, native = count in (counts["mid"], counts["low"]), count == counts["native"]
    if canonical and native and (layer.spec.wrap is not None or sequence.metres is None):
        raise InputError(
            "topology",
            got=f"{count} vertices, which the canonical mesh and {layer.backend!r} both have",
            expected="topology=canonical or topology=native",
            fix=f"native means the backend's unit and axes: {layer.spec.unit}, {layer.spec.up} up.",
        )
    return Topology.native if native and not canonical else Topology.canonical


def _check_count(
    sequence: VertexSequence, layer: SomaLayer, counts: dict[str, int], topology: Topology
) -> None:
    """Refuse vertices that are not those of the mesh."""
    count, lod = sequence.vertex_count, layer.mesh.lod
    wanted = (counts["native"],) if topology == "native" else (counts["mid"], counts["low"])
    if count not in wanted:
        known = ", ".join(f"{number} ({name})" for name, number in counts.items())
        turned = sequence.frame_count in counts.values()
        raise InputError(
            str(sequence.path),
            got=f"{count} vertices",
            expected=f"one of {known} for backend {layer.backend!r}",
            fix="Frames and vertices are exchanged: save np.ascontiguousarray(vertices.transpose(1, 0, 2))."
            if turned
            else "Pass backend=NAME of their model; export each vertex once, neither merged nor split.",
        )
    if topology == "canonical" and lod == "mid" and count != counts["mid"]:
        raise InputError(
            str(sequence.path),
            got=f"{count} vertices, the low level of detail",
            expected=f"{counts['mid']} for lod=mid",
            fix="Pass lod=low.",
        )


def _metres(sequence: VertexSequence, layer: SomaLayer, topology: Topology) -> float:
    """Length of the file's unit [m]; of native vertices the backend's, where the file does not say."""
    if sequence.metres is not None:
        return sequence.metres
    return METRES[layer.spec.unit] if topology == "native" else 1.0


def world_axes(up: UpAxis) -> np.ndarray:
    """Rotation (3, 3) from a world of which only the upward axis is known to +Y up, +Z forward."""
    return native_to_canonical(up, _FORWARD[up])


def _canonical_frame(sequence: VertexSequence) -> np.ndarray:
    """Matrix (3, 3) from the file to metres, +Y up."""
    if sequence.metres is None:
        raise InputError(
            "unit",
            got=f"none in {sequence.path.name}",
            expected="m, cm or mm",
            fix="Pass unit=m (or the true unit).",
        )
    return sequence.metres * world_axes(sequence.up or "+y")


def _native_frame(sequence: VertexSequence, layer: SomaLayer) -> np.ndarray:
    """Matrix (3, 3) from the file to the backend's unit and axes, which also count where it says nothing."""
    spec = layer.spec
    scale = _metres(sequence, layer, "native") / METRES[spec.unit]
    if sequence.up in (None, spec.up):
        return scale * np.eye(3)
    return scale * native_to_canonical(spec.up, spec.forward).T @ world_axes(sequence.up)


def _extent(vertices: np.ndarray) -> np.ndarray:
    """Root mean square distance of the vertices (frames, n, 3) from their centre, (frames,)."""
    centred = vertices - vertices.mean(axis=1, keepdims=True)
    return np.sqrt((centred.astype(np.float64) ** 2).sum(axis=2).mean(axis=1))
