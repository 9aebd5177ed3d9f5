"""Forward kinematics in Warp: the twin of ``animation.kinematics``; one thread walks one body's tree."""

from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from soma_core.geometry.torch_func import operator
from soma_core.kernels._runtime import as_warp, launching, loaded, once, scalar_name

__all__ = ["forward_kinematics"]


@once
def _kernels(scalar: str) -> SimpleNamespace:
    real = getattr(wp, scalar)
    vec3, mat33 = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    module = wp.get_module(f"soma_kinematics_{scalar}")

    @wp.kernel(module=module)
    def walk(
        order: wp.array(dtype=wp.int64), parents: wp.array(dtype=wp.int64), relative: wp.array2d(dtype=mat33),
        offsets: wp.array2d(dtype=vec3), turns: wp.array2d(dtype=mat33), positions: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        b = wp.tid()
        for i in range(order.shape[0]):
            j = wp.int32(order[i])
            p = wp.int32(parents[j])
            if p < 0:
                turns[b, j] = relative[b, j]
                positions[b, j] = offsets[b, j]
            else:
                turns[b, j] = turns[b, p] * relative[b, j]
                positions[b, j] = positions[b, p] + turns[b, p] * offsets[b, j]

    return SimpleNamespace(vec3=vec3, mat33=mat33, walk=walk)


@operator("soma_core::forward_kinematics")
def _walk(relative: Tensor, offsets: Tensor, order: Tensor, parents: Tensor) -> tuple[Tensor, Tensor]:
    kernels = _kernels(scalar_name(relative.dtype))
    turns = torch.empty_like(relative, memory_format=torch.contiguous_format)
    positions = torch.empty_like(offsets, memory_format=torch.contiguous_format)
    if not turns.numel():  # Warp takes no view of an empty tensor
        return turns, positions
    with launching(relative) as device:
        wp.launch(
            loaded(kernels.walk, device),
            dim=len(relative),
            inputs=[as_warp(order), as_warp(parents), as_warp(relative, kernels.mat33),
                    as_warp(offsets, kernels.vec3)],
            outputs=[as_warp(turns, kernels.mat33), as_warp(positions, kernels.vec3)],
            device=device,
        )  # fmt: skip
    return turns, positions


@_walk.register_fake
def _(relative, offsets, order, parents):
    contiguous = torch.contiguous_format
    return torch.empty_like(relative, memory_format=contiguous), torch.empty_like(
        offsets, memory_format=contiguous
    )


@operator("soma_core::forward_kinematics_backward")
def _walk_backward(
    turns_grad: Tensor, positions_grad: Tensor, relative: Tensor, offsets: Tensor, turns: Tensor,
    positions: Tensor, order: Tensor, parents: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    kernels = _kernels(scalar_name(relative.dtype))
    relative_grad, offsets_grad = torch.zeros_like(relative), torch.zeros_like(offsets)
    if not relative.numel():
        return relative_grad, offsets_grad
    matrices, vectors = kernels.mat33, kernels.vec3
    # The walk writes its outputs again and accumulates into their gradients, so it gets copies.
    turns, positions = turns.clone(), positions.clone()
    turns_grad = turns_grad.clone(memory_format=torch.contiguous_format)
    positions_grad = positions_grad.clone(memory_format=torch.contiguous_format)
    with launching(relative) as device:
        wp.launch(
            loaded(kernels.walk, device),
            dim=len(relative),
            inputs=[as_warp(order), as_warp(parents), as_warp(relative, matrices), as_warp(offsets, vectors)],
            outputs=[as_warp(turns, matrices), as_warp(positions, vectors)],
            adj_inputs=[None, None, as_warp(relative_grad, matrices), as_warp(offsets_grad, vectors)],
            adj_outputs=[as_warp(turns_grad, matrices), as_warp(positions_grad, vectors)],
            adjoint=True,
            device=device,
        )  # fmt: skip
    return relative_grad, offsets_grad


@_walk_backward.register_fake
def _(turns_grad, positions_grad, relative, offsets, turns, positions, order, parents):
    return torch.empty_like(relative), torch.empty_like(offsets)


def _save(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs[:2], *output, *inputs[2:])


def _backward(ctx, turns_grad, positions_grad):
    gradients = torch.ops.soma_core.forward_kinematics_backward(
        turns_grad, positions_grad, *ctx.saved_tensors
    )
    return *gradients, None, None


_walk.register_autograd(_backward, setup_context=_save)


def forward_kinematics(
    relative: Tensor, offsets: Tensor, order: Tensor, parents: Tensor
) -> tuple[Tensor, Tensor]:
    """Accumulated turns (B, J, 3, 3) and world positions (B, J, 3) [m] down the joint tree.

    Args:
        relative: (B, J, 3, 3) T-pose-relative rotations, the root's included.
        offsets: (B, J, 3) bone vectors in T-pose world axes [m].
        order: (J,) int64, parents before children.
        parents: (J,) int64, -1 for the root.
    """
    return _walk(relative.contiguous(), offsets.contiguous(), order, parents)
