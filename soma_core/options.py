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
    "BetasFrom",
    "BodyGender",
    "BoneMatch",
    "BvhChoice",
    "BvhRest",
    "Carry",
    "Contacts",
    "ConvertResult",
    "Coordinates",
    "EulerOrder",
    "FitLod",
    "FrameRange",
    "Gallery",
    "Gaps",
    "Ground",
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
    "RotationLayout",
    "RotationZero",
    "SmplLayout",
    "SmplModel",
    "Topology",
    "Translation",
    "Upward",
]


class BetasFrom(StrEnum):
    """How one body is made of shapes for each frame."""

    mean = "mean"
    median = "median"
    first = "first"


class BodyGender(StrEnum):
    """Which of a user's SMPL models a motion is posed with."""

    neutral = "neutral"
    male = "male"
    female = "female"


class SmplLayout(StrEnum):
    """Names of the keys that pose parameters of SMPL models are written under."""

    amass = "amass"
    smplx = "smplx"


class Contacts(StrEnum):
    """What becomes of feet in contact with the ground: they go with the legs, or stay where they stand."""

    free = "free"
    lock = "lock"


class BoneMatch(StrEnum):
    """Which bones of another skeleton are matched by direction; the others keep their turn since rest."""

    bones = "bones"
    limbs = "limbs"


class Carry(StrEnum):
    """How a motion of a model comes over: its body is fitted, or its joints are carried."""

    fit = "fit"
    skeleton = "skeleton"


class ConvertResult(StrEnum):
    """What the way back gives: pose parameters of the model, or vertices."""

    poses = "poses"
    vertices = "vertices"


class Coordinates(StrEnum):
    """Which of a file's motions of one person is taken."""

    world = "world"
    camera = "camera"


class FitLod(StrEnum):
    """Level of detail that poses are fitted on."""

    mid = "mid"
    low = "low"


class Gallery(StrEnum):
    """Which identities are animated."""

    one = "one"
    all = "all"


class Ground(StrEnum):
    """What lies on the floor: soles in contact, the lowest vertex of the clip, or nothing that is sought."""

    contacts = "contacts"
    lowest = "lowest"
    none = "none"


class Gaps(StrEnum):
    """What becomes of frames that a file lacks."""

    interpolate = "interpolate"
    drop = "drop"


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
    """A file that a run can write; ``soma_core.motion.writers`` has the table of them."""

    npz = "npz"
    usd = "usd"
    glb = "glb"
    html = "html"
    png = "png"
    bvh = "bvh"
    joints = "joints"
    csv = "csv"
    keypoints = "keypoints"
    vertices = "vertices"
    obj = "obj"
    ply = "ply"
    pc2 = "pc2"
    mdd = "mdd"
    usdpoints = "usdpoints"


class RotationLayout(StrEnum):
    """Order of quaternions; whether 6D rotations are the first two rows or columns of a matrix."""

    wxyz = "wxyz"
    xyzw = "xyzw"
    rows = "rows"
    columns = "columns"


class SmplModel(StrEnum):
    """Models of the SMPL family."""

    smpl = "smpl"
    smplh = "smplh"
    smplx = "smplx"


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


class BvhRest(StrEnum):
    """The pose at which the angles of a BVH are zero."""

    t_pose = "t_pose"
    bind = "bind"


class EulerOrder(StrEnum):
    """Order of the rotation channels of a BVH; the first is applied last."""

    XYZ = "XYZ"
    XZY = "XZY"
    YXZ = "YXZ"
    YZX = "YZX"
    ZXY = "ZXY"
    ZYX = "ZYX"


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
