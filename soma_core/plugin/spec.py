"""What a backend is: the declaration a plugin returns and the generator it builds (paper, section 3.2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "API_VERSION",
    "OLDEST_API_VERSION",
    "Axis",
    "BackendSpec",
    "Expressions",
    "FileNeeded",
    "Generator",
    "HasExpressions",
    "HasLinearBasis",
    "HasPoseVector",
    "HasPosed",
    "HasRandomPoses",
    "HasSkinning",
    "HasTriangles",
    "LinearBasis",
    "ModelMotion",
    "MotionFormat",
    "Parameter",
    "SkinnedModel",
    "Unit",
    "WrapPair",
]

API_VERSION = 2
"""Newest version of the plugin contract that this core speaks: since 2 options are the declared dataclass."""

OLDEST_API_VERSION = 1
"""Oldest version of the plugin contract that this core still speaks."""

Unit = Literal["m", "cm", "mm"]
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One named identity parameter of a backend.

    Attributes:
        name: key in ``params`` and in ``backend.params.<name>`` on the command line.
        shape: shape of one sample; ``()`` for a scalar, ``(128,)`` for a coefficient vector.
            A shorter vector is padded with the default.
        default: value of every entry that the caller leaves out.
        range: useful range (low, high); sampling stays inside, values outside are allowed.
        limits: values beyond which nothing changes, or nothing is defined, where these are wider than
            `range`; None where they are not. What searches for a body goes as far.
        group: optional heading under which listings show it.
        description: one line for people.
    """

    name: str
    shape: tuple[int, ...] = ()
    default: float = 0.0
    range: tuple[float, float] = (-3.0, 3.0)
    group: str = ""
    description: str = ""
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class WrapPair:
    """The two OBJ files that tie a native topology to the canonical one (paper, section 3.3).

    Attributes:
        native: the backend's neutral mesh, native vertex order, unit and axes.
        wrap: the canonical mesh lying on that surface, in canonical vertex order.
    """

    native: Path
    wrap: Path


@dataclass(frozen=True, kw_only=True)
class FileNeeded:
    """A file that the user must supply, where it is looked for and where it comes from.

    `command` makes the file, from another that the user has; the error of a missing file shows it.
    """

    path: Path
    description: str
    url: str = ""
    command: str = ""


@dataclass(frozen=True, kw_only=True)
class BackendSpec:
    """Declaration of an identity backend; made without importing torch or the native model.

    Attributes:
        name: entry-point name, ``backend=<name>`` and ``configs/backend/<name>.yaml``.
        api: version of the contract the plugin was written for; 1 where it does not say. Of 1, options reach
            ``soma_generator`` as a dictionary, since 2 as the declared dataclass.
        unit: unit of the generator's vertices and of the wrap pair.
        up, forward: the generator's axes. The body's left is ``up x forward``.
        wrap: the OBJ pair in the generator's unit; ``None`` when the native topology is the
            canonical one.
        wrap_up, wrap_forward: axes of the OBJ pair where they differ from the generator's.
        params: the identity parameters, in the order listings show them.
        fill_segments: canonical segments without a counterpart on the native surface.
        files: files that the user must supply.
        options: optional dataclass type of ``backend.options``; the core validates against it.
        licence: SPDX id or short text of the *model's* licence.
        url: where the model comes from.
        description: one line for ``soma backends``.
    """

    name: str
    unit: Unit
    up: Axis
    forward: Axis
    params: tuple[Parameter, ...]
    wrap: WrapPair | None
    api: int = 1  # stays 1 when the contract moves on: a plugin that says nothing was written for the first
    wrap_up: Axis | None = None
    wrap_forward: Axis | None = None
    fill_segments: tuple[str, ...] = ()
    files: tuple[FileNeeded, ...] = ()
    options: type | None = None
    licence: str = ""
    url: str = ""
    description: str = ""


@runtime_checkable
class Generator(Protocol):
    """The native model: parameters in, rest mesh out."""

    def rest(self, params: Mapping[str, Tensor]) -> Tensor:
        """Rest vertices (batch, n, 3) in the native unit, topology and axes.

        ``params`` holds every declared parameter, shape ``(batch, *parameter.shape)``, on the device
        and in the dtype the generator was built for. Differentiable where the model is.
        """
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearBasis:
    """A rest shape that is linear in its coefficients: ``template + coefficients @ basis``.

    Attributes:
        template: (n, 3) native unit and axes.
        basis: (k, n, 3) native unit and axes.
        coefficients: maps the params of :meth:`Generator.rest` to (batch, k).
    """

    template: Tensor
    basis: Tensor
    coefficients: Callable[[Mapping[str, Tensor]], Tensor]


@runtime_checkable
class HasLinearBasis(Protocol):
    """Optional capability: lets the core compose transfer and skeleton fit once."""

    def linear_basis(self) -> LinearBasis:
        """The template, the basis and the function from parameters to coefficients."""
        ...


