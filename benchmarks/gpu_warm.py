"""Compile Warp modules for the device in several processes at once, before anything is looked at.

python benchmarks/gpu_warm.py DEVICE GROUP [DTYPE]     compile what one group of kernels needs
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

__all__ = ["warm"]

HERE = Path(__file__).resolve().parent
KERNELS = ("kinematics", "skinning", "skeleton_fit", "nearest_rotation", "surface_frames", "rest and skin",
           "frame moments", "model residual", "solver walk plain", "solver", "fit")  # fmt: skip
FIRST = ("skeleton_fit", "solver", "fit")
"""They take longest."""
PATIENCE_S = 150.0


def warm(device: str, end: float) -> dict[str, str]:
    """Run all groups; seconds and exit code of each. Failures are left to the sections that meet them."""
    groups = sorted(KERNELS, key=lambda name: name not in FIRST)
    jobs = [("anny", "float32"), *((name, dtype) for name in groups for dtype in ("float32", "float64"))]
    room = max(1, (os.cpu_count() or 2) - 1)
    running: dict[tuple[str, str], tuple[subprocess.Popen, float]] = {}
    found, begin = {}, time.time()
    while jobs or running:
        while jobs and len(running) < room:
            job = jobs.pop(0)
            command = [sys.executable, str(HERE / "gpu_warm.py"), device, *job]
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
            running[job] = subprocess.Popen(command, cwd=HERE.parent, **quiet), time.time()
        for job, (process, since) in [*running.items()]:
            late = time.time() > min(end, begin + PATIENCE_S)
            if late:
                process.kill()
            if late or process.poll() is not None:
                text = (process.communicate()[1] or b"").decode(errors="replace").strip()[-300:]
                del running[job]
                note = "" if process.returncode == 0 else f" exit {process.returncode}: {text}"
                found[" ".join(job)] = f"{time.time() - since:.1f} s{note}"
        if time.time() > min(end, begin + PATIENCE_S):
            jobs = []
        time.sleep(0.1)
    found["all"] = f"{time.time() - begin:.1f} s"
    return found


def compile_group(device: str, group: str, dtype: str) -> None:
    """Call what the group names once."""
    import torch
    from gpu_kernels import compared, fit_twins, forward_twins
    from gpu_solver import solver_twins

    torch.set_num_threads(1)
    kind = getattr(torch, dtype)
    if group == "anny":  # builds its basis where the cache has none
        from soma_core.layer import SomaLayer

        SomaLayer("anny", kernels="torch")
        return
    if group == "fit":
        _fits(device, kind)
        return
    for make in (solver_twins,) if group.startswith("solver") else (forward_twins, fit_twins):
        for twin in make("low", 2):
            mine = twin.name.startswith(group)
            if mine and not (twin.double_only and kind == torch.float32):
                compared(twin, kind, torch.device(device))


def _fits(device: str, dtype) -> None:
    """Both kinds of layers forward, backward and inverted."""
    import torch
    from gpu_checks import targets
    from gpu_setup import KINDS, SEED, inputs_of, layer_of

    from soma_core.inversion import PoseInversion

    for kind in KINDS:
        layer = layer_of("soma", kind, device, dtype, "low")
        params, poses, shift = inputs_of("soma", 2, SEED, device, dtype)
        with torch.no_grad():
            layer(params, poses, shift)
            layer.pose(layer.identity(), poses, shift)
        layer(params, poses.requires_grad_(), shift).vertices.sum().backward()
        identity, seen, _ = targets(layer, 2)
        PoseInversion(layer)(seen, identity)


if __name__ == "__main__":
    compile_group(*sys.argv[1:])
