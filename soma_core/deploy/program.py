"""A layer as a ``torch.export`` program: any batch, plain operators, named inputs and outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from soma_core._version import __version__
from soma_core.animation.engine import Body
from soma_core.backends.parameters import batch_parameters
from soma_core.choices import ModelPart
from soma_core.deploy.blocks import without_sparse
from soma_core.deploy.posing import ShortPosing
from soma_core.deploy.turns import AxisAngle
from soma_core.errors import InputError
from soma_core.layer import SomaLayer
from soma_core.plugin.declaration import did_you_mean

__all__ = ["DeployedModel", "deploy"]

_EXAMPLE = 5
"""Bodies that a program is traced with: no other size of the model, so that only the batch stays open."""

_MEANING = {
    "rotations": "axis-angle [rad] relative to the T-pose in world-aligned axes, in the order of joint_names",
    "translation": "world position of the Hips [m]",
    "vertices": "posed vertices [m]",
    "joints": "world positions of joint_names [m]",
    "transforms": "world transforms of transform_names [m], row-major 4 x 4",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class DeployedModel:
    """A layer without this package.

    Attributes:
        program: takes the inputs in their order, each with the same batch; returns the outputs.
        inputs, outputs: names, with their shapes after the batch.
        about: all that a caller has to know, as JSON holds it; with ``triangles`` where there are vertices.
    """

    program: torch.export.ExportedProgram
    inputs: dict[str, tuple[int, ...]]
    outputs: dict[str, tuple[int, ...]]
    about: dict[str, Any]

    def example(self, batch: int = _EXAMPLE) -> tuple[Any, ...]:
        """Zeros of the inputs' shapes, as the program takes them."""
        rotations, translation, *values = (torch.zeros(batch, *shape) for shape in self.inputs.values())
        return rotations, translation, *values


