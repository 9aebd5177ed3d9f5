"""Bone after bone turned to points in Warp: twin of the loop in ``PointStart``, of one identity."""

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
from soma_core.kernels._native import native, transposing
from soma_core.kernels._runtime import as_warp, once, scalar_name
from soma_core.kernels._threads import in_threads
from soma_core.kernels.nearest_rotation_wp import NEWTON_STEPS, nearest_functions

__all__ = ["begun"]

_ids = wp.array(dtype=wp.int32)

_NAMES = """
    const int* P = plan.data; const R* Q = numbers.data; M s = (M)work.data; M x = (M)matrix.data;
    const int count = P[0], steps = P[1], k = turn / 2, again = turn % 2; const int* h = P + 2 + 8*k;
    const int* which = P + 2 + 8*steps; const R* own = Q + 4 + 15*k; const R* arms = Q + 4 + 15*steps;
    M weights = s + 3*count; M turns = s + 4*count; M places = turns + 9 * (steps + 1);
    M relative = places + 3 * (steps + 1); M inner = relative + 9*steps;
    M up = turns + 9 * h[0]; M here = turns + 9 * (k + 1); M place = places + 3 * (k + 1);
    const V zero = V{}, one = zero + R(1), least = zero + R(1e-12);
"""
"""Of a step: the slot above, its points first .. stop, its own centre, the middle of its limb, the points at
the end of that first .. stop, and the joint; numbers: mean, bone vector, axis of the bend."""

_AIM = """
    if (again && h[4] < 0) return 0;
    const bool hips = h[0] == 0;
    if (!again) for (int r = 0; r < 3; r++) inner[r] = zero;
    if (hips) {
        V total = zero, middle[3] = {zero, zero, zero}, arm[3] = {zero, zero, zero};
        for (int e = h[1]; e < h[2]; e++) {
            V w = arms[4*e] * weights[which[e]]; total += w;
            for (int r = 0; r < 3; r++) { middle[r] += w * s[3*which[e]+r]; arm[r] += w * arms[4*e+1+r]; }
        }
        total = total < least ? least : total;
        for (int r = 0; r < 3; r++) { place[r] = middle[r] / total; inner[r] = arm[r] / total; }
    } else if (!again) for (int r = 0; r < 3; r++) {
        V there = places[3*h[0]+r] + own[9] * up[3*r] + own[10] * up[3*r+1] + own[11] * up[3*r+2];
        place[r] = there;
        if (h[3] >= 0) place[r] = weights[h[3]] > zero ? s[3*h[3]+r] : there;
    }
    V sum[9], size = zero;
    for (int i = 0; i < 9; i++) sum[i] = zero;
    for (int e = h[1]; e < h[2]; e++) {
        V w = arms[4*e] * weights[which[e]], far = zero, away = zero;
        for (int c = 0; c < 3; c++) { V arm = arms[4*e+1+c] - inner[c]; away += arm * arm; }
        for (int r = 0; r < 3; r++) {
            V aim = s[3*which[e]+r] - place[r]; far += aim * aim; aim *= w;
            for (int c = 0; c < 3; c++) sum[3*r+c] += aim * (arms[4*e+1+c] - inner[c]);
        }
        size += w * ROOT(far) * ROOT(away);
    }
    if (again) {
        V total = zero, first[3], second[3], end[3] = {zero, zero, zero}, fars = zero, nears = zero;
        for (int e = h[5]; e < h[6]; e++) {
            V w = arms[4*e] * weights[which[e]]; total += w;
            for (int r = 0; r < 3; r++) end[r] += w * s[3*which[e]+r];
        }
        V safe = total < least ? least : total;
        for (int r = 0; r < 3; r++) {
            first[r] = s[3*h[4]+r] - place[r]; second[r] = end[r] / safe - s[3*h[4]+r];
            nears += first[r] * first[r]; fars += second[r] * second[r];
        }
        nears = ROOT(nears); fars = ROOT(fars);
        V both = (nears < least ? least : nears) * (fars < least ? least : fars), right = zero, sine = zero;
        V normal[3];
        for (int r = 0; r < 3; r++) {
            const int a = (r + 1) % 3, b = (r + 2) % 3;
            normal[r] = (first[a] * second[b] - first[b] * second[a]) / both;
            right += normal[r] * (own[12] * here[3*r] + own[13] * here[3*r+1] + own[14] * here[3*r+2]);
            sine += normal[r] * normal[r];
        }
        V keep = weights[h[4]] > zero ? one : zero, slight = zero + Q[2];
        keep = total > zero ? keep : zero;
        keep = right < zero ? (ROOT(sine) < slight ? zero : keep) : keep;
        for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++)
            sum[3*r+c] += Q[1] * own[12+c] * size * keep * normal[r];
    }
    size = Q[0] * size + least;
    for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++)
        x[3*r+c] = sum[3*r+c] + size * (up[3*r] * own[c] + up[3*r+1] * own[3+c] + up[3*r+2] * own[6+c]);
    return 1;
"""
"""The covariance of a step's points; the second time with the bend of the limb."""

