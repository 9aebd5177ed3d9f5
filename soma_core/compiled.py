"""A layer at one batch size, recorded once as a CUDA graph and replayed without the host's own time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from soma_core._inputs import check_kind, widened
from soma_core.animation.posed import Posed
from soma_core.backends.parameters import batch_parameters
from soma_core.errors import InputError
from soma_core.plugin.spec import BackendSpec
from soma_core.skeleton.identity import Identity

__all__ = ["CompiledLayer"]

_WARM_UPS = 3
"""Calls before the recording: the first loads kernels and makes workspaces, which a recording may not."""


class _Layer(Protocol):
    """What is asked of a ``SomaLayer``, which makes these and so cannot be imported here."""

    spec: BackendSpec
    device: torch.device
    dtype: torch.dtype

    @property
    def joint_names(self) -> tuple[str, ...]: ...
    @property
    def identity(self) -> Callable[..., Identity]: ...
    @property
    def check_identity(self) -> Callable[[Identity], None]: ...
    @property
    def pose(self) -> Callable[..., Posed]: ...
    @property
    def forward(self) -> Callable[..., Posed]: ...


class CompiledLayer:
    """Poses one number of bodies, without gradients; made by ``SomaLayer.compiled``, whose words these are.

    On CUDA, what is given is copied into memory of its own and the recorded kernels run again: **the next
    call overwrites what this one returned**; clone what is to stay. An identity that is given again, the
    same object, is not copied again. On the CPU the layer is called. A layer that is moved or converted
    afterwards is not followed.

    Args:
        layer: the ``SomaLayer``.
        batch: number of bodies B that come out.
        identities: 1, shared by all poses, or B.
        params: take identity parameters, as ``layer(params, ...)`` does, instead of identities.
        absolute: rotations are local rotations of the rig's own axes.
        matrices: rotations are matrices (B, J - 1, 3, 3) instead of axis-angle (B, J - 1, 3) [rad].
    """

    def __init__(
        self, layer: _Layer, *, batch: int, identities: int, params: bool, absolute: bool, matrices: bool
    ) -> None:
        if batch < 1 or identities not in (1, batch):
            raise InputError(
                "batch" if batch < 1 else "identities",
                got=batch if batch < 1 else identities,
                expected="1 or more" if batch < 1 else f"1 or {batch}",
                fix="Compile for the number of bodies that each call poses.",
            )
        self.layer, self.batch, self.params, self.absolute = layer, batch, params, absolute
        kind: dict[str, Any] = {"dtype": layer.dtype, "device": layer.device}
        users = len(layer.joint_names)
        eye = torch.eye(3, **kind).expand(batch, users, 3, 3)
        self._inputs = {
            "rotations": eye.clone() if matrices else torch.zeros(batch, users, 3, **kind),
            "translation": torch.zeros(batch, 3, **kind),
        }
        self._last: Identity | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._result: Posed | None = None
        self._identity, self._params = None, {}
        with torch.no_grad():
            if params:
                default = batch_parameters(layer.spec, {}, device=layer.device, dtype=layer.dtype)
                self._params = {
                    name: value.expand(identities, *value.shape[1:]).clone()
                    for name, value in default.items()
                }
            else:
                self._identity = self._static(layer.identity(), identities)
            if layer.device.type == "cuda":
                self._record()

    @staticmethod
    def _static(identity: Identity, count: int) -> Identity:
        rest = identity.rest.expand(count, -1, 3).clone(memory_format=torch.contiguous_format)
        bind = identity.bind_world.expand(count, -1, 4, 4).clone(memory_format=torch.contiguous_format)
        return dataclasses.replace(
            identity, rest=rest, bind_world=bind, fitted_rest=rest, fitted_world=bind, params={}
        )

    def _run(self) -> Posed:
        rotations, translation = self._inputs.values()
        if self.params:
            return self.layer.forward(self._params, rotations, translation, absolute=self.absolute)
        return self.layer.pose(self._identity, rotations, translation, absolute=self.absolute)

    def _record(self) -> None:
        with torch.cuda.device(self.layer.device):
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UPS):
                    self._run()
            torch.cuda.current_stream().wait_stream(stream)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, stream=stream):
                self._result = self._run()
            self._graph = graph

    @torch.no_grad()
    def __call__(
        self, body: Identity | Mapping[str, Any] | None, rotations: Tensor, translation: Tensor | None = None
    ) -> Posed:
        """Posed bodies.

        Args:
            body: an identity [m], or identity parameters where it was compiled for those.
            rotations: T-pose-relative, in the form and number that it was compiled for.
            translation: world position of the Hips [m], (B, 3), (1, 3) or (3,); default the origin.

        Raises:
            InputError: another number of bodies than it was compiled for; another shape, dtype or device;
                a parameter of a group, which has no place in the recording. On the CPU, whatever the layer
                refuses as well.
        """
        rotations = self._checked("rotations", rotations)
        if translation is not None:
            translation = self._checked("translation", translation)
        if self._graph is None:
            return self._call_through(body, rotations, translation)
        self._inputs["rotations"].copy_(rotations)
        if translation is None:
            self._inputs["translation"].zero_()
        else:
            self._inputs["translation"].copy_(translation)
        if self.params:
            for name, value in self._checked_params(body).items():
                self._params[name].copy_(value)
        else:
            self._take(self._checked_identity(body))
        self._graph.replay()
        assert self._result is not None
        return self._result

    def _call_through(self, body: Any, rotations: Tensor, translation: Tensor | None) -> Posed:
        if self.params:
            self._checked_params(body)
            return self.layer.forward(body, rotations, translation, absolute=self.absolute)
        identity = self._checked_identity(body)
        return self.layer.pose(identity, rotations, translation, absolute=self.absolute)

    def _take(self, identity: Identity) -> None:
        if identity is self._last:
            return
        assert self._identity is not None
        self._identity.rest.copy_(identity.rest)
        self._identity.bind_world.copy_(identity.bind_world)
        self._last = identity

    def _checked(self, name: str, value: Any) -> Tensor:
        value, shape = widened(value, self.layer.dtype), tuple(self._inputs[name].shape)
        check_kind(name, value, self.layer.dtype, self.layer.device)
        shared = ((3,), (1, 3)) if name == "translation" else ()
        if tuple(value.shape) not in (shape, *shared):
            raise InputError(
                name,
                got=tuple(value.shape),
                expected=f"{shape}, as compiled",
                fix="Compile another with layer.compiled(batch=..., matrices=...), or call the layer.",
            )
        return value

    def _checked_identity(self, body: Any) -> Identity:
        assert self._identity is not None
        count = len(self._identity.rest)
        if not isinstance(body, Identity) or body.batch_size not in (1, count):
            given = f"a batch of {body.batch_size}" if isinstance(body, Identity) else type(body).__name__
            raise InputError(
                "identity",
                got=given,
                expected=f"an identity of batch {count}, as compiled",
                fix="Compile with identities=... of that number, or params=True for parameters.",
            )
        self.layer.check_identity(body)
        return body

    def _checked_params(self, body: Any) -> dict[str, Tensor]:
        layer = self.layer
        given = batch_parameters(layer.spec, body, device=layer.device, dtype=layer.dtype)
        for name, value in given.items():
            place = self._params.get(name)
            if place is None or len(value) not in (1, len(place)):
                count = len(next(iter(self._params.values()), value))
                raise InputError(
                    f"params[{name!r}]",
                    got="a parameter of a group" if place is None else f"a batch of {len(value)}",
                    expected=f"a parameter without a group, of batch {count} or 1, as compiled",
                    fix="Compile with identities=... of that number, or call the layer itself.",
                )
        return given
