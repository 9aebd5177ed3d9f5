"""A body of capsules for SOMA Core: no data, few lines, every part of a backend. Read it to write your own.

``_figure`` is the shape, ``_generator`` the model, ``configs/backend/toy.yaml`` what the command line may
set, ``native.obj`` and ``SOMA_wrap.obj`` tie the shape to the canonical mesh. Listing backends imports this
module, so it stays light: torch comes in with the generator.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from soma_core.plugin import BackendSpec, Generator, Parameter, WrapPair, hookimpl

if TYPE_CHECKING:
    import torch

__all__ = ["soma_backend", "soma_generator"]

_FOLDER = Path(__file__).parent


def _factor(name: str, low: float, high: float, description: str) -> Parameter:
    return Parameter(name=name, default=1.0, range=(low, high), description=description)


@hookimpl
def soma_backend() -> BackendSpec:
    """Declare the toy: centimetres, +Z up, facing -Y; it has no mouth and no eyes."""
    return BackendSpec(
        name="toy",
        api=2,
        unit="cm",
        up="+z",
        forward="-y",
        params=(
            _factor("size", 0.6, 1.2, "factor of the whole body"),
            _factor("girth", 0.75, 1.3, "factor of the thickness of trunk and limbs"),
            _factor("legs", 0.8, 1.2, "factor of the length of the legs"),
            _factor("arms", 0.8, 1.2, "factor of the length of the arms"),
            _factor("shoulders", 0.85, 1.2, "factor of the width of the shoulders"),
            _factor("head", 0.8, 1.3, "factor of the size of the head"),
        ),
        wrap=WrapPair(native=_FOLDER / "native.obj", wrap=_FOLDER / "SOMA_wrap.obj"),
        fill_segments=("mouth_bag", "eye_bags"),
        licence="Apache-2.0",
        description="a figure of capsules, made of formulas",
    )


@hookimpl
def soma_generator(device: torch.device, dtype: torch.dtype) -> Generator:
    """Build the generator; a hook takes those of spec, device, dtype and options that it needs."""
    from soma_backend_toy._generator import ToyGenerator

    return ToyGenerator(device, dtype)
