"""The two published files: their sizes, their hashes, and where they and their wrap pairs lie."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from soma_core.plugin import WrapPair, model_folders

__all__ = ["EXPRESSIONS", "IDENTITY", "JOINTS", "LOD1", "LOD6", "PARAMETERS", "VERTEX_COUNTS", "Lod"]

IDENTITY, PARAMETERS, EXPRESSIONS, JOINTS = 45, 204, 72, 127
"""Widths of the three inputs of a file, and joints of the skeleton that it returns."""

_FOLDER = "MHR"

VERTEX_COUNTS = (73639, 18439, 10661, 4899, 2461, 971, 595)
"""Vertices of MHR by LOD."""


@dataclass(frozen=True, kw_only=True)
class Lod:
    """One of the two meshes that TorchScript files are published for.

    Attributes:
        number: the LOD.
        name: name of its backend.
        hashes: SHA-256 of each published file.
        size: how large that file is, for people.
        models: names that the file goes by.
        pairs: (native mesh, wrap) in the model's folder; an official pair first, last the one that
            ``soma wrap`` writes.
    """

    number: int
    name: str
    hashes: tuple[str, ...]
    size: str
    models: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]

    @property
    def vertex_count(self) -> int:
        """Vertices of the mesh."""
        return VERTEX_COUNTS[self.number]

    def model(self) -> Path:
        """The model's file; the place of the first name where there is none."""
        folders = model_folders(_FOLDER)
        files = [path for folder in folders if folder.is_dir() for path in folder.iterdir()]
        names = {path.name.lower(): path for path in reversed(files)}
        return next((names[name] for name in self.models if name in names), folders[0] / self.models[0])

    def pair(self) -> WrapPair:
        """The first pair that is complete, or the place of the last."""
        folders = model_folders(_FOLDER)
        pairs = [WrapPair(native=folder / a, wrap=folder / b) for folder in folders for a, b in self.pairs]
        complete = (pair for pair in pairs if pair.native.is_file() and pair.wrap.is_file())
        return next(complete, pairs[len(self.pairs) - 1])


LOD1 = Lod(
    number=1,
    name="mhr",
    hashes=("352e271a6c42729c68554ceaea0c955e866970160c31e35506d782dc0f7377bc",),
    size="696 MB",
    models=("mhr_model_lod1.pt", "mhr_model.pt"),
    pairs=(
        ("base_body_lod1.obj", "SOMA_wrap_lod1.obj"),
        ("mhr_neutral_lod1.obj", "SOMA_wrap.obj"),  # made of the published mesh, without the model
        ("mhr_neutral.obj", "SOMA_wrap.obj"),
    ),
)
LOD6 = Lod(
    number=6,
    name="mhr_lod6",
    hashes=("28839b7ee0eb38eb3943cf26cff61a306de78f86227a0f17bb044252c7bc06ac",),
    size="2 MB",
    models=("mhr_model_lod6.pt",),
    pairs=(
        ("base_body_lod6.obj", "SOMA_wrap_lod1.obj"),
        ("lod6/mhr_lod6_neutral.obj", "lod6/SOMA_wrap.obj"),
    ),
)