_SETTLE = """
    if (turn < 0) {
        for (int i = 0; i < 9; i++) turns[i] = i % 4 ? zero : one;
        for (int i = 0; i < 3; i++) places[i] = zero;
        return;
    }
    for (int i = 0; i < 9; i++) here[i] = x[i];
    M own_turn = relative + 9*k;
    for (int r = 0; r < 3; r++) {
        if (h[0] == 0) place[r] -= x[3*r] * inner[0] + x[3*r+1] * inner[1] + x[3*r+2] * inner[2];
        for (int c = 0; c < 3; c++)
            own_turn[3*r+c] = up[r] * x[c] + up[3+r] * x[3+c] + up[6+r] * x[6+c];
    }
"""


@once
def _kernel(scalar: str, lanes: int):
    width, number, newton = lanes, getattr(wp, scalar), NEWTON_STEPS
    real, rows = wp.array(dtype=number), wp.array3d(dtype=number)

    def aim(plan: _ids, numbers: real, work: real, matrix: real, turn: int) -> int:
        return 0

    def settle(plan: _ids, numbers: real, work: real, matrix: real, turn: int): ...

    aim, settle = (
        native(_NAMES + body, scalar, lanes, stub) for body, stub in ((_AIM, aim), (_SETTLE, settle))
    )
    (load, store), row = transposing(scalar, lanes), row_of(scalar)
    shift, polar, checked = nearest_functions(scalar, lanes)
    module = wp.get_module(f"soma_point_start_{scalar}_{lanes}")

    @wp.kernel(module=module, enable_backward=False)
    def begin(
        first: int, stop: int, frames: int, joints: int, plan: _ids, numbers: real, points: real,
        weights: real, memory: rows, square: rows, relative: real, hips: real,
    ):  # fmt: skip
        w, count, steps = wp.tid(), plan[0], plan[1]
        for g in range(first + w, stop, memory.shape[0] * memory.shape[1]):
            s, x, f, last = row(memory, w), row(square, w), g * width, frames - 1
            load(points, wp.int64(3 * count), 0, 3 * count, f, last, s, 0)
            load(weights, wp.int64(count), 0, count, f, last, s, 3 * count)
            settle(plan, numbers, s, x, -1)
            for turn in range(2 * steps):
                if aim(plan, numbers, s, x, turn) == 0:
                    continue
                shift(x)
                for _ in range(newton):
                    polar(x)
                checked(x)
                settle(plan, numbers, s, x, turn)
            place = 4 * count + 9 * (steps + 1)
            store(s, place + 3, 3, hips, wp.int64(3), 0, f, last)
            for k in range(steps):
                at = place + 3 * (steps + 1) + 9 * k
                store(s, at, 9, relative, wp.int64(9 * joints), 9 * plan[9 + 8 * k], f, last)

    return begin


def begun(plan: Tensor, numbers: Tensor, points: Tensor, weights: Tensor, relative: Tensor) -> Tensor:
    """Hips positions (F, 3) [m]; turns of the joints that are moved go to `relative` (F, J, 3, 3).

    Args:
        plan: int32, ``PointStart`` makes it.
        numbers: likewise.
        points: (F, P, 3) [m], finite.
        weights: (F, P), 0 for points that are not known.
        relative: of all joints, contiguous.
    """
    frames, lanes, scalar = len(points), lane_count(points), scalar_name(points.dtype)
    steps, count = (len(numbers) - 4) // 15, points.shape[1]
    size = 4 * count + 12 * (steps + 1) + 9 * steps + 3
    kernel, hips = _kernel(scalar, lanes), points.new_empty(frames, 3)
    given = points.contiguous(), weights.contiguous()

    def run(part: slice) -> None:
        workers = worker_count(part.stop - part.start, lanes)
        memory, square = (working_rows(points, workers, rows, lanes) for rows in (size, 9))
        inputs = [part.start, part.stop, frames, relative.shape[1], as_warp(plan), as_warp(numbers)]
        inputs += [*map(as_warp, (one.view(-1) for one in given)), as_rows(memory), as_rows(square)]
        launch(kernel, workers, [*inputs, as_warp(relative.view(-1)), as_warp(hips.view(-1))], points)

    in_threads(run, -(-frames // lanes), points)
    return hips
