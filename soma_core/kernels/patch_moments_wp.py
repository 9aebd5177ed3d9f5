"""Moments of targets on a GPU: patches of the mesh, groups of frames.

The same numbers as ``skin_moments_wp.target_moments``. A block of threads lays the targets of a patch in
shared memory and sums them by lists of its influences, as ``patch_residual_wp`` sums forces; a second kernel
adds up the patches.
"""

import numpy as np
import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._native import native
from soma_core.kernels._patch_text import PATCH_VERTICES
from soma_core.kernels._posing_text import THREADS
from soma_core.kernels._runtime import as_warp, launching, loaded, once, scalar_name
from soma_core.kernels.residual_patches import joint_lists

__all__ = ["MomentPatches", "moments_by_patches"]

_FEW = 8
"""Frames up to which each has its own blocks."""
_GROUP = {"float32": 8, "float64": 4}
"""Frames that share one reading of the points."""
_SCRATCH = 2**28
"""Bytes of the patches' sums of all frames that are treated in one launch."""

_ints, _shorts = wp.array(dtype=wp.int32), wp.array(dtype=wp.int16)


class MomentPatches(torch.nn.Module):
    """Tables of one rig's influences, constant buffers.

    Args:
        start: (T + 1,) row starts of the joints' influences.
        vertex: (e,) vertex of each influence.
    """

    starts: Tensor
    list_joint: Tensor
    list_vertex: Tensor
    entry: Tensor
    near: Tensor
    items: Tensor
    cells: Tensor

    def __init__(self, start: np.ndarray, vertex: np.ndarray, *, device: torch.device | str) -> None:
        super().__init__()
        joint = np.repeat(np.arange(len(start) - 1), np.diff(start))
        count = int(vertex.max(initial=-1)) + 1
        bounds = np.append(np.arange(0, count, PATCH_VERTICES), count)
        runs = joint_lists(bounds, vertex, joint)
        self.count, self.list_count = len(bounds) - 1, len(runs["joint"])
        order = np.argsort(runs["joint"], kind="stable")
        tables = {
            "starts": (np.concatenate((runs["patch_start"], runs["start"])), torch.int32),
            "list_joint": (runs["joint"], torch.int32),
            "list_vertex": (runs["vertex"], torch.int16),
            "entry": (runs["entry"], torch.int64),
            # The vertex that a joint's sums are about: float32 then loses nothing in long ones.
            "near": (vertex[np.minimum(start[:-1], len(vertex) - 1)], torch.int32),
            "items": (np.searchsorted(runs["joint"][order], np.arange(len(start))), torch.int32),
            "cells": (order, torch.int32),
        }
        for name, (array, kind) in tables.items():
            self.register_buffer(name, torch.as_tensor(array).to(device, kind), persistent=False)


@once
def _kernel(scalar: str, *, single: bool) -> wp.Kernel:
    numbers = wp.array(dtype=getattr(wp, scalar))
    group = 1 if single else _GROUP[scalar]

    def moments(
        index: int, batch: int, patches: int, vertices: int, lists: int, starts: _ints, list_joint: _ints,
        list_vertex: _shorts, near: _ints, points: numbers, targets: numbers, sums: numbers,
    ):  # fmt: skip
        ...

    name = "one" if single else "many"
    moments.__name__ = f"patch_moments_of_{name}"
    sizes = f"constexpr int G = {group}, SLOTS = {PATCH_VERTICES};\n"
    moments = native(THREADS + sizes + _MOMENTS, scalar, 1, moments)
    module = wp.get_module(f"soma_patch_moments_{name}_{scalar}")

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def patch_moments(
        threads: int, batch: int, patches: int, vertices: int, lists: int, starts: _ints, list_joint: _ints,
        list_vertex: _shorts, near: _ints, points: numbers, targets: numbers, sums: numbers,
    ):  # fmt: skip
        moments(
            wp.tid() // threads, batch, patches, vertices, lists, starts, list_joint, list_vertex, near,
            points, targets, sums,
        )  # fmt: skip

    return patch_moments


_MOMENTS = """
    constexpr int PLANE = 3 * SLOTS + 1;  // frames of a vertex in banks side by side
    SOMA_SHARED R placed[PLANE * G];
    const int patch = index % patches, first = index / patches * G, last = batch - 1;
    const int* list_start = starts.data + patches + 1;
    const int begin = 3 * SLOTS * patch, left = 3 * vertices - begin;
    for (int e = lane; e < 3 * SLOTS; e += width) {
        #pragma unroll
        for (int g = 0; g < G; g++) {
            const long long b = first + g < last ? first + g : last;
            placed[g * PLANE + e] = e < left ? targets.data[3 * b * vertices + begin + e] : R(0);
        }
    }
    MEET;
    R* cell = sums.data + (long long)(index / patches) * lists * 12 * G;
    const int count = starts.data[patch + 1] - starts.data[patch];
    for (int e = lane; e < count * G; e += width) {
        const int list = starts.data[patch] + e / G, g = e % G;
        const long long b = first + g < last ? first + g : last;
        const R* centre = targets.data + 3 * (b * vertices + near.data[list_joint.data[list]]);
        const R* place = placed + g * PLANE;
        const R centred[3] = {centre[0], centre[1], centre[2]};
        R f[12] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
        for (int i = list_start[list]; i < list_start[list + 1]; i++) {
            const R* x = place + 3 * list_vertex.data[i];
            const R* point = points.data + 4 * i;
            #pragma unroll
            for (int r = 0; r < 3; r++) {
                const R step = x[r] - centred[r];
                #pragma unroll
                for (int k = 0; k < 4; k++) f[4 * r + k] += point[k] * step;
            }
        }
        #pragma unroll
        for (int k = 0; k < 12; k++) cell[(12 * list + k) * G + g] = f[k];
    }
"""


