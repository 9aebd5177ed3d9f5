"""Declaring and building: the same for both LODs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from soma_backend_mhr._files import IDENTITY, Lod
from soma_core.plugin import BackendSpec, FileNeeded, Generator, Parameter

if TYPE_CHECKING:
    import torch

__all__ = ["URL", "MhrOptions", "build", "declare"]

URL = "https://github.com/facebookresearch/MHR"


@dataclass(frozen=True, kw_only=True)
class MhrOptions:
    """Options of both backends.

    Attributes:
        trust: open a model file that is not the published one. TorchScript runs code: only for files whose
            maker you know.
    """

    trust: bool = False


def declare(lod: Lod) -> BackendSpec:
    """Declare MHR at one LOD, and the files that are needed."""
    pair = lod.pair()
    command = f"soma wrap backend={lod.name} out={pair.wrap.parent}"
    return BackendSpec(
        name=lod.name,
        api=2,
        unit="cm",
        up="+y",
        forward="+z",
        params=(
            Parameter(
                name="identity",
                shape=(IDENTITY,),
                description="shape in standard deviations: 20 of the body, 20 of the head, 5 of the hands",
            ),
            Parameter(
                name="scales",
                shape=(68,),
                range=(-0.5, 0.5),
                description="sizes of joints and bones, as powers of 2; the last of the 204 model parameters",
            ),
            Parameter(
                name="bone_lengths",
                shape=(6,),
                range=(-0.5, 0.5),
                description="of spine, neck, shoulders, arms, hips and legs; model parameters 130 to 135",
            ),
        ),
        wrap=pair,
        fill_segments=("mouth_bag", "eye_bags", "between_toes"),
        files=(
            FileNeeded(path=lod.model(), description=f"the MHR model of LOD {lod.number}", url=URL),
            FileNeeded(path=pair.native, description="its neutral mesh as OBJ", command=command),
            FileNeeded(path=pair.wrap, description="the canonical mesh laid on it", command=command),
        ),
        options=MhrOptions,
        licence="Apache-2.0",
        url=URL,
        description=f"MHR, the Momentum Human Rig, LOD {lod.number}, from the user's own file",
    )


def build(lod: Lod, device: torch.device, dtype: torch.dtype, options: MhrOptions) -> Generator:
    """Load the user's file, after its hash was checked."""
    from soma_backend_mhr._generator import MhrGenerator
    from soma_backend_mhr._model_file import load_model

    model = load_model(lod.model(), lod, device=device, dtype=dtype, trust=options.trust)
    return MhrGenerator(model, device)
