"""Descent on the error of a whole model in Warp, from the first look at the vertices to the last step.

The twin of ``inversion.refine.Refinement`` on a CPU and without terms: a group of frames goes through
many steps at once, and nothing returns to Python between them. A step that would raise the error is tried
again shorter, where the twin damps the frame's matrix anew.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._descent_text import MEMORY
from soma_core.kernels._lanes import as_rows, lane_count, launch, row_of, working_rows
from soma_core.kernels._native import transposing
from soma_core.kernels._residual_phases import TILE, phases, tile_slots
from soma_core.kernels._runtime import as_warp, once, scalar_name
from soma_core.kernels._solver_functions import Task, descent_functions, solver_functions
from soma_core.kernels._threads import in_threads
from soma_core.kernels.model_residual_wp import Compared, gathering, skinning
from soma_core.kernels.pose_solver_wp import PoseSolver

__all__ = ["Descended", "DescentRule", "descend", "remembered"]

_ids, _short = wp.array(dtype=wp.int32), wp.array(dtype=wp.int16)

_GROWTH = 40.0
"""Relative damping of the first steps over the mean square error that is left [1/m^2]: the matrix does not
know what curves by that error."""

_SHORTEN = 0.3
"""Factor of a step that would have raised the error."""


def _entering(scalar: str, width: int):
    """Function that brings what a group of frames has into lanes."""
    real = wp.array(dtype=getattr(wp, scalar))
    (load, _), slots = transposing(scalar, width), tile_slots()
    at_origin, at_scale, at_bound = slots.origin, slots.scale, slots.bound

    @wp.func
    def enter(
        task: Task, clipped: int, at: _ids, f: int, s: real, tile: real, relative: real, hips: real,
        damping: real, mass: real, scale: real, origin: real, bound: real, typical: real, state: real,
    ):  # fmt: skip
        last = task.frames - 1
        load(relative, wp.int64(at[5]), 0, at[5], f, last, s, at[7])
        load(hips, wp.int64(3), 0, 3, f, last, s, at[8])
        load(mass, wp.int64(1), 0, 1, f, last, s, at[4])
        load(damping, wp.int64(1), 0, 1, f, last, s, at[18])
        load(scale, wp.int64(1), 0, 1, f, last, s, at[21])
        load(state, wp.int64(at[30]), 0, at[30] * wp.min(task.outcome, 1), f, last, s, at[29])
        load(origin, wp.int64(3), 0, 3, f, last, tile, at_origin)
        load(scale, wp.int64(1), 0, 1, f, last, tile, at_scale)
        if clipped > 0:
            load(bound, wp.int64(1), 0, 1, f, last, tile, at_bound)
            load(typical, wp.int64(1), 0, 1, f, last, s, at[28])

    return enter


def _comparing(scalar: str, width: int):
    """Function that looks at all vertices of a pose."""
    real, tiled = wp.array(dtype=getattr(wp, scalar)), phases(scalar, width)
    (load, _), size, at_energy = transposing(scalar, width), TILE, tile_slots().energy
    gather, skinned = gathering(real, load, tiled), skinning(real, tiled)
    clear, moved, draw, push = tiled.clear, tiled.moved, tiled.pulled, tiled.forces

    @wp.func
    def compare(
        seen: Compared, f: int,
        skin_start: _ids, skin_joint: _short, skin_value: real,
        joint_run: _ids, joint_id: _short, joint_start: _ids, joint_row: _short, joint_value: real,
        move_start: _ids, move_id: _short, move_value: real,
        rest: real, weights: real, targets: real,
        turned: real, source: real, force: real, back: real, tile: real,
    ):  # fmt: skip
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

    return compare


def _factorising(scalar: str, width: int, *, shared: bool):
    """Function that makes the matrix of a pose anew."""
    real, body = wp.array(dtype=getattr(wp, scalar)), solver_functions(scalar, width, shared=shared)
    activate, assemble, twists, modes = body.activate, body.assemble, body.twists, body.modes
    factor, doubted = body.factor, descent_functions(scalar, width, shared=shared).doubted

    @wp.func
    def renew(
        plan: _ids, numbers: real, k: real, s: real, m: real, columns: _ids, square: real, count: int,
        activations: int,
    ):  # fmt: skip
        activate(plan, numbers, k, s, m)
        assemble(plan, numbers, k, s, m)
        twists(plan, numbers, k, s, m)
        if activations > 0:
            modes(plan, numbers, k, s, m)
        doubted(plan, numbers, k, s, m, columns, square, count)
        factor(plan, numbers, k, s, m)

    return renew


def _looking(scalar: str, width: int, *, shared: bool):
    """Functions round a look at the vertices: what it takes of a pose, and what it says of it."""
    number = getattr(wp, scalar)
    real, at_energy = wp.array(dtype=number), tile_slots().energy
    body, own = (of(scalar, width, shared=shared) for of in (solver_functions, descent_functions))
    transform, activate, given = body.transform, body.activate, own.given
    brought, pull, forces, turn = own.brought, body.pull, body.forces, body.turn

    @wp.func
    def before(plan: _ids, numbers: real, k: real, s: real, m: real, turned: real, source: real):
        transform(plan, numbers, k, s, m)
        activate(plan, numbers, k, s, m)
        given(plan, numbers, k, s, m, turned, source)

    @wp.func
    def after(plan: _ids, numbers: real, k: real, s: real, m: real, force: real, back: real, tile: real):
        brought(plan, numbers, k, s, m, force, back, tile, at_energy)
        pull(plan, numbers, k, s, m)
        forces(plan, numbers, k, s, m)
        turn(plan, numbers, k, s, m)

    return before, after


def _stepping(scalar: str, width: int, *, shared: bool):
    """Functions that weigh doubt and take or undo a step, and that make the next one; that says who moves."""
    number = getattr(wp, scalar)
    real = wp.array(dtype=number)
    body, own = (of(scalar, width, shared=shared) for of in (solver_functions, descent_functions))
    doubt, solve, weighed, combined = body.doubt, body.solve, own.weighed, own.combined
    begun, accepted, drawn, mixed, judged = own.begun, own.accepted, own.drawn, own.mixed, own.judged

    @wp.func
    def take(
        plan: _ids, numbers: real, k: real, s: real, m: real, rules: real, columns: _ids, spins: real,
        base: real, square: real, count: int, step: int, fresh: int, again: int, clipped: int,
    ):  # fmt: skip
        first = wp.where(step == 0, fresh, 0)
        weighed(plan, numbers, k, s, m, base, square, count, first, rules[2], rules[3])
        if count * (step + fresh) > 0:
            doubt(plan, numbers, k, s, m, columns, spins, square, count)
            combined(plan, numbers, k, s, m, clipped)
        if step == 0:
            begun(plan, numbers, k, s, m, again, rules[12])
        else:
            accepted(
                plan, numbers, k, s, m, rules[4], rules[5], rules[6], rules[7], rules[8], rules[9], rules[10]
            )

    @wp.func
    def draw(plan: _ids, numbers: real, k: real, s: real, m: real, rules: real):
        drawn(plan, numbers, k, s, m)
        solve(plan, numbers, k, s, m)
        mixed(plan, numbers, k, s, m, rules[11])
        return judged(plan, numbers, k, s, m, rules[0], rules[1])

    return take, draw


@once
def _kernel(scalar: str, width: int, *, shared: bool):
    number = getattr(wp, scalar)
    real, rows = wp.array(dtype=number), wp.array3d(dtype=number)
    body, (_, store), row = (
        solver_functions(scalar, width, shared=shared), transposing(scalar, width), row_of(scalar)
    )  # fmt: skip
    walk, still, move, taken = (
        body.walk, body.still, body.move, descent_functions(scalar, width, shared=shared).taken
    )  # fmt: skip
    enter, compare = _entering(scalar, width), _comparing(scalar, width)
    before, after = _looking(scalar, width, shared=shared)
    take, draw = _stepping(scalar, width, shared=shared)
    renew = _factorising(scalar, width, shared=shared)
    module = wp.get_module(f"soma_descent_{scalar}_{width}_{'one' if shared else 'each'}")

    @wp.kernel(module=module, enable_backward=False)
    def descent(
        task: Task, seen: Compared, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows,
        at: _ids, rules: real, renewed: int, columns: _ids, spins: real, base: real,
        t0: _ids, t1: _short, t2: real, t3: _ids, t4: _short, t5: _ids, t6: _short, t7: real,
        t8: _ids, t9: _short, t10: real,
        rest: real, weights: real, relative: real, hips: real, damping: real, mass: real, scale: real,
        targets: real, origin: real, bound: real, typical: real, state: real,
        turns: rows, sources: rows, pushes: rows, pulls: rows, tiles: rows, squares: rows,
        relative_out: real, hips_out: real, damping_out: real, accepted_out: real, change_out: real,
        state_out: real,
    ):  # fmt: skip
        w, last = wp.tid(), task.frames - 1
        turned, source, force, back = row(turns, w), row(sources, w), row(pushes, w), row(pulls, w)
        tile, square, s, m = row(tiles, w), row(squares, w), row(memory, w), row(kept, w)
        for g in range(task.begin, task.end):
            f, k = g * width, row(constants, g)
            still(plan, numbers, k, s, m, number(0.0))
            enter(task, seen.clipped, at, f, s, tile, relative, hips, damping, mass, scale, origin, bound,
                  typical, state)  # fmt: skip
            for step in range(task.iterations + 1):
                walk(plan, numbers, k, s, m, 0)
                if step + task.forced > 0:
                    before(plan, numbers, k, s, m, turned, source)
                    compare(seen, f, t0, t1, t2, t3, t4, t5, t6, t7, t8, t9, t10, rest, weights, targets,
                            turned, source, force, back, tile)  # fmt: skip
                    after(plan, numbers, k, s, m, force, back, tile)
                take(plan, numbers, k, s, m, rules, columns, spins, base, square, task.soft_count, step,
                     task.forced, task.outcome, seen.clipped)  # fmt: skip
                if (renewed >> step) & 1 > 0:
                    renew(plan, numbers, k, s, m, columns, square, task.soft_count, seen.activations)
                if draw(plan, numbers, k, s, m, rules) == 0:
                    break
                if step < task.iterations:
                    move(plan, numbers, k, s, m, spins, 0, task.hinge_end, rules[11], 0)
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
    clip: Tensor | None, state: Tensor | None, *, begin: int, end: int, going: bool, renewed: Sequence[int],
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
        state: of an earlier descent of these frames; None without.
        begin, end: steps that are taken, counted from the first look.
        going: whether this goes on with that one; where it begins anew, only the memory of steps counts.
        renewed: those at which the matrix is made, beside the first.
    """
    count, vertices = targets.shape[:2]
    lanes, scalar = lane_count(targets), scalar_name(targets.dtype)
    assert lanes > 1, "this kernel is for CPUs"
    new, none = targets.new_empty, targets.new_zeros(1)
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

    again = 2 if going else int(state is not None)
    task, seen = Task(), Compared()
    task.frames, task.iterations, task.forced, task.outcome = count, end - begin, int(again < 2), again
    task.soft_count, task.hinge_end = 0 if doubt is None else len(base), solver.driven
    seen.frames, seen.vertices, seen.joints, seen.activations = count, vertices, joints, activations
    seen.own_rest, seen.own_weights = int(len(rest) > 1), int(len(weights) > 1)
    seen.clipped, seen.pulls, seen.measured = int(clip is not None), 1, 0
    lists = *(as_warp(one.view(-1)) for one in (columns, spins, base)), *map(as_warp, tables.values())
    _run(kernel, solver, constants[0], (task, seen), rules, sum(1 << step for step in made), lists, given,
         sizes, out)  # fmt: skip
    return out


