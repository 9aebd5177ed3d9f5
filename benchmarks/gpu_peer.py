"""py-soma-x on the same card, on assets made from ours; what it cannot do is kept as text."""

from __future__ import annotations

import functools
import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from gpu_bench import Bench
from gpu_setup import SEED, far_mm, inputs_of, layer_of, motion, shape_of
from torch import Tensor

__all__ = ["peer"]

MODES = ("warp", "dense")
BATCHES = (1, 8, 32, 128, 1024, 4096)
SAME_MM = 5.0
"""Mean distance to our plain layer at which the work counts as the same, as in ``run.py``."""
NEEDED = ("numpy", "scipy", "torch", "warp", "trimesh", "rtree", "huggingface_hub", "soma")


def peer(bench: Bench) -> None:
    """Forward, one identity in many poses, forward and backward, pose inversion."""
    if bench.peer is None:
        bench.row("none", lambda: {"why": "no --peer"})
        return
    site = bench.peer / "site"
    if site.is_dir():
        sys.path.append(str(site))
    assets = bench.peer / "assets"
    bench.row("packages", _packages)
    if bench.row("assets", lambda: _assets(assets))["status"] != "done":
        return
    for mode in MODES:
        limit = 1024 if mode == "dense" else 1 << 20  # dense weights: memory of (batch, vertices, joints)
        for batch in (1, 2) if bench.quick else [one for one in BATCHES if one <= limit]:
            for case in ("forward", "pose"):
                bench.row(f"{mode} {case} {batch}",
                          functools.partial(_forward_row, bench, assets, mode, case, batch))  # fmt: skip
    for batch in (2,) if bench.quick else (8, 128, 1024):
        call = functools.partial(_forward_row, bench, assets, "warp", "forward_backward", batch)
        bench.row(f"warp forward + backward {batch}", call)
    for lod in ("low",) if bench.quick else ("mid", "low"):
        for method in ("analytical",) if bench.quick else ("analytical", "autograd", "analytical_autograd"):
            bench.row(f"inversion {method} {lod}",
                      functools.partial(_inversion_row, bench, assets, method, lod))  # fmt: skip


def _packages() -> dict:
    """Which of its needs are here."""
    found, missing = {}, {}
    for name in NEEDED:
        try:
            found[name] = getattr(importlib.import_module(name), "__version__", "")
        except Exception as error:
            missing[name] = f"{type(error).__name__}: {error}"[:200]
    return {"found": found, "missing": missing}


def _assets(folder: Path) -> dict:
    if (folder / "SOMA_neutral.npz").exists():
        return {"made": False}
    from peers import build

    try:
        build(folder)
    except Exception as error:  # the native part comes first; the Anny pair needs anny's data
        if not (folder / "SOMA_neutral.npz").exists():
            raise
        return {"made": True, "without_anny": str(error)[:200]}
    return {"made": True}


@functools.lru_cache(maxsize=2)
def _layer(assets: Path, mode: str, device: str):
    from soma import SOMALayer

    return SOMALayer(assets, device=device, identity_model_type="soma", mode=mode)


def _call(bench: Bench, assets: Path, mode: str, case: str, sets: list) -> Callable[[int], Tensor]:
    layer = _layer(assets, mode, str(bench.device))

    def forward(i: int) -> Tensor:
        params, poses, shift = sets[i]
        return layer(poses, params["shape"], transl=shift, apply_correctives=False)["vertices"]

    def pose(i: int) -> Tensor:
        return layer.pose(sets[i][1], transl=sets[i][2], apply_correctives=False)["vertices"]

    def both(i: int) -> Tensor:
        tracked = [part.requires_grad_() for part in (*sets[i][1:], sets[i][0]["shape"])]
        for part in tracked:
            part.grad = None
        vertices = forward(i)
        vertices.square().mean().backward()
        return vertices.detach()

    if case == "forward_backward":
        return both
    if case == "pose":
        with torch.no_grad():
            layer.prepare_identity(sets[0][0]["shape"][:1], None, repose_to_bind_pose=False)
    return torch.no_grad()(forward if case == "forward" else pose)


def _forward_row(bench: Bench, assets: Path, mode: str, case: str, batch: int) -> dict:
    count = 2 if bench.quick else 4
    sets = [inputs_of("soma", batch, SEED + n, str(bench.device)) for n in range(count)]
    call = _call(bench, assets, mode, case, sets)
    ours = layer_of("soma", "plain", str(bench.device))
    params, poses, shift = sets[0]
    shape = params["shape"].detach()[: 1 if case == "pose" else 8]
    with torch.no_grad():
        mine = ours({"shape": shape}, poses.detach()[:8], shift.detach()[:8]).vertices
    off = (call(0)[:8].detach() - mine).norm(dim=-1)
    row = {"batch": batch, "mean_mm_to_ours": 1e3 * float(off.mean())}
    if not row["mean_mm_to_ours"] < SAME_MM:
        raise ValueError(f"{row['mean_mm_to_ours']:.1f} mm from ours: not the same work, not timed")
    found = bench.timed(call, sets=count)
    return row | found | {"meshes_per_s": batch / (1e-3 * found["ms"]), **bench.peak(call)}


def _inversion_row(bench: Bench, assets: Path, method: str, lod: str) -> dict:
    from peers import INVERSIONS
    from soma.pose_inversion import PoseInversion

    device, count = str(bench.device), 4 if bench.quick else 512
    layer = _layer(assets, "warp", device)
    given = shape_of(device)
    poses, shift = (part.to(device) for part in motion(count))
    with np.load(assets / "SOMA_neutral.npz", allow_pickle=False) as file:
        low = torch.from_numpy(file["lod_mid_to_low"]).long().to(device)

    def posed(turns: Tensor, hips: Tensor, **options) -> Tensor:
        layer.prepare_identity(given, None, repose_to_bind_pose=True)
        return layer.pose(turns, transl=hips, apply_correctives=False, **options)["vertices"]

    with torch.no_grad():
        target = posed(poses, shift)
    seen = target[:, low].contiguous() if lod == "low" else target
    run = PoseInversion(layer, low_lod=lod == "low")
    run.prepare_identity(given, None, repose_to_bind_pose=True)
    memory, result = bench.peaked(lambda _: run.fit(seen, **INVERSIONS[method]))
    with torch.no_grad():
        rotations, hips = result["rotations"].detach(), result["root_translation"].detach()
        again = posed(rotations[:, 1:], hips, pose2rot=False, absolute_pose=True)
        error = 1e3 * (again - target).norm(dim=-1)
    row = {"frames": count, **memory, "mean_mm": float(error.mean()), "max_mm": far_mm(again, target)}
    found = bench.timed(lambda _: run.fit(seen, **INVERSIONS[method]), seconds=1.5, most=5, warm=False)
    return row | found | {"frames_per_s": count / (1e-3 * found["ms"])}
