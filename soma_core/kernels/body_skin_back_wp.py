"""Skinning of bodies in SIMD lanes, with its derivative. The twin of ``animation.skinning`` for a CPU."""

import torch
import warp as wp
from torch import Tensor

from soma_core.geometry.torch_func import operator
from soma_core.kernels._lanes import as_rows, launch, row_of, worker_count, working_rows
from soma_core.kernels._native import HALVES, native, transposing
from soma_core.kernels._residual_phases import TILE
from soma_core.kernels._runtime import as_warp, once, scalar_name
from soma_core.kernels._threads import in_threads
from soma_core.kernels.body_skin_wp import Blend, Strides, drawing, lanes_of, skin_bodies, strides_of

__all__ = ["skin"]

_ids, _short = wp.array(dtype=wp.int32), wp.array(dtype=wp.int16)


@wp.struct
class _Task:
    """Counts of one launch: groups begin .. end of bodies, tiles first .. stop of vertices."""

    begin: int
    end: int
    first: int
    stop: int
    share: int
    bodies: int
    vertices: int
    joints: int
    points: int


@once
def _kernel(scalar: str, lanes: int):
    width, size = lanes, TILE
    real, rows = wp.array(dtype=getattr(wp, scalar)), wp.array3d(dtype=getattr(wp, scalar))
    (load, store), row, draw = transposing(scalar, lanes), row_of(scalar), drawing(scalar, lanes)

    def clear_forces(count: int, forces: real): ...

    def pull_bodies(
        start: _ids, joint: _short, value: real, transforms: real, pull: real, first: int, stop: int,
        tile: real, forces: real,
    ):  # fmt: skip
        ...

    clear, back = native(_CLEAR, scalar, lanes, clear_forces), native(_PULL, scalar, lanes, pull_bodies)

    @wp.kernel(module=wp.get_module(f"soma_body_skin_back_{scalar}_{lanes}"), enable_backward=False)
    def run(
        task: _Task, by: Strides, start: _ids, joint: _short, value: real, points: real, transforms: real,
        grad: real, turns: rows, tiles: rows, pulls: rows, sums: rows, moved: real, turned: real,
    ):  # fmt: skip
        w = wp.tid()
        turn, tile, pull, total = row(turns, w), row(tiles, w), row(pulls, w), row(sums, w)
        last, numbers, own = task.bodies - 1, 12 * task.joints, wp.int64(3 * task.vertices)
        for g in range(task.begin + w, task.end, tiles.shape[0] * tiles.shape[1]):
            f = g * width
            load(transforms, wp.int64(numbers), 0, numbers, f, last, turn, 0)
            clear(numbers, total)
            for t in range(task.first, task.stop):
                a = t * size
                b = wp.min(a + size, task.vertices)
                if by.axis == 1 and by.vertex == 3 and by.body > 1:
                    load(points, by.body, 3 * a, 3 * (b - a), f, last, tile, 0)
                else:
                    draw(points, by.body, by.vertex, by.axis, f, last, a, b, tile)
                load(grad, own, 3 * a, 3 * (b - a), f, last, pull, 0)
                back(start, joint, value, turn, pull, a, b, tile, total)
                if task.points > 0:
                    store(tile, 0, 3 * (b - a), moved, own, 3 * a, f, last)
            store(total, 0, numbers, turned, wp.int64(numbers), task.share * task.bodies * numbers, f, last)

    return run


_CLEAR = """
    M to = (M)forces.data;
    for (int i = 0; i < count; i++) to[i] = V{};
"""

