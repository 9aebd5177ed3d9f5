"""The two layers that pose inversion is measured on: what a user gets, and plain skinning."""

from __future__ import annotations

from typing import Protocol

import torch

from soma_core.layer import SomaLayer
from soma_core.rig.mesh import Lod

__all__ = ["LAYERS", "LayerMaker", "default_layer", "layer_label", "plain_layer"]


class LayerMaker(Protocol):
    """Makes the layer under test."""

    def __call__(
        self,
        backend: str,
        *,
        lod: Lod = "mid",
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> SomaLayer:
        """Make a layer of a backend."""
        ...


def default_layer(
    backend: str,
    *,
    lod: Lod = "mid",
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> SomaLayer:
    """Make the layer as it ships, with twist joints and pose correctives."""
    return SomaLayer(backend, lod=lod, device=device, dtype=dtype)


def plain_layer(
    backend: str,
    *,
    lod: Lod = "mid",
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> SomaLayer:
    """Make a layer that skins by the 78 public joints alone, as the paper's inversion and its peers do."""
    return SomaLayer(backend, lod=lod, device=device, dtype=dtype, procedural=False, correctives=None)


LAYERS: dict[str, LayerMaker] = {"default": default_layer, "plain": plain_layer}
"""Name in a table -> the layer; bounds are held against the first."""


def layer_label(layer: SomaLayer) -> str:
    """Name of a layer in a table."""
    return "plain" if layer.plain else "default"
