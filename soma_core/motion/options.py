"""Options of fits and conversions; each field has the name that it has on the command line."""

from __future__ import annotations

from dataclasses import dataclass, field

from soma_core.errors import InputError
from soma_core.options import (
    BackendChoice,
    BodyGender,
    ConvertResult,
    FitLod,
    IdentityChoice,
    InversionChoice,
    LengthUnit,
    ModelOptions,
    Picture,
    Topology,
    Translation,
    Upward,
)

__all__ = ["ConvertOptions", "FitOptions", "InvertOptions"]


@dataclass(kw_only=True)
class FitOptions(ModelOptions):
    """What every fit takes.

    Attributes:
        identity: whose poses are sought: a known body, or one that is found as well.
        inversion: how poses are found.
        fps: frames per second, of files that do not say.
        unit: of files that do not say.
        up: upward axis, of files that do not say.
        lod: of the fit.
        chunk: frames in memory at once; finished chunks are kept until the end.
        picture: the worst frames, coloured by their error.
    """

    lod: FitLod = FitLod.mid
    identity: IdentityChoice = field(default_factory=IdentityChoice)
    inversion: InversionChoice = field(default_factory=InversionChoice)
    fps: float | None = None
    unit: LengthUnit | None = None
    up: Upward | None = None
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
        backend: whose body they are, or where the search for it begins.
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
        betas: shape coefficients of the model, on the way back; None: the body's own, or the nearest.
        translation: where the body stands, on the way back.
    """

    backend: BackendChoice | None = None
    to: str = "soma"
    result: ConvertResult | None = None
    gender: BodyGender | None = None
    most_betas: int | None = None
    betas: list[float] | None = None
    translation: Translation = Translation.motion

    def __post_init__(self) -> None:
        """Refuse settings of the other direction, which would change nothing."""
        super().__post_init__()
        sought = None if self.identity.method == "known" else str(self.identity.method)
        if self.to != "soma":
            unused, why = {"identity.method": sought, "most_betas": self.most_betas}, f"to={self.to}"
        else:
            placed = None if self.translation == "motion" else str(self.translation)
            unused = {"betas": self.betas, "result": self.result, "translation": placed}
            if self.backend is not None and sought is None and self.backend.name != "mhr":
                unused["backend"] = self.backend.name  # a file tells its own model
            why = "to=soma" if sought else "to=soma and identity=known"
        for name, value in unused.items():
            if value is not None:
                fix = f"Leave {name.partition('.')[0]} out."
                raise InputError(name, got=str(value), expected=f"none with {why}", fix=fix)
