"""Moments in Warp where every frame has its own identity or its own vertex weights; frames in SIMD lanes."""

import functools

import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._lanes import (
    as_lanes,
    from_lanes,
    lane_count,
    lane_types,
    launch,
    to_lanes,
    worker_count,
)
from soma_core.kernels._runtime import as_warp, once, scalar_name
from soma_core.kernels._threads import in_threads

__all__ = ["frame_moments"]

_ids = wp.array(dtype=wp.int64)


@once
def _kernel(scalar: str, lanes: int):
    types = lane_types(scalar, lanes)
    real, frames = types.real, wp.array2d(dtype=types.vec)
    numbers, gather = wp.array(dtype=types.real), _gather(types)
    second, first = _second(types), _first(types)
    table = wp.array3d(dtype=real)
    module = wp.get_module(f"soma_frame_moments_{scalar}_{lanes}")
    module.options["max_unroll"] = 4

    @wp.kernel(module=module, enable_backward=False)
    def moments(
        begin: int, joint_start: _ids, joint_vertex: _ids, joint_weight: numbers,
        pair_start: _ids, pair_vertex: _ids, pair_weight: numbers, pair_first: _ids,
        rest: table, weights: table, vertices: table, centres: frames,
        points: frames, origin: frames, pairs: frames, own: frames, target: frames,
    ):  # fmt: skip
        w = wp.tid()
        count = vertices.shape[1]
        for g in range(begin + w, target.shape[0], points.shape[0]):
            gather(w, g, 0, rest, points)
            gather(w, g, 3 * count, vertices, points)
            gather(w, g, 6 * count, weights, points)
            for r in range(3):
                origin[g, r] = points[w, 3 * (count + wp.int32(joint_vertex[0])) + r]
            for t in range(joint_start.shape[0] - 1):
                a = wp.int32(joint_start[t])
                b = wp.int32(joint_start[t + 1])
                second(w, g, t, t, a, b, count, joint_vertex, joint_weight, centres, points, own)
                first(w, g, t, a, b, count, joint_vertex, joint_weight, centres, points, origin, target)
            for p in range(pair_start.shape[0] - 1):
                second(
                    w, g, p, wp.int32(pair_first[p]), wp.int32(pair_start[p]), wp.int32(pair_start[p + 1]),
                    count, pair_vertex, pair_weight, centres, points, pairs,
                )  # fmt: skip

    return moments


def _gather(types):
    real, vec, width, frames = types.real, types.vec, types.lanes, wp.array2d(dtype=types.vec)

    @wp.func
    def gather(w: int, g: int, offset: int, source: wp.array3d(dtype=real), out: frames):
        """Rows of a group of frames, frames innermost; a source with one row serves all."""
        last = source.shape[0] - 1
        columns = source.shape[2]
        for v in range(source.shape[1]):
            for r in range(columns):
                x = vec(real(0.0))
                for c in range(width):
                    x[c] = source[wp.min(g * width + c, last), v, r]
                out[w, offset + columns * v + r] = x

    return gather


def _second(types):
    real, vec, frames = types.real, types.vec, wp.array2d(dtype=types.vec)
    numbers = wp.array(dtype=real)

    @wp.func
    def second(
        w: int, g: int, row: int, joint: int, begin: int, stop: int, count: int, vertex: _ids,
        weight: numbers, centres: frames, points: frames, out: frames,
    ):  # fmt: skip
        """``sum s (d; 1)(d; 1)^T`` over some influences, d from the joint's centre: ten entries."""
        c0 = centres[g, 3 * joint]
        c1 = centres[g, 3 * joint + 1]
        c2 = centres[g, 3 * joint + 2]
        xx = vec(real(0.0))
        xy = vec(real(0.0))
        xz = vec(real(0.0))
        yy = vec(real(0.0))
        yz = vec(real(0.0))
        zz = vec(real(0.0))
        x = vec(real(0.0))
        y = vec(real(0.0))
        z = vec(real(0.0))
        mass = vec(real(0.0))
        for e in range(begin, stop):
            v = wp.int32(vertex[e])
            s = weight[e] * points[w, 6 * count + v]
            a = points[w, 3 * v] - c0
            b = points[w, 3 * v + 1] - c1
            c = points[w, 3 * v + 2] - c2
            sa = wp.cw_mul(s, a)
            sb = wp.cw_mul(s, b)
            sc = wp.cw_mul(s, c)
            xx += wp.cw_mul(sa, a)
            xy += wp.cw_mul(sa, b)
            xz += wp.cw_mul(sa, c)
            yy += wp.cw_mul(sb, b)
            yz += wp.cw_mul(sb, c)
            zz += wp.cw_mul(sc, c)
            x += sa
            y += sb
            z += sc
            mass += s
        k = 10 * row
        out[g, k] = xx
        out[g, k + 1] = xy
        out[g, k + 2] = xz
        out[g, k + 3] = yy
        out[g, k + 4] = yz
        out[g, k + 5] = zz
        out[g, k + 6] = x
        out[g, k + 7] = y
        out[g, k + 8] = z
        out[g, k + 9] = mass

    return second


