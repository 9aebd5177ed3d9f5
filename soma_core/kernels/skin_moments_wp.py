"""Moments of targets in Warp: the twin of ``inversion.moments``, frames in SIMD lanes."""

import functools

import numpy as np
import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._lanes import (
    as_rows,
    lane_count,
    launch,
    row_of,
    worker_count,
    working_rows,
)
from soma_core.kernels._native import native, transposing
from soma_core.kernels._runtime import as_warp, once, scalar_name
from soma_core.kernels._threads import in_threads

__all__ = ["target_moments", "tile_runs"]

_TILE = 64
"""Vertices of all frames of a group that lie in the first cache together."""

_ids = wp.array(dtype=wp.int64)


@once
def _kernel(scalar: str, lanes: int):
    width, size = lanes, _TILE
    real, rows = wp.array(dtype=getattr(wp, scalar)), wp.array3d(dtype=getattr(wp, scalar))
    (load, store), row = transposing(scalar, lanes), row_of(scalar)
    begin, add, end = _steps(real, scalar, lanes)
    module = wp.get_module(f"soma_target_moments_{scalar}_{lanes}")

    @wp.kernel(module=module, enable_backward=False)
    def moments(
        first: int, stop: int, frames: int, count: int,
        start: _ids, vertex: _ids, tile_run: _ids, run_joint: _ids, run_start: _ids, run_stop: _ids,
        point: real, mean: real, vertices: real, tiles: rows, centres: rows, sums: rows,
        origin: real, out: real,
    ):  # fmt: skip
        w = wp.tid()
        tile, centre, total = row(tiles, w), row(centres, w), row(sums, w)
        joints = start.shape[0] - 1
        stride = wp.int64(3 * count)
        last = frames - 1
        for g in range(first + w, stop, tiles.shape[0] * tiles.shape[1]):
            f = g * width
            for t in range(joints):
                load(vertices, stride, 3 * wp.int32(vertex[start[t]]), 3, f, last, centre, 3 * t)
            begin(12 * joints, total)
            for t in range(tile_run.shape[0] - 1):
                a = t * size
                load(vertices, stride, 3 * a, 3 * (wp.min(a + size, count) - a), f, last, tile, 0)
                add(t, a, tile_run, run_joint, run_start, run_stop, vertex, point, tile, centre, total)
            end(joints, mean, centre, total)
            store(total, 0, 12 * joints, out, wp.int64(12 * joints), 0, f, last)
            store(centre, 0, 3, origin, wp.int64(3), 0, f, last)

    return moments


def _steps(real, scalar: str, lanes: int):
    def begin(count: int, sums: real): ...

    def add(
        t: int, first: int, tile_run: _ids, run_joint: _ids, run_start: _ids, run_stop: _ids, vertex: _ids,
        point: real, tile: real, centres: real, sums: real,
    ):  # fmt: skip
        ...

    def end(joints: int, mean: real, centres: real, sums: real): ...

    bodies = {begin: _BEGIN, add: _ADD, end: _END}
    return tuple(native(body, scalar, lanes, stub) for stub, body in bodies.items())


_BEGIN = """
    M to = (M)sums.data;
    for (int i = 0; i < count; i++) to[i] = V{};
"""

# Sums of steps from a vertex nearby: float32 then loses nothing in long sums.
_ADD = """
    M points = (M)tile.data - 3 * first;
    for (int p = tile_run.data[t]; p < tile_run.data[t + 1]; p++) {
        const int joint = run_joint.data[p];
        M centre = (M)centres.data + 3 * joint;
        V f[12];
        for (int k = 0; k < 12; k++) f[k] = V{};
        for (long long e = run_start.data[p]; e < run_stop.data[p]; e++) {
            M x = points + 3 * vertex.data[e];
            const R* b = point.data + 4 * e;
            for (int i = 0; i < 3; i++) {
                const V step = x[i] - centre[i];
                for (int k = 0; k < 4; k++) f[4 * i + k] += b[k] * step;
            }
        }
        M to = (M)sums.data + 12 * joint;
        for (int k = 0; k < 12; k++) to[k] += f[k];
    }
"""

_END = """
    M to = (M)sums.data, centre = (M)centres.data, origin = centre;
    for (int t = 0; t < joints; t++, centre += 3)
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 4; k++) *to++ += mean.data[4 * t + k] * (centre[i] - origin[i]);
"""


def tile_runs(start: np.ndarray, vertex: np.ndarray) -> tuple[np.ndarray, ...]:
    """Influences by tile of vertices: each joint's, where a tile has any, lie together in the list.

    Args:
        start: (T + 1,) row starts of the joints' influences.
        vertex: (e,) vertex of each influence, ascending within a joint.

    Returns:
        First run of every tile (tiles + 1,); of every run its joint, and where in the list it starts and
        stops, (n,) each.
    """
    joint = np.repeat(np.arange(len(start) - 1), np.diff(start))
    tile = vertex // _TILE
    fresh = (
        np.append(True, (np.diff(tile) != 0) | (np.diff(joint) != 0)) if len(vertex) else np.zeros(0, bool)
    )
    begin = np.flatnonzero(fresh)
    stop = np.append(begin, len(vertex))[1:]
    order = np.argsort(tile[begin], kind="stable")
    begin, stop = begin[order], stop[order]
    tiles = np.arange(int(tile.max(initial=-1)) + 2)
    return np.searchsorted(tile[begin], tiles), joint[begin], begin, stop


def target_moments(
    start: Tensor, vertex: Tensor, runs: tuple[Tensor, ...], weight: Tensor, local: Tensor, mean: Tensor,
    vertices: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """``R`` (F, T, 3, 4) about an origin of each frame (F, 3) [m], of one identity.

    Args:
        start: (T + 1,) int64, row starts of the joints' influences.
        vertex: (e,) int64, vertex of each influence.
        runs: from :func:`tile_runs`.
        weight: (e,) skin weight times vertex weight.
        local: (e, 3) rest points about their joint [m].
        mean: (T, 4) sums of weight times (local, 1).
        vertices: (F, v, 3) [m], finite.
    """
    vertices = vertices.contiguous()
    count, lanes, scalar = len(vertices), lane_count(vertices), scalar_name(vertices.dtype)
    kernel, groups, joints = _kernel(scalar, lanes), -(-count // lanes), len(mean)
    new = functools.partial(torch.empty, dtype=vertices.dtype, device=vertices.device)
    out, origin = new(count, joints, 3, 4), new(count, 3)
    point = torch.cat((local * weight[:, None], weight[:, None]), 1)

    def run(part: slice) -> None:
        workers = worker_count(part.stop - part.start, lanes)
        work = [working_rows(vertices, workers, size, lanes) for size in (3 * _TILE, 3 * joints, 12 * joints)]
        flat = [as_warp(one.view(-1)) for one in (point, mean, vertices)]
        given = *map(as_warp, (start, vertex, *runs)), *flat, *map(as_rows, work)
        counts = part.start, part.stop, count, vertices.shape[1]
        inputs = [*counts, *given, as_warp(origin.view(-1)), as_warp(out.view(-1))]
        launch(kernel, workers, inputs, vertices)

    in_threads(run, groups, vertices)
    return out, origin
