"""The whole forward model against targets on a GPU, built like the fused pose.

The same numbers as ``model_residual_wp``. A block of threads takes a patch of the mesh and a group of frames:
their activations and transforms lie in shared memory, weights are read once for the group, and each thread
moves and skins a vertex. What its vertices pull at transforms and activations the block then sums by lists,
in fixed order; a second kernel adds up the patches.
"""

import functools

import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._native import native
from soma_core.kernels._patch_residual_text import FLAGS, patch_residual_text
from soma_core.kernels._patch_text import PATCH_VERTICES
from soma_core.kernels._runtime import as_warp, launching, loaded, once, scalar_name
from soma_core.kernels.residual_patches import ResidualPatches

__all__ = ["residual_by_patches"]

_FEW = 8
"""Frames up to which each has its own blocks: what counts then is to keep the device busy."""
_GROUP = {"float32": 8, "float64": 4}
"""Frames that share one reading of the weights; as many bytes in shared memory in both precisions."""
_WORDS = {"float32": 4, "float64": 2}
"""Numbers that a thread loads from shared memory at once, 16 bytes."""
_BLOCKS = 5
"""Blocks that a multiprocessor holds: as many as fit its shared memory; registers are rationed for it."""
_SCRATCH = 2**28
"""Bytes of the patches' sums of all frames that are treated in one launch."""

_ints, _shorts = wp.array(dtype=wp.int32), wp.array(dtype=wp.int16)


@once
def _kernel(scalar: str, *, single: bool) -> wp.Kernel:
    numbers = wp.array(dtype=getattr(wp, scalar))
    group = 1 if single else _GROUP[scalar]

    def residual(
        index: int, batch: int, patches: int, vertices: int, transforms: int, activations: int, cells: int,
        flags: int, points: numbers, weights: numbers, skin: numbers, active: numbers, scale: numbers,
        targets: numbers, origin: numbers, bound: numbers, ints: _ints, shorts: _shorts, reals: numbers,
        list_starts: _ints, list_vertices: _shorts, list_values: numbers, sums: numbers, distances: numbers,
    ):  # fmt: skip
        ...

    name = "one" if single else "many"
    residual.__name__ = f"patch_residual_of_{name}"
    residual = native(patch_residual_text(group, min(group, _WORDS[scalar])), scalar, 1, residual)
    module = wp.get_module(f"soma_patch_residual_{name}_{scalar}")

    bounds = PATCH_VERTICES, _BLOCKS

    @wp.kernel(module=module, enable_backward=False, grid_stride=False, launch_bounds=bounds)
    def patch_residual(
        threads: int, batch: int, patches: int, vertices: int, transforms: int, activations: int, cells: int,
        flags: int, points: numbers, weights: numbers, skin: numbers, active: numbers, scale: numbers,
        targets: numbers, origin: numbers, bound: numbers, ints: _ints, shorts: _shorts, reals: numbers,
        list_starts: _ints, list_vertices: _shorts, list_values: numbers, sums: numbers, distances: numbers,
    ):  # fmt: skip
        residual(
            wp.tid() // threads, batch, patches, vertices, transforms, activations, cells, flags, points,
            weights, skin, active, scale, targets, origin, bound, ints, shorts, reals, list_starts,
            list_vertices, list_values, sums, distances,
        )  # fmt: skip

    return patch_residual


