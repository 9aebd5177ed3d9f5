"""The blocks of options that functions and commands share.

Commands compose these very classes by hydra; nothing here imports it.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from enum import StrEnum
from os import PathLike
from types import UnionType
from typing import Any, Self, get_args, get_origin, get_type_hints

from soma_core.choices import (
    BvhRest,
    EulerOrder,
    IdentityMethod,
    Kernels,
    LengthUnit,
    Lod,
    Skinning,
)
from soma_core.errors import InputError, check_type

__all__ = [
    "AnalyticalChoice",
    "AutogradChoice",
    "BackendChoice",
    "BvhChoice",
    "FrameRange",
    "IdentityChoice",
    "InversionChoice",
    "ModelOptions",
    "Options",
    "Picture",
    "PriorChoice",
    "VideoChoice",
    "ViewOptions",
]


class Options:
    """Base of option dataclasses: a field is set once, a name of a closed choice becomes its member.

    They are frozen in effect. A frozen dataclass proper is none that hydra composes upon (omegaconf 2.3).

    Raises:
        InputError: another name than those of the choice, a value of another type than the field's, or NaN.
    """

    @classmethod
    def or_default(cls, options: Self | None) -> Self:
        """Those that a function was given, or the defaults for None; others are refused (InputError)."""
        if options is not None:
            check_type("options", options, cls, fix=f"Pass {cls.__name__}(...), or leave it out.")
        return cls() if options is None else options

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
                inner = get_args(kind)[0] if get_origin(kind) is list else None
                if isinstance(inner, type) and issubclass(inner, StrEnum) and isinstance(value, list | tuple):
                    value = [_member(name, inner, each) for each in value]
                    object.__setattr__(self, name, value)
                if isinstance(kind, type) and issubclass(kind, StrEnum) and isinstance(value, str):
                    value = _member(name, kind, value)
                    object.__setattr__(self, name, value)
            if name in vars(self) and not _fits(value, hint):
                kinds = getattr(hint, "__name__", str(hint))
                got = f"{value!r} ({type(value).__name__})"
                raise InputError(name, got=got, expected=f"a value of type {kinds}", fix="Correct the value.")
            numbers = value.values() if isinstance(value, dict) else (value,)
            if any(isinstance(number, float) and math.isnan(number) for number in numbers):
                raise InputError(name, got="nan", expected="a number", fix="Correct the value.")


def _fits(value: object, hint: Any) -> bool:
    """Whether a value is of a field's type; whole numbers are numbers, and paths are text."""
    kinds = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    for kind in (get_origin(kind) or kind for kind in kinds):
        wider = {float: (int, float), str: (str, PathLike), list: (list, tuple)}.get(kind, kind)
        if kind is Any or (isinstance(value, wider) and (kind is bool or not isinstance(value, bool))):
            return True
    return False


def _member(name: str, kind: type[StrEnum], value: object) -> StrEnum:
    if not isinstance(value, str) or value not in list(kind):
        raise InputError(name, got=repr(value), expected=f"one of {', '.join(kind)}", fix="Correct the name.")
    return kind(value)


def _within(name: str, value: float, least: float, most: float) -> None:
    """Refuse a number outside its range."""
    if not least <= value <= most:
        raise InputError(name, got=value, expected=f"a number from {least} to {most}", fix="Leave it out.")


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
class BvhChoice(Options):
    """How a BVH is written: its Euler angles, the pose of zeros, lengths, and 77 joints or 78 with a Root."""

    order: EulerOrder = EulerOrder.ZXY
    rest: BvhRest = BvhRest.t_pose
    unit: LengthUnit = LengthUnit.cm
    joints: int = 77

    def __post_init__(self) -> None:
        """Refuse another number of joints."""
        super().__post_init__()
        if self.joints not in (77, 78):
            raise InputError(
                "bvh.joints", got=self.joints, expected="77, or 78 with a Root", fix="Leave it out."
            )


@dataclass(kw_only=True)
class ModelOptions(Options):
    """The body model: its level of detail, twist joints, pose correctives, kernels, and where it runs."""

    lod: Lod = Lod.mid
    kernels: Kernels = Kernels.auto
    procedural: bool = True
    correctives: str | None = "auto"
    device: str = "cpu"


@dataclass(kw_only=True)
class ViewOptions(ModelOptions):
    """The viewer: where its page is, and the detail and frames per second that are sent while bodies move."""

    host: str = "127.0.0.1"
    port: int = 8080
    playing: Lod = Lod.low
    rate: float = 30.0


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

    def __post_init__(self) -> None:
        """Refuse what no picture has."""
        super().__post_init__()
        _within("picture.frames", self.frames, 0, 10000)
        _within("picture.width", self.width, 100, 16384)


@dataclass(kw_only=True)
class VideoChoice(Options):
    """A video: its side in pixels, frames per second, and seconds in which a single pose is turned once.

    Of `fps`, None is the motion's, 30 or in a GIF 20 at most.
    """

    size: int = 720
    fps: float | None = None
    seconds: float = 4.0

    def __post_init__(self) -> None:
        """Refuse what no video has."""
        super().__post_init__()
        _within("video.size", self.size, 2, 4096)
        _within("video.fps", 1 if self.fps is None else self.fps, 0.001, 240)
        _within("video.seconds", self.seconds, 0.001, 600)
        if self.size % 2:
            raise InputError(
                "video.size", got=self.size, expected="an even number", fix="Pass video.size=720."
            )


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
    `expected` is one on how firmly joints are held near the turns that a file tells.
    """

    untwist: float = 1.0
    expected: float = 1.0
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
    skinning: Skinning = Skinning.auto
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
