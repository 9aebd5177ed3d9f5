"""Options of fits and conversions; each field has the name that it has on the command line."""

from __future__ import annotations

from dataclasses import dataclass, field

from soma_core.errors import InputError
from soma_core.options import (
    BackendChoice,
    BetasFrom,
    BodyGender,
    ConvertResult,
    Coordinates,
    FitLod,
    Gaps,
    IdentityChoice,
    InversionChoice,
    LengthUnit,
    ModelOptions,
    Options,
    Picture,
    RotationLayout,
    SmplModel,
    Topology,
    Translation,
    Upward,
)

__all__ = ["ConvertOptions", "FitOptions", "InvertOptions", "SourceOptions"]


@dataclass(kw_only=True)
class SourceOptions(Options):
    """Whose body a file shows, how its poses are found, and what the file itself does not say.

    Attributes:
        backend: the body, or where the search for it begins.
        identity: a known body, or one that is found as well.
        inversion: how poses are found.
        fps: frames per second.
        unit: of lengths.
        up: upward axis.
    """

    backend: BackendChoice | None = None
    identity: IdentityChoice = field(default_factory=IdentityChoice)
    inversion: InversionChoice = field(default_factory=InversionChoice)
    fps: float | None = None
    unit: LengthUnit | None = None
    up: Upward | None = None


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
        """Refuse a chunk of no frames."""
        super().__post_init__()
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
        betas: shape coefficients of SMPL models; None: those of the file, on the way back the body's own, or
            the nearest.
        betas_from: what is made of a file's shapes for each frame.
        model: of the SMPL family, that a file's poses are of; None: as the file tells.
        person: whose motion, in a file of several people; ``all`` for a motion of each.
        coordinates: the motion in the world or in the camera; None: the world where the file has it.
        rotation_layout: of quaternions and 6D rotations; None: as the numbers tell.
        flat_hand_mean: whether zero is a flat hand; None: as the file says, or flat.
        gaps: what becomes of frames that a file lacks or where it holds NaN.
        longest_gap: that is interpolated [s].
        translation: where the body stands, on the way back.
    """

    to: str = "soma"
    result: ConvertResult | None = None
    gender: BodyGender | None = None
    most_betas: int | None = None
    betas: list[float] | None = None
    betas_from: BetasFrom = BetasFrom.mean
    model: SmplModel | None = None
    person: str | None = None
    coordinates: Coordinates | None = None
    rotation_layout: RotationLayout | None = None
    flat_hand_mean: bool | None = None
    gaps: Gaps = Gaps.interpolate
    longest_gap: float = 1.0
    translation: Translation = Translation.motion

    def __post_init__(self) -> None:
        """Refuse settings of the other direction, which would change nothing."""
        super().__post_init__()
        sought = None if self.identity.method == "known" else str(self.identity.method)
        unused: dict[str, object] = {"identity.method": sought, "most_betas": self.most_betas}
        unused |= {
            name: getattr(self, name) for name in ("person", "model", "coordinates", "rotation_layout")
        }
        why = f"to={self.to}"
        if self.to == "soma":
            placed = None if self.translation == "motion" else str(self.translation)
            unused = {"result": self.result, "translation": placed}
            if self.backend is not None and sought is None and self.backend.name != "mhr":
                unused["backend"] = self.backend.name  # a file tells its own model
            why = "to=soma" if sought else "to=soma and identity=known"
        for name, value in unused.items():
            if value is not None:
                fix = f"Leave {name.partition('.')[0]} out."
                raise InputError(name, got=str(value), expected=f"none with {why}", fix=fix)
