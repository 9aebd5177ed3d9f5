"""``soma bench``: time the forward path of one backend, after checking that its results are right."""

from __future__ import annotations

import json
import logging
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from soma_core.backends.rest_shape import ComposedRestShape
from soma_core.cache import atomic_write
from soma_core.errors import SomaError
from soma_core.evaluation.random_poses import random_axis_angles
from soma_core.layer import SomaLayer
from soma_core.options import BackendChoice
from soma_core.shape_space.sampling import sample_parameters

__all__ = ["run"]

_log = logging.getLogger(__name__)

_AGREEMENT_MM = 0.05
"""Largest distance between the timed path and the reference: linearised offsets and float32 rounding."""


def run(config: DictConfig, output: Path) -> None:
    """Compare with the exact torch path, then time; write ``bench.json`` into `output`.

    Raises:
        SomaError: the timed path and the reference disagree; nothing is timed then.
    """
    with _threads(config.threads):
        _run(config, output)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Let torch take `count` threads; a caller from Python has its own number back afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _run(config: DictConfig, output: Path) -> None:
    backend: BackendChoice = OmegaConf.to_object(config.backend)
    begin = time.perf_counter()
    layer = SomaLayer(
        backend.name, options=backend.options, kernels=str(config.kernels), device=config.device
    )
    construction = time.perf_counter() - begin
    _check(config, layer)
    rows = [row for batch in config.batches for row in _time_batch(config, layer, batch)]
    document = {
        "backend": backend.name,
        "kernels": str(config.kernels),
        "device": config.device,
        "threads": config.threads,
        "construction_s": construction,
        "rows": rows,
    }
    text = json.dumps(document, indent=2) + "\n"
    atomic_write(output / "bench.json", lambda path: path.write_text(text, encoding="utf-8") and None)
    for row in rows:
        _log.info("%(case)s, batch %(batch)d: %(median_ms).2f ms, %(bodies_per_s).0f bodies/s", row)


def _inputs(config: DictConfig, layer: SomaLayer, batch: int) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    random = np.random.default_rng([config.seed, batch])
    groups = {parameter.group for parameter in layer.spec.params if parameter.group}
    drawn = sample_parameters(layer.spec, batch, random, skip_groups=groups)
    params = {name: torch.as_tensor(value).to(layer.device, layer.dtype) for name, value in drawn.items()}
    poses = torch.as_tensor(random_axis_angles(layer.joint_names, batch, random))
    return params, poses.to(layer.device, layer.dtype)


@torch.no_grad()
def _check(config: DictConfig, layer: SomaLayer) -> None:
    params, poses = _inputs(config, layer, 4)
    options = dict(config.backend.options)
    reference = SomaLayer(
        config.backend.name, options=options, kernels="torch", device=config.device, exact=True
    )
    difference = layer(params, poses).vertices - reference(params, poses).vertices
    worst = 1e3 * float(difference.norm(dim=-1).max())
    if not worst <= _AGREEMENT_MM:
        raise SomaError(f"bench: the timed path is {worst:.3g} mm from the reference, bound {_AGREEMENT_MM}")


def _time_batch(config: DictConfig, layer: SomaLayer, batch: int) -> list[dict[str, float | str | int]]:
    params, poses = _inputs(config, layer, batch)
    with torch.no_grad():
        shared = layer.identity({name: value[:1] for name, value in params.items()})
        identities = layer.identity(params)
        given = identities.params
        points, fitted = layer.rest_shape(given)
    tracked = {name: value.clone().requires_grad_() for name, value in params.items()}
    turned = poses.clone().requires_grad_()

    def both() -> None:
        layer(tracked, turned).vertices.square().mean().backward()

    cases: dict[str, Callable[[], object]] = {
        "forward": torch.no_grad()(lambda: layer(params, poses)),
        "  rest shape and skeleton fit": torch.no_grad()(lambda: layer.rest_shape(given)),
        "  repose to bind": torch.no_grad()(lambda: layer.animation.repose(points, fitted)),
        "  pose, an identity each": torch.no_grad()(lambda: layer.pose(identities, poses)),
        "pose, one identity": torch.no_grad()(lambda: layer.pose(shared, poses)),
        "forward + backward": both,
    }
    if isinstance(layer.rest_shape, ComposedRestShape):
        rest_shape, columns = layer.rest_shape, layer.rest_shape.coefficients(given).T
        cases["    product with the basis"] = torch.no_grad()(
            lambda: torch.addmm(rest_shape.template, rest_shape.basis, columns)
        )
    rows = []
    for case, call in cases.items():
        median = _median_ms(call, config.repeats, layer.device)
        rows.append({"case": case, "batch": batch, "median_ms": median, "bodies_per_s": 1e3 * batch / median})
    return rows


def _median_ms(call: Callable[[], object], repeats: int, device: torch.device) -> float:
    found = []
    for index in range(repeats + 3):
        begin = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        if index >= 3:  # the first calls warm caches and kernels
            found.append(1e3 * (time.perf_counter() - begin))
    return statistics.median(found)
