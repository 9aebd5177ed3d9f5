"""Levenberg-Marquardt on moments in Warp: the twin of ``inversion.gauss_newton``.

One thread takes a group of frames through the whole solve; nothing returns to Python between steps. All
matrices are sparse by blocks, in the order of ``inversion.elimination``.
"""

import functools
from collections.abc import Mapping

import numpy as np
import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._gn_assembly import Plan, assembly_functions
from soma_core.kernels._gn_factor import factor_functions
from soma_core.kernels._gn_terms import term_functions, terms_struct
from soma_core.kernels._gn_tree import tree_functions
from soma_core.kernels._lanes import as_lanes, from_lanes, in_threads, lane_count, lane_types, to_lanes
from soma_core.kernels._runtime import launching, scalar_name

__all__ = ["GaussNewtonPlan", "gauss_newton"]


@functools.cache
def _kernel(scalar: str, lanes: int, *, shared: bool):
    types, tree = lane_types(scalar, lanes), tree_functions(scalar, lanes, shared=shared)
    real, vec, frames, constants = types.real, types.vec, tree.frames, tree.constants
    state, terms, term = _state(scalar, lanes), terms_struct(scalar, lanes), term_functions(scalar, lanes)
    change, accept, energy_change = _change(types, state), _accept(types, state), _energy_change(types, state)
    begin = _begin(tree, state, change)
    solve, move = _solve_step(scalar, lanes, shared=shared), _move(types, tree, state)
    module = wp.get_module(f"soma_gauss_newton_{scalar}_{lanes}_{'one' if shared else 'each'}")
    # Unrolled, the kernel takes three times as long to compile and is no faster.
    module.options.update({"enable_backward": False, "max_unroll": 2})

    @wp.kernel(module=module, enable_backward=False)
    def fit(
        plan: Plan, s: state, iterations: int, start_damping: real, lower: real, higher: real,
        most: real, longest: real, hinge: real, t: terms, second: constants, offsets: constants,
        threshold: frames, target: frames, relative: frames, hips: frames, accepted: frames,
        last_change: frames,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(w, target.shape[0], s.turns.shape[0]):
            begin(w, g, plan, second, offsets, target, relative, hips, s)
            damping = vec(start_damping)
            count = vec(real(0.0))
            energy = vec(real(0.0))
            # A lane rests once it has converged: what becomes of a frame does not depend on its neighbours.
            moving = vec(real(1.0))
            for _ in range(iterations):
                before = solve(w, g, plan, damping, hinge, second, t, s)
                move(w, plan, longest, s)
                tree.walk(
                    w, g, plan.parents, offsets, s.trial_relative, s.trial_hips, s.trial_turns, s.trial_places
                )
                change(w, plan, s.trial_turns, s.trial_places, s)
                tree.times_second(w, g, plan.pairs, second, s.change, s.product)
                gained = energy_change(w, s) - before
                gained += term.energy(w, g, plan, s.trial_relative, t, s.scratch)
                better = wp.cw_mul(moving, types.below(gained, real(0.0)))
                accept(w, better, s)
                count += better
                energy = types.choose(moving, gained, energy)
                damping = wp.cw_mul(damping, vec(higher) + (lower - higher) * better)
                damping = types.smaller(damping, vec(most))
                small = types.below(types.magnitude(gained) - threshold[g, 0], real(0.0))
                moving -= wp.cw_mul(moving, small)
                if types.total(moving) == real(0.0):
                    break
            for i in range(relative.shape[1]):
                relative[g, i] = s.relative[w, i]
            for r in range(3):
                hips[g, r] = s.hips[w, r]
            accepted[g, 0] = count
            last_change[g, 0] = energy

    return fit


def _begin(tree, state, change):
    frames, constants = tree.frames, tree.constants

    @wp.func
    def begin(
        w: int, g: int, plan: Plan, second: constants, offsets: constants, target: frames,
        relative: frames, hips: frames, s: state,
    ):  # fmt: skip
        """State of a group of frames at its start, with ``P = G N - R`` in `residual`."""
        for i in range(relative.shape[1]):
            s.relative[w, i] = relative[g, i]
            s.trial_relative[w, i] = relative[g, i]
        for r in range(3):
            s.hips[w, r] = hips[g, r]
        tree.walk(w, g, plan.parents, offsets, s.relative, s.hips, s.turns, s.places)
        change(w, plan, s.turns, s.places, s)
        tree.times_second(w, g, plan.pairs, second, s.trial, s.residual)
        for i in range(target.shape[1]):
            s.residual[w, i] -= target[g, i]

    return begin


def _solve_step(scalar: str, lanes: int, *, shared: bool):
    types, tree = lane_types(scalar, lanes), tree_functions(scalar, lanes, shared=shared)
    assembly, factor = assembly_functions(scalar, lanes, shared=shared), factor_functions(scalar, lanes)
    state, terms, term = _state(scalar, lanes), terms_struct(scalar, lanes), term_functions(scalar, lanes)
    real, vec, constants, damp = types.real, types.vec, tree.constants, _damp(types, state)

    @wp.func
    def solve(w: int, g: int, plan: Plan, damping: vec, hinge: real, second: constants, t: terms, s: state):
        """Assemble, damp, factorise and solve: minus the step in `slope`; returns the energy of the terms."""
        assembly.moments(w, g, plan, second, s.turns, s.places, s.column, s.blocks, s.root)
        assembly.finish(w, plan, s.blocks)
        assembly.forces(w, plan, s.turns, s.places, s.residual, s.spread, s.force, s.slope)
        energy = term.add(w, g, plan, s.relative, s.turns, t, s.scratch, s.blocks, s.slope)
        term.stiffen(w, plan, hinge, s.turns, t, s.scratch, s.blocks)
        damp(w, plan, damping, s)
        factor.factorise(w, plan, s.blocks, s.carry, s.last, s.inverse)
        factor.solve(w, plan, s.blocks, s.carry, s.last, s.inverse, s.slope)
        term.project(w, plan, s.turns, t, s.scratch, s.slope)
        return energy

    return solve


def _move(types, tree, state):
    real, vec = types.real, types.vec

    @wp.func
    def move(w: int, plan: Plan, longest: real, s: state):
        """The trial pose: every joint turned by its step, no further than `longest`, and the Hips shifted."""
        for k in range(plan.joint.shape[0]):
            x = -s.slope[w, 3 * k]
            y = -s.slope[w, 3 * k + 1]
            z = -s.slope[w, 3 * k + 2]
            length = types.root(wp.cw_mul(x, x) + wp.cw_mul(y, y) + wp.cw_mul(z, z))
            short = wp.cw_div(vec(longest), types.larger(length, vec(longest)))
            tree.retract(
                w, plan.joint[k], plan.parent[k], wp.cw_mul(x, short), wp.cw_mul(y, short),
                wp.cw_mul(z, short), s.turns, s.relative, s.trial_relative,
            )  # fmt: skip
        for r in range(3):
            s.trial_hips[w, r] = s.hips[w, r] - s.slope[w, 3 * plan.joint.shape[0] + r]

    return move


@functools.cache
def _state(scalar: str, lanes: int):
    """Working memory of each worker, one row a worker."""
    frames = wp.array2d(dtype=lane_types(scalar, lanes).vec)

    @wp.struct
    class State:
        relative: frames
        hips: frames
        turns: frames
        places: frames
        trial_relative: frames
        trial_hips: frames
        trial_turns: frames
        trial_places: frames
        trial: frames
        residual: frames
        change: frames
        product: frames
        column: frames
        blocks: frames
        root: frames
        carry: frames
        last: frames
        inverse: frames
        spread: frames
        force: frames
        slope: frames
        scratch: frames

    return State


def _damp(types, state):
    real, vec = types.real, types.vec

    @wp.func
    def damp(w: int, plan: Plan, damping: vec, s: state):
        """Rows of the translation, then Levenberg damping relative to the diagonal and a ridge."""
        count = plan.joint.shape[0]
        mass = vec(real(0.0))
        mean = vec(real(0.0))
        for k in range(count):
            if plan.parent_column[k] < 0:
                mass += s.root[w, 4 * k + 3]
            for r in range(3):
                s.carry[w, 9 * k + 4 * r] = vec(real(0.0))
                mean += s.blocks[w, 12 * plan.block_start[k] + 5 * r]
            s.carry[w, 9 * k + 1] = s.root[w, 4 * k + 2]
            s.carry[w, 9 * k + 2] = -s.root[w, 4 * k + 1]
            s.carry[w, 9 * k + 3] = -s.root[w, 4 * k + 2]
            s.carry[w, 9 * k + 5] = s.root[w, 4 * k]
            s.carry[w, 9 * k + 6] = s.root[w, 4 * k + 1]
            s.carry[w, 9 * k + 7] = -s.root[w, 4 * k]
        grow = vec(real(1.0)) + damping
        ridge = (real(1e-9) / real(3 * count + 3)) * (mean + real(3.0) * mass)
        for k in range(count):
            for r in range(3):
                d = 12 * plan.block_start[k] + 5 * r
                s.blocks[w, d] = wp.cw_mul(s.blocks[w, d], grow) + ridge
        for i in range(9):
            s.last[w, i] = vec(real(0.0))
        for r in range(3):
            s.last[w, 4 * r] = wp.cw_mul(mass, grow) + ridge

    return damp


def _change(types, state):
    frames = wp.array2d(dtype=types.vec)

    @wp.func
    def change(w: int, plan: Plan, turns: frames, places: frames, s: state):
        """Transforms of the weighted joints into `trial`, how far they moved into `change`."""
        for t in range(plan.weighted.shape[0]):
            j = plan.weighted[t]
            for r in range(3):
                for c in range(3):
                    s.trial[w, 12 * t + 4 * r + c] = turns[w, 9 * j + 3 * r + c]
                    s.change[w, 12 * t + 4 * r + c] = (
                        turns[w, 9 * j + 3 * r + c] - s.turns[w, 9 * j + 3 * r + c]
                    )
                s.trial[w, 12 * t + 4 * r + 3] = places[w, 3 * j + r]
                s.change[w, 12 * t + 4 * r + 3] = places[w, 3 * j + r] - s.places[w, 3 * j + r]

    return change


def _energy_change(types, state):
    real, vec = types.real, types.vec

    @wp.func
    def energy_change(w: int, s: state):
        """Exact change of the energy by the trial step, free of cancellation."""
        energy = vec(real(0.0))
        for i in range(s.change.shape[1]):
            energy += wp.cw_mul(s.change[w, i], s.product[w, i] + real(2.0) * s.residual[w, i])
        return energy

    return energy_change


def _accept(types, state):
    vec, choose = types.vec, types.choose

    @wp.func
    def accept(w: int, better: vec, s: state):
        """Take the trial in the lanes where `better` is one; keep the state where it is zero."""
        for i in range(s.change.shape[1]):
            s.residual[w, i] = choose(better, s.residual[w, i] + s.product[w, i], s.residual[w, i])
        for i in range(s.relative.shape[1]):
            s.relative[w, i] = choose(better, s.trial_relative[w, i], s.relative[w, i])
            s.turns[w, i] = choose(better, s.trial_turns[w, i], s.turns[w, i])
        for i in range(s.places.shape[1]):
            s.places[w, i] = choose(better, s.trial_places[w, i], s.places[w, i])
        for r in range(3):
            s.hips[w, r] = choose(better, s.trial_hips[w, r], s.hips[w, r])

    return accept


class GaussNewtonPlan:
    """The order of work of one rig on one device.

    Args:
        lists: name -> integers, for every field of :class:`Plan`.
    """

    def __init__(self, lists: Mapping[str, np.ndarray], device: torch.device) -> None:
        self.plan = Plan()
        with launching(torch.empty(0, device=device)) as where:
            for name, values in lists.items():
                setattr(self.plan, name, wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=where))
        self.joints, self.weighted = len(lists["parents"]), len(lists["weighted"])
        self.columns, self.slots = len(lists["joint"]), len(lists["block_row"])

    def state(self, scalar: str, lanes: int, workers: int, like: Tensor):
        """Working memory for `workers` threads."""
        j, t, n = self.joints, 12 * self.weighted, self.columns
        sizes = {
            "relative": 9 * j, "hips": 3, "turns": 9 * j, "places": 3 * j,
            "trial_relative": 9 * j, "trial_hips": 3, "trial_turns": 9 * j, "trial_places": 3 * j,
            "trial": t, "residual": t, "change": t, "product": t, "column": 16 * j,
            "blocks": 12 * self.slots, "root": 4 * n, "carry": 9 * n, "last": 9, "inverse": 3 * n + 3,
            "spread": 9 * j, "force": 3 * j, "slope": 3 * n + 3, "scratch": 8,
        }  # fmt: skip
        types, state, memory = lane_types(scalar, lanes), _state(scalar, lanes)(), {}
        for name, size in sizes.items():
            memory[name] = torch.zeros(workers, size, lanes, dtype=like.dtype, device=like.device)
            if name.endswith("turns"):
                memory[name][:, :9:4] = 1  # the root never turns
            setattr(state, name, wp.from_torch(memory[name], dtype=types.vec))
        return state, memory


