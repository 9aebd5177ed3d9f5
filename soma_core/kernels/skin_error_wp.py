"""Distance of posed vertices to targets in Warp, frames in SIMD lanes; no posed vertex is written."""

import functools

import warp as wp
from torch import Tensor

from soma_core.kernels._lanes import as_lanes, from_lanes, in_threads, lane_count, lane_types, to_lanes
from soma_core.kernels._runtime import as_warp, launching, scalar_name

__all__ = ["skin_error"]

_ids = wp.array(dtype=wp.int64)


@functools.cache
def _kernel(scalar: str, lanes: int):
    types = lane_types(scalar, lanes)
    real, vec, width = types.real, types.vec, lanes
    frames, numbers = wp.array2d(dtype=vec), wp.array2d(dtype=real)
    module = wp.get_module(f"soma_skin_error_{scalar}_{lanes}")

    @wp.kernel(module=module, enable_backward=False)
    def distance(
        first: int, start: _ids, joint: _ids, point: numbers, weight: wp.array(dtype=real),
        transforms: frames, vertices: wp.array3d(dtype=real), out: numbers, total: frames,
    ):  # fmt: skip
        g = first + wp.tid()
        begin = g * width
        last = vertices.shape[0] - 1
        energy = vec(real(0.0))
        for v in range(vertices.shape[1]):
            x = vec(real(0.0))
            y = vec(real(0.0))
            z = vec(real(0.0))
            for i in range(width):
                f = wp.min(begin + i, last)
                x[i] = -vertices[f, v, 0]
                y[i] = -vertices[f, v, 1]
                z[i] = -vertices[f, v, 2]
            for e in range(wp.int32(start[v]), wp.int32(start[v + 1])):
                k = 12 * wp.int32(joint[e])
                a = point[e, 0]
                b = point[e, 1]
                c = point[e, 2]
                d = point[e, 3]
                x += a * transforms[g, k] + b * transforms[g, k + 1] + c * transforms[g, k + 2]
                x += d * transforms[g, k + 3]
                y += a * transforms[g, k + 4] + b * transforms[g, k + 5] + c * transforms[g, k + 6]
                y += d * transforms[g, k + 7]
                z += a * transforms[g, k + 8] + b * transforms[g, k + 9] + c * transforms[g, k + 10]
                z += d * transforms[g, k + 11]
            squared = wp.cw_mul(x, x) + wp.cw_mul(y, y) + wp.cw_mul(z, z)
            energy += weight[v] * squared
            length = types.root(squared)
            for i in range(width):
                if begin + i <= last:
                    out[begin + i, v] = length[i]
        total[g, 0] = energy

    return distance


def skin_error(
    start: Tensor, joint: Tensor, point: Tensor, weight: Tensor, transforms: Tensor, vertices: Tensor
) -> tuple[Tensor, Tensor]:
    """Distances (F, v) [m] of one body in many poses to targets, and their weighted squared sums (F,) [m^2].

    Args:
        start: (v + 1,) int64, row starts of the vertices' influences.
        joint: (e,) int64, joint of each influence.
        point: (e, 4) skin weight times (rest point; 1) [m].
        weight: (v,) vertex weights.
        transforms: (F, J, 3, 4) from ``skinning_transforms``.
        vertices: (F, v, 3) [m].
    """
    vertices = vertices.contiguous()
    count, lanes, scalar = len(vertices), lane_count(vertices), scalar_name(vertices.dtype)
    types, kernel = lane_types(scalar, lanes), _kernel(scalar, lanes)
    groups = to_lanes(transforms, lanes)
    out, total = vertices.new_empty(vertices.shape[:2]), groups.new_empty(len(groups), 1, lanes)

    def run(part: slice) -> None:
        with launching(vertices) as device:
            wp.launch(
                kernel, dim=part.stop - part.start,
                inputs=[part.start, as_warp(start), as_warp(joint), as_warp(point), as_warp(weight),
                        as_lanes(groups, types), as_warp(vertices), as_warp(out), as_lanes(total, types)],
                device=device,
            )  # fmt: skip

    in_threads(run, len(groups), vertices)
    return out, from_lanes(total, count, ())