@runtime_checkable
class HasPosed(Protocol):
    """Optional capability: the model's own posed mesh."""

    def posed(self, params: Mapping[str, Tensor], pose: Any) -> Tensor:
        """Posed vertices (batch, n, 3) in the native unit, topology and axes."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class SkinnedModel:
    """Bodies of a native model as meshes that joints skin; native unit and axes.

    Joint j turns by a local rotation about its place, and all that hangs on it. Rotations are relative to
    the rest mesh, in axes aligned with the native world there; identity is the rest mesh. A vertex is
    ``sum_j w_vj (W_j (rest_v + offset_v - joint_j) + place_j) + translation``, W_j and place_j the world
    rotation and the place of joint j, where the root joint stays in place.

    Attributes:
        joint_names: in the model's order, parents first.
        parents: index of the parent of each joint, -1 for the first, which is the only root.
        rest: (batch, n, 3) rest meshes.
        joints: (batch, J, 3) their joints.
        weights: (n, J) skinning weights, rows sum to 1.
        pose_offsets: maps local rotations (batch, J, 3, 3) to what they add to the rest mesh before it is
            skinned, (batch, n, 3); differentiable. None where a pose adds nothing.
    """

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    rest: Tensor
    joints: Tensor
    weights: Tensor
    pose_offsets: Callable[[Tensor], Tensor] | None = None


@runtime_checkable
class HasRandomPoses(Protocol):
    """Optional capability beside ``posed()``: poses of the native model to learn correctives from."""

    def random_poses(self, count: int, seed: int) -> Any:
        """`count` poses that a person could take, in the form that ``posed()`` takes; the root at rest."""
        ...


@runtime_checkable
class HasSkinning(Protocol):
    """Optional capability: lets the core fit the model's own pose to a motion."""

    def skinning(self, params: Mapping[str, Tensor]) -> SkinnedModel:
        """The bodies of the params of :meth:`Generator.rest`."""
        ...


@runtime_checkable
class HasPoseVector(Protocol):
    """Optional capability: a pose is one vector of parameters, which the core fits by evaluating the model.

    Attributes:
        pose_size: entries of what :meth:`posed` takes as ``{"parameters": (batch, pose_size)}``; zero is the
            rest mesh.
        root_size: how many of them, the first, move the body as a whole.
        heading: which of those turns it about the vertical, in radians.
    """

    pose_size: int
    root_size: int
    heading: int

    def posed(self, params: Mapping[str, Tensor], pose: Any) -> Tensor:
        """Posed vertices (batch, n, 3) in the native unit, topology and axes."""
        ...

    def own_arrays(self, params: Mapping[str, Tensor], parameters: Tensor) -> Mapping[str, Tensor]:
        """Poses (frames, pose_size) of one body under the names that files of the model have."""
        ...


@runtime_checkable
class HasTriangles(Protocol):
    """Optional capability: ``soma wrap backend=NAME`` works before the backend has any OBJ file."""

    def triangles(self) -> Tensor:
        """Native vertex ids (t, 3), counter-clockwise seen from outside."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Expressions:
    """Directions of a face: what one unit of each coefficient adds to the rest mesh.

    Attributes:
        names: of the coefficients, k of them.
        basis: (k, n, 3) native unit and axes.
    """

    names: tuple[str, ...]
    basis: Tensor


@runtime_checkable
class HasExpressions(Protocol):
    """Optional capability: the face of the model."""

    def expressions(self) -> Expressions:
        """The named directions of the face."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelMotion:
    """A motion in the terms of one native model: one body, and a pose for each frame.

    Attributes:
        params: the body, as for ``SomaLayer.identity``.
        pose: what ``posed()`` takes, each an array (frames, ...): ``rotations`` (frames, J, 3) [rad] and
            ``translation`` (frames, 3) of a model that tells its skinning, ``parameters`` (frames, p) of one
            whose pose is a vector, anything of another that is only read.
        fps: frames per second.
        up: upward axis of the world that the pose is given in; None: the backend's own.
        options: of the backend.
        source: where the motion comes from, for files that say so.
    """

    params: Mapping[str, Any]
    pose: Mapping[str, Any]
    fps: float
    up: Axis | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""


@dataclass(frozen=True, kw_only=True)
class MotionFormat:
    """Files that hold motions of a backend's model, for ``soma convert``; from the hook ``soma_motions``.

    A file is of this format where the core knows none of its own, the suffix is one of these, and the file
    holds all the keys. Nothing of a plugin looks at a file before.

    Attributes:
        name: how reports call it.
        suffixes: of its files, such as ``(".npz",)``.
        keys: names that an NPZ, a pickle or a file of tensors holds; empty for other suffixes.
        read: makes a motion of a file; needs ``posed()``. None where files are only written.
        write: writes a motion to a path; needs ``skinning()`` or a pose vector. None: files are only read.
    """

    name: str
    suffixes: tuple[str, ...]
    keys: tuple[str, ...] = ()
    read: Callable[[Path], ModelMotion] | None = None
    write: Callable[[Path, ModelMotion], None] | None = None
