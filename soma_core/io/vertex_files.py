"""Open vertices over time, whatever file they are in; the suffix tells the format."""

from __future__ import annotations

import math
from pathlib import Path

from soma_core.errors import InputError
from soma_core.files import refuse_unreadable
from soma_core.io.npz_fields import say_overridden
from soma_core.io.vertex_arrays import open_npy, open_npz_vertices
from soma_core.io.vertex_folder import FolderSequence
from soma_core.io.vertex_glb import GlbSequence
from soma_core.io.vertex_sequence import UpAxis, VertexSequence
from soma_core.io.vertex_usd import UsdSequence
from soma_core.paths import expanded
from soma_core.topology.frames import METRES

__all__ = ["open_vertex_sequence"]

_READERS = {".npz": open_npz_vertices, ".npy": open_npy, ".glb": GlbSequence}
_USD = (".usd", ".usda", ".usdc", ".usdz")


def open_vertex_sequence(
    path: str | Path,
    *,
    fps: float | None = None,
    unit: str | None = None,
    up: UpAxis | None = None,
    allow_references: bool = False,
) -> VertexSequence:
    """Open the vertices of a mesh over time; frames are read when they are asked for.

    Args:
        path: an ``.npz`` or ``.npy`` array (frames, n, 3), a folder of OBJ or PLY meshes, a ``.usd`` or
            ``.glb`` with one animated mesh. Nothing in a file is executed.
        fps: frame rate; overrides the file's own.
        unit: length unit; overrides the file's own.
        up: upward axis; overrides the file's own.
        allow_references: let a USD file refer to what lies outside of its folder.

    Raises:
        AssetError: the file is missing, damaged or a git-LFS pointer.
        InputError: a format or a layout that is not read, or a frame rate that is not positive.
    """
    path = expanded(path)
    said = [name for name, value in (("unit", unit), ("up", up)) if value is not None]
    sequence = _open(path, said, allow_references=allow_references)
    metres = sequence.metres
    length = next((name for name, each in METRES.items() if each == metres), metres and f"{metres:g} m")
    asked = {"fps": (fps, sequence.fps), "unit": (unit, length), "up": (up, sequence.up)}
    for name, (given, own) in asked.items():
        if given is not None and own is not None:
            say_overridden(path, name, given=given, own=own)
    if fps is not None:
        sequence.fps = float(fps)
    if sequence.fps is not None and not (math.isfinite(sequence.fps) and sequence.fps > 0):
        rate = sequence.fps
        sequence.close()
        raise InputError(
            "fps", got=f"{rate:g}", expected="a positive number", fix="Give the frames per second."
        )
    if unit is not None:
        sequence.metres = METRES[unit]
    if up is not None:
        sequence.up = up
    return sequence


def _open(path: Path, said: list[str], *, allow_references: bool) -> VertexSequence:
    if path.is_dir():
        return FolderSequence(path)
    refuse_unreadable(path)
    if path.suffix.lower() in _USD:
        return UsdSequence(path, allow_references=allow_references)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(
            str(path),
            got=f"the suffix {path.suffix!r}",
            expected=f"{', '.join((*_READERS, *_USD))} or a folder of .obj or .ply files",
            fix="Export the vertices in one of these formats.",
        )
    return reader(path, said) if reader is open_npz_vertices else reader(path)
