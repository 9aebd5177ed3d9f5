"""The forward path on a GPU: agreement with the CPU, CUDA graphs, and times; prints one line a figure.

``python benchmarks/forward_gpu.py [lod]``
"""

import functools
import statistics
import sys
import traceback

import torch

from soma_core import SomaLayer


def milliseconds(call, repeats=30):
    """Median of single calls between events, after a warm-up; and the mean of calls issued in a row."""
    for _ in range(3):
        call()
    torch.cuda.synchronize()
    times = []
    for _ in range(repeats):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        call()
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    for _ in range(repeats):
        call()
    end.record()
    end.synchronize()
    return statistics.median(times), start.elapsed_time(end) / repeats


def inputs(batch, device, dtype, identities):
    draw = torch.Generator().manual_seed(0)
    rotations = 0.5 * torch.randn(batch, 77, 3, generator=draw, dtype=torch.float64)
    translation = torch.randn(batch, 3, generator=draw, dtype=torch.float64)
    shape = torch.randn(identities, 128, generator=draw, dtype=torch.float64)
    return [part.to(device, dtype) for part in (rotations, translation, shape)]


def compare(lod, dtype):
    layers = {device: SomaLayer("soma", lod=lod, dtype=dtype, device=device) for device in ("cpu", "cuda")}
    for batch, identities in ((1, 1), (7, 1), (33, 1), (33, 33)):
        found = {}
        for device, layer in layers.items():
            rotations, translation, shape = inputs(batch, device, dtype, identities)
            with torch.no_grad():
                scale = torch.full((1, 77), 1.1, dtype=dtype, device=device)
                one = layer({"shape": shape}, rotations, translation)
                other = layer.pose(
                    layer.identity({"shape": shape}), rotations, translation, absolute=True, bone_scale=scale
                )
            found[device] = [
                part.cpu() for p in (one, other) for part in (p.vertices, p.joints, p.transforms)
            ]
        error = max(float((a - b).abs().max()) for a, b in zip(*found.values(), strict=True))
        print(f"{lod} {dtype} B={batch} identities={identities}: CPU and CUDA differ by {error:.2e} m")


def gradients(lod):
    """The fused kernels against the way with derivatives, both on the device; and run to run."""
    layer = SomaLayer("soma", lod=lod, device="cuda")
    rotations, translation, shape = inputs(16, "cuda", torch.float32, 16)
    identity = layer.identity({"shape": shape})
    with torch.no_grad():
        fast = [layer.pose(identity, rotations, translation).vertices for _ in range(20)]
    slow = layer.pose(identity, rotations.clone().requires_grad_(), translation).vertices
    print(f"fused and autograd differ by {float((fast[0] - slow).abs().max()):.2e} m")
    print(f"20 runs alike to the bit: {all(torch.equal(fast[0], other) for other in fast)}")
    slow.square().sum().backward()


def times(lod):
    layer = SomaLayer("soma", lod=lod, device="cuda")
    for batch in (1, 8, 64, 256, 1024):
        with torch.no_grad():
            times_of(layer, batch, *inputs(batch, "cuda", torch.float32, batch))


def times_of(layer, batch, rotations, translation, shape):
    one, own = layer.identity({"shape": shape[:1]}), layer.identity({"shape": shape})
    graph = layer.compiled(batch=batch)
    whole = layer.compiled(batch=batch, identities=batch, params=True)
    calls = {
        "pose, one identity": lambda: layer.pose(one, rotations, translation),
        "pose, own identities": lambda: layer.pose(own, rotations, translation),
        "identity": lambda: layer.identity({"shape": shape}),
        "forward": lambda: layer({"shape": shape}, rotations, translation),
        "pose, graph": lambda: graph(one, rotations, translation),
        "pose, graph replay alone": graph._graph.replay,
        "forward, graph": lambda: whole({"shape": shape}, rotations, translation),
    }
    for name, call in calls.items():
        single, rows = milliseconds(call)
        print(f"B={batch} {name}: {single:.3f} ms single, {rows:.3f} in a row, {batch / rows:,.1f} k/s")
    error = graph(one, rotations, translation).vertices - layer.pose(one, rotations, translation).vertices
    print(f"B={batch} graph and call differ by {float(error.abs().max()):.2e} m")


def groups(lod):
    """How many bodies should share one reading of the weights."""
    from soma_core.kernels import fused_pose_wp

    chosen = dict(fused_pose_wp._GROUP)
    for size in (4, 8):
        fused_pose_wp._GROUP["float32"] = size
        fused_pose_wp._patch_kernel.cache_clear()
        layer = SomaLayer("soma", lod=lod, device="cuda")
        for batch in (64, 1024):
            rotations, translation, shape = inputs(batch, "cuda", torch.float32, 1)
            with torch.no_grad():
                one = layer.identity({"shape": shape})
                _, rows = milliseconds(functools.partial(layer.pose, one, rotations, translation))
            print(f"groups of {size}: B={batch} pose {rows:.3f} ms in a row")
    fused_pose_wp._GROUP.update(chosen)
    fused_pose_wp._patch_kernel.cache_clear()


def kernels(lod):
    from torch.profiler import ProfilerActivity, profile

    layer = SomaLayer("soma", lod=lod, device="cuda")
    rotations, translation, shape = inputs(1024, "cuda", torch.float32, 1024)
    with torch.no_grad():
        for _ in range(2):
            layer({"shape": shape}, rotations, translation)
        torch.cuda.synchronize()
        with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as found:
            layer({"shape": shape}, rotations, translation)
            torch.cuda.synchronize()
    print(found.key_averages().table(sort_by="cuda_time_total", row_limit=20, max_name_column_width=50))


def synchronisations(lod):
    """Calls raise where the host would wait for the device."""
    for exact in (False, True):
        layer = SomaLayer("soma", lod=lod, device="cuda", exact=exact)
        synchronisations_of(layer, *inputs(4, "cuda", torch.float32, 4))
        print(f"exact={exact}: the host waits nowhere")


def synchronisations_of(layer, rotations, translation, shape):
    with torch.no_grad():
        layer({"shape": shape}, rotations, translation)
        torch.cuda.set_sync_debug_mode("error")
        try:
            layer({"shape": shape}, rotations, translation)
        finally:
            torch.cuda.set_sync_debug_mode("default")


if __name__ == "__main__":
    LOD = sys.argv[1] if len(sys.argv) > 1 else "mid"
    print(torch.cuda.get_device_name())
    for step in (
        lambda: compare("low", torch.float32),
        lambda: compare("low", torch.float64),
        lambda: compare(LOD, torch.float32),
        lambda: gradients(LOD),
        lambda: synchronisations(LOD),
        lambda: times(LOD),
        lambda: groups(LOD),
        lambda: kernels(LOD),
    ):
        try:
            step()
        except Exception:
            traceback.print_exc(file=sys.stdout)
        sys.stdout.flush()
