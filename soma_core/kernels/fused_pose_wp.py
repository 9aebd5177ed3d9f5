"""The forward pose without gradients in two launches: bodies, then their skin (paper, section 3.5.1).

The first launch has a block of threads for each body: kinematics, twist joints, skinning transforms and the
activations of the correctives. The second has a block for each patch of skin and group of bodies: weights are
read once for the group, and rest shapes are moved by the correctives on the way to the skin.
"""

import warp as wp
from torch import Tensor

from soma_core.geometry.torch_func import operator
from soma_core.kernels._native import native
from soma_core.kernels._patch_text import patch_text
from soma_core.kernels._posing_text import body_text
from soma_core.kernels._runtime import as_warp, launching, loaded, once, scalar_name
from soma_core.kernels._threads import FEW, in_threads

__all__ = ["pose_bodies", "posing", "skin_patches"]

_BODY_THREADS, _PATCH_THREADS = 256, 128
_FEW = 8
"""Bodies up to which each has its own blocks of skin: what counts then is to keep the device busy."""
_GROUP = {"float32": 8, "float64": 4}
"""Bodies that share one reading of the weights; as many bytes in shared memory in both precisions."""
_WORDS = {"float32": 4, "float64": 2}
"""Numbers that a thread loads from shared memory at once, 16 bytes."""

_ints, _shorts = wp.array(dtype=wp.int32), wp.array(dtype=wp.int16)


@once
def posing(scalar: str) -> wp.Kernel:
    """Kernel of :func:`pose_bodies`."""
    numbers = wp.array(dtype=getattr(wp, scalar))

    def pose_body(
        index: int, rotations: numbers, rotation_stride: int, axis_angle: int, absolute: int,
        skinned: int, translation: numbers, translation_stride: int, bind_world: numbers, bind_stride: int,
        scaled: int, bone_scale: numbers, scale_stride: int, ints: _ints, reals: numbers, world: numbers,
        joints: numbers, skin: numbers, active: numbers,
    ):  # fmt: skip
        ...

    pose_body = native(body_text(), scalar, 1, pose_body)

    @wp.kernel(module=wp.get_module(f"soma_pose_bodies_{scalar}"), enable_backward=False, grid_stride=False)
    def bodies(
        threads: int, first: int, rotations: numbers, rotation_stride: int, axis_angle: int, absolute: int,
        skinned: int, translation: numbers, translation_stride: int, bind_world: numbers, bind_stride: int,
        scaled: int, bone_scale: numbers, scale_stride: int, ints: _ints, reals: numbers, world: numbers,
        joints: numbers, skin: numbers, active: numbers,
    ):  # fmt: skip
        pose_body(
            first + wp.tid() // threads, rotations, rotation_stride, axis_angle, absolute, skinned,
            translation, translation_stride, bind_world, bind_stride, scaled, bone_scale, scale_stride, ints,
            reals, world, joints, skin, active,
        )  # fmt: skip

    return bodies


@once
def _patch_kernel(scalar: str, *, single: bool) -> wp.Kernel:
    numbers = wp.array(dtype=getattr(wp, scalar))
    group = 1 if single else _GROUP[scalar]

    def skin_patch(
        index: int, batch: int, patches: int, vertices: int, points: numbers, body_stride: wp.int64,
        vertex_stride: wp.int64, axis_stride: wp.int64, skin: numbers, transforms: int, moved: int,
        active: numbers, activations: int, ints: _ints, shorts: _shorts, reals: numbers, out: numbers,
    ):  # fmt: skip
        ...

    skin_patch.__name__ = "skin_patch_of_one" if single else "skin_patch_of_many"
    skin_patch = native(patch_text(group, min(group, _WORDS[scalar])), scalar, 1, skin_patch)
    module = wp.get_module(f"soma_skin_patches_{'one' if single else 'many'}_{scalar}")

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def patch(
        threads: int, batch: int, patches: int, vertices: int, points: numbers, body_stride: wp.int64,
        vertex_stride: wp.int64, axis_stride: wp.int64, skin: numbers, transforms: int, moved: int,
        active: numbers, activations: int, ints: _ints, shorts: _shorts, reals: numbers, out: numbers,
    ):  # fmt: skip
        skin_patch(
            wp.tid() // threads, batch, patches, vertices, points, body_stride, vertex_stride, axis_stride,
            skin, transforms, moved, active, activations, ints, shorts, reals, out,
        )  # fmt: skip

    return patch


def _launch(kernel: wp.Kernel, blocks: int, threads: int, given: list, device: wp.Device) -> None:
    """Launch whole blocks; on the CPU each is one thread, as the native bodies expect."""
    threads = threads if device.is_cuda else 1
    wp.launch(
        loaded(kernel, device),
        dim=blocks * threads,
        inputs=[threads, *given],
        device=device,
        block_dim=threads,
    )


def _flat(tensor: Tensor):
    return as_warp(tensor.view(-1))


def _rows(tensor: Tensor) -> tuple[Tensor, int]:
    """Contiguous rows, those of an expanded batch only once, and the numbers from one row to the next."""
    if len(tensor) > 1 and tensor.stride(0) == 0:
        tensor = tensor[:1]
    tensor = tensor.contiguous()
    return tensor, 0 if len(tensor) == 1 else tensor[0].numel()


