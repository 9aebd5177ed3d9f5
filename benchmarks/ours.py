"""Worker: this project.

python benchmarks/ours.py BACKEND KIND THREADS [DEVICE]     the forward path
python benchmarks/ours.py inversion THREADS [DEVICE]        pose inversion
"""

from __future__ import annotations

import importlib.metadata
import sys
import time

import numpy as np
import torch
from inputs import PHENOTYPES
from worker import Call, Work, serve

from soma_core.layer import SomaLayer

KINDS = {
    "plain": {"procedural": False, "correctives": None},
    "default": {},
    "reference": {"kernels": "torch", "dtype": torch.float64},
}
"""``plain`` is the work of the peers, which skin by the 78 public joints: their template with twist joints is
not in the package. ``default`` is the layer as it ships, and ``reference`` the same in double precision."""


def main(backend: str, kind: str, threads: str, device: str = "cpu") -> None:
    torch.set_num_threads(int(threads))
    begin = time.perf_counter()
    layer = SomaLayer(backend, device=device, **KINDS[kind])
    construction = time.perf_counter() - begin

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array).to(device, layer.dtype)

    def params(inputs: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
        if backend == "soma":
            return {"shape": tensor(inputs["shape"])}
        values = tensor(inputs["phenotypes"])
        return {name: values[:, index].contiguous() for index, name in enumerate(PHENOTYPES)}

    def prepare(case: str, inputs: dict[str, np.ndarray]) -> Call:
        poses, shift, given = tensor(inputs["poses"]), tensor(inputs["translation"]), params(inputs)
        if case == "forward":
            return torch.no_grad()(lambda: _waited(layer(given, poses, shift).vertices))
        if case == "pose":
            with torch.no_grad():
                identity = layer.identity({name: value[:1] for name, value in given.items()})
            return torch.no_grad()(lambda: _waited(layer.pose(identity, poses, shift).vertices))
        tracked = [value.requires_grad_() for value in (poses, shift, *given.values())]

        def both() -> torch.Tensor:
            for value in tracked:
                value.grad = None
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


def main_inversion(threads: str, device: str = "cpu") -> None:
    from soma_core.inversion import PoseInversion

    torch.set_num_threads(int(threads))
    layers = {
        (lod, kind): SomaLayer("anny", lod=lod, device=device, **KINDS[kind])
        for lod in ("mid", "low") for kind in ("plain", "default")
    }  # fmt: skip

    @torch.no_grad()
    def prepare(case: str, inputs: dict[str, np.ndarray]) -> Work:
        lod, kind = case.split("/")
        values = inputs["phenotypes"][0].tolist()
        params = dict(zip(PHENOTYPES, values, strict=True))
        layer, inversion = layers[lod, kind], PoseInversion(layers[lod, kind])
        identity = layer.identity(params)
        if "vertices" in inputs:
            judge, target = layers["mid", kind], torch.from_numpy(inputs["vertices"]).to(device)
            given = target[:, torch.as_tensor(layer.mesh.mid_ids.astype(np.int64))].contiguous()
        else:
            judge = layer
            poses, shift = (torch.from_numpy(inputs[name]).to(device) for name in ("poses", "translation"))
            given = target = layer.pose(identity, poses, shift).vertices.contiguous()

        @torch.no_grad()
        def array(result) -> np.ndarray:
            posed = judge.pose(judge.identity(params), result.rotations, result.translation)
            return torch.stack([posed.vertices, target]).cpu().numpy()

        def call():
            result = inversion(given, identity)
            _waited(result.residual)
            return result

        return Work(torch.no_grad()(call), array)

    serve(prepare, {
        "implementation": "soma_core", "soma-body-core": importlib.metadata.version("soma-body-core"),
        "torch": torch.__version__,
    })  # fmt: skip


if __name__ == "__main__":
    if sys.argv[1] == "inversion":
        main_inversion(*sys.argv[2:])
    else:
        main(*sys.argv[1:])
