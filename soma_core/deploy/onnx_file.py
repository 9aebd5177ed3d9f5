"""A deployed model as an ONNX file, and its run in onnxruntime."""

from __future__ import annotations

import contextlib
import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from soma_core._lazy import needed
from soma_core.cache import atomic_write
from soma_core.deploy.program import DeployedModel

__all__ = ["OPSET", "need_onnx", "open_session", "run_session", "write_onnx", "write_program"]

OPSET = 18
"""Version of ONNX's operators that files are written in."""


def need_onnx(package: str, *parts: str) -> Any:
    """A package of the extra ``onnx``, with those of its modules that are named.

    Raises:
        InputError: it is not installed.
    """
    return needed(package, *parts, setting="write", pip="[onnx]", otherwise="pass write=[pt2]")


def write_onnx(path: Path, model: DeployedModel) -> None:
    """Write an ONNX file with named inputs and outputs, an open batch, and what there is to know as metadata.

    Raises:
        InputError: the extra ``onnx`` is not installed.
    """
    optimizer = need_onnx("onnxscript", "optimizer").optimizer
    with warnings.catch_warnings(), _quiet("torch.onnx"):
        warnings.simplefilter("ignore")  # of torch, about its own use of pytree (2.13)
        made = torch.onnx.export(
            model.program, model.example(), dynamo=True, opset_version=OPSET, optimize=False, verbose=False,
            input_names=[*model.inputs], output_names=[*model.outputs],
        )  # fmt: skip
    assert made is not None
    optimizer.fold_constants(made.model)
    _shape_once(made.model.graph)
    optimizer.remove_unused_nodes(made.model)  # its whole optimizer takes minutes for some thousand nodes
    graph = made.model.graph
    for node in graph.all_nodes():
        node.metadata_props.clear()  # stack traces, with the paths of this machine
        for value in node.outputs:  # a parameter may be called as a value inside
            value.name = value.name if value.name in model.outputs else f"{value.name}_"
    made.model.producer_name = "soma-body-core"
    for name, value in model.about.items():
        text = value if isinstance(value, str) else json.dumps(value)
        made.model.metadata_props[f"soma.{name}"] = text
    atomic_write(path, made.save)


def _shape_once(graph: Any) -> None:
    """Make constants of shapes in which nothing but the batch is open: an engine puts each together anew."""
    ir = need_onnx("onnxscript", "ir").ir
    for node in graph.all_nodes():
        shape = node.inputs[1].producer() if node.op_type == "Reshape" else None
        if shape is None or shape.op_type != "Concat":
            continue
        parts = [ir.convenience.get_const_tensor(value) for value in shape.inputs]
        if sum(part is None for part in parts) == 1:
            sizes = [np.array([-1]) if part is None else part.numpy() for part in parts]
            fixed = ir.node("Constant", [], {"value": ir.tensor(np.concatenate(sizes).astype(np.int64))})
            graph.insert_before(node, fixed)
            node.replace_input_with(1, fixed.outputs[0])


def write_program(path: Path, model: DeployedModel) -> None:
    """Write the program for ``torch.export.load``; ``extra_files={"about.json": ""}`` gets what to know."""

    def save(part: Path) -> None:
        with open(part, "wb") as stream, warnings.catch_warnings():
            warnings.filterwarnings("ignore", "No complete tensor")  # matters off the CPU (torch 2.13)
            torch.export.save(model.program, stream, extra_files={"about.json": json.dumps(model.about)})

    atomic_write(path, save)


@contextlib.contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Only errors of a logger: torch lists packages that have nothing to do with the model."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def open_session(path: Path, *, threads: int = 1) -> Any:
    """An ``onnxruntime.InferenceSession`` on the CPU.

    Raises:
        InputError: onnxruntime is not installed.
    """
    runtime = need_onnx("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = threads
    return runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def run_session(session: Any, inputs: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Outputs by their names, of inputs by theirs: tensors or arrays, each with the same batch."""
    names = [output.name for output in session.get_outputs()]
    arrays = {name: np.asarray(value, np.float32) for name, value in inputs.items()}
    return dict(zip(names, session.run(names, arrays), strict=True))
