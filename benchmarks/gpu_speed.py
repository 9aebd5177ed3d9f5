"""Speed of the layer and of pose inversion; nothing is timed whose result is wrong."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from gpu_bench import Bench
from gpu_checks import LAYER_MM, judged, targets
from gpu_setup import KINDS, SEED, backends, far_mm, inputs_of, layer_of
from torch import Tensor

from soma_core.inversion import PoseInversion
from soma_core.layer import SomaLayer

__all__ = ["BATCHES", "graph", "inversion", "table4"]

BATCHES = (1, 8, 32, 128, 1024, 4096)
BACKWARD = (8, 128, 1024)
GRAPHS = (1, 1024)
FRAMES = (512, 8192, 32768)
CHECKED = 2
"""Bodies of every batch that are compared with float64 on the CPU."""
SLOW_S = 45.0
"""A fit that would take longer is left out."""


def table4(bench: Bench) -> None:
    """Forward, one identity in many poses, forward and backward, and the parts of an identity."""
    batches = (1, 2) if bench.quick else BATCHES
    backward = (2,) if bench.quick else BACKWARD
    for backend in backends():
        for kind in reversed(KINDS):
            for batch in batches:
                bench.row(f"{backend} {kind} forward {batch}",
                          functools.partial(_forward_row, bench, backend, kind, batch))  # fmt: skip
    for kind in reversed(KINDS):
        for batch in batches:
            bench.row(f"soma {kind} pose {batch}", functools.partial(_pose_row, bench, kind, batch))
    for backend in backends():
        for kind in reversed(KINDS):
            for batch in backward:
                bench.row(f"{backend} {kind} forward + backward {batch}",
                          functools.partial(_backward_row, bench, backend, kind, batch))  # fmt: skip
    for backend in backends():
        for batch in batches:
            bench.row(f"{backend} identity {batch}",
                      functools.partial(_identity_row, bench, backend, batch))  # fmt: skip


def _sets(bench: Bench, backend: str, batch: int) -> list[tuple[dict[str, Tensor], Tensor, Tensor]]:
    """Several inputs in rotation."""
    count = 2 if bench.quick or batch > 1024 else 4
    return [inputs_of(backend, batch, seed, str(bench.device)) for seed in range(SEED, SEED + count)]


def _checked(vertices: Tensor, backend: str, kind: str, given: tuple, *, shared: bool = False) -> dict:
    """Distance of some bodies to float64 on the CPU, or an error: what is wrong is not timed."""
    params, poses, shift = given
    ids = [0, len(poses) - 1][: max(1, min(CHECKED, len(poses)))]
    who = [0] if shared else ids
    layer = layer_of(backend, kind, "cpu", torch.float64)
    params = {name: value.detach()[who].cpu().double() for name, value in params.items()}
    with torch.no_grad():
        expected = layer(params, poses.detach()[ids].cpu().double(), shift.detach()[ids].cpu().double())
    off = far_mm(vertices[ids], expected.vertices)
    if not (off <= LAYER_MM[torch.float32] and bool(torch.isfinite(vertices).all())):
        raise ValueError(f"{off:.4f} mm from float64 on the CPU, or not finite: not timed")
    return {"mm_to_float64": off, "ok": True}


def _measured(bench: Bench, call: Callable, batch: int, sets: int) -> dict:
    found = bench.timed(call, sets=sets)
    return {"batch": batch, **found, "meshes_per_s": batch / (1e-3 * found["ms"]), **bench.peak(call)}


@torch.no_grad()
def _forward_row(bench: Bench, backend: str, kind: str, batch: int) -> dict:
    layer, sets = layer_of(backend, kind, str(bench.device)), _sets(bench, backend, batch)
    row = _checked(layer(*sets[0]).vertices, backend, kind, sets[0])
    return row | _measured(bench, lambda i: layer(*sets[i]).vertices, batch, len(sets))


@torch.no_grad()
def _pose_row(bench: Bench, kind: str, batch: int) -> dict:
    layer, sets = layer_of("soma", kind, str(bench.device)), _sets(bench, "soma", batch)
    who = [layer.identity({name: value[:1] for name, value in given[0].items()}) for given in sets]

    def call(i: int) -> Tensor:
        return layer.pose(who[i], *sets[i][1:]).vertices

    row = _checked(call(0), "soma", kind, sets[0], shared=True)
    return row | _measured(bench, call, batch, len(sets))


def _backward_row(bench: Bench, backend: str, kind: str, batch: int) -> dict:
    layer, sets = layer_of(backend, kind, str(bench.device)), _sets(bench, backend, batch)
    tracked = [[part.requires_grad_() for part in (poses, shift, *params.values())]
               for params, poses, shift in sets]  # fmt: skip

    def call(i: int) -> Tensor:
        for part in tracked[i]:
            part.grad = None
        vertices = layer(*sets[i]).vertices
        vertices.square().mean().backward()
        return vertices.detach()

    row = _checked(call(0), backend, kind, sets[0])
    if not all(bool(part.grad.isfinite().all()) for part in tracked[0]):
        raise ValueError("gradients that are not finite: not timed")
    return row | _measured(bench, call, batch, len(sets))


@torch.no_grad()
def _identity_row(bench: Bench, backend: str, batch: int) -> dict:
    """The whole identity; of it the skeleton's fit to vertices, and its rotations alone."""
    layer, sets = layer_of(backend, "plain", str(bench.device)), _sets(bench, backend, batch)
    row = {"batch": batch, **bench.timed(lambda i: layer.identity(sets[i][0]).rest, sets=len(sets))}
    fit = getattr(layer.rest_shape, "fit", None)
    if fit is not None:
        rests = [layer.identity(given[0]).fitted_rest.contiguous() for given in sets]
        row["skeleton_ms"] = bench.timed(lambda i: fit(rests[i]), sets=len(sets))["ms"]
        flat = rests[0].permute(1, 2, 0).reshape(rests[0].shape[1], -1)
        moments = fit.moments(flat).view(fit.joint_count, 4, 3, batch).permute(3, 0, 1, 2).contiguous()
        row["skeleton_rotations_ms"] = bench.timed(lambda _: fit.from_moments(moments))["ms"]
    return row


