"""A complete small backend around the synthetic body: every check applies to it, and it passes them all."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from soma_core.plugin import BackendSpec, FileNeeded, Parameter, WrapPair, hookimpl

FOLDER = Path(__file__).parent


@dataclass
class Options:
    """How far the belly goes."""

    strength: float = 1.0


@hookimpl
def soma_backend():
    return BackendSpec(
        name="specimen",
        api=2,
        unit="cm",
        up="+z",
        forward="-y",
        wrap=WrapPair(native=FOLDER / "native.obj", wrap=FOLDER / "wrap.obj"),
        params=(
            Parameter(name="shape", shape=(4,), description="four directions, in standard deviations"),
            Parameter(name="size", default=1.0, range=(0.8, 1.2), description="factor of the stature"),
            Parameter(name="belly", range=(-1.0, 1.0), group="local", description="-1 flat, 1 round"),
        ),
        fill_segments=("mouth_bag", "eye_bags"),
        files=(
            FileNeeded(path=FOLDER / "model.txt", description="the model", url="https://example.org/model"),
        ),
        options=Options,
        licence="CC0-1.0",
        description="a body of formulas",
    )


@hookimpl
def soma_generator(spec, device, dtype, options):
    from soma_backend_specimen._generator import Specimen

    return Specimen(spec.wrap.native, options.strength, device=device, dtype=dtype)


@hookimpl
def soma_checks():
    from soma_backend_specimen._checks import taller

    return [taller]


@hookimpl
def soma_motions():
    from soma_backend_specimen._motion import FORMAT

    return [FORMAT]
