"""The small steps of an identity in Warp, without derivatives: fitted skeleton, way to the bind pose.

On CUDA, dozens of products of 3x3 matrices would each be a launch of their own.
"""

from types import SimpleNamespace

import warp as wp
from torch import Tensor

from soma_core.geometry.torch_func import operator
from soma_core.kernels._runtime import as_warp, launching, loaded, once, scalar_name

__all__ = ["fitted_world", "identity_kernels", "to_bind_pose"]

_ids = wp.array(dtype=wp.int64)


def _functions(scalar: str, module: wp.Module) -> tuple[wp.Function, wp.Function, wp.Function]:
    """A transform of a rotation and a place, and both of a transform."""
    real = getattr(wp, scalar)
    vec3, mat33 = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    mat44 = wp.types.matrix((4, 4), real)

    @wp.func(module=module)
    def joined(rotation: mat33, place: vec3):
        zero, one = real(0.0), real(1.0)
        return mat44(
            rotation[0, 0], rotation[0, 1], rotation[0, 2], place[0],
            rotation[1, 0], rotation[1, 1], rotation[1, 2], place[1],
            rotation[2, 0], rotation[2, 1], rotation[2, 2], place[2],
            zero, zero, zero, one,
        )  # fmt: skip

    @wp.func(module=module)
    def turn_of(world: mat44):
        return mat33(
            world[0, 0], world[0, 1], world[0, 2], world[1, 0], world[1, 1], world[1, 2],
            world[2, 0], world[2, 1], world[2, 2],
        )  # fmt: skip

    @wp.func(module=module)
    def place_of(world: mat44):
        return vec3(world[0, 3], world[1, 3], world[2, 3])

    return joined, turn_of, place_of


@once
def identity_kernels(scalar: str) -> SimpleNamespace:
    """Kernels of both functions, and their types."""
    real = getattr(wp, scalar)
    vec3, mat33 = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    mat44, mat34 = wp.types.matrix((4, 4), real), wp.types.matrix((3, 4), real)
    module = wp.get_module(f"soma_identity_{scalar}")
    joined, turn_of, place_of = _functions(scalar, module)

    @wp.kernel(module=module, enable_backward=False)
    def assemble(
        displacement: wp.array2d(dtype=mat33), source: _ids, bind_rotation: wp.array(dtype=mat33),
        joints: wp.array2d(dtype=vec3), out: wp.array2d(dtype=mat44),
    ):  # fmt: skip
        b, j = wp.tid()
        taken = wp.int32(source[j])
        turn = bind_rotation[j]
        if taken > 0:  # 0 is the identity
            turn = displacement[b, taken - 1] * turn
        turn = real(1.5) * turn - real(0.5) * (turn * (wp.transpose(turn) * turn))
        out[b, j] = joined(turn, joints[b, j])

    @wp.kernel(module=module, enable_backward=False)
    def rebind(
        fitted: wp.array2d(dtype=mat44), parents: _ids, bind_rotation: wp.array(dtype=mat33),
        parent_orient: wp.array(dtype=mat33), bind_parent_turn: wp.array(dtype=mat33),
        world: wp.array2d(dtype=mat44), skin: wp.array2d(dtype=mat34),
    ):  # fmt: skip
        b, j = wp.tid()
        place = vec3()
        k = int(j)  # noqa: RUF100, UP018 - a dynamic variable to Warp
        while k > 1:
            p = wp.int32(parents[k])
            above, own = fitted[b, p], fitted[b, k]
            bone = wp.transpose(turn_of(above)) * (place_of(own) - place_of(above))
            place += bind_parent_turn[k] * (parent_orient[k] * bone)
            k = p
        if k == 1:
            place += place_of(fitted[b, 1])
        turn, rest = bind_rotation[j], fitted[b, j]
        world[b, j] = joined(turn, place)
        spin = turn * wp.transpose(turn_of(rest))
        shift = place - spin * place_of(rest)
        skin[b, j] = mat34(
            spin[0, 0], spin[0, 1], spin[0, 2], shift[0],
            spin[1, 0], spin[1, 1], spin[1, 2], shift[1],
            spin[2, 0], spin[2, 1], spin[2, 2], shift[2],
        )  # fmt: skip

    return SimpleNamespace(vec3=vec3, mat33=mat33, mat44=mat44, mat34=mat34, assemble=assemble, rebind=rebind)