def _first(types):
    real, vec, frames = types.real, types.vec, wp.array2d(dtype=types.vec)
    numbers = wp.array(dtype=real)

    @wp.func
    def first(
        w: int, g: int, t: int, begin: int, stop: int, count: int, vertex: _ids, weight: numbers,
        centres: frames, points: frames, origin: frames, out: frames,
    ):  # fmt: skip
        """``sum s x (d; 1)^T`` over a joint's influences, x from the origin: twelve entries."""
        for i in range(12):
            out[g, 12 * t + i] = vec(real(0.0))
        for e in range(begin, stop):
            v = wp.int32(vertex[e])
            s = weight[e] * points[w, 6 * count + v]
            a = points[w, 3 * v] - centres[g, 3 * t]
            b = points[w, 3 * v + 1] - centres[g, 3 * t + 1]
            c = points[w, 3 * v + 2] - centres[g, 3 * t + 2]
            for r in range(3):
                x = wp.cw_mul(s, points[w, 3 * (count + v) + r] - origin[g, r])
                out[g, 12 * t + 4 * r] += wp.cw_mul(x, a)
                out[g, 12 * t + 4 * r + 1] += wp.cw_mul(x, b)
                out[g, 12 * t + 4 * r + 2] += wp.cw_mul(x, c)
                out[g, 12 * t + 4 * r + 3] += x

    return first


def frame_moments(
    joints: tuple[Tensor, Tensor, Tensor], pairs: tuple[Tensor, Tensor, Tensor, Tensor],
    rest: Tensor, centres: Tensor, weights: Tensor, vertices: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Raw sums of every frame: pairs (F, p, 10), joints (F, T, 10), targets (F, T, 3, 4), origins (F, 3) [m].

    Ten entries are ``xx xy xz yy yz zz x y z 1`` of ``s (d; 1)(d; 1)^T``, d a rest point from the centre of
    its joint (the pair's first). Targets are ``s x (d; 1)^T``, x from the origin of the frame.

    Args:
        joints: row starts (T + 1,), vertices (e,) and skin weights (e,) of the joints' influences.
        pairs: row starts (p + 1,), vertices (m,), products of two skin weights (m,), first joint (p,).
        rest: (1 or F, v, 3) [m].
        centres: bind positions of the weighted joints, (F, T, 3) [m].
        weights: (1 or F, v).
        vertices: (F, v, 3) [m].
    """
    vertices, rest, weights = vertices.contiguous(), rest.contiguous(), weights[..., None].contiguous()
    count, lanes, scalar = len(vertices), lane_count(vertices), scalar_name(vertices.dtype)
    types, kernel = lane_types(scalar, lanes), _kernel(scalar, lanes)
    centre = to_lanes(centres, lanes)
    new = functools.partial(torch.empty, dtype=vertices.dtype, device=vertices.device)
    sizes = 3, 10 * len(pairs[3]), 10 * centres.shape[1], 12 * centres.shape[1]
    out = [new(len(centre), size, lanes) for size in sizes]
    lists = [one.contiguous() for one in (*joints, *pairs)]
    tables = rest, weights, vertices

    def run(part: slice) -> None:
        workers, size = worker_count(part.stop - part.start, lanes), 7 * vertices.shape[1]
        points = new(workers, size, lanes) if lanes > 1 else new(size, workers, 1).transpose(0, 1)
        shown = [as_lanes(one[: part.stop], types) for one in (centre, *out)]
        inputs = [part.start, *map(as_warp, lists), *map(as_warp, tables), shown[0]]
        launch(kernel, workers, [*inputs, as_lanes(points, types), *shown[1:]], vertices)

    in_threads(run, len(centre), vertices)
    joint_count = centres.shape[1]
    return (
        from_lanes(out[1], count, (len(pairs[3]), 10)), from_lanes(out[2], count, (joint_count, 10)),
        from_lanes(out[3], count, (joint_count, 3, 4)), from_lanes(out[0], count, (3,)),
    )  # fmt: skip