def _terms(given: tuple[Mapping[str, Tensor], Tensor] | None, scalar: str, lanes: int, like: Tensor):
    """A function from a part of the groups to its terms; empty ones where none are given."""
    types, struct = lane_types(scalar, lanes), terms_struct(scalar, lanes)
    fields, mass = given if given is not None else ({}, like.new_ones(len(like)))
    count, hinged = len(fields.get("variable", ())), fields.get("hinge_axis", like.new_zeros(1, 3)).flip(0)
    none = like.new_zeros(1)  # Warp takes no empty array
    # Columns are the variable joints in descending order.
    column = len(hinged) - 1 - fields["variable"].to(torch.int32) if count else none.to(torch.int32)
    numbers = [(fields[name] if count else none).contiguous() for name in ("stiffness", "free")]
    reference = fields["reference"].expand(len(like), -1, 3, 3) if count else like.new_zeros(len(like), 1)
    groups = to_lanes(reference, lanes), to_lanes(mass[:, None], lanes)
    axis = hinged.contiguous().flatten()
    kept = column, numbers, groups, axis  # alive as long as the function

    def part_of(part: slice):
        terms = struct()
        terms.count, terms.hinges = count, len(hinged) if bool((hinged != 0).any()) else 0
        terms.column = wp.from_torch(kept[0], dtype=wp.int32)
        terms.stiffness, terms.free = (wp.from_torch(one) for one in kept[1])
        terms.axis = wp.from_torch(kept[3])
        terms.reference, terms.mass = (wp.from_torch(one[part], dtype=types.vec) for one in kept[2])
        return terms

    return part_of