_PULL = (
    HALVES
    + """
    HM transform = (HM)transforms.data, x = (HM)tile.data, g = (HM)pull.data, force = (HM)forces.data;
    for (int v = first; v < stop; v++, x += 3 * P, g += 3 * P)
        for (int h = 0; h < P; h++) {
            const H p = x[h], q = x[P + h], r = x[2 * P + h], a = g[h], b = g[P + h], c = g[2 * P + h];
            H back[3] = {H{}, H{}, H{}};
            for (int e = start.data[v]; e < start.data[v + 1]; e++) {
                const R w = value.data[e];
                HM m = transform + (12 * P * joint.data[e] + h), to = force + (12 * P * joint.data[e] + h);
                const H pulled[3] = {w * a, w * b, w * c};
                for (int i = 0; i < 3; i++, m += 4 * P, to += 4 * P) {
                    for (int k = 0; k < 3; k++) back[k] += m[k * P] * pulled[i];
                    to[0] += pulled[i] * p;
                    to[P] += pulled[i] * q;
                    to[2 * P] += pulled[i] * r;
                    to[3 * P] += pulled[i];
                }
            }
            for (int k = 0; k < 3; k++) x[k * P + h] = back[k];
        }
"""
)


@operator("soma_core::skin_bodies")
def _skin(points: Tensor, transforms: Tensor, start: Tensor, column: Tensor, value: Tensor) -> Tensor:
    return skin_bodies(points, transforms, Blend(start, column, value))


@_skin.register_fake
def _(points, transforms, start, column, value):
    return points.new_empty(transforms.shape[0], points.shape[1], 3)


@operator("soma_core::skin_bodies_backward")
def _skin_backward(
    grad: Tensor, points: Tensor, transforms: Tensor, start: Tensor, column: Tensor, value: Tensor,
    wanted: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    (count, joints), vertices = transforms.shape[:2], points.shape[1]
    moved = points.new_empty(count if wanted else 0, vertices, 3)
    if not count or not vertices:
        return moved, transforms.new_zeros(transforms.shape)
    lanes, tiles = lanes_of(count, points), -(-vertices // TILE)
    groups = -(-count // lanes)
    shares = max(1, min(torch.get_num_threads() // groups, tiles))
    turned = transforms.new_empty(shares, *transforms.shape)
    kernel = _kernel(scalar_name(points.dtype), lanes)
    transforms, grad = transforms.contiguous(), grad.contiguous()
    sizes = 12 * joints, 3 * TILE, 3 * TILE, 12 * joints

    def run(part: slice) -> None:  # of more than one share, a part is one of them
        task = _Task()
        task.share = part.start % shares
        task.begin, task.end = part.start // shares, -(-part.stop // shares)
        task.first, task.stop = tiles * task.share // shares, tiles * (task.share + 1) // shares
        task.bodies, task.vertices, task.joints, task.points = count, vertices, joints, int(wanted)
        workers = worker_count(task.end - task.begin, lanes)
        work = [working_rows(points, workers, size, lanes) for size in sizes]
        begin = as_warp(points.as_strided((1,), (1,)))
        given = begin, as_warp(transforms.view(-1)), as_warp(grad.view(-1)), *map(as_rows, work)
        tables, out = map(as_warp, (start, column, value)), (moved if wanted else grad, turned)
        inputs = [task, strides_of(points), *tables, *given, *(as_warp(one.view(-1)) for one in out)]
        launch(kernel, workers, inputs, points)

    in_threads(run, groups * shares, points)
    return moved, turned.sum(0) if shares > 1 else turned[0]


@_skin_backward.register_fake
def _(grad, points, transforms, start, column, value, wanted):
    moved = points.new_empty(transforms.shape[0] if wanted else 0, points.shape[1], 3)
    return moved, torch.empty_like(transforms, memory_format=torch.contiguous_format)


def _save(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx, grad):
    points, wanted = ctx.saved_tensors[0], ctx.needs_input_grad[0]
    moved, turned = torch.ops.soma_core.skin_bodies_backward(grad, *ctx.saved_tensors, wanted)
    if not wanted:
        moved = None
    elif points.shape[0] == 1:
        moved = moved.sum(0, keepdim=True)
    return moved, turned, None, None, None


_skin.register_autograd(_backward, setup_context=_save)


def skin(points: Tensor, transforms: Tensor, weights: Blend) -> Tensor:
    """Skinned vertices (B, v, 3) [m], contiguous. Differentiable; sums run in one order.

    Args:
        points: rest points (B or 1, v, 3) [m], in any layout.
        transforms: (B, T, 3, 4).
        weights: (v, T), float32 or float64 as the points.
    """
    return _skin(points, transforms, *weights)