def graph(bench: Bench) -> None:
    """Replays of a CUDA graph: what is left without launches from Python."""
    if not bench.cuda and not bench.quick:
        bench.row("none", lambda: {"why": "no CUDA graph on the CPU"})
        return
    whole = [(case, kind, batch) for kind in reversed(KINDS) for case in ("pose", "forward")
             for batch in ((2,) if bench.quick else GRAPHS)]  # fmt: skip
    if hasattr(SomaLayer, "compiled"):
        for case, kind, batch in whole:
            call = functools.partial(_compiled_row, bench, kind, case, batch)
            bench.row(f"compiled {case} {kind} {batch}", call)
    for case, kind, batch in whole if bench.cuda else ():
        bench.row(f"recorded {case} {kind} {batch}", functools.partial(_graph_row, bench, kind, case, batch))


def _still(layer: SomaLayer, case: str, given: tuple) -> tuple[Callable[[], Tensor], list[Tensor]]:
    """A call on tensors that stay where they are, and these."""
    params, poses, shift = given[0], given[1].clone(), given[2].clone()
    if case == "forward":
        return lambda: layer(params, poses, shift).vertices, [poses, shift]
    identity = layer.identity({name: value[:1] for name, value in params.items()})
    return lambda: layer.pose(identity, poses, shift).vertices, [poses, shift]


@torch.no_grad()
def _graph_row(bench: Bench, kind: str, case: str, batch: int) -> dict:
    layer, device = layer_of("soma", kind, str(bench.device)), str(bench.device)
    call, given = _still(layer, case, inputs_of("soma", batch, SEED, device))
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            call()
    torch.cuda.current_stream().wait_stream(stream)
    captured = torch.cuda.CUDAGraph()
    with torch.cuda.graph(captured):
        out = call()
    for mine, other in zip(given, inputs_of("soma", batch, SEED + 1, device)[1:], strict=True):
        mine.copy_(other)  # a replay must follow its inputs
    captured.replay()
    off = far_mm(out, call())
    row = {"batch": batch, "mm_to_eager": off, "ok": off <= LAYER_MM[torch.float32]}
    eager = bench.timed(lambda _: call())["ms"]
    return row | bench.timed(lambda _: captured.replay()) | {"eager_ms": eager}


@torch.no_grad()
def _compiled_row(bench: Bench, kind: str, case: str, batch: int) -> dict:
    """``layer.compiled``: the graph and the copies of what is given."""
    layer, sets = layer_of("soma", kind, str(bench.device)), _sets(bench, "soma", batch)
    if case == "forward":
        run, bodies = layer.compiled(batch=batch, identities=batch, params=True), [one[0] for one in sets]
    else:
        run = layer.compiled(batch=batch)
        bodies = [layer.identity({name: value[:1] for name, value in one[0].items()}) for one in sets[:1]]
        bodies = bodies * len(sets)
    run(bodies[0], *sets[0][1:])
    expected = layer.pose(bodies[1], *sets[1][1:]) if case == "pose" else layer(*sets[1])
    off = far_mm(run(bodies[1], *sets[1][1:]).vertices, expected.vertices)
    if not off <= LAYER_MM[torch.float32]:
        raise ValueError(f"{off:.4f} mm from the layer itself: not timed")
    found = bench.timed(lambda i: run(bodies[i], *sets[i][1:]), sets=len(sets))
    return {"batch": batch, "mm_to_eager": off, "ok": True, **found}


def inversion(bench: Bench) -> None:
    """Frames a second on exact targets of a smooth motion, with what was reached."""
    lods = ("low",) if bench.quick else ("mid", "low")
    rate: dict[tuple[str, str], float] = {}
    for count in (8,) if bench.quick else FRAMES:
        for kind in KINDS:
            for lod in lods:
                known = rate.get((kind, lod))
                expected = 2.5 * count / known if known else 0.0
                name = f"{kind} {lod} {count}"
                if expected > SLOW_S:
                    bench.row(name, lambda e=expected: {"why": f"left out: would take {e:.0f} s"})
                    continue
                row = bench.row(name, functools.partial(_inversion_row, bench, kind, lod, count),
                                needs=expected)  # fmt: skip
                rate[kind, lod] = row.get("frames_per_s", known or 1.0)


@torch.no_grad()
def _inversion_row(bench: Bench, kind: str, lod: str, count: int) -> dict:
    layer = layer_of("soma", kind, str(bench.device), lod=lod)
    identity, seen, truth = targets(layer, count)
    run = PoseInversion(layer)
    memory, result = bench.peaked(lambda _: run(seen, identity))
    row = {"frames": count, **memory, **judged(layer, identity, seen, truth, result)}
    del result
    if not row["mean_mm"] < 20:
        raise ValueError(f"{row['mean_mm']:.1f} mm on exact targets: not timed")
    found = bench.timed(lambda _: run(seen, identity), seconds=1.5, most=20, warm=False)
    return row | found | {"frames_per_s": count / (1e-3 * found["ms"])}
