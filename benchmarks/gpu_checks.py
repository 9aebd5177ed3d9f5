"""What machine this is, and the layer and the fit on the device against the CPU."""

from __future__ import annotations

import functools
import platform
import shutil
import subprocess
import sys
import time

import torch
from gpu_bench import Bench
from gpu_setup import KINDS, SEED, backends, far_mm, inputs_of, layer_of, motion, shape_of
from processes import cpu_name
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import PoseInversion
from soma_core.layer import SomaLayer
from soma_core.skeleton.identity import Identity

__all__ = ["after", "fit", "judged", "layer", "machine", "targets"]

LAYER_MM = {torch.float32: 0.02, torch.float64: 1e-7}
"""Of the device to float64 on the CPU; the bodies are two metres tall and their parameters float32."""
SLOPE = {torch.float32: 2e-3, torch.float64: 1e-7}
"""Of gradients, relative to the largest entry."""
FIT_MM, FIT_DEGREES, FIT_CONVERGED = 0.1, 1.0, 0.95
"""On exact targets: the worst vertex, the worst angle of a determined joint, the least share of frames."""
QUERY = "name,driver_version,clocks.sm,clocks.max.sm,clocks.mem,temperature.gpu,power.draw,memory.used"


def _clocks() -> dict:
    if not shutil.which("nvidia-smi"):
        return {}
    command = ["nvidia-smi", f"--query-gpu={QUERY}", "--format=csv,noheader"]
    text = subprocess.run(command, capture_output=True, text=True, timeout=20).stdout.strip()
    return dict(zip(QUERY.split(","), text.splitlines()[0].split(", "), strict=False)) if text else {}


def machine(bench: Bench) -> None:
    """Versions, clocks, rates of memory and of a matrix product, and compile times of Warp modules."""
    bench.row("versions", _versions)
    bench.row("clocks", _clocks)
    if bench.cuda:
        bench.row("memory", lambda: _copied(bench))
        bench.row("product", lambda: _multiplied(bench))
    bench.row("compile", lambda: _compiled(bench))


def _versions() -> dict:
    import numpy as np
    import scipy
    import warp

    found = {"python": platform.python_version(), "torch": torch.__version__, "warp": warp.config.version,
             "numpy": np.__version__, "scipy": scipy.__version__, "cuda": torch.version.cuda,
             "cpu": cpu_name(), "threads": torch.get_num_threads(), "command": sys.executable,
             "tf32": torch.backends.cuda.matmul.allow_tf32}  # fmt: skip
    if torch.cuda.is_available():
        card = torch.cuda.get_device_properties(0)
        found |= {"card": card.name, "memory_gb": card.total_memory / 1e9,
                  "multiprocessors": card.multi_processor_count,
                  "capability": list(torch.cuda.get_device_capability())}  # fmt: skip
    return found


def _copied(bench: Bench) -> dict:
    """Bytes read and written by a copy of 2 GB."""
    source = torch.randn(500_000_000, device=bench.device)
    target = torch.empty_like(source)
    found = bench.timed(lambda _: target.copy_(source), most=20)
    return {"tb_per_s": 2 * 4e-12 * source.numel() / (1e-3 * found["ms"]), **found}


def _multiplied(bench: Bench) -> dict:
    """A product like that of a shape basis: (55,104, 128) by (128, 1024), float32."""
    one, other = (torch.randn(*shape, device=bench.device) for shape in ((55104, 128), (128, 1024)))
    found = bench.timed(lambda _: one @ other, most=50)
    return {"tflop_per_s": 2e-12 * 55104 * 128 * 1024 / (1e-3 * found["ms"]), **found}


