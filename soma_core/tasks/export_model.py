"""``soma export-model``: a body model as ONNX and ``torch.export``, compared with its layer."""

from __future__ import annotations

import json
import logging
import statistics
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from omegaconf import OmegaConf

from soma_core.cache import atomic_text
from soma_core.choices import ModelFile, ModelPart
from soma_core.deploy.onnx_file import need_onnx, open_session, run_session, write_onnx, write_program
from soma_core.deploy.program import DeployedModel, deploy
from soma_core.errors import InputError, SomaError
from soma_core.evaluation.random_poses import random_axis_angles
from soma_core.layer import SomaLayer
from soma_core.shape_space.sampling import sample_parameters

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from soma_core.config.schema import ExportModelConfig

__all__ = ["compare", "random_inputs", "run"]

_log = logging.getLogger(__name__)

_AGREEMENT_MM = {ModelPart.pose: 1e-3, ModelPart.joints: 1e-3, ModelPart.full: 3e-3}
"""Largest distance from the layer: some roundings of float32 at the size of a body, and those of the fit.

Of what is fitted, the layer itself is up to 1.4e-3 mm from its own float64.
"""

_BATCHES = (1, 7)
_REPEATS = 20


def run(config: DictConfig, output: Path) -> None:
    """Write the model's files into `output`; compare ONNX with the layer in onnxruntime, and time it.

    Raises:
        SomaError: the extra ``onnx`` is not installed, or the file disagrees with the layer.
    """
    options: ExportModelConfig = OmegaConf.to_object(config)  # type: ignore[assignment]
    if not options.write:
        raise InputError("write", got="none", expected="onnx, pt2 or both", fix="Leave it out.")
    if ModelFile.onnx in options.write:
        for name in ("onnxscript", "onnxruntime"):
            need_onnx(name)
    layer = SomaLayer(
        options.backend.name, options=options.backend.options, lod=options.lod.value,
        procedural=options.procedural, correctives=options.correctives,
    )  # fmt: skip
    model = deploy(layer, options.what, params=options.backend.params, parameters=options.parameters)
    written = ["model.json"]
    if ModelFile.pt2 in options.write:
        write_program(output / "model.pt2", model)
        written.append("model.pt2")
    if ModelFile.onnx in options.write:
        write_onnx(output / "model.onnx", model)
        written.append("model.onnx")
    atomic_text(output / "model.json", json.dumps(model.about) + "\n")
    for kind, shapes in (("in", model.inputs), ("out", model.outputs)):
        rows = ", ".join(f"{name} {('batch', *shape)}".replace("'", "") for name, shape in shapes.items())
        _log.info("%s: %s", kind, rows)
    _log.info("wrote %s", ", ".join(written))
    if ModelFile.onnx in options.write:
        _report(output / "model.onnx", model, layer, options)


def _report(path: Path, model: DeployedModel, layer: SomaLayer, options: ExportModelConfig) -> None:
    """Say how far the file is from the layer, and its time; refuse what is too far."""
    session = open_session(path)
    random = np.random.default_rng(options.seed)
    worst = 0.0
    for batch in _BATCHES:
        inputs = random_inputs(model, layer, batch, random)
        worst = max(worst, compare(run_session(session, inputs), inputs, layer, options.backend.params))
    inputs = random_inputs(model, layer, 1, random)
    times = []
    for _ in range(_REPEATS):
        begin = time.process_time()
        run_session(session, inputs)
        times.append(time.process_time() - begin)
    _log.info(
        "onnxruntime: %.2g mm from the layer at most, %.2g ms a frame on one core (batch 1)",
        worst, 1e3 * statistics.median(times),
    )  # fmt: skip
    bound = _AGREEMENT_MM[options.what]
    if not worst <= bound:
        raise SomaError(f"{path}: {worst:.3g} mm from the layer, bound {bound:g}.")


def random_inputs(
    model: DeployedModel, layer: SomaLayer, batch: int, random: np.random.Generator
) -> dict[str, torch.Tensor]:
    """Inputs of random poses near the origin, and of random bodies where the model takes parameters."""
    inputs = {
        "rotations": torch.as_tensor(random_axis_angles(layer.joint_names, batch, random)).float(),
        "translation": torch.as_tensor(random.uniform(-0.5, 0.5, (batch, 3))).float(),
    }
    drawn = sample_parameters(layer.spec, batch, random, skip_groups=set())
    return inputs | {name: torch.as_tensor(drawn[name]).float() for name in [*model.inputs][2:]}


@torch.no_grad()
def compare(
    found: dict[str, np.ndarray], inputs: dict[str, torch.Tensor], layer: SomaLayer, params: dict[str, object]
) -> float:
    """Largest distance [mm] of vertices and joints from those of the layer."""
    rotations, translation = inputs["rotations"], inputs["translation"]
    values = {name: value for name, value in inputs.items() if name not in ("rotations", "translation")}
    fixed = layer.identity(params).params
    bodies = {name: value.expand(len(rotations), *value.shape[1:]) for name, value in fixed.items()} | values
    posed = layer(bodies, rotations, translation)
    return max(
        1e3 * float(np.linalg.norm(found[name] - getattr(posed, name).numpy(), axis=-1).max())
        for name in ("vertices", "joints")
        if name in found
    )
