"""Moments of targets in Warp: the twin of ``inversion.moments``, frames in SIMD lanes."""

import functools

import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._lanes import as_lanes, from_lanes, in_threads, lane_count, lane_types
from soma_core.kernels._runtime import as_warp, launching, scalar_name

__all__ = ["target_moments"]

_ids = wp.array(dtype=wp.int64)


@functools.cache
def _kernel(scalar: str, lanes: int):
    types = lane_types(scalar, lanes)
    real, width, frames = types.real, lanes, wp.array2d(dtype=types.vec)
    module = wp.get_module(f"soma_target_moments_{scalar}_{lanes}")
    gather, joint_moments = _gather(types), _joint_moments(types, _write(types))

    @wp.kernel(module=module, enable_backward=False)
    def moments(
        start: _ids, vertex: _ids, weight: wp.array(dtype=real), local: wp.array2d(dtype=real),
        mean: wp.array2d(dtype=real), vertices: wp.array3d(dtype=real), points: frames,
        origin: frames, out: frames,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(w, out.shape[0], points.shape[0]):
            gather(w, g * width, vertices, points)
            for r in range(3):
                origin[g, r] = points[w, 3 * wp.int32(vertex[0]) + r]
            for t in range(start.shape[0] - 1):
                joint_moments(w, g, t, start, vertex, weight, local, mean, points, origin, out)

    return moments


def _write(types):
    real, vec, frames = types.real, types.vec, wp.array2d(dtype=types.vec)

    @wp.func
    def write(
        g: int, k: int, t: int, x: vec, y: vec, z: vec, sums: vec, step: vec, mean: wp.array2d(dtype=real),
        out: frames,
    ):  # fmt: skip
        out[g, k] = x + mean[t, 0] * step
        out[g, k + 1] = y + mean[t, 1] * step
        out[g, k + 2] = z + mean[t, 2] * step
        out[g, k + 3] = sums + mean[t, 3] * step

    return write


def _joint_moments(types, write):
    real, vec, frames = types.real, types.vec, wp.array2d(dtype=types.vec)

    @wp.func
    def joint_moments(
        w: int, g: int, t: int, start: _ids, vertex: _ids, weight: wp.array(dtype=real),
        local: wp.array2d(dtype=real), mean: wp.array2d(dtype=real), points: frames, origin: frames,
        out: frames,
    ):  # fmt: skip
        """``R`` of one joint, about the origin of the frames."""
        first = wp.int32(start[t])
        v = 3 * wp.int32(vertex[first])
        # Sums of steps from a vertex nearby: float32 then loses nothing in long sums.
        c0 = points[w, v]
        c1 = points[w, v + 1]
        c2 = points[w, v + 2]
        x0 = vec(real(0.0))
        x1 = vec(real(0.0))
        x2 = vec(real(0.0))
        x3 = vec(real(0.0))
        y0 = vec(real(0.0))
        y1 = vec(real(0.0))
        y2 = vec(real(0.0))
        y3 = vec(real(0.0))
        z0 = vec(real(0.0))
        z1 = vec(real(0.0))
        z2 = vec(real(0.0))
        z3 = vec(real(0.0))
        for e in range(first, wp.int32(start[t + 1])):
            v = 3 * wp.int32(vertex[e])
            x = weight[e] * (points[w, v] - c0)
            y = weight[e] * (points[w, v + 1] - c1)
            z = weight[e] * (points[w, v + 2] - c2)
            b0 = local[e, 0]
            b1 = local[e, 1]
            b2 = local[e, 2]
            x0 += b0 * x
            x1 += b1 * x
            x2 += b2 * x
            x3 += x
            y0 += b0 * y
            y1 += b1 * y
            y2 += b2 * y
            y3 += y
            z0 += b0 * z
            z1 += b1 * z
            z2 += b2 * z
            z3 += z
        k = 12 * t
        write(g, k, t, x0, x1, x2, x3, c0 - origin[g, 0], mean, out)
        write(g, k + 4, t, y0, y1, y2, y3, c1 - origin[g, 1], mean, out)
        write(g, k + 8, t, z0, z1, z2, z3, c2 - origin[g, 2], mean, out)

    return joint_moments


def _gather(types):
    real, vec, width = types.real, types.vec, types.lanes
    frames = wp.array2d(dtype=vec)

    @wp.func
    def gather(w: int, first: int, vertices: wp.array3d(dtype=real), points: frames):
        """Vertices of a group of frames into row w of `points`, frames innermost."""
        last = vertices.shape[0] - 1
        for v in range(vertices.shape[1]):
            for r in range(3):
                x = vec(real(0.0))
                for c in range(width):
                    x[c] = vertices[wp.min(first + c, last), v, r]
                points[w, 3 * v + r] = x

    return gather


def target_moments(
    start: Tensor, vertex: Tensor, weight: Tensor, local: Tensor, mean: Tensor, vertices: Tensor
) -> tuple[Tensor, Tensor]:
    """``R`` (F, T, 3, 4) about an origin of each frame (F, 3) [m], of one identity.

    Args:
        start: (T + 1,) int64, row starts of the joints' influences.
        vertex: (e,) int64, vertex of each influence.
        weight: (e,) skin weight times vertex weight.
        local: (e, 3) rest points about their joint [m].
        mean: (T, 4) sums of weight times (local, 1).
        vertices: (F, v, 3) [m], finite.
    """
    vertices = vertices.contiguous()
    count, lanes, scalar = len(vertices), lane_count(vertices), scalar_name(vertices.dtype)
    types, groups = lane_types(scalar, lanes), -(-count // lanes)
    new = functools.partial(torch.empty, dtype=vertices.dtype, device=vertices.device)
    out, origin = new(groups, 12 * len(mean), lanes), new(groups, 3, lanes)
    kernel = _kernel(scalar, lanes)

    def run(part: slice) -> None:
        workers = len(out[part]) if vertices.is_cuda else 1
        points = new(workers, 3 * vertices.shape[1], lanes)
        shown = vertices[part.start * lanes : part.stop * lanes]
        with launching(vertices) as device:
            wp.launch(
                kernel, dim=workers,
                inputs=[as_warp(start), as_warp(vertex), as_warp(weight), as_warp(local), as_warp(mean),
                        as_warp(shown), *(as_lanes(one, types) for one in (points, origin[part], out[part]))],
                device=device,
            )  # fmt: skip

    in_threads(run, groups, vertices)
    return from_lanes(out, count, (len(mean), 3, 4)), from_lanes(origin, count, (3,))