def _compiled(bench: Bench) -> dict:
    """Seconds of the first and the second call of everything in float32: what compiling takes."""
    device, found = str(bench.device), {}
    begin = time.perf_counter()
    made = layer_of("soma", "default", device)
    found["construction_s"] = time.perf_counter() - begin
    params, poses, shift = inputs_of("soma", 4, SEED, device)
    low = layer_of("soma", "default", device, lod="low")
    calls = {
        "forward": lambda: made(params, poses, shift),
        "backward": lambda: made(params, poses.requires_grad_(), shift).vertices.sum().backward(),
        "fit": lambda: _fitted(low, 4),
    }
    for name, call in calls.items():
        for which in ("first", "second"):
            begin = time.perf_counter()
            call()
            bench.wait()
            found[f"{name}_{which}_s"] = time.perf_counter() - begin
    return found


def _fitted(layer: SomaLayer, count: int) -> dict:
    identity, seen, truth = targets(layer, count)
    return judged(layer, identity, seen, truth, PoseInversion(layer)(seen, identity))


def after(bench: Bench) -> None:
    """Clocks once more."""
    bench.row("clocks", _clocks)


def layer(bench: Bench) -> None:
    """Vertices and gradients of the whole layer."""
    batch = 2 if bench.quick else 8
    for backend in backends():
        for kind in KINDS:
            for dtype in (torch.float32, torch.float64):
                bench.row(f"{backend} {kind} {str(dtype)[6:]}",
                          functools.partial(_layer_row, bench, backend, kind, dtype, batch))  # fmt: skip


def _layer_row(bench: Bench, backend: str, kind: str, dtype: torch.dtype, batch: int) -> dict:
    params, poses, shift = inputs_of(backend, batch, SEED, "cpu")  # float32 for all, so that all see the same
    expected = _moved(layer_of(backend, kind, "cpu", torch.float64), params, poses, shift)
    found = _moved(layer_of(backend, kind, str(bench.device), dtype), params, poses, shift)
    row = {"mm_to_float64": far_mm(found[0], expected[0]), "bound_mm": LAYER_MM[dtype]}
    if dtype == torch.float32:
        same = _moved(layer_of(backend, kind, "cpu"), params, poses, shift)
        row["mm_to_cpu"] = far_mm(found[0], same[0])
        row["cpu_mm_to_float64"] = far_mm(same[0], expected[0])
    for name, mine, theirs in zip(("rotations", "translation", "params"), found[1], expected[1], strict=True):
        row[f"slope_{name}"] = float((mine - theirs).abs().max() / theirs.abs().max())
    row["bound_slope"] = SLOPE[dtype]
    slopes = [row[f"slope_{name}"] for name in ("rotations", "translation", "params")]
    row["mm_without_gradients"], row["mm_pose"] = _without_gradients(
        layer_of(backend, kind, str(bench.device), dtype), params, poses, shift, expected[0]
    )
    far = max(row[name] for name in ("mm_to_float64", "mm_without_gradients", "mm_pose"))
    row["ok"] = far <= LAYER_MM[dtype] and max(slopes) <= SLOPE[dtype]
    return row


@torch.no_grad()
def _without_gradients(
    layer: SomaLayer, params: dict[str, Tensor], poses: Tensor, shift: Tensor, expected: Tensor
) -> tuple[float, float]:
    """The same by the kernels that have no derivative: the layer [mm], and poses of its first body."""
    given = {name: value.to(layer.device, layer.dtype) for name, value in params.items()}
    poses, shift = (part.to(layer.device, layer.dtype) for part in (poses, shift))
    first = layer.identity({name: value[:1] for name, value in given.items()})
    same = layer.pose(first, poses[:1], shift[:1]).vertices  # one body, in the first of its poses
    many = layer.pose(first, poses, shift).vertices
    one_by_one = torch.cat([layer.pose(first, poses[i : i + 1], shift[i : i + 1]).vertices
                            for i in range(len(poses))])  # fmt: skip
    off = max(far_mm(same, expected[:1]), far_mm(many, one_by_one))
    return far_mm(layer(given, poses, shift).vertices, expected), off


