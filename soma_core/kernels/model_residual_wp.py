"""The whole forward model against targets in Warp: one pass over the vertices, frames in SIMD lanes.

The twin of ``model_residual.reference_residual``. Tile by tile of vertices: rest points with what the
correctives add, skinning, residuals, and what these pull at activations and transforms. Everything of a tile
stays in cache, and no vertex is written but its distance, where asked for.
"""

import functools

import numpy as np
import scipy.sparse
import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._lanes import (
    as_rows,
    lane_count,
    launch,
    row_of,
    worker_count,
    working_rows,
)
from soma_core.kernels._native import transposing
from soma_core.kernels._residual_phases import TILE, phases, tile_slots
from soma_core.kernels._runtime import as_warp, once, scalar_name
from soma_core.kernels._threads import in_threads

__all__ = ["Compared", "gathering", "residual_sums", "residual_tables", "skinning"]

_ids, _short = wp.array(dtype=wp.int32), wp.array(dtype=wp.int16)


_TOGETHER = 4
"""Groups that a thread takes through a tile one after the other, so that its constants are read once."""


@wp.struct
class Compared:
    """Counts and switches of one launch; groups begin .. end of frames."""

    begin: int
    end: int
    together: int
    frames: int
    vertices: int
    joints: int
    activations: int
    own_rest: int
    own_weights: int
    clipped: int
    pulls: int
    measured: int


