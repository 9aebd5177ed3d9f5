"""Stage 2 of the skeleton fit in Warp: the twin of ``skeleton.rotations`` (paper, section 3.4.2)."""

import functools
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._runtime import as_warp, launching, scalar_name
from soma_core.kernels.rotation_functions_wp import bone_functions, kabsch_function

__all__ = ["fit_displacements"]


@functools.cache
def _kernels(scalar: str, width: int) -> SimpleNamespace:
    module = wp.get_module(f"soma_skeleton_fit_{scalar}_{width}")
    real = getattr(wp, scalar)
    vec3, mat33 = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    from_covariance = kabsch_function(scalar, module)
    arc, pair_normal = bone_functions(scalar, module)

    @wp.kernel(module=module)
    def displace(
        pivots: wp.array(dtype=wp.int64), children: wp.array2d(dtype=wp.int64), bind: wp.array(dtype=vec3),
        joints: wp.array2d(dtype=vec3), covariances: wp.array2d(dtype=mat33), out: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        b, p = wp.tid()
        k = wp.int32(pivots[p])
        first = from_covariance(covariances[b, k])
        c = wp.int32(children[p, 0])
        if children[p, 1] == pivots[p]:
            out[b, p] = arc(first * (bind[c] - bind[k]), joints[b, c] - joints[b, k]) * first
        else:
            total = mat33()
            for e in range(width):  # unrolled: Warp differentiates a dynamic loop over sums wrongly
                c = wp.int32(children[p, e])
                bone, reach = first * (bind[c] - bind[k]), joints[b, c] - joints[b, k]
                total += wp.outer(reach, bone)
                for f in range(width):  # every pair comes twice; equal ones and the padding add zero
                    d = wp.int32(children[p, f])
                    other, far = first * (bind[d] - bind[k]), joints[b, d] - joints[b, k]
                    total += real(0.5) * pair_normal(bone, other, reach, far)
            out[b, p] = from_covariance(total) * first

    return SimpleNamespace(vec3=vec3, mat33=mat33, displace=displace)


@torch.library.custom_op("soma_core::fit_displacements", mutates_args=())
def _fit(
    joints: Tensor, covariances: Tensor, bind: Tensor, pivots: Tensor, children: Tensor
) -> Tensor:  # fmt: skip
    kernels = _kernels(scalar_name(joints.dtype), children.shape[1])
    out = joints.new_empty(len(joints), len(pivots), 3, 3)
    if not out.numel():  # Warp takes no view of an empty tensor
        return out
    with launching(joints) as device:
        wp.launch(
            kernels.displace,
            dim=tuple(out.shape[:2]),
            inputs=[as_warp(pivots), as_warp(children), as_warp(bind, kernels.vec3),
                    as_warp(joints, kernels.vec3), as_warp(covariances, kernels.mat33)],
            outputs=[as_warp(out, kernels.mat33)],
            device=device,
        )  # fmt: skip
    return out


@_fit.register_fake
def _(joints, covariances, bind, pivots, children):
    return joints.new_empty(joints.shape[0], pivots.shape[0], 3, 3)


@torch.library.custom_op("soma_core::fit_displacements_backward", mutates_args=())
def _fit_backward(
    grad: Tensor, joints: Tensor, covariances: Tensor, bind: Tensor, pivots: Tensor, children: Tensor
) -> tuple[Tensor, Tensor]:  # fmt: skip
    kernels = _kernels(scalar_name(joints.dtype), children.shape[1])
    contiguous = torch.contiguous_format
    joints_grad = torch.zeros_like(joints, memory_format=contiguous)
    covariances_grad = torch.zeros_like(covariances, memory_format=contiguous)
    grad = grad.clone(memory_format=contiguous)
    scratch = torch.empty_like(grad)
    if not grad.numel():
        return joints_grad, covariances_grad
    with launching(joints) as device:
        wp.launch(
            kernels.displace,
            dim=tuple(grad.shape[:2]),
            inputs=[as_warp(pivots), as_warp(children), as_warp(bind, kernels.vec3),
                    as_warp(joints, kernels.vec3), as_warp(covariances, kernels.mat33)],
            outputs=[as_warp(scratch, kernels.mat33)],
            adj_inputs=[None, None, None, as_warp(joints_grad, kernels.vec3),
                        as_warp(covariances_grad, kernels.mat33)],
            adj_outputs=[as_warp(grad, kernels.mat33)],
            adjoint=True,
            device=device,
        )  # fmt: skip
    return joints_grad, covariances_grad


@_fit_backward.register_fake
def _(grad, joints, covariances, bind, pivots, children):
    contiguous = torch.contiguous_format
    return torch.empty_like(joints, memory_format=contiguous), torch.empty_like(
        covariances, memory_format=contiguous
    )


def _save(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx, grad):
    gradients = torch.ops.soma_core.fit_displacements_backward(grad, *ctx.saved_tensors)
    return *gradients, None, None, None


_fit.register_autograd(_backward, setup_context=_save)


def fit_displacements(
    joints: Tensor, covariances: Tensor, bind: Tensor, pivots: Tensor, children: Tensor
) -> Tensor:
    """Rotation of each pivot joint from bind to fitted, (B, p, 3, 3).

    Args:
        joints: (B, J, 3) [m].
        covariances: (B, J, 3, 3).
        bind: (J, 3) bind positions [m].
        pivots: (p,) int64 joint ids.
        children: (p, width) int64 child ids of each pivot, at least two columns, padded with the pivot.
    """
    return _fit(joints.contiguous(), covariances.contiguous(), bind, pivots, children)
