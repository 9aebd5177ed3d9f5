"""Options of fits and conversions; each field has the name that it has on the command line."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

from soma_core.errors import InputError
from soma_core.io.vertex_sequence import UpAxis
from soma_core.options import (
    AngleUnit,
    Axes,
    BackendChoice,
    BodyGender,
    ConvertResult,
    FitLod,
    IdentityChoice,
    InversionChoice,
    LengthUnit,
    ModelOptions,
    Options,
    Picture,
    RotationZero,
    Topology,
    Translation,
    Upward,
)
from soma_core.topology.frames import METRES

if TYPE_CHECKING:
    from soma_core.plugin.spec import Unit

__all__ = ["ConvertOptions", "FitOptions", "InvertOptions", "SourceOptions"]


SIGNED: dict[str, UpAxis] = {"y": "+y", "z": "+z", "-y": "-y", "-z": "-z"}
"""Upward axes as readers take them, by their settings."""


@dataclass(kw_only=True)
class SourceOptions(Options):
    """Whose body a file shows, how its poses are found, and what the file itself does not say.

    Attributes:
        backend: the body, or where the search for it begins.
        identity: a known body, or one that is found as well.
        inversion: how poses are found.
        fps: frames per second.
        unit: of lengths.
        up: upward axis of the world.
        axes: of the world by name, instead: ``camera`` has y down and z forward.
    """

    backend: BackendChoice | None = None
    identity: IdentityChoice = field(default_factory=IdentityChoice)
    inversion: InversionChoice = field(default_factory=InversionChoice)
    fps: float | None = None
    unit: LengthUnit | None = None
    up: Upward | None = None
    axes: Axes | None = None

    @property
    def upward(self) -> UpAxis | None:
        """Upward axis with its sign, by either setting; None where neither is given."""
        if self.axes is not None:
            return "-y"
        return None if self.up is None else SIGNED[str(self.up)]

    @property
    def unit_name(self) -> Unit | None:
        """The unit as readers take it."""
        return None if self.unit is None else cast("Unit", str(self.unit))

    @property
    def metres(self) -> float | None:
        """Length of the unit [m]."""
        return None if self.unit_name is None else METRES[self.unit_name]


@dataclass(kw_only=True)
class FitOptions(ModelOptions, SourceOptions):
    """What every fit takes: the file, the model, and how far the work goes at a time.

    Attributes:
        lod: of the fit.
        chunk: frames in memory at once; finished chunks are kept until the end.
        picture: the worst frames, coloured by their error.
    """

    lod: FitLod = FitLod.mid  # type: ignore[assignment]  # a part of the model's choice
    chunk: int = 256
    picture: Picture = field(default_factory=lambda: Picture(frames=0))

    def __post_init__(self) -> None:
        """Refuse a chunk of no frames, and two names of an axis that differ."""
        super().__post_init__()
        if self.axes is not None and self.up not in (None, "-y"):
            raise InputError(
                "axes", got=f"{self.axes} beside up={self.up}", expected="one of the two",
                fix="A camera's axes have up=-y.",
            )  # fmt: skip
        if self.chunk < 1:
            raise InputError("chunk", got=self.chunk, expected="at least 1", fix="Try chunk=256.")


@dataclass(kw_only=True)
class InvertOptions(FitOptions):
    """A fit to vertices over time.

    Attributes:
        topology: which mesh they are vertices of; ``auto`` tells it by their number.
    """

    backend: BackendChoice = field(default_factory=lambda: BackendChoice(name="soma"))
    topology: Topology = Topology.auto


@dataclass(kw_only=True)
class ConvertOptions(FitOptions):
    """A conversion of other tools' motions to this skeleton, or back.

    Attributes:
        backend: whose body moves, on the way back; in whose shapes an unknown body is sought.
        to: ``soma`` for this skeleton, else the backend to go back to.
        result: of the way back; None: poses of SMPL models, vertices of others.
        gender: of SMPL models; None: that of the file.
        most_betas: how many of a file's shape coefficients are used; None: all.
        angles: unit of a file's rotation vectors; None: radians.
        convention: zero of the rotations in a file on this skeleton; None: as the file says.
        betas: shape coefficients of the model, on the way back; None: the body's own, or the nearest.
        translation: where the body stands, on the way back.
    """

    to: str = "soma"
    result: ConvertResult | None = None
    gender: BodyGender | None = None
    most_betas: int | None = None
    angles: AngleUnit | None = None
    convention: RotationZero | None = None
    betas: list[float] | None = None
    translation: Translation = Translation.motion

    def __post_init__(self) -> None:
        """Refuse settings of the other direction, which would change nothing."""
        super().__post_init__()
        sought = None if self.identity.method == "known" else str(self.identity.method)
        unused: dict[str, object] = {"identity.method": sought, "most_betas": self.most_betas}
        why = f"to={self.to}"
        if self.to == "soma":
            placed = None if self.translation == "motion" else str(self.translation)
            unused = {"betas": self.betas, "result": self.result, "translation": placed}
            if self.backend is not None and sought is None and self.backend.name != "mhr":
                unused["backend"] = self.backend.name  # a file tells its own model
            why = "to=soma" if sought else "to=soma and identity=known"
        for name, value in unused.items():
            if value is not None:
                fix = f"Leave {name.partition('.')[0]} out."
                raise InputError(name, got=str(value), expected=f"none with {why}", fix=fix)