def _moved(layer: SomaLayer, params: dict[str, Tensor], poses: Tensor, shift: Tensor) -> tuple:
    """Vertices, and gradients in float64 on the CPU of a sum of them under random signs."""
    given = {name: value.to(layer.device, layer.dtype).requires_grad_() for name, value in params.items()}
    poses, shift = (part.to(layer.device, layer.dtype).requires_grad_() for part in (poses, shift))
    vertices = layer(given, poses, shift).vertices
    random = torch.Generator().manual_seed(1)
    pull = torch.randn(vertices.shape, generator=random, dtype=torch.float64).to(vertices)
    grads = torch.autograd.grad((vertices * pull).sum(), (poses, shift, *given.values()))
    flat = [grad.detach().cpu().double() for grad in grads]
    return vertices, (flat[0], flat[1], torch.cat([grad.flatten() for grad in flat[2:]]))


def fit(bench: Bench) -> None:
    """Exact targets recovered."""
    count = 4 if bench.quick else 128
    for lod in ("low",) if bench.quick else ("low", "mid"):
        for kind in KINDS:
            for kernels in ("auto", "warp"):
                bench.row(f"{kind} {lod} {kernels}",
                          functools.partial(_fit_row, bench, kind, lod, kernels, count))  # fmt: skip


def _fit_row(bench: Bench, kind: str, lod: str, kernels: str, count: int) -> dict:
    layer = layer_of("soma", kind, str(bench.device), lod=lod)
    identity, seen, truth = targets(layer, count)
    run = PoseInversion(layer, kernels=kernels)
    begin = time.perf_counter()
    with torch.no_grad():
        result = run(seen, identity)
    bench.wait()
    return {"frames": count, "first_s": time.perf_counter() - begin,
            **judged(layer, identity, seen, truth, result)}  # fmt: skip


@torch.no_grad()
def targets(layer: SomaLayer, count: int) -> tuple[Identity, Tensor, Tensor]:
    """One identity, vertices (count, v, 3) that it was posed to on the layer's device, and the rotations."""
    identity = layer.identity({"shape": shape_of(str(layer.device), layer.dtype)})
    poses, shift = (part.to(layer.device, layer.dtype) for part in motion(count))
    truth = axis_angle_to_matrix(poses)
    seen = torch.empty(count, layer.mesh.vertex_count, 3, dtype=layer.dtype, device=layer.device)
    for start in range(0, count, 512):
        some = slice(start, start + 512)
        seen[some] = layer.pose(identity, truth[some], shift[some]).vertices
    return identity, seen, truth


@torch.no_grad()
def judged(layer: SomaLayer, identity: Identity, seen: Tensor, truth: Tensor, result) -> dict:
    """Errors of a fit of exact targets, by the layer's own ``pose``."""
    weighed = torch.ones(layer.mesh.vertex_count, dtype=torch.bool, device=layer.device)
    weighed[torch.as_tensor(layer.mesh.face_interior.copy(), device=layer.device)] = False
    total, worst = 0.0, 0.0
    for start in range(0, len(seen), 512):
        some = slice(start, start + 512)
        posed = layer.pose(identity, result.rotations[some], result.translation[some]).vertices
        off = (posed - seen[some])[:, weighed].norm(dim=-1)
        total, worst = total + float(off.mean(1).sum()), max(worst, float(off.max()))
    # The chord of the turn that is left keeps the digits of a small angle.
    chord = (result.rotations - truth).flatten(2).double().norm(dim=-1) / 8**0.5
    angle = 2 * chord.clamp(max=1).asin().rad2deg()[result.determined]
    row = {
        "mean_mm": 1e3 * total / len(seen), "max_mm": 1e3 * worst, "max_degrees": float(angle.max()),
        "median_degrees": float(angle.median()), "converged": float(result.converged.float().mean()),
        "valid": float(result.valid.float().mean()), "steps": float(result.iterations.float().mean()),
    }  # fmt: skip
    row["p999_degrees"] = float(angle.flatten().kthvalue(max(1, int(0.999 * angle.numel()))).values)
    row["ok"] = (row["max_mm"] <= FIT_MM and row["max_degrees"] <= FIT_DEGREES
                 and row["converged"] >= FIT_CONVERGED)  # fmt: skip
    return row