def gauss_newton(
    plan: GaussNewtonPlan, target: Tensor, second: Tensor, offsets: Tensor, relative: Tensor, hips: Tensor,
    threshold: Tensor, *, iterations: int, damping: tuple[float, float, float, float], longest: float,
    hinge: float, terms: tuple[Mapping[str, Tensor], Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Refined rotations (F, J, 3, 3), Hips (F, 3) [m], accepted steps (F,), last energy change (F,) [m^2].

    Args:
        plan: index lists of the rig.
        target: ``R`` (F, T, 3, 4).
        second: ``N`` (1 or F, p, 4, 4).
        offsets: (1 or F, J, 3) [m].
        relative, hips: where to begin.
        threshold: (F,) a frame is done when a step changes its energy by less [m^2].
        iterations, damping (start, lower, raise, most), longest [rad], hinge: as in the torch twin.
        terms: fields of ``JointTerms``, and the sum of the vertex weights of each frame (F,).
    """
    count, scalar, lanes = len(target), scalar_name(target.dtype), lane_count(target)
    shared = len(second) == 1 and len(offsets) == 1
    types = lane_types(scalar, lanes)
    groups = [to_lanes(one, lanes) for one in (threshold[:, None], target, relative, hips)]
    if shared:
        constants = second.reshape(1, -1).contiguous(), offsets.reshape(1, -1).contiguous()
    else:
        each = (second.expand(count, *second.shape[1:]), offsets.expand(count, *offsets.shape[1:]))
        constants = tuple(to_lanes(one, lanes) for one in each)
    outputs = [groups[0].new_empty(len(groups[0]), 1, lanes) for _ in range(2)]
    kernel = _kernel(scalar, lanes, shared=shared)
    soft = _terms(terms, scalar, lanes, target)

    def run(part: slice) -> None:
        size = len(groups[0][part])
        workers = size if target.is_cuda else 1
        state, memory = plan.state(scalar, lanes, workers, target)
        numbers = [wp.from_torch(one) if shared else as_lanes(one[part], types) for one in constants]
        with launching(target) as device:
            wp.launch(
                kernel, dim=workers,
                inputs=[plan.plan, state, iterations, *damping, longest, hinge, soft(part), *numbers,
                        *(as_lanes(one[part], types) for one in (*groups, *outputs))],
                device=device,
            )  # fmt: skip
        del memory

    in_threads(run, len(groups[0]), target)
    accepted, last = (from_lanes(one, count, ()) for one in outputs)
    return (
        from_lanes(groups[2], count, relative.shape[1:]), from_lanes(groups[3], count, (3,)), accepted, last
    )  # fmt: skip