@operator("soma_core::pose_bodies")
def _pose_bodies(
    rotations: Tensor, translation: Tensor, bind_world: Tensor, bone_scale: Tensor | None, ints: Tensor,
    reals: Tensor, batch: int, helpers: int, activations: int, absolute: bool, skinned: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    found = world, joints, skin, active = _empty(rotations, bind_world, batch, helpers, activations, skinned)
    if not batch:
        return found
    axis_angle = rotations.ndim == 3
    rotations, rotation_stride = _rows(rotations)
    translation, translation_stride = _rows(translation)
    bind_world, bind_stride = _rows(bind_world)
    scaled = bone_scale is not None
    stretch, scale_stride = _rows(bone_scale) if scaled else (reals, 0)
    given = [
        _flat(rotations), rotation_stride, int(axis_angle), int(absolute), int(skinned), _flat(translation),
        translation_stride, _flat(bind_world), bind_stride, int(scaled), _flat(stretch), scale_stride,
        as_warp(ints), as_warp(reals), _flat(world), _flat(joints), _flat(skin), _flat(active),
    ]  # fmt: skip
    kernel = posing(scalar_name(rotations.dtype))

    def run(part: slice) -> None:
        with launching(rotations) as device:
            _launch(kernel, part.stop - part.start, _BODY_THREADS, [part.start, *given], device)

    in_threads(run, batch, rotations, least=FEW)
    return found


def _empty(
    like: Tensor, bind_world: Tensor, batch: int, helpers: int, activations: int, skinned: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Memory for what comes out."""
    joint_count = bind_world.shape[1]
    return (
        like.new_empty(batch, joint_count, 4, 4),
        like.new_empty(batch, joint_count - 1, 3),
        like.new_empty(batch, joint_count + helpers if skinned else 0, 3, 4),
        like.new_empty(batch, max(activations, 1) if skinned else 0),
    )


@_pose_bodies.register_fake
def _(
    rotations, translation, bind_world, bone_scale, ints, reals, batch, helpers, activations, absolute,
    skinned,
):  # fmt: skip
    return _empty(rotations, bind_world, batch, helpers, activations, skinned)


@operator("soma_core::skin_patches")
def _skin_patches(
    points: Tensor, skin: Tensor, active: Tensor | None, ints: Tensor, shorts: Tensor, reals: Tensor,
    patches: int,
) -> Tensor:  # fmt: skip
    batch, vertices, skin = len(skin), points.shape[1], skin.contiguous()
    out = points.new_empty(batch, vertices, 3)
    if not out.numel():
        return out
    scalar = scalar_name(points.dtype)
    single = batch <= _FEW
    group = 1 if single else _GROUP[scalar]
    body_stride, vertex_stride, axis_stride = points.stride()
    body_stride = 0 if len(points) == 1 else body_stride
    moved = active is not None
    active = active if moved else reals[:1]
    # The kernel is told strides, so the points need no copy; Warp is only given where they begin.
    start = points.as_strided((1,), (1,))
    with launching(points) as device:
        given = [
            batch, patches, vertices, as_warp(start), body_stride, vertex_stride, axis_stride, _flat(skin),
            skin.shape[1], int(moved), _flat(active), active.shape[-1], as_warp(ints), as_warp(shorts),
            as_warp(reals), _flat(out),
        ]  # fmt: skip
        blocks = patches * -(-batch // group)
        _launch(_patch_kernel(scalar, single=single), blocks, _PATCH_THREADS, given, device)
    return out


@_skin_patches.register_fake
def _(points, skin, active, ints, shorts, reals, patches):
    return points.new_empty(skin.shape[0], points.shape[1], 3)


def pose_bodies(
    rotations: Tensor, translation: Tensor, bind_world: Tensor, bone_scale: Tensor | None, ints: Tensor,
    reals: Tensor, *, batch: int, helpers: int, activations: int, absolute: bool, skinned: bool = True,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """World transforms (B, J, 4, 4), joints (B, J - 1, 3), skinning transforms (B, J + H, 3, 4), activations.

    The activations (B, A) are times the size of the body. No derivative. Each of the tensors may have a
    batch of 1, or be expanded, without being copied.

    Args:
        rotations: (B, J - 1, 3) axis-angle [rad] or (B, J - 1, 3, 3).
        translation: (B, 3) places of the Hips [m].
        bind_world: (B, J, 4, 4) [m].
        bone_scale: (B, J - 1), or None.
        ints, reals: tables from ``animation.fused``.
        batch, helpers, activations: B, H and A.
        absolute: `rotations` are local ones in the rig's own axes.
        skinned: False leaves out what only skin needs; there are no skinning transforms and activations then.
    """
    return _pose_bodies(
        rotations, translation, bind_world, bone_scale, ints, reals, batch, helpers, activations, absolute,
        skinned,
    )  # fmt: skip


def skin_patches(
    points: Tensor, skin: Tensor, active: Tensor | None, ints: Tensor, shorts: Tensor, reals: Tensor,
    *, patches: int,
) -> Tensor:  # fmt: skip
    """Skinned vertices (B, v, 3), contiguous; no derivative.

    Args:
        points: (B or 1, v, 3) rest shapes [m], with any strides.
        skin: (B, T, 3, 4) skinning transforms.
        active: (B, A) activations of the correctives, or None to leave them out.
        ints, shorts, reals: tables from ``kernels.patches``.
        patches: number of patches of the mesh.
    """
    return _skin_patches(points, skin, active, ints, shorts, reals, patches)
