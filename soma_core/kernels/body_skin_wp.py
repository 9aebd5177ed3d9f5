"""Bodies skinned in one pass, without gradients; bodies in SIMD lanes.

Tile by tile of vertices: rest points, brought to the bind pose where asked for, what the correctives add, and
skinning. Nothing but posed vertices is written. The twin of ``animation.skinning`` for a CPU.
"""

from typing import NamedTuple

import scipy.sparse
import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._lanes import as_rows, launch, row_of, worker_count, working_rows
from soma_core.kernels._native import HALVES, native, transposing
from soma_core.kernels._residual_phases import OFFSET, TILE
from soma_core.kernels._runtime import as_warp, once, scalar_name
from soma_core.kernels._threads import FEW, in_threads
from soma_core.kernels._view_text import TANH

__all__ = ["WIDTHS", "Added", "Blend", "Strides", "blend_of", "drawing", "lanes_of", "skin_bodies",
           "skinning", "strides_of"]  # fmt: skip

WIDTHS = {torch.float32: (4, 8, 16), torch.float64: (4, 8)}
"""Bodies a thread may treat at once: SIMD registers of current CPUs, wide ones split where there are none."""

_ids, _short = wp.array(dtype=wp.int32), wp.array(dtype=wp.int16)


class Blend(NamedTuple):
    """A sparse matrix as the kernel reads it.

    Attributes:
        start: row starts, int32.
        column: ids (e,), int16.
        value: (e,), or (e, 3) of rows of three.
    """

    start: Tensor
    column: Tensor
    value: Tensor


class Added(NamedTuple):
    """What correctives add.

    Attributes:
        first: weights (A, 6 J) of features.
        moves: offsets (3 v, A) of activations, in rows of three.
        squashed: whether activations are a hyperbolic tangent.
    """

    first: Blend
    moves: Blend
    squashed: bool


def blend_of(matrix: scipy.sparse.csr_array, *, dtype: torch.dtype, rows: int = 1) -> Blend:
    """Tables of a matrix (rows v, n), with the `rows` of one vertex together."""
    matrix = matrix.tocsr().sorted_indices()
    if rows > 1:
        matrix = matrix.tobsr((rows, 1)).sorted_indices()
    assert matrix.shape[1] < 2**15, matrix.shape
    return Blend(
        torch.as_tensor(matrix.indptr.copy(), dtype=torch.int32),
        torch.as_tensor(matrix.indices.copy(), dtype=torch.int16),
        torch.as_tensor(matrix.data.reshape(-1).copy()).to(dtype),
    )


@wp.struct
class _Task:
    """Counts and switches of one launch: groups begin .. end of bodies, tiles of vertices."""

    begin: int
    end: int
    tiles: int
    bodies: int
    vertices: int
    joints: int
    reposed: int
    features: int
    activations: int
    squashed: int


@wp.struct
class Strides:
    """Numbers from one body, one vertex, one axis of the points to the next."""

    body: wp.int64
    vertex: wp.int64
    axis: wp.int64


