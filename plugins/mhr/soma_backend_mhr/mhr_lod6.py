"""The backend mhr_lod6: MHR at LOD 6."""

from __future__ import annotations

from typing import TYPE_CHECKING

from soma_backend_mhr._backend import MhrOptions, build, declare
from soma_backend_mhr._files import LOD6
from soma_core.plugin import BackendSpec, Generator, hookimpl

if TYPE_CHECKING:
    import torch

__all__ = ["soma_backend", "soma_generator"]


@hookimpl
def soma_backend() -> BackendSpec:
    """Declare MHR at LOD 6."""
    return declare(LOD6)


@hookimpl
def soma_generator(device: torch.device, dtype: torch.dtype, options: MhrOptions) -> Generator:
    """Build MHR at LOD 6 from the user's file."""
    return build(LOD6, device, dtype, options)
