"""Descent on the error of a whole model in Warp, from the first look at the vertices to the last step.

The twin of ``inversion.refine.Refinement`` on a CPU and without terms: a group of frames goes through
many steps at once, and nothing returns to Python between them. A step that would raise the error is tried
again shorter, where the twin damps the frame's matrix anew.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._descent_text import MEMORY
from soma_core.kernels._lanes import as_rows, in_threads, lane_count, launch, row_of, working_rows
from soma_core.kernels._native import transposing
from soma_core.kernels._residual_phases import TILE, phases, tile_slots
from soma_core.kernels._runtime import as_warp, scalar_name
from soma_core.kernels._solver_functions import Task, solver_functions
from soma_core.kernels.model_residual_wp import Compared, gathering, skinning
from soma_core.kernels.pose_solver_wp import PoseSolver

__all__ = ["Descended", "DescentRule", "descend", "remembered"]

_ids, _short = wp.array(dtype=wp.int32), wp.array(dtype=wp.int16)

_GROWTH = 40.0
"""Relative damping of the first steps over the mean square error that is left [1/m^2]: the matrix does not
know what curves by that error."""

_SHORTEN = 0.3
"""Factor of a step that would have raised the error."""


@functools.cache
def _kernel(scalar: str, width: int, *, shared: bool):
    number = getattr(wp, scalar)
    real, rows = wp.array(dtype=number), wp.array3d(dtype=number)
    body, tiled = solver_functions(scalar, width, shared=shared), phases(scalar, width)
    (load, store), row = transposing(scalar, width), row_of(scalar)
    gather, skinned, slots = gathering(real, load, tiled), skinning(real, tiled), tile_slots()
    clear, moved, draw, push = tiled.clear, tiled.moved, tiled.pulled, tiled.forces
    walk, still, transform, activate = body.walk, body.still, body.transform, body.activate
    given, brought, pull, forces, turn = body.given, body.brought, body.pull, body.forces, body.turn
    weighed, doubt, combined, doubted = body.weighed, body.doubt, body.combined, body.doubted
    assemble, twists, modes, factor = body.assemble, body.twists, body.modes, body.factor
    drawn, solve, mixed, judged = body.drawn, body.solve, body.mixed, body.judged
    move, begun, taken, accepted = body.move, body.begun, body.taken, body.accepted
    at_origin, at_scale, at_bound, at_energy = slots.origin, slots.scale, slots.bound, slots.energy
    size = TILE
    module = wp.get_module(f"soma_descent_{scalar}_{width}_{'one' if shared else 'each'}")

    @wp.kernel(module=module, enable_backward=False)
    def descent(
        task: Task, seen: Compared, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows,
        at: _ids, rules: real, renewed: int, columns: _ids, spins: real, base: real,
        skin_start: _ids, skin_joint: _short, skin_value: real,
        joint_run: _ids, joint_id: _short, joint_start: _ids, joint_row: _short, joint_value: real,
        move_start: _ids, move_id: _short, move_value: real,
        rest: real, weights: real, relative: real, hips: real, damping: real, mass: real, scale: real,
        targets: real, origin: real, bound: real, typical: real, state: real,
        turns: rows, sources: rows, pushes: rows, pulls: rows, tiles: rows, squares: rows,
        relative_out: real, hips_out: real, damping_out: real, accepted_out: real, change_out: real,
        state_out: real,
    ):  # fmt: skip
        w, last, count = wp.tid(), task.frames - 1, task.soft_count
        turned, source, force, back = row(turns, w), row(sources, w), row(pushes, w), row(pulls, w)
        tile, square = row(tiles, w), row(squares, w)
        for g in range(task.begin, task.end):
            f = g * width
            s, m, k = row(memory, w), row(kept, w), row(constants, g)
            still(plan, numbers, k, s, m, number(0.0))
            load(relative, wp.int64(at[5]), 0, at[5], f, last, s, at[7])
            load(hips, wp.int64(3), 0, 3, f, last, s, at[8])
            load(mass, wp.int64(1), 0, 1, f, last, s, at[4])
            load(damping, wp.int64(1), 0, 1, f, last, s, at[18])
            load(scale, wp.int64(1), 0, 1, f, last, s, at[21])
            load(state, wp.int64(at[30]), 0, at[30] * wp.min(task.outcome, 1), f, last, s, at[29])
            load(origin, wp.int64(3), 0, 3, f, last, tile, at_origin)
            load(scale, wp.int64(1), 0, 1, f, last, tile, at_scale)
            if seen.clipped > 0:
                load(bound, wp.int64(1), 0, 1, f, last, tile, at_bound)
                load(typical, wp.int64(1), 0, 1, f, last, s, at[28])
            for step in range(task.iterations + 1):
                walk(plan, numbers, k, s, m, 0)
                if step + task.forced > 0:
                    transform(plan, numbers, k, s, m)
                    activate(plan, numbers, k, s, m)
                    given(plan, numbers, k, s, m, turned, source)
                    clear(tile, at_energy, 1)
                    clear(force, 0, 12 * seen.joints)
                    clear(back, 0, seen.activations)
                    for t in range((seen.vertices + size - 1) // size):
                        a = t * size
                        b = wp.min(a + size, seen.vertices)
                        gather(seen, f, a, b, rest, weights, targets, tile)
                        moved(move_start, move_id, move_value, source, a, b, tile)
                        skinned(seen, skin_start, skin_joint, skin_value, turned, weights, a, b, tile)
                        draw(move_start, move_id, move_value, a, b, tile, back)
                        push(joint_run, joint_id, joint_start, joint_row, joint_value, t, t + 1, tile, force)
                    brought(plan, numbers, k, s, m, force, back, tile, at_energy)
                    pull(plan, numbers, k, s, m)
                    forces(plan, numbers, k, s, m)
                    turn(plan, numbers, k, s, m)
                first = wp.where(step == 0, task.forced, 0)
                weighed(plan, numbers, k, s, m, base, square, count, first, rules[2], rules[3])
                if count * (step + task.forced) > 0:
                    doubt(plan, numbers, k, s, m, columns, spins, square, count)
                    combined(plan, numbers, k, s, m, seen.clipped)
                if step == 0:
                    begun(plan, numbers, k, s, m, task.outcome, rules[12])
                else:
                    accepted(
                        plan, numbers, k, s, m, rules[4], rules[5], rules[6], rules[7], rules[8],
                        rules[9], rules[10],
                    )  # fmt: skip
                if (renewed >> step) & 1 > 0:
                    activate(plan, numbers, k, s, m)
                    assemble(plan, numbers, k, s, m)
                    twists(plan, numbers, k, s, m)
                    if seen.activations > 0:
                        modes(plan, numbers, k, s, m)
                    doubted(plan, numbers, k, s, m, columns, square, count)
                    factor(plan, numbers, k, s, m)
                drawn(plan, numbers, k, s, m)
                solve(plan, numbers, k, s, m)
                mixed(plan, numbers, k, s, m, rules[11])
                if judged(plan, numbers, k, s, m, rules[0], rules[1]) == 0:
                    break
                if step < task.iterations:
                    move(plan, numbers, k, s, m, spins, 0, task.hinge_end, rules[11])
                    taken(plan, numbers, k, s, m)
            store(s, at[7], at[5], relative_out, wp.int64(at[5]), 0, f, last)
            store(s, at[8], 3, hips_out, wp.int64(3), 0, f, last)
            store(s, at[18], 1, damping_out, wp.int64(1), 0, f, last)
            store(s, at[9], 1, accepted_out, wp.int64(1), 0, f, last)
            store(s, at[10], 1, change_out, wp.int64(1), 0, f, last)
            store(s, at[29], at[30], state_out, wp.int64(at[30]), 0, f, last)

    return descent


class DescentRule(NamedTuple):
    """How a descent goes on; names are those of ``inversion.refine``.

    Attributes:
        tolerance, share: where frames rest, [m] and relative.
        unit: factor of the clumps that doubt is weighed by.
        noise, floor: relative and absolute rounding of an error, [m^2] for a mass of one.
        damping, lower, raised, least_raised, most: of the damping.
        longest: largest turn of a joint [rad].
    """

    tolerance: float
    share: float
    unit: float
    noise: float
    floor: float
    damping: float
    lower: float
    raised: float
    least_raised: float
    most: float
    longest: float


class Descended(NamedTuple):
    """Poses after a descent.

    Attributes:
        relative, hips: (F, J, 3, 3) and (F, 3) [m].
        damping: (F,) for a next one.
        accepted: (F,) steps taken.
        change: (F,) what a Newton step would still change [m], zero where a frame rests.
        state: (F, k) for a next one.
    """

    relative: Tensor
    hips: Tensor
    damping: Tensor
    accepted: Tensor
    change: Tensor
    state: Tensor


def descend(
    solver: PoseSolver, constants: tuple[Tensor, bool], tables: Mapping[str, Tensor], rule: DescentRule,
    doubt: tuple[Tensor, Tensor, Tensor] | None, rest: Tensor, weights: Tensor, relative: Tensor,
    hips: Tensor, damping: Tensor, mass: Tensor, scale: Tensor, targets: Tensor, origin: Tensor,
    clip: Tensor | None, state: Tensor | None, *, begin: int, end: int, renewed: Sequence[int],
) -> Descended:  # fmt: skip
    """Lower the error of F frames.

    Args:
        solver, constants: of the rig and the identities.
        tables: of ``model_residual_wp.residual_tables``.
        rule: how.
        doubt: columns (q,), axes (q, 3) and squares (q,) [1/rad^2]; None without.
        rest, weights: (1 or F, v, 3) and (1 or F, v).
        relative, hips: where to begin.
        damping, mass, scale: (F,).
        targets, origin: (F, v, 3) and (F, 3) [m].
        clip: lengths beyond which residuals count linearly, and typical ones (2, F) [m]; None for least
            squares.
        state: of an earlier descent of these frames, which this one goes on with; where it begins anew, only
            its memory of steps counts. None without.
        begin, end: steps that are taken, counted from the first look.
        renewed: those at which the matrix is made, beside the first.
    """
    count, vertices = targets.shape[:2]
    lanes, scalar = lane_count(targets), scalar_name(targets.dtype)
    assert lanes > 1, "this kernel is for CPUs"
    new = targets.new_empty
    none = targets.new_zeros(1)
    columns, spins, base = (torch.zeros(1, dtype=torch.int32), none, none) if doubt is None else doubt
    rules = targets.new_tensor([
        rule.tolerance, rule.share, rule.unit, torch.finfo(targets.dtype).tiny, rule.noise, rule.floor,
        rule.lower, rule.raised, rule.least_raised, rule.most, _SHORTEN, rule.longest, _GROWTH,
    ])  # fmt: skip
    out = Descended(
        torch.empty_like(relative, memory_format=torch.contiguous_format), new(count, 3), new(count),
        new(count), new(count), new(count, solver.under_way),
    )  # fmt: skip
    made = {0, *(step - begin for step in renewed)}
    bound, typical = (none, none) if clip is None else clip
    given = [
        rest, weights, relative, hips, damping, mass, scale, targets, origin, bound, typical,
        none if state is None else state,
    ]  # fmt: skip
    given = [one.contiguous() for one in given]
    counts = solver.counts
    joints, activations = counts["all_count"], counts["activation_count"]
    sizes = 12 * joints, activations, 12 * joints, activations, tile_slots().size, len(base)
    kernel = _kernel(scalar, lanes, shared=constants[1])

    def run(part: slice) -> None:
        work = [working_rows(targets, 1, size, lanes) for size in (solver.memory, solver.kept, *sizes)]
        task, seen = Task(), Compared()
        task.begin, task.end, task.frames = part.start, part.stop, count
        again = (0 if state is None else 1) if begin == 0 else 2
        task.iterations, task.forced, task.outcome = end - begin, int(again < 2), again
        task.soft_count, task.hinge_end = 0 if doubt is None else len(base), solver.driven
        seen.frames, seen.vertices, seen.joints, seen.activations = count, vertices, joints, activations
        seen.own_rest, seen.own_weights = int(len(rest) > 1), int(len(weights) > 1)
        seen.clipped, seen.pulls, seen.measured = int(clip is not None), 1, 0
        inputs = [
            task, seen, as_warp(solver.plan), as_warp(solver.numbers), as_rows(constants[0]),
            *map(as_rows, work[:2]), as_warp(solver.at), as_warp(rules),
            sum(1 << step for step in made), *(as_warp(one.view(-1)) for one in (columns, spins, base)),
            *map(as_warp, tables.values()), *(as_warp(one.view(-1)) for one in given),
            *map(as_rows, work[2:]), *(as_warp(one.view(-1)) for one in out),
        ]  # fmt: skip
        launch(kernel, 1, inputs, targets)

    in_threads(run, -(-count // lanes), targets)
    return out


def remembered(size: int) -> tuple[slice, slice]:
    """Where in a state of `size` numbers changes of slopes lie, and inverse products with their steps."""
    width = (size - MEMORY - 4) // (1 + 2 * MEMORY)
    return slice((1 + MEMORY) * width, (1 + 2 * MEMORY) * width), slice(size - MEMORY - 4, size - 4)