@operator("soma_core::fitted_world")
def _fitted_world(displacement: Tensor, source: Tensor, bind_rotation: Tensor, joints: Tensor) -> Tensor:
    kernels, batch, count = identity_kernels(scalar_name(joints.dtype)), len(joints), len(source)
    out = joints.new_empty(batch, count, 4, 4)
    if not out.numel():
        return out
    displacement, joints = displacement.contiguous(), joints.contiguous()
    with launching(joints) as device:
        given = [
            as_warp(displacement, kernels.mat33), as_warp(source), as_warp(bind_rotation, kernels.mat33),
            as_warp(joints, kernels.vec3), as_warp(out, kernels.mat44),
        ]  # fmt: skip
        wp.launch(loaded(kernels.assemble, device), dim=(batch, count), inputs=given, device=device)
    return out


@_fitted_world.register_fake
def _(displacement, source, bind_rotation, joints):
    return joints.new_empty(joints.shape[0], source.shape[0], 4, 4)


@operator("soma_core::to_bind_pose")
def _to_bind_pose(
    fitted: Tensor, parents: Tensor, bind_rotation: Tensor, parent_orient: Tensor, bind_parent_turn: Tensor
) -> tuple[Tensor, Tensor]:
    kernels, (batch, count) = identity_kernels(scalar_name(fitted.dtype)), fitted.shape[:2]
    world, skin = fitted.new_empty(batch, count, 4, 4), fitted.new_empty(batch, count, 3, 4)
    if not world.numel():
        return world, skin
    fitted = fitted.contiguous()
    with launching(fitted) as device:
        constants = (
            as_warp(part, kernels.mat33) for part in (bind_rotation, parent_orient, bind_parent_turn)
        )
        given = [
            as_warp(fitted, kernels.mat44), as_warp(parents), *constants, as_warp(world, kernels.mat44),
            as_warp(skin, kernels.mat34),
        ]  # fmt: skip
        wp.launch(loaded(kernels.rebind, device), dim=(batch, count), inputs=given, device=device)
    return world, skin


@_to_bind_pose.register_fake
def _(fitted, parents, bind_rotation, parent_orient, bind_parent_turn):
    batch, count = fitted.shape[:2]
    return fitted.new_empty(batch, count, 4, 4), fitted.new_empty(batch, count, 3, 4)


def fitted_world(displacement: Tensor, source: Tensor, bind_rotation: Tensor, joints: Tensor) -> Tensor:
    """World transforms (B, J, 4, 4) [m] of fitted joints; the twin of ``skeleton.rotations``' last steps.

    Args:
        displacement: (B, p, 3, 3) turns of the pivots from the bind pose.
        source: (J,) int64, one more than the pivot whose turn a joint takes; 0 for none.
        bind_rotation: (J, 3, 3).
        joints: (B, J, 3) [m].
    """
    return _fitted_world(displacement, source, bind_rotation.contiguous(), joints)


def to_bind_pose(
    fitted: Tensor, parents: Tensor, bind_rotation: Tensor, parent_orient: Tensor, bind_parent_turn: Tensor
) -> tuple[Tensor, Tensor]:
    """World transforms in the bind pose (B, J, 4, 4), and the skinning transforms (B, J, 3, 4) to it.

    Args:
        fitted: (B, J, 4, 4) [m].
        parents: (J,) int64, -1 for the root.
        bind_rotation, parent_orient, bind_parent_turn: (J, 3, 3), of ``animation.kinematics``.
    """
    constants = (part.contiguous() for part in (bind_rotation, parent_orient, bind_parent_turn))
    return _to_bind_pose(fitted, parents, *constants)
