"""The `soma` backend: the native PCA shape space on the canonical mesh (paper, section 3.2).

It is found, declared and built through the same hooks as every other backend.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soma_core.errors import AssetError
from soma_core.npz import open_npz_file
from soma_core.paths import assets_dir, expanded
from soma_core.plugin.hookspecs import hookimpl
from soma_core.plugin.spec import BackendSpec, Generator, LinearBasis, Parameter
from soma_core.rig.manifest import RESTORE

if TYPE_CHECKING:
    import torch
    from torch import Tensor

__all__ = ["NativeGenerator", "NativeOptions", "component_count", "soma_backend", "soma_generator"]

_FILE = "SOMA_neutral.npz"


def component_count(path: Path) -> int:
    """Read the number of components from the header of one array; the arrays themselves stay unread.

    Raises:
        AssetError: the file is missing, damaged, or holds no shape space.
    """
    with open_npz_file(path, fix=RESTORE) as file:
        try:
            (count,) = file.header("eigenvalues").shape
        except (KeyError, ValueError) as error:
            cause = f"no shape space can be read ({type(error).__name__}: {error})"
            raise AssetError(path, cause=cause, fix=RESTORE) from error
    return int(count)


@dataclass(frozen=True, kw_only=True)
class NativeOptions:
    """Options of the native backend.

    Attributes:
        shape_space: another file in the layout of ``SOMA_neutral.npz``; None is the shipped one. Its
            leading components are used; missing ones leave the body unchanged.
    """

    shape_space: str | None = None


@hookimpl
def soma_backend() -> BackendSpec:
    """Declare the native shape space: centimetres, +Y up, +Z forward, already on the canonical mesh."""
    count = component_count(assets_dir() / _FILE)
    return BackendSpec(
        name="soma",
        api=2,
        unit="cm",
        up="+y",
        forward="+z",
        wrap=None,
        params=(
            Parameter(
                name="shape",
                shape=(count,),
                description="coefficients in standard deviations; a shorter list is padded with zeros",
            ),
        ),
        options=NativeOptions,
        licence="Apache-2.0",
        description=f"the native shape space, {count} components",
    )


@hookimpl
def soma_generator(
    spec: BackendSpec, device: torch.device, dtype: torch.dtype, options: NativeOptions
) -> Generator:
    """Build the generator from the shipped shape space, or from the one that the options name."""
    from soma_core.rig.neutral import load_shape_space

    path = options.shape_space
    space = load_shape_space(expanded(path) if path else None)
    scaled = np.sqrt(space.eigenvalues.astype(np.float64))[:, None] * space.shapedirs
    (count,) = spec.params[0].shape
    directions = scaled[:count].reshape(-1, *space.mean.shape)
    if len(directions) < count:
        missing = np.zeros((count - len(directions), *space.mean.shape))
        directions = np.concatenate((directions, missing))
    return NativeGenerator(space.mean, directions, device=device, dtype=dtype)


class NativeGenerator:
    """A linear shape space: ``mean + shape @ directions``, in centimetres.

    Args:
        mean: (v, 3) [cm].
        directions: (k, v, 3) [cm], one standard deviation each; k may be 0.
        device: where the tensors live.
        dtype: floating type of the tensors.
    """

    def __init__(
        self, mean: np.ndarray, directions: np.ndarray, *, device: torch.device, dtype: torch.dtype
    ) -> None:
        import torch

        self._mean = torch.from_numpy(np.array(mean)).to(device=device, dtype=dtype)
        self._directions = torch.from_numpy(directions).to(device=device, dtype=dtype)

    def rest(self, params: Mapping[str, Tensor]) -> Tensor:
        """Rest vertices (batch, v, 3) [cm] for ``shape`` (batch, k); differentiable."""
        motion = params["shape"] @ self._directions.flatten(1)
        return self._mean + motion.unflatten(-1, self._mean.shape)

    def linear_basis(self) -> LinearBasis:
        """The mean, the directions, and ``shape`` as coefficients."""
        return LinearBasis(
            template=self._mean, basis=self._directions, coefficients=lambda params: params["shape"]
        )
