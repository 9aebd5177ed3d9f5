"""What a user can choose: closed sets of values, and the blocks of options that functions and commands share.

Commands compose these very classes by hydra; nothing here imports it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from enum import StrEnum
from os import PathLike
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from soma_core.errors import InputError

__all__ = [
    "AnalyticalChoice",
    "AngleUnit",
    "AutogradChoice",
    "Axes",
    "BackendChoice",
    "BodyGender",
    "ConvertResult",
    "FitLod",
    "FrameRange",
    "Gallery",
    "IdentityChoice",
    "IdentityMethod",
    "IdentitySource",
    "InversionChoice",
    "Kernels",
    "LengthUnit",
    "Lod",
    "ModelOptions",
    "Options",
    "Picture",
    "PriorChoice",
    "Product",
    "RotationZero",
    "Topology",
    "Translation",
    "Upward",
]


class BodyGender(StrEnum):
    """Which of a user's SMPL models a motion is posed with."""

    neutral = "neutral"
    male = "male"
    female = "female"


class ConvertResult(StrEnum):
    """What the way back gives: pose parameters of the model, or vertices."""

    poses = "poses"
    vertices = "vertices"


class FitLod(StrEnum):
    """Level of detail that poses are fitted on."""

    mid = "mid"
    low = "low"


class Gallery(StrEnum):
    """Which identities are animated."""

    one = "one"
    all = "all"


class IdentityMethod(StrEnum):
    """How the identity of a fit is found, if it is not known."""

    known = "known"
    backend = "backend"
    unpose = "unpose"


class IdentitySource(StrEnum):
    """Which identity is animated."""

    backend = "backend"
    motion = "motion"


class Kernels(StrEnum):
    """Which version of the hot path runs."""

    auto = "auto"
    torch = "torch"
    warp = "warp"


class LengthUnit(StrEnum):
    """Unit of a file's lengths."""

    m = "m"
    cm = "cm"
    mm = "mm"


class Lod(StrEnum):
    """Level of detail of the canonical mesh."""

    mid = "mid"
    low = "low"
    xlo = "xlo"


class Product(StrEnum):
    """A file that a run can write."""

    npz = "npz"
    usd = "usd"
    glb = "glb"
    png = "png"


class Topology(StrEnum):
    """Which mesh vertices belong to."""

    auto = "auto"
    canonical = "canonical"
    native = "native"


class Translation(StrEnum):
    """Where the body stands."""

    ground = "ground"
    motion = "motion"
    none = "none"


Upward = StrEnum("Upward", {"y": "y", "z": "z", "-y": "-y", "-z": "-z", "+y": "y", "+z": "z"})
"""Upward axis of a file's world; ``+y`` is another name of ``y``."""


class Axes(StrEnum):
    """Axes of a file's world by name: a camera's have y down, and z forward, away from it."""

    camera = "camera"


class RotationZero(StrEnum):
    """What the rotations of a file on this skeleton are relative to."""

    t_pose_relative = "t_pose_relative"
    absolute_local = "absolute_local"


class AngleUnit(StrEnum):
    """Unit of a file's rotation vectors."""

    rad = "rad"
    deg = "deg"


class Options:
    """Base of option dataclasses: a field is set once, a name of a closed choice becomes its member.

    They are frozen in effect. A frozen dataclass proper is none that hydra composes upon (omegaconf 2.3).

    Raises:
        InputError: another name than those of the choice, or a value of another type than the field's.
    """

    def __setattr__(self, name: str, value: object) -> None:
        """Set a field that is not set yet."""
        if name in vars(self):
            raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")
        object.__setattr__(self, name, value)

    def __post_init__(self) -> None:
        """Turn the names of closed choices into their members, and refuse what is of another type."""
        for name, hint in get_type_hints(type(self)).items():
            value = vars(self).get(name)
            for kind in (hint, *get_args(hint)):
                if isinstance(kind, type) and issubclass(kind, StrEnum) and isinstance(value, str):
                    value = _member(name, kind, value)
                    object.__setattr__(self, name, value)
            if name in vars(self) and not _fits(value, hint):
                kinds = getattr(hint, "__name__", str(hint))
                got = f"{value!r} ({type(value).__name__})"
                raise InputError(name, got=got, expected=f"a value of type {kinds}", fix="Correct the value.")