class _Body(torch.nn.Module):
    """What is traced. The layer stands in a list: of a child's buffers, unused ones would be kept too."""

    def __init__(
        self, layer: SomaLayer, part: ModelPart, fixed: Mapping[str, Tensor], names: Sequence[str]
    ) -> None:
        super().__init__()
        self.part, self.fixed, self.names, self._layer = part, dict(fixed), tuple(names), [layer]
        self.turn = AxisAngle(dtype=layer.dtype, device=layer.device)
        self.short = (
            ShortPosing(layer) if part is not ModelPart.joints and ShortPosing.serves(layer) else None
        )
        with torch.no_grad():
            self.identity = None if part is ModelPart.full else layer.identity(self.fixed)
            self.bound = None
            if self.identity is not None and self.short is not None:
                self.bound = self.short.bound(*layer.rest_shape(self.identity.params))

    def forward(self, rotations: Tensor, translation: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
        layer, identity = self._layer[0], self.identity
        if self.short is not None and self.bound is not None:
            return self.short(self.bound, rotations, translation)
        if identity is None:
            given = self.fixed | dict(zip(self.names, values, strict=True))
            batch = rotations.shape[0]
            params = {name: value.expand(batch, *value.shape[1:]) for name, value in given.items()}
            shape = layer.rest_shape(params)
            if self.short is not None:
                return self.short(self.short.bound(*shape), rotations, translation)
            identity = layer._identity(params, *shape)
        vectors = rotations.permute(2, 1, 0)
        turns = self.turn.exponential(vectors.flatten(1)).view(3, 3, *vectors.shape[1:])
        body = Body(identity, turns.permute(3, 2, 0, 1), translation)
        if self.part is ModelPart.joints:
            world = layer.animation.transforms(body, absolute=False)
            return world[:, 1:, :3, 3], world
        posed = layer.pose_checked(body)
        return posed.vertices, posed.joints, posed.transforms


def deploy(
    layer: SomaLayer,
    part: ModelPart = ModelPart.pose,
    *,
    params: Mapping[str, Any] | None = None,
    parameters: Sequence[str] | None = None,
) -> DeployedModel:
    """Trace a layer: forward kinematics, twist joints, correctives and skinning, float32 on the CPU.

    Args:
        layer: its backend, level of detail, rig and correctives are taken.
        part: ``pose`` of one identity, ``full`` with identity parameters as inputs, or ``joints`` alone.
        params: of one body: the identity of ``pose`` and ``joints``, and what stays fixed of ``full``.
        parameters: of ``full``, which parameters are inputs; default: all that belong to no group.

    Raises:
        InputError: unknown names; a backend whose generator torch.export cannot follow, of ``full``.
    """
    given = layer._given | {"kernels": "torch", "device": "cpu", "dtype": torch.float32}
    plain = type(layer)(**given)
    fixed = batch_parameters(plain.spec, params, device=plain.device, dtype=plain.dtype)
    if any(len(value) != 1 for value in fixed.values()):
        raise InputError("params", got="several bodies", expected="one", fix="Give one value a parameter.")
    names = _inputs(plain, part, parameters)
    without_sparse(plain, dtype=plain.dtype, device=plain.device)
    shapes = {parameter.name: parameter.shape for parameter in plain.spec.params}
    users = len(plain.joint_names)
    inputs = {"rotations": (users, 3), "translation": (3,)} | {name: shapes[name] for name in names}
    outputs: dict[str, tuple[int, ...]] = {"joints": (users, 3), "transforms": (users + 1, 4, 4)}
    if part is not ModelPart.joints:
        outputs = {"vertices": (plain.mesh.vertex_count, 3)} | outputs
    kept = {name: value for name, value in fixed.items() if name not in names}
    about = _about(plain, part, kept, inputs, outputs)
    program = _traced(_Body(plain, part, kept, names), [*inputs.values()], plain.backend)
    return DeployedModel(program=program, inputs=inputs, outputs=outputs, about=about)


def _inputs(layer: SomaLayer, part: ModelPart, parameters: Sequence[str] | None) -> list[str]:
    """Names of the parameters that are inputs."""
    declared = {parameter.name: parameter for parameter in layer.spec.params}
    if part is not ModelPart.full:
        if parameters:
            raise InputError(
                "parameters", got=f"{', '.join(parameters)} with what={part.value}", expected="what=full",
                fix="Pass what=full, or set one body by backend.params.NAME=VALUE.",
            )  # fmt: skip
        return []
    if parameters is None:
        return [name for name, parameter in declared.items() if not parameter.group]
    for name in parameters:
        if name not in declared:
            raise InputError(
                "parameters", got=repr(name), expected=f"a parameter of backend {layer.backend!r}",
                fix=did_you_mean(name, [*declared]) or f"`soma backends show {layer.backend}` lists them.",
            )  # fmt: skip
    return list(dict.fromkeys(parameters))


def _traced(
    body: torch.nn.Module, shapes: Sequence[tuple[int, ...]], backend: str
) -> torch.export.ExportedProgram:
    example = tuple(torch.zeros(_EXAMPLE, *shape) for shape in shapes)
    open_batch = {0: torch.export.Dim("batch", min=1)}
    values = tuple(open_batch for _ in shapes[2:])
    dynamic = (open_batch, open_batch, values) if values else (open_batch, open_batch)
    try:
        with torch.no_grad():
            return torch.export.export(body, example, dynamic_shapes=dynamic)
    except Exception as error:  # whatever a plugin's own code raises while it is traced
        if isinstance(body, _Body) and body.identity is not None:
            raise
        cause = str(error).strip().partition("\n")[0] or type(error).__name__
        raise InputError(
            "what",
            got=f"full of backend {backend!r}, whose generator torch.export cannot follow ({cause})",
            expected="pose or joints",
            fix="Pass what=pose and one body by backend.params.NAME=VALUE.",
        ) from error


def _about(
    layer: SomaLayer,
    part: ModelPart,
    fixed: Mapping[str, Tensor],
    inputs: Mapping[str, tuple[int, ...]],
    outputs: Mapping[str, tuple[int, ...]],
) -> dict[str, Any]:
    """What a caller has to know."""
    rig, spec = layer.rig, layer.spec
    declared = {parameter.name: parameter for parameter in spec.params}

    def named(shapes: Mapping[str, tuple[int, ...]]) -> list[dict[str, Any]]:
        rows = []
        for name, shape in shapes.items():
            parameter = declared.get(name)
            row: dict[str, Any] = {"name": name, "shape": ["batch", *shape]}
            row["meaning"] = _MEANING.get(name) or (parameter.description if parameter else "")
            if parameter is not None:
                row |= {"default": parameter.default, "range": list(parameter.range)}
            rows.append(row)
        return rows

    about: dict[str, Any] = {
        "producer": f"soma-body-core {__version__}",
        "what": part.value,
        "backend": layer.backend,
        "licence": spec.licence,
        "lod": layer.mesh.lod,
        "rig_revision": rig.revision,
        "unit": "m",
        "axes": "right-handed, +Y up, the body faces +Z",
        "correctives": layer.correctives is not None and part is not ModelPart.joints,
        "twist_joints": layer.procedural and part is not ModelPart.joints,
        "identity": {name: value[0].tolist() for name, value in fixed.items()},
        "inputs": named(inputs),
        "outputs": named(outputs),
        "joint_names": list(layer.joint_names),
        "transform_names": list(rig.joint_names),
        "transform_parents": [int(parent) for parent in rig.parents],
    }
    if part is not ModelPart.joints:
        about["triangles"] = layer.mesh.triangles.ravel().tolist()
    return about
