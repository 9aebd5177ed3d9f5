"""The backend smpl: SMPL."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from soma_backend_smpl._backend import SmplOptions, build, convert, declare
from soma_backend_smpl.family import SMPL
from soma_core.plugin import BackendSpec, Generator, hookimpl

if TYPE_CHECKING:
    import torch

__all__ = ["soma_backend", "soma_convert", "soma_generator"]


@hookimpl
def soma_backend() -> BackendSpec:
    """Declare SMPL."""
    return declare(SMPL)


@hookimpl
def soma_generator(
    spec: BackendSpec, device: torch.device, dtype: torch.dtype, options: SmplOptions
) -> Generator:
    """Build SMPL from the user's file."""
    return build(SMPL, spec, device, dtype, options)


@hookimpl
def soma_convert(source: Path, output: Path | None) -> Sequence[Path]:
    """Write a clean file of an official one."""
    return convert(SMPL, source, output)
