"""Stage 2 of the skeleton fit in Warp: the twin of ``skeleton.rotations`` (paper, section 3.4.2).

Derivatives are written out instead of generated: Warp differentiates a dynamic loop over sums wrongly, and
with the loops over children unrolled, the generated adjoint of 25 pairs takes half a minute to compile for
CUDA.
"""

from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from soma_core.geometry.kabsch import PRIOR_STRENGTH
from soma_core.geometry.torch_func import operator
from soma_core.kernels._runtime import as_warp, launching, loaded, once, scalar_name
from soma_core.kernels.rotation_functions_wp import bone_functions, kabsch_function

__all__ = ["displacing", "fit_displacements"]

_ids, _table = wp.array(dtype=wp.int64), wp.array2d(dtype=wp.int64)


@once
def displacing(scalar: str) -> wp.Kernel:
    """Kernel of :func:`fit_displacements`."""
    module = wp.get_module(f"soma_skeleton_fit_{scalar}")
    types = _types(scalar)
    vec3, mat33 = types.vec3, types.mat33
    from_covariance, arc, fan_covariance = _forward(types, module)
    positions, matrices = wp.array2d(dtype=vec3), wp.array2d(dtype=mat33)

    @wp.kernel(module=module, enable_backward=False)
    def displace(
        pivots: _ids, children: _table, bind: wp.array(dtype=vec3), joints: positions, covariances: matrices,
        out: matrices,
    ):  # fmt: skip
        b, p = wp.tid()
        k = wp.int32(pivots[p])
        first = from_covariance(covariances[b, k])
        c = wp.int32(children[p, 0])
        if children[p, 1] == pivots[p]:
            out[b, p] = arc(first * (bind[c] - bind[k]), joints[b, c] - joints[b, k]) * first
        else:
            total = fan_covariance(b, p, k, children, bind, joints, first)
            out[b, p] = from_covariance(total) * first

    return displace


def _forward(types: SimpleNamespace, module: wp.Module) -> tuple[wp.Function, wp.Function, wp.Function]:
    arc, pair_normal = bone_functions(types.scalar, module)
    return kabsch_function(types.scalar, module), arc, _fan_covariance(types, module, pair_normal)


@once
def _types(scalar: str) -> SimpleNamespace:
    real = getattr(wp, scalar)
    return SimpleNamespace(
        scalar=scalar, real=real, vec3=wp.types.vector(3, real), mat33=wp.types.matrix((3, 3), real)
    )


def _fan_covariance(types: SimpleNamespace, module: wp.Module, pair_normal: wp.Function) -> wp.Function:
    real, vec3, mat33 = types.real, types.vec3, types.mat33

    @wp.func(module=module)
    def fan_covariance(
        b: int, p: int, k: int, children: _table, bind: wp.array(dtype=vec3), joints: wp.array2d(dtype=vec3),
        first: mat33,
    ):  # fmt: skip
        """Covariance of the bones of pivot k, turned by `first`, and of the normals of all their pairs."""
        total = mat33()
        for e in range(children.shape[1]):
            c = wp.int32(children[p, e])
            bone, reach = first * (bind[c] - bind[k]), joints[b, c] - joints[b, k]
            total += wp.outer(reach, bone)
            for f in range(children.shape[1]):  # every pair comes twice; the padding adds zero
                d = wp.int32(children[p, f])
                if (
                    d != c
                ):  # fused products leave rounding in a vector's product with itself, and it is scaled
                    other, far = first * (bind[d] - bind[k]), joints[b, d] - joints[b, k]
                    total += real(0.5) * pair_normal(bone, other, reach, far)
        return total

    return fan_covariance


