"""The closed sets of values that configurations choose from."""

from __future__ import annotations

from enum import StrEnum

__all__ = [
    "BodyGender",
    "ConvertResult",
    "FitLod",
    "Gallery",
    "IdentityMethod",
    "IdentitySource",
    "Kernels",
    "LengthUnit",
    "Lod",
    "Product",
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
    """Unit of a file's vertices."""

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


class Upward(StrEnum):
    """Upward axis of a file's vertices."""

    y = "y"
    z = "z"
