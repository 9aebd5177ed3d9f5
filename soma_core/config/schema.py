"""The schema of each task's configuration: a typo or a wrong type dies before anything runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from soma_core.config.choices import (
    BodyGender,
    ConvertResult,
    FitLod,
    Gallery,
    IdentityMethod,
    IdentitySource,
    Kernels,
    LengthUnit,
    Lod,
    Product,
    Topology,
    Translation,
    Upward,
)

__all__ = [
    "AnalyticalChoice",
    "AnimateConfig",
    "AutogradChoice",
    "BackendChoice",
    "BenchConfig",
    "ConvertConfig",
    "CorrectivesData",
    "EvaluateConfig",
    "Experiment",
    "FrameRange",
    "IdentityChoice",
    "InversionChoice",
    "InvertConfig",
    "Picture",
    "PriorChoice",
    "TrainCorrectivesConfig",
    "TrainShapeConfig",
    "WrapConfig",
    "register_schemas",
]


@dataclass
class BackendChoice:
    """An identity: the backend, its parameters (null: the default) and its options."""

    name: str = MISSING
    params: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)


@dataclass
class FrameRange:
    """A slice of the motion, as in Python: stop is left out, null means to the end."""

    start: int = 0
    stop: int | None = None
    step: int = 1


@dataclass
class Picture:
    """The contact sheet: how many frames, and its width in pixels."""

    frames: int = 10
    width: int = 1600


@dataclass
class AnimateConfig:
    """Configuration of ``soma animate``."""

    backend: BackendChoice = field(default_factory=BackendChoice)
    backends: Gallery = Gallery.one
    motion: str | None = None
    motion_fps: float | None = None
    identity_from: IdentitySource = IdentitySource.backend
    frames: FrameRange = field(default_factory=FrameRange)
    translation: Translation = Translation.ground
    lod: Lod = Lod.mid
    kernels: Kernels = Kernels.auto
    procedural: bool = True
    correctives: str | None = "auto"
    device: str = "cpu"
    seed: int = 0
    write: list[Product] = field(default_factory=lambda: list(Product))
    picture: Picture = field(default_factory=Picture)


@dataclass
class AnalyticalChoice:
    """Sweeps of the stage ``analytical`` over all but the fingers, the fingers, and everything."""

    body: int = 2
    fingers: int = 0
    full: int = 1


@dataclass
class AutogradChoice:
    """Stage ``autograd``: steps, learning rates [rad, m], how far they fall, factors of regions, the loss."""

    iterations: int = 100
    rate: float = 0.02
    shift_rate: float = 0.002
    final: float = 0.005
    regions: dict[str, float] = field(default_factory=dict)
    loss: str = "moments"


@dataclass
class PriorChoice:
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


@dataclass
class InversionChoice:
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


@dataclass
class IdentityChoice:
    """Whose poses are sought: a known identity, or one found from some of the frames."""

    method: IdentityMethod = IdentityMethod.known
    free: list[str] | None = None
    frames: int = 20
    iterations: int = 12


@dataclass
class InvertConfig:
    """Configuration of ``soma invert``."""

    backend: BackendChoice = field(default_factory=BackendChoice)
    identity: IdentityChoice = field(default_factory=IdentityChoice)
    inversion: InversionChoice = field(default_factory=InversionChoice)
    input: str | None = None
    fps: float | None = None
    unit: LengthUnit | None = None
    up: Upward | None = None
    topology: Topology = Topology.auto
    lod: FitLod = FitLod.mid
    procedural: bool = True
    correctives: str | None = "auto"
    device: str = "cpu"
    seed: int = 0
    chunk: int = 256
    picture: Picture = field(default_factory=lambda: Picture(frames=5))


@dataclass
class ConvertConfig:
    """Configuration of ``soma convert``."""

    backend: BackendChoice | None = None
    identity: IdentityChoice = field(default_factory=IdentityChoice)
    inversion: InversionChoice = field(default_factory=InversionChoice)
    input: str | None = None
    out: str = MISSING
    to: str = "soma"
    result: ConvertResult | None = None
    fps: float | None = None
    unit: LengthUnit | None = None
    up: Upward | None = None
    gender: BodyGender | None = None
    most_betas: int | None = None
    betas: list[float] | None = None
    translation: Translation = Translation.motion
    lod: FitLod = FitLod.mid
    device: str = "cpu"
    seed: int = 0
    chunk: int = 256
    picture: Picture = field(default_factory=lambda: Picture(frames=5))


@dataclass
class TrainShapeConfig:
    """Configuration of ``soma train-shape``."""

    mix: dict[str, float] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    spread: float = 0.15
    skip_groups: list[str] = field(default_factory=list)
    count: int = 6000
    components: int = 128
    batch: int = 256
    mirror: bool = True
    held_out: int = 200
    resume: bool = False
    seed: int = 0
    device: str = "cpu"
    out: str | None = None


@dataclass
class CorrectivesData:
    """Poses that correctives are taught on: random clips, and every `step`-th frame of motion files."""

    random_clips: int = 140
    hanging_clips: int = 40
    poses: int = 24
    motions: list[str] = field(default_factory=list)
    step: int = 10
    mirror: bool = True
    held_out: float = 0.1


@dataclass
class TrainCorrectivesConfig:
    """Configuration of ``soma train-correctives``."""

    teacher: str = "elastic"
    data: CorrectivesData = field(default_factory=CorrectivesData)
    channels: int = 24
    reach: float = 1.5
    lod: FitLod = FitLod.low
    batch: int = 64
    epochs: int = 24
    rate: float = 0.003
    sparsity: float = 0.01
    patience: int = 8
    ridge: float = 1e-4
    mebibytes: float = 4.7
    resume: bool = False
    seed: int = 0
    device: str = "cpu"
    out: str | None = None


@dataclass
class Experiment:
    """What an evaluation measures: on what backend, how many bodies or frames, which methods and files."""

    name: str = MISSING
    backend: str = MISSING
    count: int = 100
    methods: list[str] = field(default_factory=list)
    data: str | None = None
    checkpoint: str | None = None
    motions: list[str] = field(default_factory=list)


@dataclass
class EvaluateConfig:
    """Configuration of ``soma evaluate``."""

    experiment: Experiment = field(default_factory=Experiment)
    seed: int = 0
    device: str = "cpu"


@dataclass
class BenchConfig:
    """Configuration of ``soma bench``."""

    backend: BackendChoice = field(default_factory=BackendChoice)
    batches: list[int] = field(default_factory=lambda: [1, 8, 32, 128])
    kernels: Kernels = Kernels.auto
    device: str = "cpu"
    threads: int = 2
    repeats: int = 20
    seed: int = 0


@dataclass
class WrapConfig:
    """Configuration of ``soma wrap``."""

    backend: BackendChoice | None = None
    native: str | None = None
    out: str | None = None
    unit: LengthUnit | None = None
    up: str | None = None
    forward: str | None = None
    fill: list[str] = field(default_factory=lambda: ["eye_bags", "mouth_bag", "between_toes"])
    symmetric: bool | None = None
    landmarks: str | None = None
    mask: str | None = None
    picture: bool = True


def register_schemas() -> None:
    """Make the schemas known to hydra under ``<task>_schema``; safe to call again."""
    store = ConfigStore.instance()
    for task, schema in (
        ("animate", AnimateConfig),
        ("invert", InvertConfig),
        ("convert", ConvertConfig),
        ("train_shape", TrainShapeConfig),
        ("train_correctives", TrainCorrectivesConfig),
        ("evaluate", EvaluateConfig),
        ("bench", BenchConfig),
        ("wrap", WrapConfig),
    ):
        store.store(name=f"{task}_schema", node=schema)
