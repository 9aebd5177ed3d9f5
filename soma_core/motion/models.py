"""Backends with their fits, and bodies as sequences of vertices: posed when read, or held in memory."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.backends.parameters import batch_parameters
from soma_core.errors import InputError
from soma_core.inversion.guided import GuidedInversion
from soma_core.inversion.options import inversion_options
from soma_core.io.vertex_sequence import UpAxis, VertexSequence
from soma_core.layer import SomaLayer
from soma_core.motion.options import FitOptions
from soma_core.options import InversionChoice, ModelOptions, Options
from soma_core.plugin.declaration import refuse_posed
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import HasPosed, HasSkinning
from soma_core.rig import load_canonical
from soma_core.topology.correspondence import load_correspondence
from soma_core.topology.frames import METRES, native_to_canonical
from soma_core.topology.transfer import make_transfer

__all__ = [
    "FitBackend",
    "FitBackends",
    "HeldSequence",
    "ModelSequence",
    "TransferredSequence",
    "model_settings",
    "open_layer",
    "under",
]


def open_layer(model: ModelOptions, name: str, options: Mapping[str, Any]) -> SomaLayer:
    """The backend `name` with options of its own, as the model options say.

    Raises:
        BackendError: it is not installed, or a file of its user's is missing.
    """
    return SomaLayer(
        name, options=options, lod=str(model.lod), device=model.device, kernels=str(model.kernels),
        procedural=model.procedural, correctives=model.correctives,
    )  # fmt: skip


def model_settings(layer: SomaLayer) -> dict[str, Any]:
    """What decides a body beside its backend, for a report."""
    correctives = layer.correctives_file
    return {
        "lod": layer.mesh.lod, "procedural": layer.procedural,
        "correctives": correctives and correctives.name, "rig": layer.rig.revision,
    }  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class FitBackend:
    """A layer, the fit on it, and the model's own poses."""

    layer: SomaLayer
    inversion: GuidedInversion

    def posed(self, params: Mapping[str, Tensor], pose: Mapping[str, Tensor]) -> Tensor:
        """The model's own posed vertices; what goes wrong inside names the backend."""
        with default_registry().isolated(self.layer.backend, "rest"), torch.no_grad():
            found = self._generator.posed(params, pose)
            refuse_posed(found, len(next(iter(pose.values()))))
            return found

    @property
    def mean_hands(self) -> np.ndarray | None:
        """Mean pose (30, 3) [rad] of the fingers, of a model that has one."""
        found: np.ndarray | None = getattr(self._generator, "mean_hands", None)
        return found

    @property
    def hand_components(self) -> np.ndarray | None:
        """Directions (2, 45, 45) [rad] of the fingers of both hands, of a model that has them, in rows."""
        found: np.ndarray | None = getattr(self._generator, "hand_components", None)
        return found

    def rest_joints(self, params: Mapping[str, Any]) -> np.ndarray:
        """Joints (J, 3) of the model's own skeleton at rest, in its unit and axes.

        Raises:
            InputError: the model does not tell its skeleton.
        """
        generator, layer = self._generator, self.layer
        if not isinstance(generator, HasSkinning):
            raise InputError(
                "backend", got=f"{layer.backend}, without a skeleton", expected="one that has it",
                fix="Pass the posed vertices to soma invert.",
            )  # fmt: skip
        given = batch_parameters(layer.spec, params, device=layer.device, dtype=layer.dtype)
        with default_registry().isolated(layer.backend, "rest"), torch.no_grad():
            return generator.skinning(given).joints[0].double().cpu().numpy()

    @functools.cached_property
    def _generator(self) -> HasPosed:
        layer = self.layer
        generator = default_registry().generator(
            layer.backend, device=layer.device, dtype=layer.dtype, options=layer.options
        )
        if not isinstance(generator, HasPosed):
            raise InputError(
                "backend",
                got=f"{layer.backend}, whose generator has no posed()",
                expected="a backend that poses its own model",
                fix="Pass the posed vertices to soma invert.",
            )
        return generator


@contextmanager
def under(group: type[Options], name: str) -> Iterator[None]:
    """Name settings of a group in full where they are refused: ``tolerance`` is ``inversion.tolerance``."""
    try:
        yield
    except InputError as error:
        if error.argument.partition(".")[0] not in {field.name for field in fields(group)}:
            raise
        fix = re.sub(r"\b(Pass|Leave) (\w+)(?==| out)", rf"\1 {name}.\2", error.fix)
        raise InputError(
            f"{name}.{error.argument}", got=error.got, expected=error.expected, fix=fix
        ) from error


class FitBackends:
    """Layers with their fits, each made when it is first asked for.

    Args:
        options: the model and the fit.
    """

    def __init__(self, options: FitOptions) -> None:
        self._options = options
        self._made: dict[tuple[str, str], FitBackend] = {}

    def get(self, name: str, options: Mapping[str, Any]) -> FitBackend:
        """The backend `name` with these options of its own.

        Raises:
            BackendError: it is not installed, or a file of its user's is missing.
            InputError: a choice of the fit that is none.
        """
        key = (name, repr(sorted(options.items())))
        if key not in self._made:
            layer, choice = open_layer(self._options, name, options), asdict(self._options.inversion)
            kernels = str(choice.pop("kernels"))
            with under(InversionChoice, "inversion"):
                inversion = GuidedInversion(layer, **inversion_options(choice), kernels=kernels)
            self._made[key] = FitBackend(layer=layer, inversion=inversion)
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


class HeldSequence(VertexSequence):
    """Vertices (frames, n, 3) [m], +Y up, that a reader gave as one array."""

    def __init__(self, path: Path, vertices: np.ndarray, *, fps: float) -> None:
        super().__init__(path, len(vertices), vertices.shape[1], fps=fps, metres=1.0, up="+y")
        self._vertices = vertices

    def _read(self, start: int, stop: int) -> np.ndarray:
        return np.ascontiguousarray(self._vertices[start:stop])


class TransferredSequence(VertexSequence):
    """Vertices of one backend's topology on the canonical mesh of mid [m], +Y up.

    Nothing of the backend is needed but its wrap pair.

    Args:
        sequence: the vertices, in metres, +Y up.
        backend: whose topology they have.

    Raises:
        BackendError: it is not installed, or its wrap pair is missing or unusable.
    """

    def __init__(self, sequence: VertexSequence, backend: str) -> None:
        registry = default_registry()
        spec = registry.spec(backend)
        mesh, _ = load_canonical("mid")
        with registry.isolated(backend, "wrap"):
            correspondence = None if spec.wrap is None else load_correspondence(spec.wrap, mesh)
            self._transfer = make_transfer(
                spec, mesh, correspondence, dtype=torch.float32, device=torch.device("cpu")
            )
        self._sequence = sequence
        self._frame = native_to_canonical(spec.up, spec.forward) / METRES[spec.unit]
        super().__init__(
            sequence.path, sequence.frame_count, mesh.vertex_count, fps=sequence.fps, metres=1.0, up="+y"
        )

    def _read(self, start: int, stop: int) -> np.ndarray:
        native = self._sequence.read(start, stop) @ self._frame
        return self._transfer(torch.as_tensor(native).float()).numpy()
