"""Worker: this project. ``python benchmarks/ours.py BACKEND [DEVICE]``"""

from __future__ import annotations

import importlib.metadata
import sys
import time

import numpy as np
import torch
from inputs import PHENOTYPES
from worker import Call, serve

from soma_core.layer import SomaLayer


def main(backend: str, device: str = "cpu") -> None:
    torch.set_num_threads(2)
    begin = time.perf_counter()
    layer = SomaLayer(backend, device=device)
    construction = time.perf_counter() - begin

    def params(inputs: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
        if backend == "soma":
            return {"shape": torch.from_numpy(inputs["shape"]).to(device)}
        values = torch.from_numpy(inputs["phenotypes"]).to(device)
        return {name: values[:, index].contiguous() for index, name in enumerate(PHENOTYPES)}

    def prepare(case: str, inputs: dict[str, np.ndarray]) -> Call:
        poses, shift = (torch.from_numpy(inputs[name]).to(device) for name in ("poses", "translation"))
        given = params(inputs)
        if case == "forward":
            return torch.no_grad()(lambda: _waited(layer(given, poses, shift).vertices))
        if case == "pose":
            with torch.no_grad():
                identity = layer.identity({name: value[:1] for name, value in given.items()})
            return torch.no_grad()(lambda: _waited(layer.pose(identity, poses, shift).vertices))
        tracked = [tensor.requires_grad_() for tensor in (poses, shift, *given.values())]

        def both() -> torch.Tensor:
            for tensor in tracked:
                tensor.grad = None
            vertices = layer(given, poses, shift).vertices
            vertices.square().mean().backward()
            return _waited(vertices.detach())

        return both

    serve(prepare, {
        "implementation": "soma_core", "soma-body-core": importlib.metadata.version("soma-body-core"),
        "torch": torch.__version__, "construction_s": f"{construction:.3f}",
    })  # fmt: skip


def _waited(vertices: torch.Tensor) -> torch.Tensor:
    if vertices.is_cuda:
        torch.cuda.synchronize()
    return vertices


if __name__ == "__main__":
    main(*sys.argv[1:])
