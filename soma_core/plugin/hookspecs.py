"""The pluggy hooks of a SOMA backend plugin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pluggy

from soma_core.plugin.checks import Check
from soma_core.plugin.spec import BackendSpec, Generator, MotionFormat

if TYPE_CHECKING:
    import torch

__all__ = [
    "ENTRY_POINT_GROUP",
    "PROJECT",
    "hookimpl",
    "hookspec",
    "soma_backend",
    "soma_checks",
    "soma_convert",
    "soma_generator",
    "soma_motions",
]

PROJECT = "soma"
ENTRY_POINT_GROUP = "soma_core.backends"

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec(firstresult=True)
def soma_backend() -> BackendSpec:  # type: ignore[empty-body]
    """Declare the backend. Imports neither torch nor the native model."""


@hookspec(firstresult=True)
def soma_generator(  # type: ignore[empty-body]
    spec: BackendSpec, device: torch.device, dtype: torch.dtype, options: Any
) -> Generator:
    """Build the native generator on `device` with floating type `dtype`.

    `options` is an instance of the dataclass that the declaration names, checked; None where it names none.
    A plugin of api 1 gets its fields as a dictionary.
    """


@hookspec
def soma_checks() -> Sequence[Check]:  # type: ignore[empty-body]
    """Give further conformance checks of this backend, besides those of the core. Optional."""


@hookspec(firstresult=True)
def soma_convert(source: Path, output: Path | None) -> Sequence[Path]:  # type: ignore[empty-body]
    """Turn a file of the model's makers into what the backend reads, and return what was written. Optional.

    `output` is the file to write; None leaves the choice to the plugin.
    """


@hookspec
def soma_motions() -> Sequence[MotionFormat]:  # type: ignore[empty-body]
    """Name the motion files that ``soma convert`` reads or writes with this backend. Optional."""
