"""Single steps of the pose solver in Warp: the tree, slopes, the whole model's matrix, and what it solves."""

from types import SimpleNamespace

import warp as wp

from soma_core.kernels._lanes import row_of
from soma_core.kernels._native import transposing
from soma_core.kernels._runtime import once
from soma_core.kernels._solver_functions import Task, of_identities, solver_functions

__all__ = ["factor_kernel", "solution_kernels", "step_kernels", "tree_kernels"]

_ids = wp.array(dtype=wp.int32)


def _enter(scalar: str, lanes: int, *, shared: bool):
    """Brings the pose of a group of frames into lanes, and walks down its tree."""
    number = getattr(wp, scalar)
    real, body = wp.array(dtype=number), solver_functions(scalar, lanes, shared=shared)
    (load, _), walk, still = transposing(scalar, lanes), body.walk, body.still

    @wp.func
    def enter(
        plan: _ids,
        numbers: real,
        k: real,
        s: real,
        m: real,
        at: _ids,
        f: int,
        last: int,
        relative: real,
        hips: real,
    ):
        still(plan, numbers, k, s, m, number(0.0))
        load(relative, wp.int64(at[5]), 0, at[5], f, last, s, at[7])
        load(hips, wp.int64(3), 0, 3, f, last, s, at[8])
        walk(plan, numbers, k, s, m, 0)

    return enter


@of_identities
def tree_kernels(scalar: str, lanes: int, *, shared: bool) -> SimpleNamespace:
    """The tree of a pose, what it gives the model's residual, and what that says of its joints."""
    number = getattr(wp, scalar)
    real, rows = wp.array(dtype=number), wp.array3d(dtype=number)
    body, width = solver_functions(scalar, lanes, shared=shared), lanes
    forces, transform, activate, pull, turn = body.forces, body.transform, body.activate, body.pull, body.turn
    (load, store), enter = transposing(scalar, lanes), _enter(scalar, lanes, shared=shared)
    row = row_of(scalar)
    module = wp.get_module(f"soma_pose_tree_{scalar}_{lanes}_{'one' if shared else 'each'}")

    @wp.kernel(module=module, enable_backward=False)
    def posed(
        task: Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        relative: real, hips: real, turns: real, places: real, transforms: real, active: real, before: real,
        slope: real,
    ):  # fmt: skip
        w, size, count = wp.tid(), 4 * at[14], at[20] * task.outcome
        for g in range(task.begin + w, task.end, memory.shape[0] * memory.shape[1]):
            f, last = g * width, task.frames - 1
            s, m, k = row(memory, w), row(kept, w), row(constants, g)
            enter(plan, numbers, k, s, m, at, f, last, relative, hips)
            store(s, at[11], at[12], turns, wp.int64(at[12]), 0, f, last)
            store(s, at[13], at[14], places, wp.int64(at[14]), 0, f, last)
            if task.outcome > 0:
                transform(plan, numbers, k, s, m)
                activate(plan, numbers, k, s, m)
            store(s, at[22], size * task.outcome, transforms, wp.int64(size), 0, f, last)
            store(s, at[23], count, active, wp.int64(count), 0, f, last)
            store(s, at[24], count, before, wp.int64(count), 0, f, last)
            store(s, at[19], count, slope, wp.int64(count), 0, f, last)

    @wp.kernel(module=module, enable_backward=False)
    def slopes(
        task: Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        relative: real, hips: real, push: real, pulls: real, activity: real, slope: real, residual: real,
    ):  # fmt: skip
        w, size, count = wp.tid(), 4 * at[14], at[20]
        for g in range(task.begin + w, task.end, memory.shape[0] * memory.shape[1]):
            f, last = g * width, task.frames - 1
            s, m, k = row(memory, w), row(kept, w), row(constants, g)
            enter(plan, numbers, k, s, m, at, f, last, relative, hips)
            load(push, wp.int64(size), 0, size, f, last, s, at[25])
            load(pulls, wp.int64(count), 0, count, f, last, s, at[26])
            load(activity, wp.int64(count), 0, count, f, last, s, at[19])
            pull(plan, numbers, k, s, m)
            store(s, at[15], at[6], residual, wp.int64(at[6]), 0, f, last)
            forces(plan, numbers, k, s, m)
            turn(plan, numbers, k, s, m)
            store(s, at[16], at[17], slope, wp.int64(at[17]), 0, f, last)

    return SimpleNamespace(posed=posed, slopes=slopes)


