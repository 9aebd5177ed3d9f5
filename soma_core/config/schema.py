"""The schema of each task's configuration: a typo or a wrong type dies before anything runs."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

from soma_core.choices import (
    Contacts,
    FitLod,
    Gallery,
    Ground,
    IdentitySource,
    Kernels,
    LengthUnit,
    Lod,
    ModelFile,
    ModelPart,
    Product,
    Translation,
)
from soma_core.motion.options import CleanOptions, DatasetOptions, InvertOptions
from soma_core.motion.writers import WriteOptions, listed_writers
from soma_core.options import BackendChoice, FrameRange, ModelOptions, Options, Picture, ViewOptions
from soma_core.paths import configs_dir

__all__ = [
    "SCHEMAS",
    "AnimateConfig",
    "BenchConfig",
    "CleanConfig",
    "ConvertConfig",
    "CorrectivesData",
    "EvaluateConfig",
    "Experiment",
    "ExportModelConfig",
    "InvertConfig",
    "TrainCorrectivesConfig",
    "TrainShapeConfig",
    "ViewConfig",
    "WrapConfig",
    "register_schemas",
]


def _any_backend() -> BackendChoice:
    """A backend that is yet to be chosen."""
    return BackendChoice(name=MISSING)


@dataclass(kw_only=True)
class _PlayedMotion(Options):
    """Which motion is played, on whose body."""

    backend: BackendChoice = field(default_factory=_any_backend)
    backends: Gallery = Gallery.one
    motion: str | None = None
    motion_fps: float | None = None
    person: str | None = None
    motion_unit: LengthUnit | None = None
    identity_from: IdentitySource = IdentitySource.backend
    frames: FrameRange = field(default_factory=FrameRange)
    translation: Translation = Translation.ground
    ground: Ground | None = None
    contacts: Contacts = Contacts.free


@dataclass(kw_only=True)
class AnimateConfig(ModelOptions, WriteOptions, _PlayedMotion):
    """Configuration of ``soma animate``."""

    seed: int = 0
    write: list[Product] = field(default_factory=lambda: [Product.npz, Product.usd, Product.glb, Product.png])
    picture: Picture = field(default_factory=Picture)


@dataclass(kw_only=True)
class ViewConfig(ViewOptions):
    """Configuration of ``soma view``."""

    backend: BackendChoice = field(default_factory=_any_backend)
    beside: list[str] = field(default_factory=list)
    motion: str | None = None
    settings: str | None = None
    identity_from: IdentitySource = IdentitySource.backend
    compare: str | None = None
    translation: Translation = Translation.ground
    seed: int = 0


@dataclass(kw_only=True)
class InvertConfig(InvertOptions):
    """Configuration of ``soma invert``."""

    backend: BackendChoice = field(default_factory=_any_backend)
    input: str | None = None
    seed: int = 0


@dataclass(kw_only=True)
class ConvertConfig(DatasetOptions):
    """Configuration of ``soma convert``."""

    input: str | None = None
    out: str = MISSING
    seed: int = 0


@dataclass(kw_only=True)
class CleanConfig(ModelOptions, CleanOptions):
    """Configuration of ``soma clean``."""

    input: str | None = None
    motion_fps: float | None = None
    person: str | None = None
    motion_unit: LengthUnit | None = None
    frames: FrameRange = field(default_factory=FrameRange)
    seed: int = 0


@dataclass
class TrainShapeConfig:
    """Configuration of ``soma train-shape``."""

    shards: list[str] = field(default_factory=list)
    mix: dict[str, float] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    spread: float = 0.15
    skip_groups: list[str] = field(default_factory=list)
    count: int = 6000
    components: int = 128
    batch: int = 256
    mirror: bool = True
    held_out: int = 200
    save_every: int = 4
    resume: bool = True
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

    teacher: str = "bone"
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
    smoothness: float = 0.0
    mebibytes: float = 4.7
    first: str | None = None
    save_every: int = 500
    resume: bool = True
    seed: int = 0
    device: str = "cpu"
    out: str | None = None


@dataclass
class Experiment:
    """What an evaluation measures: backends and their options, how many bodies or frames, methods, files."""

    name: str = MISSING
    backend: str = MISSING
    count: int = 100
    methods: list[str] = field(default_factory=list)
    data: str | None = None
    checkpoint: str | None = None
    motions: list[str] = field(default_factory=list)
    options: dict[str, Any] = field(default_factory=dict)


@dataclass
class EvaluateConfig:
    """Configuration of ``soma evaluate``."""

    experiment: Experiment = field(default_factory=Experiment)
    seed: int = 0
    device: str = "cpu"


@dataclass
class BenchConfig:
    """Configuration of ``soma bench``."""

    backend: BackendChoice = field(default_factory=_any_backend)
    batches: list[int] = field(default_factory=lambda: [1, 8, 32, 128])
    kernels: Kernels = Kernels.auto
    device: str = "cpu"
    threads: int = 2
    repeats: int = 20
    seed: int = 0


@dataclass(kw_only=True)
class ExportModelConfig(Options):
    """Configuration of ``soma export-model``."""

    backend: BackendChoice = field(default_factory=_any_backend)
    what: ModelPart = ModelPart.pose
    write: list[ModelFile] = field(default_factory=lambda: [ModelFile.onnx, ModelFile.pt2])
    parameters: list[str] | None = None
    lod: Lod = Lod.low
    procedural: bool = True
    correctives: str | None = "auto"
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


SCHEMAS: dict[str, type] = {
    "animate": AnimateConfig,
    "invert": InvertConfig,
    "convert": ConvertConfig,
    "clean": CleanConfig,
    "train_shape": TrainShapeConfig,
    "train_correctives": TrainCorrectivesConfig,
    "evaluate": EvaluateConfig,
    "bench": BenchConfig,
    "export_model": ExportModelConfig,
    "wrap": WrapConfig,
    "view": ViewConfig,
}
"""Task -> schema of its configuration."""


def _listed_products(program: str) -> str:
    """What a help text says of ``write=``, for the commands that have it."""
    if program not in ("soma animate", "soma convert"):
        return ""
    return f"Products, write=[NAME,...]:\n{listed_writers()}\n\n"


_EXPLAINED = re.compile(r"^(?:  - )?(?P<key>[a-z]\w*): [^#\n]*# (?P<text>.+)$", re.MULTILINE)
"""A key of a task or of its defaults in a file, and the comment beside it."""


def _explained_keys(program: str) -> str:
    """What the comments in a task's file say of its keys."""
    task = program.partition(" ")[2].replace("-", "_")
    if task not in SCHEMAS:
        return ""
    text = (configs_dir() / f"{task}.yaml").read_text(encoding="utf-8")
    rows = [(line["key"], line["text"]) for line in _EXPLAINED.finditer(text)]
    width = max((len(key) for key, _ in rows), default=0)
    lines = [f"  {key:<{width}}  {text}" for key, text in rows]
    return "\n".join(["What keys mean:", *lines, "", ""]) if lines else ""


def register_schemas() -> None:
    """Make the schemas known to hydra under ``<task>_schema``; safe to call again."""
    OmegaConf.register_new_resolver("soma_products", _listed_products, replace=True)
    OmegaConf.register_new_resolver("soma_keys", _explained_keys, replace=True)
    store = ConfigStore.instance()
    for task, schema in SCHEMAS.items():
        if f"{task}_schema.yaml" not in store.repo:  # a schema takes milliseconds to make
            store.store(name=f"{task}_schema", node=schema)
