"""Motions in a backend's own pose parameters: their vertices, posed by the backend when they are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.backends.parameters import batch_parameters
from soma_core.errors import InputError
from soma_core.inversion import PoseInversion
from soma_core.io.vertex_sequence import UpAxis, VertexSequence
from soma_core.layer import SomaLayer
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import HasPosed
from soma_core.topology.frames import METRES

__all__ = ["FitBackend", "FitBackends", "ModelSequence"]


@dataclass(frozen=True, kw_only=True, eq=False)
class FitBackend:
    """A backend that poses, and the fit on its layer."""

    layer: SomaLayer
    inversion: PoseInversion
    generator: HasPosed

    def posed(self, params: Mapping[str, Tensor], pose: Mapping[str, Tensor]) -> Tensor:
        """The model's own posed vertices; what goes wrong inside names the backend."""
        with default_registry().isolated(self.layer.backend, "rest"), torch.no_grad():
            return self.generator.posed(params, pose)


class FitBackends:
    """Backends with their fits, each made when it is first asked for.

    Args:
        lod, device: of the layers.
        make_inversion: the fit on a layer.
    """

    def __init__(self, lod: str, device: str, make_inversion: Callable[[SomaLayer], PoseInversion]) -> None:
        self._lod, self._device, self._make = lod, device, make_inversion
        self._made: dict[tuple[str, str], FitBackend] = {}

    def get(self, name: str, options: Mapping[str, Any]) -> FitBackend:
        """The backend `name` with these options.

        Raises:
            BackendError: it is not installed, or a file of its user's is missing.
            InputError: it cannot pose its own model.
        """
        key = (name, repr(sorted(options.items())))
        if key not in self._made:
            layer = SomaLayer(name, options=options, lod=self._lod, device=self._device)
            generator = default_registry().generator(
                name, device=layer.device, dtype=layer.dtype, options=options
            )
            if not isinstance(generator, HasPosed):
                raise InputError(
                    "backend",
                    got=f"{name}, whose generator has no posed()",
                    expected="a backend that poses its own model",
                    fix="Pass the posed vertices to soma invert.",
                )
            self._made[key] = FitBackend(layer=layer, inversion=self._make(layer), generator=generator)
        return self._made[key]


class ModelSequence(VertexSequence):
    """Vertices that a backend makes of its own pose parameters, a few frames at once.

    Args:
        path: the file that the parameters come from.
        backend: the model.
        params: identity, as for ``SomaLayer.identity``.
        pose: name -> (frames, ...) array of what the backend's ``posed`` takes.
        fps: frames per second.
        up: upward axis of the world that the pose is given in.
    """

    def __init__(
        self,
        path: Path,
        backend: FitBackend,
        params: Mapping[str, Any],
        pose: Mapping[str, np.ndarray],
        *,
        fps: float,
        up: UpAxis,
    ) -> None:
        layer = backend.layer
        self._backend, self._pose = backend, pose
        self._params = batch_parameters(layer.spec, params, device=layer.device, dtype=layer.dtype)
        vertex_count = self._posed(0, 1).shape[1]
        frame_count = len(next(iter(pose.values())))
        super().__init__(path, frame_count, vertex_count, fps=fps, metres=METRES[layer.spec.unit], up=up)

    def _posed(self, start: int, stop: int) -> Tensor:
        layer = self._backend.layer
        kind = {"device": layer.device, "dtype": layer.dtype}
        pose = {name: torch.as_tensor(values[start:stop], **kind) for name, values in self._pose.items()}
        return self._backend.posed(self._params, pose)

    def _read(self, start: int, stop: int) -> np.ndarray:
        return self._posed(start, stop).cpu().numpy()