def _run(
    kernel: wp.Kernel, solver: PoseSolver, constants: Tensor, tasks: tuple, rules: Tensor, renewed: int,
    lists: tuple, given: Sequence[Tensor], sizes: tuple[int, ...], out: Descended,
) -> None:  # fmt: skip
    """Launch in as many threads as torch uses."""
    like = out.relative
    lanes = lane_count(like)

    def run(part: slice) -> None:
        work = [working_rows(like, 1, size, lanes) for size in (solver.memory, solver.kept, *sizes)]
        task = Task()
        for name in ("frames", "iterations", "forced", "outcome", "soft_count", "hinge_end"):
            setattr(task, name, getattr(tasks[0], name))
        task.begin, task.end = part.start, part.stop
        inputs = [
            task, tasks[1], as_warp(solver.plan), as_warp(solver.numbers), as_rows(constants),
            *map(as_rows, work[:2]), as_warp(solver.at), as_warp(rules), renewed, *lists,
            *(as_warp(one.view(-1)) for one in given), *map(as_rows, work[2:]),
            *(as_warp(one.view(-1)) for one in out),
        ]  # fmt: skip
        launch(kernel, 1, inputs, like)

    in_threads(run, -(-len(like) // lanes), like)


def remembered(size: int) -> tuple[slice, slice]:
    """Where in a state of `size` numbers changes of slopes lie, and inverse products with their steps."""
    width = (size - MEMORY - 4) // (1 + 2 * MEMORY)
    return slice((1 + MEMORY) * width, (1 + 2 * MEMORY) * width), slice(size - MEMORY - 4, size - 4)
