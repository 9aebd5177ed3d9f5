"""What files and settings that are typed on the page mean, and how their names are shown there."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.errors import InputError
from soma_core.io.vertex_files import open_vertex_sequence
from soma_core.io.vertex_sequence import VertexSequence
from soma_core.layer import SomaLayer
from soma_core.motion.files import layout_of
from soma_core.motion.models import TransferredSequence
from soma_core.motion.options import ConvertOptions
from soma_core.motion.posed_input import PosedInput
from soma_core.plugin.spec import BackendSpec
from soma_core.topology.frames import METRES, native_to_canonical

__all__ = ["escaped", "holds_motion", "recorded", "settings_of"]

_MESHES = (".npy", ".glb", ".usd", ".usda", ".usdc", ".usdz")
"""Files whose vertices are compared, though some have a skeleton too."""


def escaped(name: str) -> str:
    """A name as text of Markdown: HTML, pictures and links in names of strangers are shown, not made."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(name.split()))


def holds_motion(path: Path) -> bool:
    """Whether a file is a motion rather than vertices over time.

    Raises:
        AssetError: it is missing or damaged.
    """
    return not path.is_dir() and path.suffix.lower() not in _MESHES and layout_of(path) is not None


def recorded(path: Path, layer: SomaLayer, settings: ConvertOptions) -> VertexSequence:
    """Vertices of a file on the canonical mesh [m], +Y up; it stays open.

    Raises:
        SomaError: it cannot be read, or has other vertices than the layer and its backend.
    """
    sequence = open_vertex_sequence(path, fps=settings.fps, unit=settings.unit_name, up=settings.upward)
    try:
        posed = PosedInput(sequence, layer, topology="auto")
        placed = _Placed(sequence, posed, layer.spec)
    except BaseException:
        sequence.close()
        raise
    return placed if posed.topology == "canonical" else TransferredSequence(placed, layer.backend)


def settings_of(text: str) -> ConvertOptions:
    """Settings of a conversion from ``key=value key=value``.

    Raises:
        InputError: one that there is not, or a value that it has not.
    """
    given: dict[str, Any] = {}
    for word in text.split():
        key, sign, value = word.partition("=")
        if not sign or key not in ConvertOptions.__dataclass_fields__:
            raise InputError(
                "settings", got=word, expected="settings of soma convert, as fps=30 or unit=cm",
                fix="Correct the word, or take it out.",
            )  # fmt: skip
        try:
            given[key] = json.loads(value)
        except ValueError:
            given[key] = value
    return ConvertOptions(**given)


class _Placed(VertexSequence):
    """Vertices of a sequence in metres, +Y up, whatever the mesh."""

    def __init__(self, sequence: VertexSequence, posed: PosedInput, spec: BackendSpec) -> None:
        count = posed.read(0, 1).shape[1]
        super().__init__(sequence.path, sequence.frame_count, count, fps=sequence.fps, metres=1.0, up="+y")
        native = native_to_canonical(spec.up, spec.forward) * METRES[spec.unit]
        self._posed, self._axes = posed, np.eye(3) if posed.topology == "canonical" else native

    def _read(self, start: int, stop: int) -> np.ndarray:
        return np.ascontiguousarray(self._posed.read(start, stop) @ self._axes.T)