@once
def _kernel(scalar: str, lanes: int):
    width, size, at_length = lanes, TILE, tile_slots().length
    real, rows = wp.array(dtype=getattr(wp, scalar)), wp.array3d(dtype=getattr(wp, scalar))
    (load, store), row = transposing(scalar, lanes), row_of(scalar)
    step = phases(scalar, lanes)
    enter, gather, leave = _enter(real, load, step), gathering(real, load, step), _leave(real, store)
    clear, moved, draw, push = step.clear, step.moved, step.pulled, step.forces
    skinned = skinning(real, step)
    module = wp.get_module(f"soma_model_residual_{scalar}_{lanes}")

    @wp.kernel(module=module, enable_backward=False)
    def run(
        task: Compared,
        skin_start: _ids, skin_joint: _short, skin_value: real,
        joint_run: _ids, joint_id: _short, joint_start: _ids, joint_row: _short, joint_value: real,
        move_start: _ids, move_id: _short, move_value: real,
        rest: real, weights: real, transforms: real, active: real, scale: real, targets: real, origin: real,
        bound: real, turns: rows, sources: rows, pushes: rows, pulls: rows, tiles: rows,
        energy: real, forces: real, pull: real, distances: real,
    ):  # fmt: skip
        w = wp.tid() * task.together
        for block in range(task.begin + w, task.end, tiles.shape[0] * tiles.shape[1]):
            groups = wp.min(task.together, task.end - block)
            for s in range(w, w + groups):
                f = (block + s - w) * width
                turn, source, tile = row(turns, s), row(sources, s), row(tiles, s)
                enter(task, f, transforms, active, scale, origin, bound, turn, source, tile)
                clear(row(pushes, s), 0, 12 * task.joints * task.pulls)
                clear(row(pulls, s), 0, task.activations * task.pulls)
            for t in range((task.vertices + size - 1) // size):
                a = t * size
                b = wp.min(a + size, task.vertices)
                for s in range(w, w + groups):
                    f = (block + s - w) * width
                    tile = row(tiles, s)
                    gather(task, f, a, b, rest, weights, targets, tile)
                    moved(move_start, move_id, move_value, row(sources, s), a, b, tile)
                    turn = row(turns, s)
                    skinned(task, skin_start, skin_joint, skin_value, turn, weights, a, b, tile)
                    shown = (b - a) * task.measured
                    store(tile, at_length, shown, distances, wp.int64(task.vertices), a, f, task.frames - 1)
                    back = row(pulls, s)
                    draw(move_start, move_id, move_value, a, a + (b - a) * task.pulls, tile, back)
                    end, force = t + task.pulls, row(pushes, s)
                    push(joint_run, joint_id, joint_start, joint_row, joint_value, t, end, tile, force)
            for s in range(w, w + groups):
                tile, force, back = row(tiles, s), row(pushes, s), row(pulls, s)
                leave(task, (block + s - w) * width, tile, force, back, energy, forces, pull)

    return run


def _enter(real, load, step):
    slots, clear = tile_slots(), step.clear
    at_origin, at_scale, at_bound, at_energy = slots.origin, slots.scale, slots.bound, slots.energy

    @wp.func
    def enter(
        task: Compared, f: int, transforms: real, active: real, scale: real, origin: real, bound: real,
        turn: real, source: real, tile: real,
    ):  # fmt: skip
        """Bring what each frame has one of into lanes."""
        last = task.frames - 1
        size = 12 * task.joints
        load(transforms, wp.int64(size), 0, size, f, last, turn, 0)
        load(origin, wp.int64(3), 0, 3, f, last, tile, at_origin)
        clear(tile, at_energy, 1)
        if task.clipped > 0:
            load(bound, wp.int64(1), 0, 1, f, last, tile, at_bound)
        clear(tile, at_scale, 1)
        if task.activations > 0:
            load(active, wp.int64(task.activations), 0, task.activations, f, last, source, 0)
            load(scale, wp.int64(1), 0, 1, f, last, tile, at_scale)

    return enter


def gathering(real, load, step):
    """Function that brings a tile of vertices into lanes."""
    slots, points = tile_slots(), step.points
    at_point, at_target, at_weight = slots.point, slots.target, slots.weight

    @wp.func
    def gather(task: Compared, f: int, a: int, b: int, rest: real, weights: real, targets: real, tile: real):
        """Bring rest points, weights and targets of vertices a .. b into lanes."""
        last = task.frames - 1
        stride = wp.int64(3 * task.vertices)
        load(targets, stride, 3 * a, 3 * (b - a), f, last, tile, at_target)
        if task.own_weights > 0:
            load(weights, wp.int64(task.vertices), a, b - a, f, last, tile, at_weight)
        if task.own_rest > 0:
            load(rest, stride, 3 * a, 3 * (b - a), f, last, tile, at_point)
        else:
            points(rest, a, b, tile)

    return gather


def skinning(real, step):
    """Function that skins a tile of vertices."""
    residual = step.residual

    @wp.func
    def skinned(
        task: Compared, start: _ids, joint: _short, value: real, turn: real, weights: real, a: int, b: int,
        tile: real,
    ):  # fmt: skip
        """Skin vertices a .. b and weigh what they miss."""
        residual(
            start, joint, value, turn, weights, task.own_weights, task.clipped, task.measured, task.pulls, a,
            b, tile,
        )  # fmt: skip

    return skinned


def _leave(real, store):
    at_energy = tile_slots().energy

    @wp.func
    def leave(
        task: Compared, f: int, tile: real, force: real, back: real, energy: real, forces: real, pull: real
    ):
        """Write the sums of a group of frames."""
        last = task.frames - 1
        size = 12 * task.joints
        store(tile, at_energy, 1, energy, wp.int64(1), 0, f, last)
        if task.pulls > 0:
            store(force, 0, size, forces, wp.int64(size), 0, f, last)
            store(back, 0, task.activations, pull, wp.int64(task.activations), 0, f, last)

    return leave


def residual_sums(
    tables: dict[str, Tensor], rest: Tensor, weights: Tensor, transforms: Tensor, active: Tensor,
    scale: Tensor, targets: Tensor, origin: Tensor, bound: Tensor | None, *, gradient: bool, distances: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Energy (F,), forces (F, T, 3, 4), pull (F, C) and distances (F, v); empty where not asked for.

    Args:
        tables: of ``model_residual.ModelResidual``.
        rest, weights, transforms, active, scale, targets, origin, bound, gradient, distances: as there;
            `active` is (F, 0) without correctives.
    """
    count, vertices = targets.shape[:2]
    joints, activations = transforms.shape[1], active.shape[1]
    lanes, scalar = lane_count(targets), scalar_name(targets.dtype)
    kernel, groups = _kernel(scalar, lanes), -(-count // lanes)
    new = functools.partial(torch.empty, dtype=targets.dtype, device=targets.device)
    out = (
        new(count), new(count if gradient else 0, joints, 3, 4), new(count if gradient else 0, activations),
        _large_pages(new(0, vertices), count if distances else 0),
    )  # fmt: skip
    limit = new(0) if bound is None else bound
    given = [one.contiguous() for one in (rest, weights, transforms, active, scale, targets, origin, limit)]
    sizes = 12 * joints, activations, 12 * joints, activations, tile_slots().size

    def run(part: slice) -> None:
        workers = worker_count(part.stop - part.start, lanes)
        together = 1 if lanes == 1 else min(_TOGETHER, part.stop - part.start)
        work = [working_rows(targets, workers * together, size, lanes) for size in sizes]
        task = Compared()
        task.begin, task.end, task.together = part.start, part.stop, together
        task.frames, task.vertices = count, vertices
        task.joints, task.activations = joints, activations
        task.own_rest, task.own_weights = int(len(rest) > 1), int(len(weights) > 1)
        task.clipped, task.pulls, task.measured = int(bound is not None), int(gradient), int(distances)
        flat = [as_warp(one.view(-1)) for one in (*given, *out)]
        inputs = [task, *map(as_warp, tables.values()), *flat[:8], *map(as_rows, work), *flat[8:]]
        launch(kernel, workers, inputs, targets)

    in_threads(run, groups, targets)
    return out


def _large_pages(like: Tensor, count: int) -> Tensor:
    """Unwritten memory for `count` rows; NumPy asks for large pages, whose first touch costs a quarter."""
    if like.is_cuda:
        return like.new_empty(count, like.shape[1])
    return torch.from_numpy(np.empty((count, like.shape[1]), scalar_name(like.dtype)))


def residual_tables(skin: scipy.sparse.csr_array, moves: scipy.sparse.csr_array) -> dict[str, np.ndarray]:
    """Constants of a launch, in the order of the kernel's arguments.

    Args:
        skin: (v, T) weights.
        moves: (3 v, C) offsets, the three rows of a vertex together.
    """
    skin, moves = skin.tocsr().sorted_indices(), moves.tobsr((3, 1)).sorted_indices()
    # The skin's entries once more by tile, then joint, then vertex: a run is one joint of a tile.
    row = np.repeat(np.arange(skin.shape[0]), np.diff(skin.indptr))
    order = np.lexsort((row, skin.indices, row // TILE))
    tile, joint = row[order] // TILE, skin.indices[order]
    runs, begin = np.unique(tile * skin.shape[1] + joint, return_index=True)
    tiles = np.arange(-(-skin.shape[0] // TILE) + 1)
    return {
        "skin_start": skin.indptr.astype(np.int32),
        "skin_joint": _short_ids(skin.indices),
        "skin_value": skin.data,
        "joint_run": np.searchsorted(runs // skin.shape[1], tiles).astype(np.int32),
        "joint_id": _short_ids(joint[begin]),
        "joint_start": np.append(begin, len(row)).astype(np.int32),
        "joint_row": _short_ids(row[order] % TILE),
        "joint_value": skin.data[order],
        "move_start": moves.indptr.astype(np.int32),
        "move_id": _short_ids(moves.indices),
        "move_value": moves.data.ravel(),
    }


def _short_ids(ids: np.ndarray) -> np.ndarray:
    """Ids as 16-bit numbers: half the memory to read."""
    assert ids.max(initial=0) < 2**15, ids.max()
    return ids.astype(np.int16)
