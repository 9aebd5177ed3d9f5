"""Frames in SIMD lanes: element types and small functions of kernels that treat one group of frames a thread.

Warp runs a CPU kernel one thread after the other, and its compiler does not vectorise over threads. So a
thread takes a group of frames, and every number is a vector with one entry a frame: the compiler turns each
operation into one SIMD instruction. On a GPU a group is one frame, and the memory of the groups of a warp
lies abreast: their numbers at one place of it are neighbours, which one transaction reads.
"""

from collections.abc import Sequence
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._runtime import launching, loaded, once

__all__ = ["ABREAST", "as_lanes", "as_rows", "frame_rows", "from_lanes", "lane_count",
           "lane_types", "launch", "row_of", "to_lanes", "worker_count", "working_rows"]  # fmt: skip

_CPU_BYTES = 64
"""Width of the widest SIMD register of current CPUs; narrower ones take two or four instructions."""


ABREAST = 32
"""Groups whose memory lies abreast on a GPU: a warp."""


def lane_count(tensor: Tensor) -> int:
    """Frames that one thread treats: as many as fit a SIMD register, one on a GPU."""
    return 1 if tensor.is_cuda else _CPU_BYTES // tensor.element_size()


@once
def lane_types(scalar: str, lanes: int) -> SimpleNamespace:
    """Element type ``vec`` of `lanes` numbers of type `scalar`, and lane-wise functions."""
    real = getattr(wp, scalar)
    vec = wp.types.vector(lanes, real)
    return SimpleNamespace(
        real=real, vec=vec, lanes=lanes, **_functions(real, vec, lanes), **_selections(real, vec, lanes)
    )


def _functions(real, vec, width: int) -> dict:
    """Functions of one lane after the other."""

    @wp.func
    def root(x: vec):
        for c in range(width):
            x[c] = wp.sqrt(x[c])
        return x

    @wp.func
    def inverse_root(x: vec, floor: real):
        for c in range(width):
            x[c] = real(1.0) / wp.sqrt(wp.max(x[c], floor))
        return x

    @wp.func
    def below(x: vec, bound: real):
        """One where x < bound, else zero; NaN gives zero."""
        for c in range(width):
            x[c] = wp.where(x[c] < bound, real(1.0), real(0.0))
        return x

    @wp.func
    def larger(x: vec, y: vec):
        for c in range(width):
            x[c] = wp.max(x[c], y[c])
        return x

    @wp.func
    def smaller(x: vec, y: vec):
        for c in range(width):
            x[c] = wp.min(x[c], y[c])
        return x

    return {"root": root, "inverse_root": inverse_root, "below": below, "larger": larger, "smaller": smaller}


def _selections(real, vec, width: int) -> dict:
    """Functions that tell lanes apart."""

    @wp.func
    def magnitude(x: vec):
        for c in range(width):
            x[c] = wp.abs(x[c])
        return x

    @wp.func
    def choose(mask: vec, x: vec, y: vec):
        """Take x where the mask is one, y where it is zero; what is not taken may be NaN."""
        for c in range(width):
            x[c] = wp.where(mask[c] > real(0.5), x[c], y[c])
        return x

    @wp.func
    def total(x: vec):
        """Sum over the lanes."""
        result = real(0.0)
        for c in range(width):
            result += x[c]
        return result

    return {"magnitude": magnitude, "choose": choose, "total": total}


def to_lanes(frames: Tensor, lanes: int) -> Tensor:
    """(F, ...) -> contiguous (groups, k, lanes), frames innermost; the last frame fills the last group."""
    flat = frames.flatten(1)
    missing = -len(flat) % lanes
    if missing:
        flat = torch.cat((flat, flat[-1:].expand(missing, -1)))
    return flat.view(-1, lanes, flat.shape[1]).transpose(1, 2).contiguous()


def from_lanes(groups: Tensor, count: int, shape: tuple[int, ...]) -> Tensor:
    """Inverse of :func:`to_lanes`: (groups, k, lanes) -> contiguous (count, *shape)."""
    return groups.transpose(1, 2).reshape(-1, groups.shape[1])[:count].reshape(count, *shape).contiguous()


def as_lanes(groups: Tensor, types: SimpleNamespace) -> wp.array:
    """Descriptor of (groups, k, lanes) memory as a two-dimensional array of lane vectors."""
    rows, lanes = groups.shape[1:]
    assert lanes == 1 or groups.is_contiguous(), groups.stride()
    if lanes > 1 or groups.is_contiguous():  # of one lane the stride may be any
        groups = groups.as_strided(groups.shape, (rows * lanes, lanes, 1))
    return wp.from_torch(groups, dtype=types.vec, requires_grad=False, return_ctype=True)


def working_rows(like: Tensor, groups: int, size: int, lanes: int) -> Tensor:
    """Memory of `size` vectors for every group, (tiles, groups abreast, numbers); see :func:`row_of`."""
    if lanes > 1:
        return like.new_empty(groups, 1, size * lanes)
    return like.new_empty(-(-groups // ABREAST), size, ABREAST).transpose(1, 2)


def frame_rows(frames: Tensor, lanes: int) -> Tensor:
    """Numbers of frames (F, k) in the layout of :func:`working_rows`; of one frame, for all groups."""
    if lanes > 1:
        return to_lanes(frames, lanes).flatten(1)[:, None]
    return to_lanes(frames, ABREAST).transpose(1, 2)


def worker_count(groups: int, lanes: int) -> int:
    """Threads of a kernel's launch: one on a CPU, where others run beside it, one a group on a GPU."""
    return 1 if lanes > 1 else groups


def as_rows(rows: Tensor) -> wp.array:
    """Descriptor of :func:`working_rows`, or of (1, 1, k) for all groups."""
    return wp.from_torch(rows, requires_grad=False, return_ctype=True)


@once
def row_of(scalar: str) -> wp.Function:
    """Function of kernels: a group's part of :func:`working_rows`."""
    number = getattr(wp, scalar)

    @wp.func
    def row(rows: wp.array3d(dtype=number), g: int):
        return rows[wp.min(g // rows.shape[1], rows.shape[0] - 1), g % rows.shape[1]]

    return row


def launch(kernel: wp.Kernel, workers: int, inputs: Sequence, like: Tensor) -> None:
    """Start a kernel where `like` is; on a GPU in blocks of one warp, which spread best."""
    with launching(like) as device:
        block = ABREAST if like.is_cuda else 1
        wp.launch(loaded(kernel, device), dim=workers, inputs=inputs, device=device, block_dim=block)
