"""Smooth local rotations of a skinned surface in Warp: the twin of ``correctives.frames``."""

import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._runtime import as_warp, launching, loaded, once, scalar_name
from soma_core.kernels.rotation_functions_wp import kabsch_function

__all__ = ["surface_frames"]


@once
def _kernel(scalar: str) -> tuple[wp.Kernel, type, type, type]:
    real = getattr(wp, scalar)
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    mat33 = wp.types.matrix((3, 3), real)
    module = wp.get_module(f"soma_surface_frames_{scalar}")
    from_covariance = kabsch_function(scalar, module)

    @wp.kernel(module=module, enable_backward=False)
    def frames(
        crow: wp.array(dtype=wp.int64), col: wp.array(dtype=wp.int64), moments: wp.array2d(dtype=vec3),
        centre: wp.array(dtype=vec3), transforms: wp.array3d(dtype=vec4), out: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        b, v = wp.tid()
        p = centre[v]
        total = mat33()
        for e in range(wp.int32(crow[v]), wp.int32(crow[v + 1])):
            j = wp.int32(col[e])
            r0, r1, r2 = transforms[b, j, 0], transforms[b, j, 1], transforms[b, j, 2]
            turn = mat33(r0[0], r0[1], r0[2], r1[0], r1[1], r1[2], r2[0], r2[1], r2[2])
            place = turn * p + vec3(r0[3], r1[3], r2[3])
            second = wp.matrix_from_rows(moments[e, 0], moments[e, 1], moments[e, 2])
            total += turn * second + wp.outer(place, moments[e, 3])
        out[b, v] = from_covariance(total)

    return frames, vec3, vec4, mat33


def surface_frames(transforms: Tensor, crow: Tensor, col: Tensor, moments: Tensor, centre: Tensor) -> Tensor:
    """Rotations (B, v, 3, 3); see ``correctives.frames.surface_frames_reference`` for the arguments.

    float32 and float64, one dtype and device for all; no derivative.
    """
    kernel, vec3, vec4, mat33 = _kernel(scalar_name(transforms.dtype))
    transforms = transforms.contiguous()
    out = transforms.new_empty(len(transforms), len(centre), 3, 3)
    if not out.numel():  # Warp takes no view of an empty tensor
        return out
    with launching(transforms) as device, torch.no_grad():
        wp.launch(
            loaded(kernel, device),
            dim=tuple(out.shape[:2]),
            inputs=[as_warp(crow), as_warp(col), as_warp(moments, vec3), as_warp(centre, vec3),
                    as_warp(transforms, vec4), as_warp(out, mat33)],
            device=device,
        )  # fmt: skip
    return out