@once
def skinning(scalar: str, lanes: int):
    """Kernel of :func:`skin_bodies`."""
    width, size = lanes, TILE
    real, rows = wp.array(dtype=getattr(wp, scalar)), wp.array3d(dtype=getattr(wp, scalar))
    (load, store), row = transposing(scalar, lanes), row_of(scalar)
    draw, (activate, move, skin) = drawing(scalar, lanes), _steps(real, scalar, lanes)
    module = wp.get_module(f"soma_body_skin_{scalar}_{lanes}")

    @wp.kernel(module=module, enable_backward=False)
    def run(
        task: _Task, by: Strides,
        skin_start: _ids, skin_joint: _short, skin_value: real,
        first_start: _ids, first_joint: _short, first_value: real,
        active_start: _ids, active_id: _short, active_value: real,
        move_start: _ids, move_id: _short, move_value: real,
        points: real, transforms: real, before: real, features: real,
        turns: rows, firsts: rows, given: rows, sources: rows, tiles: rows, out: real,
    ):  # fmt: skip
        w = wp.tid()
        turn, first, source, tile = row(turns, w), row(firsts, w), row(sources, w), row(tiles, w)
        last = task.bodies - 1
        numbers, own = 12 * task.joints, 12 * task.reposed
        for g in range(task.begin + w, task.end, tiles.shape[0] * tiles.shape[1]):
            f = g * width
            load(transforms, wp.int64(numbers), 0, numbers, f, last, turn, 0)
            load(before, wp.int64(own), 0, own, f, last, first, 0)
            load(features, wp.int64(task.features), 0, task.features, f, last, row(given, w), 0)
            activate(
                active_start, active_id, active_value, task.squashed, task.features, task.activations,
                row(given, w), source,
            )  # fmt: skip
            for t in range(task.tiles):
                a = t * size
                b = wp.min(a + size, task.vertices)
                if by.axis == 1 and by.vertex == 3 and by.body > 1:
                    load(points, by.body, 3 * a, 3 * (b - a), f, last, tile, 0)
                else:
                    draw(points, by.body, by.vertex, by.axis, f, last, a, b, tile)
                if task.reposed > 0:
                    skin(first_start, first_joint, first_value, first, a, b, tile)
                if task.activations > 0:
                    move(move_start, move_id, move_value, source, a, b, tile)
                skin(skin_start, skin_joint, skin_value, turn, a, b, tile)
                store(tile, 0, 3 * (b - a), out, wp.int64(3 * task.vertices), 3 * a, f, last)

    return run


@once
def drawing(scalar: str, lanes: int) -> wp.Function:
    """Function that brings vertices begin .. stop of bodies, however they lie, into a tile."""
    real = wp.array(dtype=getattr(wp, scalar))

    def draw_bodies(
        source: real, body: wp.int64, vertex: wp.int64, axis: wp.int64, first: int, last: int,
        begin: int, stop: int, tile: real,
    ):  # fmt: skip
        ...

    return native(_DRAW, scalar, lanes, draw_bodies)


def _steps(real, scalar: str, lanes: int):
    def activate(
        start: _ids, column: _short, value: real, squashed: int, features: int, count: int, given: real,
        active: real,
    ):  # fmt: skip
        ...

    def move(
        start: _ids, activation: _short, value: real, active: real, first: int, stop: int, tile: real
    ): ...

    def skin(
        start: _ids, joint: _short, value: real, transforms: real, first: int, stop: int, tile: real
    ): ...

    bodies = {activate: _ACTIVATE, move: _MOVE, skin: _SKIN}
    for stub in bodies:
        stub.__name__ += "_bodies"
    return tuple(native(body, scalar, lanes, stub) for stub, body in bodies.items())


_DRAW = """
    M x = (M)tile.data;
    for (int v = begin; v < stop; v++)
        for (int r = 0; r < 3; r++, x += 1) {
            const R* p = source.data + v * vertex + r * axis;
            if (body == 0) *x = V{} + *p;
            else if (body == 1 && first + N <= last + 1) *x = *(const V*)(p + first);
            else {
                V found = V{};
                for (int c = 0; c < N; c++) ((R*)&found)[c] = p[(first + c < last ? first + c : last) * body];
                *x = found;
            }
        }
"""

_ACTIVATE = (
    "const V zero = V{}, one = zero + R(1);"
    + TANH
    + """
    M x = (M)given.data, to = (M)active.data;
    for (int a = 0; a < count; a++) {
        V sum = zero;
        for (int e = start.data[a]; e < start.data[a + 1]; e++) sum += value.data[e] * x[column.data[e]];
        sum = sum > zero ? sum : zero;
        to[a] = x[features - 1] * (squashed ? tanh_of(sum) : sum);
    }
"""
)

_MOVE = (
    """
    M a = (M)active.data, x = (M)tile.data;
    for (int v = first; v < stop; v++, x += 3) {
"""
    + OFFSET
    + """
        x[0] += p;
        x[1] += q;
        x[2] += r;
    }
"""
)