@once
def _totals(scalar: str) -> wp.Kernel:
    number = getattr(wp, scalar)
    numbers = wp.array(dtype=number)
    module = wp.get_module(f"soma_moment_totals_{scalar}")

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def totals(
        batch: int, group: int, lists: int, joints: int, vertices: int, items: _ints, cell: _ints,
        near: _ints, mean: numbers, targets: numbers, sums: numbers, out: numbers, origin: numbers,
    ):  # fmt: skip
        """One number of one frame, of the moments or behind them of the origin; frames innermost."""
        g = wp.tid() % group
        size = 12 * joints
        o = (wp.tid() // group) % (size + 3)
        tile = wp.tid() // group // (size + 3)
        f = tile * group + g
        if f >= batch:
            return
        row = wp.int64(f) * wp.int64(vertices)
        if o >= size:
            origin[3 * f + o - size] = targets[wp.int64(3) * (row + wp.int64(near[0])) + wp.int64(o - size)]
            return
        item = o // 12
        part = o % 12
        axis = wp.int64(part // 4)
        total = number(0.0)
        for e in range(items[item], items[item + 1]):
            total += sums[((tile * lists + cell[e]) * 12 + part) * group + g]
        step = targets[wp.int64(3) * (row + wp.int64(near[item])) + axis]
        step = step - targets[wp.int64(3) * (row + wp.int64(near[0])) + axis]
        out[f * size + o] = total + mean[4 * item + part % 4] * step

    return totals


def moments_by_patches(
    tables: MomentPatches, weight: Tensor, local: Tensor, mean: Tensor, vertices: Tensor
) -> tuple[Tensor, Tensor]:
    """``R`` (F, T, 3, 4) about an origin of each frame (F, 3) [m], of one identity.

    Args:
        tables: of the rig.
        weight, local, mean, vertices: as ``skin_moments_wp.target_moments`` takes them.
    """
    vertices = vertices.contiguous()
    count, joints = len(vertices), len(mean)
    out, origin = vertices.new_empty(count, joints, 3, 4), vertices.new_empty(count, 3)
    point = torch.cat((local * weight[:, None], weight[:, None]), 1)[tables.entry]
    group = 1 if count <= _FEW else _GROUP[scalar_name(vertices.dtype)]
    parts = -(-count * 12 * tables.list_count * vertices.element_size() // _SCRATCH)
    step = group * -(-count // (group * max(parts, 1)))
    for first in range(0, count, max(step, 1)):
        chunk = slice(first, first + step)
        _launch(tables, point, mean, vertices[chunk], out[chunk], origin[chunk], group)
    return out, origin


def _launch(
    tables: MomentPatches, point: Tensor, mean: Tensor, vertices: Tensor, out: Tensor, origin: Tensor,
    group: int,
) -> None:  # fmt: skip
    """Both kernels on frames whose sums fit into memory together."""
    batch, size = vertices.shape[:2]
    scalar, groups, lists = scalar_name(vertices.dtype), -(-batch // group), tables.list_count
    sums = vertices.new_empty(groups * 12 * lists * group)
    with launching(vertices) as device:
        threads = PATCH_VERTICES if device.is_cuda else 1
        arrays = (
            tables.starts, tables.list_joint, tables.list_vertex, tables.near, point, vertices, sums,
        )  # fmt: skip
        inputs = [
            threads, batch, tables.count, size, lists, *(as_warp(one.view(-1)) for one in arrays)
        ]  # fmt: skip
        kernel = _kernel(scalar, single=group == 1)
        dim = groups * tables.count * threads
        wp.launch(loaded(kernel, device), dim=dim, inputs=inputs, device=device, block_dim=threads)
        arrays = tables.items, tables.cells, tables.near, mean, vertices, sums, out, origin
        joints = len(mean)
        inputs = [batch, group, lists, joints, size, *(as_warp(one.view(-1)) for one in arrays)]
        wp.launch(
            loaded(_totals(scalar), device),
            dim=groups * (12 * joints + 3) * group,
            inputs=inputs,
            device=device,
        )
