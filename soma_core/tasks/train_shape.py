"""``soma train-shape``: learn the native shape space from identities sampled from installed backends."""

from __future__ import annotations

import importlib.metadata
import json
import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from soma_core.cache import atomic_write, content_key
from soma_core.correctives.processes import Processes, joined_processes
from soma_core.errors import InputError
from soma_core.layer import SomaLayer
from soma_core.paths import cache_dir
from soma_core.plugin.discovery import installed_versions
from soma_core.plugin.registry import default_registry
from soma_core.progress import progress
from soma_core.rig import load_canonical
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.neutral import ShapeSpace
from soma_core.shape_space.converted import ConvertedBodies
from soma_core.shape_space.report import ErrorRow, plot_errors, reconstruction_errors
from soma_core.shape_space.sampling import HELD_OUT, IdentityStream, ShapeStream
from soma_core.shape_space.training import Components, TrainingPlan, train_components

__all__ = ["SHAPE_SPACE_FILE", "run", "write_shape_space"]

_log = logging.getLogger(__name__)

SHAPE_SPACE_FILE = "shape_space.npz"
_CODE_VERSION = 1
_CM_PER_M = 100.0


def run(config: DictConfig, output: Path) -> None:
    """Sample, train, measure on held-out identities, and write the shape space and its report.

    Writes ``shape_space.npz`` (or the file `config.out`), ``report.json`` and, where matplotlib is
    installed, ``reconstruction.png`` into `output`. Under ``torchrun`` all processes make bodies, and the
    first one trains and writes; the result is that of one process.

    Raises:
        InputError: a mixture, shards, a plan or an option that cannot be used.
        BackendError: a backend of the mixture is not usable.
    """
    if config.held_out < 1:
        raise InputError("held_out", got=config.held_out, expected="at least 1", fix="Try held_out=200.")
    with joined_processes("cpu") as processes:
        _trained(config, output, processes)


def _trained(config: DictConfig, output: Path, processes: Processes) -> None:
    mesh, _ = load_canonical("mid")
    stream, count, source = _stream(config, processes)
    plan = _plan(config, count)
    provenance = {**_provenance(config, mesh), **source}
    key = content_key(_CODE_VERSION, json.dumps(provenance, sort_keys=True), str(plan))
    total = len(plan.batch_sizes)
    components = train_components(
        stream,
        plan,
        bind=_CM_PER_M * mesh.vertices,
        partner=mesh.mirror,
        state=cache_dir() / "train_shape" / f"{key}.npz",
        key=key,
        resume=config.resume,
        progress=lambda steps, done: progress(steps, label="shape space, batch", total=total, done=done),
        processes=processes,
    )
    if components is None:
        return
    held_out = stream.shapes(HELD_OUT, 0, config.held_out)
    errors = reconstruction_errors(components.mean, components.directions, held_out)
    metadata = {**provenance, **_measured(components, errors, config.held_out)}
    space = ShapeSpace(
        mean=components.mean.astype(np.float32),
        shapedirs=components.directions.astype(np.float32),
        eigenvalues=components.eigenvalues.astype(np.float32),
        metadata=metadata,
    )
    write_shape_space(Path(config.out) if config.out else output / SHAPE_SPACE_FILE, space)
    text = json.dumps(metadata, indent=2) + "\n"
    atomic_write(output / "report.json", lambda path: _write_text(path, text))
    if not plot_errors(errors, output / "reconstruction.png"):
        _log.info("matplotlib is not installed: report.json has the numbers, there is no plot")


def write_shape_space(path: Path, space: ShapeSpace) -> None:
    """Write a shape-space file; ``python -m assets.make --shape-space FILE`` rounds it and merges it."""
    arrays = {"mean": space.mean, "shapedirs": space.shapedirs, "eigenvalues": space.eigenvalues}
    text = json.dumps(dict(space.metadata), sort_keys=True)
    atomic_write(path, lambda part: np.savez_compressed(part, metadata=np.array(text), **arrays))


def _plan(config: DictConfig, count: int) -> TrainingPlan:
    return TrainingPlan(
        count=count, components=config.components, batch=config.batch, mirror=config.mirror,
        save_every=config.save_every,
    )  # fmt: skip


def _stream(config: DictConfig, processes: Processes) -> tuple[ShapeStream, int, dict[str, Any]]:
    """Where bodies come from, how many to train on, and what a file says of that."""

    def layer(name: str, options: Mapping[str, Any] | None) -> SomaLayer:
        return SomaLayer(name, options=options, device=config.device, dtype=torch.float32)

    if config.shards:
        bodies = ConvertedBodies(
            list(config.shards), held_out=config.held_out, most=config.count, layer=layer, seed=config.seed,
            batch_sizes=lambda count: _plan(config, count).batch_sizes, processes=processes,
        )  # fmt: skip
        shards = {"key": bodies.key, "files": [Path(each).name for each in config.shards]}
        source = {"trained_on": bodies.origins, "identities": bodies.count, "shards": shards}
        return bodies, bodies.count, source
    options = OmegaConf.to_container(config.options, resolve=True)
    layers = {name: layer(name, options.get(name)) for name in config.mix}
    drawn = IdentityStream(
        layers,
        dict(config.mix),
        seed=config.seed,
        spread=config.spread,
        skip_groups=list(config.skip_groups),
    )
    return drawn, config.count, {}


def _provenance(config: DictConfig, mesh: CanonicalMesh) -> dict[str, Any]:
    """What the space is trained on, in a form that can be stored."""
    options = OmegaConf.to_container(config.options, resolve=True)
    return {
        "units": "cm",
        "up_axis": "+y",
        "forward_axis": "+z",
        "handedness": "right",
        "pose": "bind, lowest vertex at height 0",
        "rig_revision": mesh.revision,
        "trained_on": [
            {**_origin(name), "share": share, "options": options.get(name, {})}
            for name, share in ({} if config.shards else config.mix).items()
        ],
        "identities": config.count,
        "mirror_images": config.mirror,
        "seed": config.seed,
        "batch": config.batch,
        "spread": config.spread,
        "skipped_groups": list(config.skip_groups),
    }


def _origin(name: str) -> dict[str, Any]:
    """Distribution, licence and versions behind backend `name`."""
    registry = default_registry()
    spec = registry.spec(name)
    entry = next(entry for entry in registry.entries() if entry.name == name)
    return {
        "backend": name,
        "distribution": entry.distribution,
        "version": entry.version,
        "requires": _installed_requirements(entry.distribution),
        "licence": spec.licence,
        "url": spec.url,
    }


def _installed_requirements(distribution: str) -> Mapping[str, str]:
    """Versions of what `distribution` directly requires, extras left out."""
    try:
        requirements = importlib.metadata.requires(distribution) or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    names = [re.split(r"[^A-Za-z0-9._-]", line)[0] for line in requirements if "extra ==" not in line]
    installed = {name.lower(): version for name, version in installed_versions().items()}
    return {name: installed[name.lower()] for name in names if name.lower() in installed}


def _measured(components: Components, errors: list[ErrorRow], held_out: int) -> dict[str, Any]:
    return {
        "shapes": components.shapes,
        "components": len(components.eigenvalues),
        "explained_variance": round(float(components.explained.sum()), 8),
        "held_out_identities": held_out,
        "held_out_errors": errors,
    }


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