_SKIN = (
    HALVES
    + """
    HM transform = (HM)transforms.data, x = (HM)tile.data;
    for (int v = first; v < stop; v++, x += 3 * P)
        for (int h = 0; h < P; h++) {
            H m[12];
            for (int k = 0; k < 12; k++) m[k] = H{};
            for (int e = start.data[v]; e < start.data[v + 1]; e++) {
                HM t = transform + (12 * P * joint.data[e] + h);
                const R w = value.data[e];
                for (int k = 0; k < 12; k++) m[k] += w * t[k * P];
            }
            const H p = x[h], q = x[P + h], r = x[2 * P + h];
            for (int i = 0; i < 3; i++)
                x[i * P + h] = m[4 * i] * p + m[4 * i + 1] * q + m[4 * i + 2] * r + m[4 * i + 3];
        }
"""
)


def skin_bodies(
    points: Tensor, transforms: Tensor, skin: Blend, *, before: Tensor | None = None,
    first: Blend | None = None, features: Tensor | None = None, added: Added | None = None,
    out: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Skinned vertices (B, v, 3) [m], contiguous.

    Args:
        points: rest points (B or 1, v, 3) [m], in any layout; best with bodies innermost.
        transforms: (B, T, 3, 4).
        skin: weights (v, T).
        before: transforms (B, J, 3, 4) that take points to the bind pose first; None of what is there.
        first: weights (v, J) of these.
        features: of poses, and the bodies' size, (B, 6 J + 1); None without correctives.
        added: what these make of them.
        out: where to write; None for new memory.
    """
    count, vertices = len(transforms), points.shape[1]
    if out is None:
        out = points.new_empty(count, vertices, 3)
    if not out.numel():
        return out
    lanes = lanes_of(count, points)
    kernel, none = skinning(scalar_name(points.dtype), lanes), points.new_zeros(1)
    blends = skin, first or skin, *((skin, skin) if added is None else added[:2])
    frames = [none if one is None else one.contiguous() for one in (transforms, before, features)]
    strides = strides_of(points)
    joints, reposed = transforms.shape[1], 0 if before is None else before.shape[1]
    seen, moving = (0, 0) if added is None or features is None else (features.shape[1], _rows(added.first))
    sizes = 12 * joints, 12 * reposed, seen, moving, 3 * TILE

    def run(part: slice) -> None:
        task = _Task()
        task.begin, task.end, task.tiles = part.start, part.stop, -(-vertices // TILE)
        task.bodies, task.vertices, task.joints, task.reposed = count, vertices, joints, reposed
        task.features, task.activations, task.squashed = (
            seen,
            moving,
            int(added is not None and added.squashed),
        )
        workers = worker_count(task.end - task.begin, lanes)
        work = [working_rows(points, workers, max(size, 1), lanes) for size in sizes]
        tables = [as_warp(one) for blend in blends for one in blend]
        start = as_warp(points.as_strided((1,), (1,)))
        given = start, *(as_warp(one.view(-1)) for one in frames), *map(as_rows, work), as_warp(out.view(-1))
        launch(kernel, workers, [task, strides, *tables, *given], points)

    in_threads(run, -(-count // lanes), points)
    return out


def _rows(blend: Blend) -> int:
    return len(blend.start) - 1


def strides_of(points: Tensor) -> Strides:
    """Of points (B or 1, v, 3); one body serves all."""
    strides = Strides()
    strides.body, strides.vertex, strides.axis = points.stride()
    if len(points) == 1:
        strides.body = 0
    return strides


def lanes_of(count: int, like: Tensor) -> int:
    """Bodies a thread treats at once: as few as keep every thread busy, as many as a register holds."""
    share, widths = -(-count // max(1, min(torch.get_num_threads(), count // FEW))), WIDTHS[like.dtype]
    return next((width for width in widths if width >= share), widths[-1])