@once
def _pull_back(scalar: str) -> wp.Kernel:
    """Kernel of the derivative of ``displace``: gradients of joints are added, those of covariances set.

    It has a module of its own, which only those compile who ask for a gradient.
    """
    module = wp.get_module(f"soma_skeleton_fit_gradient_{scalar}")
    types = _types(scalar)
    vec3, mat33 = types.vec3, types.mat33
    from_covariance, arc, fan_covariance = _forward(types, module)
    kabsch_gradient, arc_gradient = _kabsch_gradient(types, module), _arc_gradient(types, module)
    fan_gradient = _fan_gradient(types, module)
    positions, matrices = wp.array2d(dtype=vec3), wp.array2d(dtype=mat33)

    @wp.kernel(module=module, enable_backward=False)
    def pull_back(
        pivots: _ids, children: _table, bind: wp.array(dtype=vec3), joints: positions, covariances: matrices,
        grad: matrices, joints_grad: positions, covariances_grad: matrices,
    ):  # fmt: skip
        b, p = wp.tid()
        k = wp.int32(pivots[p])
        first = from_covariance(covariances[b, k])
        pull = grad[b, p] * wp.transpose(first)
        at_pivot = vec3()
        if children[p, 1] == pivots[p]:
            c = wp.int32(children[p, 0])
            rest, reach = bind[c] - bind[k], joints[b, c] - joints[b, k]
            bone_pull, reach_pull = arc_gradient(first * rest, reach, pull)
            first_pull = wp.transpose(arc(first * rest, reach)) * grad[b, p] + wp.outer(bone_pull, rest)
            wp.atomic_add(joints_grad, b, c, reach_pull)
            at_pivot = -reach_pull
        else:
            total = fan_covariance(b, p, k, children, bind, joints, first)
            spread = from_covariance(total)
            first_pull = wp.transpose(spread) * grad[b, p]
            pull = kabsch_gradient(total, spread, pull)
            for e in range(children.shape[1]):
                c = wp.int32(children[p, e])
                rest, reach = bind[c] - bind[k], joints[b, c] - joints[b, k]
                bone = first * rest
                bone_pull, reach_pull = fan_gradient(b, p, k, c, children, bind, joints, first, pull)
                bone_pull += wp.transpose(pull) * reach
                reach_pull += pull * bone
                first_pull += wp.outer(bone_pull, rest)
                wp.atomic_add(joints_grad, b, c, reach_pull)  # zero for the padding
                at_pivot -= reach_pull
        # A joint is one pivot and one child: of two addends no order shows.
        wp.atomic_add(joints_grad, b, k, at_pivot)
        covariances_grad[b, k] = kabsch_gradient(covariances[b, k], first, first_pull)

    return pull_back


def _kabsch_gradient(types: SimpleNamespace, module: wp.Module) -> wp.Function:
    """Derivative of ``kabsch_function`` in closed form, as ``geometry.kabsch`` derives it."""
    real, vec3, mat33 = types.real, types.vec3, types.mat33
    single = types.scalar == "float32"
    prior = wp.constant(real(PRIOR_STRENGTH))
    floor = wp.constant(real(1e-24 if single else 1e-162))
    tiny = wp.constant(real(1e-30 if single else 1e-100))

    @wp.func(module=module)
    def kabsch_gradient(covariance: mat33, rotation: mat33, pull: mat33):
        """Pull on the covariance by a pull on the rotation that was found for it."""
        eye = wp.identity(n=3, dtype=real)
        size = wp.sqrt(wp.ddot(covariance, covariance) + floor)
        stretch = wp.transpose(rotation) * (covariance + (prior * size) * eye)
        stretch = real(0.5) * (stretch + wp.transpose(stretch))
        system = wp.trace(stretch) * eye - stretch
        local = wp.transpose(rotation) * pull
        torque = vec3(local[2, 1] - local[1, 2], local[0, 2] - local[2, 0], local[1, 0] - local[0, 1])
        x, y, z = system[0], system[1], system[2]
        det = wp.determinant(system)
        if wp.abs(det) < tiny:
            det = tiny
        turn = wp.matrix_from_rows(wp.cross(y, z), wp.cross(z, x), wp.cross(x, y)) * torque / det
        shifted = rotation * wp.skew(turn)
        return shifted + (prior * wp.trace(shifted) / size) * covariance

    return kabsch_gradient


def _arc_gradient(types: SimpleNamespace, module: wp.Module) -> wp.Function:
    real, vec3, mat33 = types.real, types.vec3, types.mat33
    opposite = wp.constant(real(1e-7 if types.scalar == "float32" else 1e-12))

    @wp.func(module=module)
    def of_length(vector: vec3, unit: vec3, pull: vec3):
        """Pull on a vector by a pull on its direction; a vanished one has none."""
        size = wp.length(vector)
        result = vec3()
        if size > real(0.0):
            result = (pull - wp.dot(unit, pull) * unit) / size
        return result

    @wp.func(module=module)
    def arc_gradient(source: vec3, target: vec3, pull: mat33):
        """Pulls on the two arguments of ``arc`` by a pull on the rotation."""
        a, b = wp.normalize(source), wp.normalize(target)
        total = a + b
        axis = vec3()
        if wp.dot(total, total) < opposite:  # the axis that ``arc`` takes: the least of a's components
            axis = vec3(real(0.0), real(0.0), real(1.0))
            if wp.abs(a[0]) <= wp.abs(a[1]) and wp.abs(a[0]) <= wp.abs(a[2]):
                axis = vec3(real(1.0), real(0.0), real(0.0))
            elif wp.abs(a[1]) <= wp.abs(a[2]):
                axis = vec3(real(0.0), real(1.0), real(0.0))
            total = wp.cross(a, axis)
        middle = wp.normalize(total)
        eye = wp.identity(n=3, dtype=real)
        left = pull * (real(2.0) * wp.outer(a, a) - eye)
        right = (real(2.0) * wp.outer(middle, middle) - eye) * pull
        total_pull = of_length(total, middle, real(2.0) * ((left + wp.transpose(left)) * middle))
        a_pull = real(2.0) * ((right + wp.transpose(right)) * a)
        b_pull = vec3()
        if wp.dot(axis, axis) > real(0.0):
            a_pull += wp.cross(axis, total_pull)
        else:
            a_pull += total_pull
            b_pull = total_pull
        return of_length(source, a, a_pull), of_length(target, b, b_pull)

    return arc_gradient


