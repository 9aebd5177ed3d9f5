"""Stage 2 of the skeleton fit in Warp: the twin of ``skeleton.rotations`` (paper, section 3.4.2)."""

import functools
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from soma_core.geometry.kabsch import PRIOR_STRENGTH
from soma_core.kernels._runtime import as_warp, launching, scalar_name

__all__ = ["fit_displacements"]

_NEWTON_STEPS = 9


def _rotation_functions(scalar: str, module: wp.Module) -> SimpleNamespace:
    real = getattr(wp, scalar)
    vec3, mat33 = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    prior = wp.constant(real(PRIOR_STRENGTH))
    floor = wp.constant(real(1e-24 if scalar == "float32" else 1e-162))
    tiny = wp.constant(real(1e-30 if scalar == "float32" else 1e-100))
    newton_steps = wp.constant(_NEWTON_STEPS)
    converged = wp.constant(real(1e-9 if scalar == "float32" else 1e-20))
    opposite = wp.constant(real(1e-7 if scalar == "float32" else 1e-12))

    @wp.func(module=module)
    def cofactor(m: mat33):
        a, b, c = (
            vec3(m[0, 0], m[0, 1], m[0, 2]),
            vec3(m[1, 0], m[1, 1], m[1, 2]),
            vec3(m[2, 0], m[2, 1], m[2, 2]),
        )
        return wp.matrix_from_rows(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))

    @wp.func(module=module)
    def nearest(covariance: mat33):
        gram = wp.transpose(covariance) * covariance
        mean = wp.trace(gram) / real(3.0)
        centred = gram - mean * wp.identity(n=3, dtype=real)
        spread = wp.sqrt(wp.ddot(centred, centred) / real(6.0))
        half = real(0.5) * wp.determinant(centred / wp.max(spread, tiny))
        angle = wp.acos(wp.clamp(half, real(-1.0), real(1.0))) / real(3.0)
        scale = wp.sqrt(wp.max(mean + real(2.0) * spread * wp.cos(angle), real(0.0)))
        unit = covariance / wp.max(scale, tiny)
        x = unit + cofactor(unit)
        step = int(0)  # noqa: UP018, RUF046 - a dynamic variable to Warp, so that the loop can end early
        while step < newton_steps:
            step += 1
            adjugate = cofactor(x)
            det = x[0, 0] * adjugate[0, 0] + x[0, 1] * adjugate[0, 1] + x[0, 2] * adjugate[0, 2]
            if wp.abs(det) < real(1e-30):
                det = real(1e-30)
            stretch = wp.sqrt(wp.sqrt(wp.ddot(adjugate, adjugate) / wp.ddot(x, x)) / wp.abs(det))
            following = real(0.5) * (stretch * x + adjugate / (stretch * det))
            change = following - x
            x = following
            if wp.ddot(change, change) < converged:
                break
        return x

    @wp.func_grad(nearest)
    def adj_nearest(covariance: mat33, adj_ret: mat33):
        rotation = nearest(covariance)
        stretch = wp.transpose(rotation) * covariance
        stretch = real(0.5) * (stretch + wp.transpose(stretch))
        system = wp.trace(stretch) * wp.identity(n=3, dtype=real) - stretch
        local = wp.transpose(rotation) * adj_ret
        torque = vec3(local[2, 1] - local[1, 2], local[0, 2] - local[2, 0], local[1, 0] - local[0, 1])
        det = wp.determinant(system)
        if wp.abs(det) < tiny:
            det = tiny
        u = (cofactor(system) * torque) / det
        wp.adjoint[covariance] += rotation * wp.skew(u)

    @wp.func(module=module)
    def from_covariance(covariance: mat33):
        pull = prior * wp.sqrt(wp.ddot(covariance, covariance) + floor)
        return nearest(covariance + pull * wp.identity(n=3, dtype=real))

    @wp.func(module=module)
    def arc(source: vec3, target: vec3):
        a, b = wp.normalize(source), wp.normalize(target)
        total = a + b
        if wp.dot(total, total) < opposite:
            axis = vec3(real(0.0), real(0.0), real(1.0))
            if wp.abs(a[0]) <= wp.abs(a[1]) and wp.abs(a[0]) <= wp.abs(a[2]):
                axis = vec3(real(1.0), real(0.0), real(0.0))
            elif wp.abs(a[1]) <= wp.abs(a[2]):
                axis = vec3(real(0.0), real(1.0), real(0.0))
            total = wp.cross(a, axis)
        middle = wp.normalize(total)
        eye = wp.identity(n=3, dtype=real)
        return (real(2.0) * wp.outer(middle, middle) - eye) * (real(2.0) * wp.outer(a, a) - eye)

    @wp.func(module=module)
    def pair_normal(first: vec3, second: vec3, first_goal: vec3, second_goal: vec3):
        source, goal = wp.cross(first, second), wp.cross(first_goal, second_goal)
        area = wp.sqrt(wp.sqrt((wp.dot(source, source) + tiny) * (wp.dot(goal, goal) + tiny)))
        return wp.outer(goal, source) / area

    return SimpleNamespace(
        vec3=vec3, mat33=mat33, from_covariance=from_covariance, arc=arc, pair_normal=pair_normal
    )


@functools.cache
def _kernels(scalar: str, width: int) -> SimpleNamespace:
    module = wp.get_module(f"soma_skeleton_fit_{scalar}_{width}")
    functions = _rotation_functions(scalar, module)
    vec3, mat33 = functions.vec3, functions.mat33
    from_covariance, arc, pair_normal = functions.from_covariance, functions.arc, functions.pair_normal

    @wp.kernel(module=module)
    def displace(
        pivots: wp.array(dtype=wp.int64), children: wp.array2d(dtype=wp.int64), bind: wp.array(dtype=vec3),
        joints: wp.array2d(dtype=vec3), covariances: wp.array2d(dtype=mat33), out: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        b, p = wp.tid()
        k = wp.int32(pivots[p])
        first = from_covariance(covariances[b, k])
        if children[p, 1] < wp.int64(0):
            c = wp.int32(children[p, 0])
            out[b, p] = arc(first * (bind[c] - bind[k]), joints[b, c] - joints[b, k]) * first
        else:
            total = mat33()
            for e in range(width):  # unrolled: Warp differentiates a dynamic loop over sums wrongly
                c0 = wp.int32(children[p, e])
                if c0 >= 0:
                    bone, reach = first * (bind[c0] - bind[k]), joints[b, c0] - joints[b, k]
                    total += wp.outer(reach, bone)
                    for f in range(width):
                        c1 = wp.int32(children[p, f])
                        if f > e and c1 >= 0:
                            other, far = first * (bind[c1] - bind[k]), joints[b, c1] - joints[b, k]
                            total += pair_normal(bone, other, reach, far)
            out[b, p] = from_covariance(total) * first

    return SimpleNamespace(vec3=vec3, mat33=mat33, displace=displace)


@torch.library.custom_op("soma_core::fit_displacements", mutates_args=())
def _fit(
    joints: Tensor, covariances: Tensor, bind: Tensor, pivots: Tensor, children: Tensor
) -> Tensor:  # fmt: skip
    kernels = _kernels(scalar_name(joints.dtype), children.shape[1])
    out = joints.new_empty(len(joints), len(pivots), 3, 3)
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
        children: (p, width) int64 child ids of each pivot, at least two columns, padded with -1.
    """
    return _fit(joints.contiguous(), covariances.contiguous(), bind, pivots, children)