@once
def _totals(scalar: str) -> wp.Kernel:
    number = getattr(wp, scalar)
    numbers = wp.array(dtype=number)

    @wp.kernel(module=wp.get_module(f"soma_patch_totals_{scalar}"), enable_backward=False, grid_stride=False)
    def totals(
        batch: int, group: int, cells: int, entries: int, joints: int, transforms: int, activations: int,
        items: _ints, cell: _ints, sums: numbers, energy: numbers, forces: numbers, pull: numbers,
    ):  # fmt: skip
        """One number of one frame: the energy first, then the forces, then the pull; frames innermost."""
        g = wp.tid() % group
        o = (wp.tid() // group) % entries
        tile = wp.tid() // group // entries
        f = tile * group + g
        if f >= batch:
            return
        size = 12 * transforms
        item = 0
        part = 0
        if o > size:
            item = joints + o - size
        elif o > 0:
            item = 1 + (o - 1) // 12
            part = (o - 1) % 12
        total = number(0.0)
        if o > size or item <= joints:
            begin = tile * cells + part
            for e in range(items[item], items[item + 1]):
                total += sums[(begin + cell[e]) * group + g]
        if o == 0:
            energy[f] = total
        elif o > size:
            pull[f * activations + o - size - 1] = total
        else:
            forces[f * size + o - 1] = total

    return totals


def residual_by_patches(
    tables: ResidualPatches, rest: Tensor, weights: Tensor, transforms: Tensor, active: Tensor, scale: Tensor,
    targets: Tensor, origin: Tensor, bound: Tensor | None, *, gradient: bool, distances: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Energy (F,), forces (F, T, 3, 4), pull (F, C) and distances (F, v); empty where not asked for.

    Args:
        tables: of the mesh, which fit.
        rest, weights, transforms, active, scale, targets, origin, bound, gradient, distances: as
            ``model_residual.ModelResidual`` takes them; `active` is (F, 0) without correctives.
    """
    count, vertices = targets.shape[:2]
    new = functools.partial(torch.empty, dtype=targets.dtype, device=targets.device)
    moved = count if gradient else 0
    out = (
        new(count), new(moved, transforms.shape[1], 3, 4), new(moved, active.shape[1]),
        new(count if distances else 0, vertices),
    )  # fmt: skip
    flags = _flags(rest, weights, clipped=bound is not None, pulls=gradient, measured=distances)
    limit = new(0) if bound is None else bound
    given = [one.contiguous() for one in (rest, weights, transforms, active, scale, targets, origin, limit)]
    cells = tables.cell_count if gradient else tables.patches.count
    group = 1 if count <= _FEW else _GROUP[scalar_name(targets.dtype)]
    parts = -(-count * cells * targets.element_size() // _SCRATCH)  # alike, so that none is left small
    step = group * -(-count // (group * max(parts, 1)))
    for first in range(0, count, max(step, 1)):
        chunk = slice(first, first + step)
        _launch(
            tables, [_frames(one, chunk, count) for one in given], [one[chunk] for one in out], flags, cells,
            group,
        )  # fmt: skip
    return out


def _flags(rest: Tensor, weights: Tensor, **asked: bool) -> int:
    asked = {"own_rest": len(rest) > 1, "own_weights": len(weights) > 1, **asked}
    return sum(FLAGS[name.upper()] for name, on in asked.items() if on)


def _frames(tensor: Tensor, chunk: slice, count: int) -> Tensor:
    """Some frames of what has some, or what all share."""
    return tensor[chunk] if len(tensor) == count else tensor


def _launch(
    tables: ResidualPatches, given: list[Tensor], out: list[Tensor], flags: int, cells: int, group: int
) -> None:
    """Both kernels on frames whose sums fit into memory together."""
    _, _, transforms, active, _, targets, _, _ = given
    batch, vertices = targets.shape[:2]
    scalar, groups = scalar_name(targets.dtype), -(-batch // group)
    sums = targets.new_empty(groups * cells * group)
    energy, forces, pull, distances = out
    patches = tables.patches
    names = transforms.shape[1], active.shape[1]
    entries = 1 if not len(forces) else 1 + 12 * names[0] + names[1]
    lists = (
        patches.ints, patches.shorts, patches.reals, tables.starts, tables.vertices, tables.values, sums,
        distances,
    )  # fmt: skip
    with launching(targets) as device:
        # A thread keeps one slot of a patch; on the CPU a block is one thread, as the native bodies expect.
        threads = PATCH_VERTICES if device.is_cuda else 1
        inputs = [
            threads, batch, patches.count, vertices, *names, cells, flags,
            *(as_warp(one.view(-1)) for one in (*given, *lists)),
        ]  # fmt: skip
        kernel = _kernel(scalar, single=group == 1)
        dim = groups * patches.count * threads
        wp.launch(loaded(kernel, device), dim=dim, inputs=inputs, device=device, block_dim=threads)
        sizes = batch, group, cells, entries, tables.joint_count, *names
        arrays = tables.items, tables.cells, sums, energy, forces, pull
        inputs = [*sizes, *(as_warp(one.view(-1)) for one in arrays)]
        wp.launch(loaded(_totals(scalar), device), dim=groups * entries * group, inputs=inputs, device=device)