def _pair_gradient(types: SimpleNamespace, module: wp.Module) -> wp.Function:
    real, vec3, mat33 = types.real, types.vec3, types.mat33
    floor = wp.constant(real(1e-18 if types.scalar == "float32" else 1e-150))

    @wp.func(module=module)
    def pair_gradient(first: vec3, second: vec3, first_goal: vec3, second_goal: vec3, pull: mat33):
        """Pulls on `first` and `first_goal` by a pull on ``pair_normal``, which knows no order."""
        source, goal = wp.cross(first, second), wp.cross(first_goal, second_goal)
        source_size, goal_size = wp.dot(source, source) + floor, wp.dot(goal, goal) + floor
        scale = real(1.0) / wp.sqrt(wp.sqrt(source_size * goal_size))
        on_source, on_goal = scale * (wp.transpose(pull) * goal), scale * (pull * source)
        by_area = real(0.5) * wp.dot(goal, on_goal)
        on_source -= (by_area / source_size) * source
        on_goal -= (by_area / goal_size) * goal
        return wp.cross(second, on_source), wp.cross(second_goal, on_goal)

    return pair_gradient


def _fan_gradient(types: SimpleNamespace, module: wp.Module) -> wp.Function:
    vec3, mat33 = types.vec3, types.mat33
    pair_gradient = _pair_gradient(types, module)

    @wp.func(module=module)
    def fan_gradient(
        b: int, p: int, k: int, c: int, children: _table, bind: wp.array(dtype=vec3),
        joints: wp.array2d(dtype=vec3), first: mat33, pull: mat33,
    ):  # fmt: skip
        """Pulls on child c's turned bone and on its reach by a pull on the normals of its pairs."""
        bone, reach = first * (bind[c] - bind[k]), joints[b, c] - joints[b, k]
        bone_pull, reach_pull = vec3(), vec3()
        for f in range(children.shape[1]):
            d = wp.int32(children[p, f])
            if d != c:
                other, far = first * (bind[d] - bind[k]), joints[b, d] - joints[b, k]
                of_bone, of_reach = pair_gradient(bone, other, reach, far, pull)
                bone_pull += of_bone
                reach_pull += of_reach
        return bone_pull, reach_pull

    return fan_gradient


@operator("soma_core::fit_displacements")
def _fit(
    joints: Tensor, covariances: Tensor, bind: Tensor, pivots: Tensor, children: Tensor
) -> Tensor:  # fmt: skip
    scalar = scalar_name(joints.dtype)
    types = _types(scalar)
    out = joints.new_empty(len(joints), len(pivots), 3, 3)
    if not out.numel():  # Warp takes no view of an empty tensor
        return out
    with launching(joints) as device:
        wp.launch(
            loaded(displacing(scalar), device),
            dim=tuple(out.shape[:2]),
            inputs=[as_warp(pivots), as_warp(children), as_warp(bind, types.vec3),
                    as_warp(joints, types.vec3), as_warp(covariances, types.mat33)],
            outputs=[as_warp(out, types.mat33)],
            device=device,
        )  # fmt: skip
    return out


@_fit.register_fake
def _(joints, covariances, bind, pivots, children):
    return joints.new_empty(joints.shape[0], pivots.shape[0], 3, 3)


@operator("soma_core::fit_displacements_backward")
def _fit_backward(
    grad: Tensor, joints: Tensor, covariances: Tensor, bind: Tensor, pivots: Tensor, children: Tensor
) -> tuple[Tensor, Tensor]:  # fmt: skip
    scalar = scalar_name(joints.dtype)
    types = _types(scalar)
    contiguous = torch.contiguous_format
    joints_grad = torch.zeros_like(joints, memory_format=contiguous)
    covariances_grad = torch.zeros_like(covariances, memory_format=contiguous)
    grad = grad.contiguous()
    if not grad.numel():
        return joints_grad, covariances_grad
    with launching(joints) as device:
        wp.launch(
            loaded(_pull_back(scalar), device),
            dim=tuple(grad.shape[:2]),
            inputs=[as_warp(pivots), as_warp(children), as_warp(bind, types.vec3),
                    as_warp(joints, types.vec3), as_warp(covariances, types.mat33),
                    as_warp(grad, types.mat33)],
            outputs=[as_warp(joints_grad, types.vec3), as_warp(covariances_grad, types.mat33)],
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
