"""Options of fits and conversions; each field has the name that it has on the command line."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from soma_core.choices import (
    AngleUnit,
    Axes,
    BetasFrom,
    BodyGender,
    BoneMatch,
    Carry,
    Contacts,
    ConvertResult,
    Coordinates,
    DatasetOutput,
    Engine,
    FitLod,
    Gaps,
    Ground,
    LengthUnit,
    Product,
    Refine,
    RotationLayout,
    RotationZero,
    Skinning,
    Smooth,
    SmplLayout,
    SmplModel,
    Topology,
    Translation,
    Upward,
)
from soma_core.errors import InputError
from soma_core.io.vertex_sequence import UpAxis
from soma_core.motion.writers import MESH_WRITERS, WriteOptions
from soma_core.options import BackendChoice, IdentityChoice, InversionChoice, ModelOptions, Options, Picture
from soma_core.topology.frames import METRES

__all__ = [
    "CleanOptions", "ConvertOptions", "DatasetOptions", "FitOptions", "InvertOptions", "LimbSeconds",
    "SourceOptions",
]  # fmt: skip


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
        points: the set that a file of points has, or a JSON file of one's own; None for other files.
    """

    backend: BackendChoice | None = None
    identity: IdentityChoice = field(default_factory=IdentityChoice)
    inversion: InversionChoice = field(default_factory=InversionChoice)
    fps: float | None = None
    unit: LengthUnit | None = None
    up: Upward | None = None
    axes: Axes | None = None
    points: str | None = None

    @property
    def upward(self) -> UpAxis | None:
        """Upward axis with its sign, by either setting; None where neither is given."""
        if self.axes is not None:
            return "-y"
        return None if self.up is None else SIGNED[str(self.up)]

    @property
    def unit_name(self) -> str | None:
        """The unit as readers take it."""
        return None if self.unit is None else str(self.unit)

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
        camera: JSON file of the camera, or of a list of cameras, in whose pictures `points` are.
    """

    lod: FitLod = FitLod.mid  # type: ignore[assignment]  # a part of the model's choice
    chunk: int = 256
    picture: Picture = field(default_factory=lambda: Picture(frames=0))
    camera: str | None = None

    def __post_init__(self) -> None:
        """Refuse a chunk of no frames, and two names of an axis that differ."""
        super().__post_init__()
        if self.axes is not None and self.up not in (None, "-y"):
            raise InputError(
                "axes", got=f"{self.axes} beside up={self.up}", expected="one of the two",
                fix="A camera's axes have up=-y.",
            )  # fmt: skip
        if self.camera is not None and self.points is None and not isinstance(self, WriteOptions):
            fix = "Pass points=NAME, such as coco17."
            raise InputError("camera", got=self.camera, expected="none without points", fix=fix)
        if self.chunk < 1:
            raise InputError("chunk", got=self.chunk, expected="at least 1", fix="Try chunk=256.")


@dataclass(kw_only=True)
class InvertOptions(FitOptions):
    """A fit to vertices over time.

    Attributes:
        topology: which mesh they are vertices of; ``auto`` tells it by their number.
        allow_references: let a USD file refer to what lies outside of its folder.
    """

    backend: BackendChoice = field(default_factory=lambda: BackendChoice(name="soma"))
    topology: Topology = Topology.auto
    allow_references: bool = False


@dataclass(kw_only=True)
class ConvertOptions(WriteOptions, FitOptions):
    """A conversion of other tools' motions to this skeleton, or back.

    Attributes:
        backend: whose body moves, on the way back and in what is written of a body; in whose shapes an
            unknown body is sought.
        inversion: how poses are found: those of the full model, which plays them.
        to: ``soma`` for this skeleton, else the backend to go back to; or a product, as with `write`.
        write: products, of ``soma_core.motion.writers``. To this skeleton they come beside the motion, which
            is always written; on the way back they are meshes of the model. None: the motion, or what
            `result` says.
        result: of the way back; None: poses of SMPL models, vertices of others.
        gender: of SMPL models; None: that of the file.
        most_betas: how many of a file's shape coefficients are used; None: all.
        angles: unit of a file's rotation vectors, None: radians; or of the angles of a BVH, None: degrees.
        convention: zero of the rotations in a file on this skeleton; None: as the file says.
        betas: shape coefficients of SMPL models; None: those of the file, on the way back the body's own, or
            the nearest.
        betas_from: what is made of a file's shapes for each frame.
        model: of the SMPL family, that a file's poses are of; None: as the file tells.
        person: whose motion, in a file of several people; ``all`` for a motion of each.
        coordinates: the motion in the world or in the camera; None: the world where the file has it.
        rotation_layout: of quaternions and 6D rotations, None: as the numbers tell; ``columns`` for matrices
            that are stored column by column.
        swap_sides: whether what a file calls left is right.
        flat_hand_mean: whether zero is a flat hand; None: as the file says, or flat.
        gaps: what becomes of frames that a file lacks or where it holds NaN.
        longest_gap: that is interpolated [s].
        num_betas: how many are written; None: as many as the body's file or the model has, 10 at least.
        layout: names of the keys that poses of SMPL models are written under; None: those of AMASS.
        translation: where the body stands, on the way back and in what is written of a body.
        ground: what lies on the floor then; None: the usual for that translation.
        contacts: whether feet that stand are pinned then.
        carry: for models of the SMPL family: ``skeleton`` needs no model file, and reads no betas.
        mapping: file that says which joint of a skeleton is which, where its names are not known.
        root: of a file with several skeletons, the one that is read.
        refine: ``joints`` brings hands and feet of another skeleton to where they are there; None: no.
        match: which bones of another skeleton are matched by direction: ``bones`` all, ``soles`` all but the
            slope of feet, ``limbs`` those of arms, legs and fingers; None: ``soles``, and ``limbs`` for the
            SMPL family.
    """

    to: str = "soma"
    inversion: InversionChoice = field(default_factory=lambda: InversionChoice(skinning=Skinning.full))
    write: list[Product] | None = None
    carry: Carry = Carry.fit
    mapping: str | None = None
    root: str | None = None
    match: BoneMatch | None = None
    refine: Refine | None = None
    result: ConvertResult | None = None
    gender: BodyGender | None = None
    most_betas: int | None = None
    angles: AngleUnit | None = None
    convention: RotationZero | None = None
    betas: list[float] | None = None
    betas_from: BetasFrom = BetasFrom.mean
    model: SmplModel | None = None
    person: str | None = None
    coordinates: Coordinates | None = None
    rotation_layout: RotationLayout | None = None
    swap_sides: bool = False
    flat_hand_mean: bool | None = None
    gaps: Gaps = Gaps.interpolate
    longest_gap: float = 1.0
    num_betas: int | None = None
    layout: SmplLayout | None = None
    translation: Translation = Translation.motion
    ground: Ground | None = None
    contacts: Contacts = Contacts.free

    def __post_init__(self) -> None:
        """Refuse settings of the other direction, which would change nothing."""
        super().__post_init__()
        if self.to == "fbx":
            raise InputError(
                "to", got="fbx", expected="what is written without other programs",
                fix="Pass to=glb; docs/to_fbx.py then makes an FBX of it in Blender.",
            )  # fmt: skip
        if self.to in list(Product):
            object.__setattr__(self, "write", [*(self.write or []), Product(self.to)])
            object.__setattr__(self, "to", "soma")
        if self.num_betas is not None and self.num_betas < 1:
            raise InputError("num_betas", got=self.num_betas, expected="at least 1", fix="Try num_betas=10.")
        sought = None if self.identity.method == "known" else str(self.identity.method)
        unused: dict[str, object] = {"identity.method": sought, "most_betas": self.most_betas}
        unused |= {name: getattr(self, name) for name in ("model", "coordinates", "rotation_layout")}
        unused["swap_sides"] = self.swap_sides or None
        why = f"to={self.to}"
        if self.to == "soma":
            placed = None if self.translation == "motion" or self.shown else str(self.translation)
            held = None if self.contacts == "free" or self.shown else str(self.contacts)
            unused = {
                "num_betas": self.num_betas, "layout": self.layout,
                "result": self.result, "translation": placed, "contacts": held,
                "ground": None if self.shown else self.ground,
            }  # fmt: skip
            told = sought is None and self.points is None and not self.shown
            if self.backend is not None and told and self.backend.name != "mhr":
                unused["backend"] = self.backend.name  # a file tells its own model
            why = "to=soma" if sought else "to=soma and identity=known"
        for name, value in unused.items():
            if value is not None:
                fix = f"Leave {name.partition('.')[0]} out."
                raise InputError(name, got=str(value), expected=f"none with {why}", fix=fix)
        self._check_products()

    @property
    def shown(self) -> list[Product]:
        """Products beside the motion, for which a body is posed."""
        return [product for product in self.write or [] if product is not Product.npz]

    def _check_products(self) -> None:
        """Refuse products that the direction does not have, and settings that none of them takes.

        Raises:
            InputError: the first one.
        """
        if self.to == "soma":
            used = () if self.points is None else ("camera",)
            self.refuse_unused(self.write or [Product.npz], used)
            return
        strange = [product for product in self.shown if product not in MESH_WRITERS]
        mixed = self.shown and (Product.npz in (self.write or []) or self.result == "poses")
        if strange or mixed:
            raise InputError(
                "write", got=strange[0] if strange else f"poses and {self.shown[0]}",
                expected=f"with to={self.to}, npz for its poses, or its mesh: {', '.join(MESH_WRITERS)}",
                fix="Leave to out for this skeleton." if strange else "Run it once for each.",
            )  # fmt: skip
        for name, value in self.given().items():
            raise InputError(name, got=value, expected=f"none with to={self.to}", fix=f"Leave {name} out.")


@dataclass(kw_only=True)
class DatasetOptions(ConvertOptions):
    """A conversion of many files: who does it, and how the motions are kept.

    Attributes:
        engine: processes of this machine, or Ray.
        output: a file for each, which mirror the folder, or Parquet shards with a row a clip.
        workers: how many work at once; None: one a core, one on a GPU, and of a cluster as many as it takes.
        num_gpus: GPUs of each of Ray's actors; parts of one are shared.
        address: of a Ray cluster; None: Ray is started on this machine.
        shard: clips in a shard.
    """

    engine: Engine = Engine.local
    output: DatasetOutput = DatasetOutput.folder
    workers: int | None = None
    num_gpus: float = 0.0
    address: str | None = None
    shard: int = 64

    def __post_init__(self) -> None:
        """Refuse settings of the other engine, and what shards do not hold."""
        super().__post_init__()
        for name, least in (("shard", 1), ("workers", 1), ("num_gpus", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(name, got=value, expected=f"at least {least}", fix=f"Leave {name} out.")
        parquet, ray = self.output == "parquet", self.engine == "ray"
        unused = {
            "address": (None if ray else self.address, "engine=local", "Pass engine=ray."),
            "num_gpus": (None if ray else self.num_gpus or None, "engine=local", "Pass engine=ray."),
            "to": (self.to if parquet and self.to != "soma" else None, "output=parquet", "Leave output out."),
            "write": (
                ",".join(self.shown) if parquet and self.shown else None, "output=parquet", "Leave one out.",
            ),
        }  # fmt: skip
        if self.num_gpus and self.device == "cpu":
            unused["num_gpus"] = (self.num_gpus, "device=cpu", "Pass device=cuda.")
        for name, (value, beside, fix) in unused.items():
            if value is not None:
                raise InputError(name, got=value, expected=f"none with {beside}", fix=fix)

    @classmethod
    def of(cls, options: ConvertOptions | None, **changes: Any) -> DatasetOptions:
        """These options alone, of a conversion or of what a command adds to them."""
        given = ConvertOptions.or_default(options)
        known = {each.name: getattr(given, each.name) for each in fields(cls) if hasattr(given, each.name)}
        return cls(**known | changes)


@dataclass(kw_only=True)
class LimbSeconds(Options):
    """How long a stretch of time a motion is smoothed over, by limb [s]; `path` is that of the Hips.

    None and 0 leave a limb alone, in :class:`CleanOptions` None is what the preset has.
    """

    path: float | None = None
    hips: float | None = None
    spine: float | None = None
    head: float | None = None
    arms: float | None = None
    hands: float | None = None
    fingers: float | None = None
    legs: float | None = None
    feet: float | None = None

    def __post_init__(self) -> None:
        """Refuse what is no such time."""
        super().__post_init__()
        for name, value in vars(self).items():
            if value is not None and not 0 <= value <= 1:
                raise InputError(
                    f"seconds.{name}", got=value, expected="0, which leaves it alone, to 1 second",
                    fix=f"Try seconds.{name}=0.05.",
                )  # fmt: skip


@dataclass(kw_only=True)
class CleanOptions(Options):
    """What is done to a motion, in this order.

    Attributes:
        spikes: whether frames in which a joint sticks out are replaced.
        smooth: preset of smoothing.
        seconds: of limbs that are smoothed otherwise.
        rate: frames per second of the result; None: as they are.
        mirror: whether left and right change places.
    """

    spikes: bool = True
    smooth: Smooth = Smooth.light
    seconds: LimbSeconds = field(default_factory=LimbSeconds)
    rate: float | None = None
    mirror: bool = False

    def __post_init__(self) -> None:
        """Refuse a rate that is none."""
        super().__post_init__()
        if self.rate is not None and not 0 < self.rate <= 10_000:
            raise InputError("rate", got=self.rate, expected="frames per second", fix="Try rate=30.")