def _fits(value: object, hint: Any) -> bool:
    """Whether a value is of a field's type; whole numbers are numbers, and paths are text."""
    kinds = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    for kind in (get_origin(kind) or kind for kind in kinds):
        wider = {float: (int, float), str: (str, PathLike), list: (list, tuple)}.get(kind, kind)
        if kind is Any or (isinstance(value, wider) and (kind is bool or not isinstance(value, bool))):
            return True
    return False


def _member(name: str, kind: type[StrEnum], value: str) -> StrEnum:
    if value not in list(kind):
        raise InputError(name, got=repr(value), expected=f"one of {', '.join(kind)}", fix="Correct the name.")
    return kind(value)


@dataclass(kw_only=True)
class BackendChoice(Options):
    """An identity: the backend, its parameters (None: the default) and its options."""

    name: str
    params: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Leave out what has its default."""
        super().__post_init__()
        for field_name in ("params", "options"):
            given = vars(self)[field_name].items()
            object.__setattr__(self, field_name, {name: value for name, value in given if value is not None})


@dataclass(kw_only=True)
class ModelOptions(Options):
    """The body model: its level of detail, twist joints, pose correctives, kernels, and where it runs."""

    lod: Lod = Lod.mid
    kernels: Kernels = Kernels.auto
    procedural: bool = True
    correctives: str | None = "auto"
    device: str = "cpu"


@dataclass(kw_only=True)
class FrameRange(Options):
    """A slice of the motion, as in Python: stop is left out, None means to the end."""

    start: int = 0
    stop: int | None = None
    step: int = 1


@dataclass(kw_only=True)
class Picture(Options):
    """The contact sheet: how many frames, and its width in pixels."""

    frames: int = 10
    width: int = 1600


@dataclass(kw_only=True)
class AnalyticalChoice(Options):
    """Sweeps of the stage ``analytical`` over all but the fingers, the fingers, and everything."""

    body: int = 2
    fingers: int = 0
    full: int = 1


@dataclass(kw_only=True)
class AutogradChoice(Options):
    """Stage ``autograd``: steps, learning rates [rad, m], how far they fall, factors of regions, the loss."""

    iterations: int = 100
    rate: float = 0.02
    shift_rate: float = 0.002
    final: float = 0.005
    regions: dict[str, float] = field(default_factory=dict)
    loss: str = "moments"


@dataclass(kw_only=True)
class PriorChoice(Options):
    """Soft terms [m/rad]: limits of joints [rad], a rest pose, smooth motion; hinges: elbows and knees.

    `untwist` is a factor on how much twists of elbows, knees and fingers are in doubt; 0 turns that off.
    """

    untwist: float = 1.0
    limits: dict[str, float] = field(default_factory=dict)
    limit_strength: float = 0.05
    hinges: bool = False
    rest_strength: float = 0.0
    temporal_strength: float = 0.0
    temporal_rounds: int = 3


@dataclass(kw_only=True)
class InversionChoice(Options):
    """How poses are found: the stages in their order, and what each of them takes."""

    stages: list[str] = field(default_factory=lambda: ["procrustes", "gauss_newton"])
    iterations: int = 40
    tolerance: float = 2e-5
    robust: float | None = None
    robust_rounds: int = 10
    refreshes: int = 30
    analytical: AnalyticalChoice = field(default_factory=AnalyticalChoice)
    autograd: AutogradChoice = field(default_factory=AutogradChoice)
    priors: PriorChoice = field(default_factory=PriorChoice)
    kernels: Kernels = Kernels.auto


@dataclass(kw_only=True)
class IdentityChoice(Options):
    """Whose poses are sought: a known identity, or one found from some of the frames."""

    method: IdentityMethod = IdentityMethod.known
    free: list[str] | None = None
    frames: int = 20
    iterations: int = 12
