"""Linear blend skinning in Warp: the twin of ``animation.skinning``."""

from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from soma_core.geometry.sparse import Csr
from soma_core.geometry.torch_func import operator
from soma_core.kernels._runtime import as_warp, launching, loaded, once, scalar_name

__all__ = ["skin"]


@once
def _kernels(scalar: str) -> SimpleNamespace:
    real = getattr(wp, scalar)
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    module = wp.get_module(f"soma_skinning_{scalar}")

    @wp.kernel(module=module, enable_backward=False)
    def forward(
        crow: wp.array(dtype=wp.int64), col: wp.array(dtype=wp.int64), val: wp.array(dtype=real),
        transforms: wp.array3d(dtype=vec4), points: wp.array2d(dtype=vec3), out: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        b, v = wp.tid()
        r0, r1, r2 = vec4(), vec4(), vec4()
        for e in range(wp.int32(crow[v]), wp.int32(crow[v + 1])):
            w, j = val[e], wp.int32(col[e])
            r0 += w * transforms[b, j, 0]
            r1 += w * transforms[b, j, 1]
            r2 += w * transforms[b, j, 2]
        x = points[b, v]
        h = vec4(x[0], x[1], x[2], real(1.0))
        out[b, v] = vec3(wp.dot(r0, h), wp.dot(r1, h), wp.dot(r2, h))

    @wp.kernel(module=module, enable_backward=False)
    def points_backward(
        crow: wp.array(dtype=wp.int64), col: wp.array(dtype=wp.int64), val: wp.array(dtype=real),
        transforms: wp.array3d(dtype=vec4), grad: wp.array2d(dtype=vec3), out: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        b, v = wp.tid()
        g = grad[b, v]
        total = vec4()
        for e in range(wp.int32(crow[v]), wp.int32(crow[v + 1])):
            w, j = val[e], wp.int32(col[e])
            total += w * (
                g[0] * transforms[b, j, 0] + g[1] * transforms[b, j, 1] + g[2] * transforms[b, j, 2]
            )
        out[b, v] = vec3(total[0], total[1], total[2])

    @wp.kernel(module=module, enable_backward=False)
    def transforms_backward(
        crow: wp.array(dtype=wp.int64), col: wp.array(dtype=wp.int64), val: wp.array(dtype=real),
        points: wp.array2d(dtype=vec3), grad: wp.array2d(dtype=vec3), out: wp.array3d(dtype=vec4),
    ):  # fmt: skip
        b, j = wp.tid()  # one thread a joint, vertices in fixed order: no atomics, deterministic
        r0, r1, r2 = vec4(), vec4(), vec4()
        for e in range(wp.int32(crow[j]), wp.int32(crow[j + 1])):
            v = wp.int32(col[e])
            x, g = points[b, v], val[e] * grad[b, v]
            h = vec4(x[0], x[1], x[2], real(1.0))
            r0 += g[0] * h
            r1 += g[1] * h
            r2 += g[2] * h
        out[b, j, 0] = r0
        out[b, j, 1] = r1
        out[b, j, 2] = r2

    return SimpleNamespace(
        vec3=vec3, vec4=vec4, forward=forward, points_backward=points_backward,
        transforms_backward=transforms_backward,
    )  # fmt: skip


@operator("soma_core::skin")
def _skin(
    points: Tensor, transforms: Tensor, crow: Tensor, col: Tensor, val: Tensor,
    t_crow: Tensor, t_col: Tensor, t_val: Tensor,
) -> Tensor:  # fmt: skip
    kernels, out = (
        _kernels(scalar_name(points.dtype)),
        torch.empty_like(points, memory_format=torch.contiguous_format),
    )
    if not out.numel():  # Warp takes no view of an empty tensor
        return out
    with launching(points) as device:
        wp.launch(
            loaded(kernels.forward, device),
            dim=tuple(points.shape[:2]),
            inputs=[as_warp(crow), as_warp(col), as_warp(val), as_warp(transforms, kernels.vec4),
                    as_warp(points, kernels.vec3), as_warp(out, kernels.vec3)],
            device=device,
        )  # fmt: skip
    return out


@_skin.register_fake
def _(points, transforms, crow, col, val, t_crow, t_col, t_val):
    return torch.empty_like(points, memory_format=torch.contiguous_format)


@operator("soma_core::skin_backward")
def _skin_backward(
    grad: Tensor, points: Tensor, transforms: Tensor, crow: Tensor, col: Tensor, val: Tensor,
    t_crow: Tensor, t_col: Tensor, t_val: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    kernels = _kernels(scalar_name(points.dtype))
    points_grad = torch.empty_like(points, memory_format=torch.contiguous_format)
    transforms_grad = torch.empty_like(transforms, memory_format=torch.contiguous_format)
    if not points.numel():
        return points_grad, transforms_grad.zero_()
    grad = grad.contiguous()
    warp_grad = as_warp(grad, kernels.vec3)
    with launching(points) as device:
        wp.launch(
            loaded(kernels.points_backward, device),
            dim=tuple(points.shape[:2]),
            inputs=[as_warp(crow), as_warp(col), as_warp(val), as_warp(transforms, kernels.vec4), warp_grad,
                    as_warp(points_grad, kernels.vec3)],
            device=device,
        )  # fmt: skip
        wp.launch(
            loaded(kernels.transforms_backward, device),
            dim=tuple(transforms.shape[:2]),
            inputs=[as_warp(t_crow), as_warp(t_col), as_warp(t_val), as_warp(points, kernels.vec3), warp_grad,
                    as_warp(transforms_grad, kernels.vec4)],
            device=device,
        )  # fmt: skip
    return points_grad, transforms_grad


@_skin_backward.register_fake
def _(grad, points, transforms, crow, col, val, t_crow, t_col, t_val):
    contiguous = torch.contiguous_format
    return torch.empty_like(points, memory_format=contiguous), torch.empty_like(
        transforms, memory_format=contiguous
    )


def _save(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx, grad):
    points_grad, transforms_grad = torch.ops.soma_core.skin_backward(grad, *ctx.saved_tensors)
    return points_grad, transforms_grad, None, None, None, None, None, None


_skin.register_autograd(_backward, setup_context=_save)


def skin(points: Tensor, transforms: Tensor, weights: Csr, transpose: Csr) -> Tensor:
    """Skinned vertices (B, v, 3) from points (B, v, 3) and transforms (B, J, 3, 4), same dtype and device.

    `weights` (v, J) and `transpose` (J, v) are one matrix in CSR form. Reductions run in index order:
    forward and backward are deterministic. float32 and float64, CPU and CUDA.
    """
    return _skin(points.contiguous(), transforms.contiguous(), *weights, *transpose)