@of_identities
def step_kernels(scalar: str, lanes: int, *, shared: bool) -> SimpleNamespace:
    """Poses after a step, and the doubt of twists."""
    number = getattr(wp, scalar)
    real, rows = wp.array(dtype=number), wp.array3d(dtype=number)
    body, width = solver_functions(scalar, lanes, shared=shared), lanes
    move, keep, doubt = body.move, body.keep, body.doubt
    (load, store), enter = transposing(scalar, lanes), _enter(scalar, lanes, shared=shared)
    row = row_of(scalar)
    module = wp.get_module(f"soma_pose_step_{scalar}_{lanes}_{'one' if shared else 'each'}")

    @wp.kernel(module=module, enable_backward=False)
    def moved(
        task: Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        softs: _ids, stiffs: real, longest: number,
        relative: real, hips: real, step: real, relative_out: real, hips_out: real,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(task.begin + w, task.end, memory.shape[0] * memory.shape[1]):
            f, last = g * width, task.frames - 1
            s, m, k = row(memory, w), row(kept, w), row(constants, g)
            enter(plan, numbers, k, s, m, at, f, last, relative, hips)
            load(step, wp.int64(at[17]), 0, at[17], f, last, s, at[16])
            keep(plan, numbers, k, s, m)
            move(plan, numbers, k, s, m, stiffs, 0, task.hinge_end, longest, task.apart)
            store(s, at[0], at[5], relative_out, wp.int64(at[5]), 0, f, last)
            store(s, at[1], 3, hips_out, wp.int64(3), 0, f, last)

    @wp.kernel(module=module, enable_backward=False)
    def doubted(
        task: Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        columns: _ids, spins: real, squares: rows,
        relative: real, turns: real, share: real, slope: real,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(task.begin + w, task.end, memory.shape[0] * memory.shape[1]):
            f, last = g * width, task.frames - 1
            s, m, k = row(memory, w), row(kept, w), row(constants, 0)
            load(relative, wp.int64(at[5]), 0, at[5], f, last, s, at[7])
            load(turns, wp.int64(at[12]), 0, at[5], f, last, s, at[11])
            own = row(squares, g)
            doubt(plan, numbers, k, s, m, columns, spins, own, task.soft_count)
            store(s, at[27], 1, share, wp.int64(1), 0, f, last)
            store(s, at[16], at[17], slope, wp.int64(at[17]), 0, f, last)

    return SimpleNamespace(moved=moved, doubted=doubted)


@of_identities
def factor_kernel(scalar: str, lanes: int, *, shared: bool):
    """The factorised matrix of the whole model."""
    number = getattr(wp, scalar)
    real, rows = wp.array(dtype=number), wp.array3d(dtype=number)
    body, width = solver_functions(scalar, lanes, shared=shared), lanes
    assemble, twists, modes = body.assemble, body.twists, body.modes
    factor, terms = body.factor, body.terms
    (load, _), enter = transposing(scalar, lanes), _enter(scalar, lanes, shared=shared)
    row = row_of(scalar)
    module = wp.get_module(f"soma_pose_factor_{scalar}_{lanes}_{'one' if shared else 'each'}")

    @wp.kernel(module=module, enable_backward=False)
    def factorise(
        task: Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        softs: _ids, stiffs: real, reference: rows, stiffness: number,
        relative: real, hips: real, damping: real, mass: real, activity: real, scale: real,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(task.begin + w, task.end, memory.shape[0] * memory.shape[1]):
            f, last = g * width, task.frames - 1
            s, m, k = row(memory, w), row(kept, g), row(constants, g)
            own = row(reference, g)
            enter(plan, numbers, k, s, m, at, f, last, relative, hips)
            load(damping, wp.int64(1), 0, 1, f, last, s, at[18])
            load(mass, wp.int64(1), 0, 1, f, last, s, at[4])
            assemble(plan, numbers, k, s, m)
            twists(plan, numbers, k, s, m)
            if at[20] > 0:
                load(activity, wp.int64(at[20]), 0, at[20], f, last, s, at[19])
                load(scale, wp.int64(1), 0, 1, f, last, s, at[21])
                modes(plan, numbers, k, s, m)
            terms(plan, numbers, k, s, m, softs, stiffs, own, task.soft_count, task.hinge_end, stiffness, 0)
            factor(plan, numbers, k, s, m)

    return factorise


@once
def solution_kernels(scalar: str, lanes: int) -> SimpleNamespace:
    """What a factorised matrix is asked for: solutions, and the variables' variances."""
    number = getattr(wp, scalar)
    real, rows = wp.array(dtype=number), wp.array3d(dtype=number)
    body, width = solver_functions(scalar, lanes, shared=True), lanes
    (load, store), solve, selected = transposing(scalar, lanes), body.solve, body.selected
    row = row_of(scalar)
    module = wp.get_module(f"soma_pose_solution_{scalar}_{lanes}")

    @wp.kernel(module=module, enable_backward=False)
    def solved(
        task: Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        slope: real, out: real,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(task.begin + w, task.end, memory.shape[0] * memory.shape[1]):
            f, last = g * width, task.frames - 1
            s, m, k = row(memory, w), row(kept, g), row(constants, 0)
            load(slope, wp.int64(at[17]), 0, at[17], f, last, s, at[16])
            solve(plan, numbers, k, s, m)
            store(s, at[16], at[17], out, wp.int64(at[17]), 0, f, last)

    @wp.kernel(module=module, enable_backward=False)
    def varied(
        task: Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids, out: real
    ):
        w, count = wp.tid(), at[17] // 3 - 1
        for g in range(task.begin + w, task.end, memory.shape[0] * memory.shape[1]):
            s, m, k = row(memory, w), row(kept, g), row(constants, 0)
            selected(plan, numbers, k, s, m)
            store(s, at[16], count, out, wp.int64(count), 0, g * width, task.frames - 1)

    return SimpleNamespace(solved=solved, varied=varied)
