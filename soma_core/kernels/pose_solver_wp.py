"""The pose solver in Warp: Levenberg-Marquardt on moments, and steps on the matrix of the whole model.

Frames lie in SIMD lanes; a thread takes a group of them through the whole solve, and nothing returns to
Python between steps. Matrices are sparse by blocks. The twins are ``inversion.gauss_newton`` and
``inversion.offsets``.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._lanes import (
    as_rows,
    frame_rows,
    lane_count,
    launch,
    row_of,
    worker_count,
    working_rows,
)
from soma_core.kernels._native import transposing
from soma_core.kernels._runtime import as_warp, scalar_name
from soma_core.kernels._solver_functions import Task, of_identities, solver_functions
from soma_core.kernels._solver_layout import COUNTS, EXTRA, LISTS, NUMBERS, slot_sizes
from soma_core.kernels._threads import in_threads
from soma_core.kernels.pose_steps_wp import factor_kernel, solution_kernels, step_kernels, tree_kernels

__all__ = ["Factor", "PoseSolver", "Soft"]

_ids = wp.array(dtype=wp.int32)


@of_identities
def _kernel(scalar: str, lanes: int, *, shared: bool):
    number = getattr(wp, scalar)
    real, rows = wp.array(dtype=number), wp.array3d(dtype=number)
    body, width = solver_functions(scalar, lanes, shared=shared), lanes
    (load, store), row = transposing(scalar, lanes), row_of(scalar)
    walk, change, copy, assemble, twists = body.walk, body.change, body.copy, body.assemble, body.twists
    forces, factor, solve, terms = body.forces, body.factor, body.solve, body.terms
    move, accept, still = body.move, body.accept, body.still
    module = wp.get_module(f"soma_pose_solver_{scalar}_{lanes}_{'one' if shared else 'each'}")

    @wp.kernel(module=module, enable_backward=False)
    def fit(
        task: Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        softs: _ids, stiffs: real, reference: rows, damping: real, longest: number, stiffness: number,
        target: real, relative: real, hips: real, threshold: real, mass: real,
        relative_out: real, hips_out: real, accepted: real, last_change: real,
    ):  # fmt: skip
        w, count, hinge_end = wp.tid(), task.soft_count, task.hinge_end
        for g in range(task.begin + w, task.end, memory.shape[0] * memory.shape[1]):
            f, last = g * width, task.frames - 1
            s, m, k = row(memory, w), row(kept, w), row(constants, g)
            own = row(reference, g)
            still(plan, numbers, k, s, m, damping[0])
            turn, moments = wp.int64(at[5]), wp.int64(at[6])
            load(relative, turn, 0, at[5], f, last, s, at[0])
            load(hips, wp.int64(3), 0, 3, f, last, s, at[1])
            load(target, moments, 0, at[6], f, last, s, at[2])
            load(threshold, wp.int64(1), 0, 1, f, last, s, at[3])
            load(mass, wp.int64(1), 0, 1, f, last, s, at[4])
            for step in range(task.iterations + 1):  # the first is the start: each function is put in once
                if step > 0:
                    assemble(plan, numbers, k, s, m)
                    twists(plan, numbers, k, s, m)
                    forces(plan, numbers, k, s, m)
                    terms(plan, numbers, k, s, m, softs, stiffs, own, count, hinge_end, stiffness, 0)
                    factor(plan, numbers, k, s, m)
                    solve(plan, numbers, k, s, m)
                    move(plan, numbers, k, s, m, stiffs, count, hinge_end, longest, task.apart)
                walk(plan, numbers, k, s, m, 1)
                change(plan, numbers, k, s, m, wp.where(step == 0, 1, 0))
                if step == 0:
                    copy(plan, numbers, k, s, m, task.forced)
                    continue
                terms(plan, numbers, k, s, m, softs, stiffs, own, count, hinge_end, stiffness, 1)
                if accept(plan, numbers, k, s, m, damping[1], damping[2], damping[3], damping[4]) == 0:
                    break
            store(s, at[7], at[5], relative_out, turn, 0, f, last)
            store(s, at[8], 3, hips_out, wp.int64(3), 0, f, last)
            store(s, at[9], 1, accepted, wp.int64(1), 0, f, last)
            store(s, at[10], 1, last_change, wp.int64(1), 0, f, last)

    return fit


class Soft(NamedTuple):
    """Terms of a fit as the kernels take them.

    Attributes:
        columns: (q,) int32 column of each term's joint.
        numbers: stiffness (q,), free angle (q,), hinge axis (3 columns,) in one.
        reference: (1 or F, q, 3, 3).
        hinged: whether any joint is a hinge.
    """

    columns: Tensor
    numbers: Tensor
    reference: Tensor
    hinged: bool


class Factor(NamedTuple):
    """A factorised matrix of F frames; :meth:`PoseSolver.solve` takes it."""

    kept: Tensor
    count: int


class PoseSolver:
    """Kernels of one rig: its lists on a device, and launches.

    Args:
        counts, lists, numbers: of ``inversion.tables``.
        dtype, device: of the state.
    """

    def __init__(
        self, counts: Mapping[str, int], lists: Mapping[str, np.ndarray], numbers: Mapping[str,
        np.ndarray], *,
        dtype: torch.dtype, device: torch.device,
    ) -> None:  # fmt: skip
        self.counts = counts = {name: int(counts.get(name, 0)) for name in (*COUNTS, *EXTRA)}
        slots, c = slot_sizes(counts), counts["column_count"]
        kept = {"blocks": 12 * counts["slot_count"], "carry": 9 * c, "last": 9, "inverse": 3 * c + 3}
        header = len(COUNTS) + len(LISTS) + len(NUMBERS) + len(slots) + len(kept)
        values = [np.asarray(lists.get(name, ()), np.int32).ravel() for name in LISTS]
        reals = [np.asarray(numbers.get(name, ()), np.float64).ravel() for name in NUMBERS]
        starts = (
            header + _before(values), _before(reals), _before(list(slots.values())),
            _before(list(kept.values())),
        )  # fmt: skip
        plan = np.concatenate([[counts[name] for name in COUNTS], *starts, *values, [0]]).astype(np.int32)
        self.plan = torch.as_tensor(plan, device=device)
        self.numbers = torch.as_tensor(np.concatenate([*reals, [0.0]])).to(device, dtype)
        place = dict(zip(slots, starts[2].tolist(), strict=True))
        d = counts["driven_count"]
        at = (
            place["trial_relative"], place["trial_hips"], place["target"], place["threshold"], place["mass"],
            9 * counts["joint_count"], 12 * counts["weighted_count"], place["relative"], place["hips"],
            place["accepted"], place["last_change"], place["turns"], 9 * counts["all_count"], place["places"],
            3 * counts["all_count"], place["residual"], place["slope"] + 3 * d, 3 * (c - d) + 3,
            place["damping"],
            place["activity"], counts["activation_count"], place["scale"], place["transform"],
            place["active"], place["before"], place["push"], place["pull"], place["gained"],
            place["typical"], place["gradient"], place["fresh"] - place["gradient"],
        )  # fmt: skip
        self.at = torch.tensor(at, dtype=torch.int32, device=device)
        self.memory, self.kept = sum(slots.values()), sum(kept.values())
        self.driven, self.columns, self.under_way = d, c, at[-1]
        self._sent: dict[tuple[float, ...], Tensor] = {}

    def constants(self, *parts: Tensor) -> tuple[Tensor, bool]:
        """Numbers of identities in one: (1, 1, size) of one for all frames, else those of each."""
        shared = all(len(part) == 1 for part in parts)
        count = max(len(part) for part in parts)
        flat = torch.cat([part.flatten(1).expand(count, -1) for part in parts], 1).contiguous()
        return (flat[:, None], True) if shared else (frame_rows(flat, lane_count(flat)), False)

    def fit(
        self, constants: tuple[Tensor, bool], target: Tensor, relative: Tensor, hips: Tensor,
        threshold: Tensor,
        mass: Tensor, *, forced: bool, iterations: int, damping: tuple[float, ...], longest: float,
        stiffness: float, soft: Soft, apart: bool = False,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        """Rotations (F, J, 3, 3), Hips (F, 3) [m], accepted steps (F,), last change of the energy (F,) [m^2].

        Args:
            constants: of :meth:`constants`.
            target: ``R`` (F, T, 3, 4); with `forced` the residual's moments at the start.
            relative, hips: where to begin.
            threshold: (F,) a frame is done when a step changes its energy by less [m^2].
            mass: (F,) sums of the vertex weights.
            iterations, damping (start, lower, raise, least, most), longest [rad],
            stiffness, apart: as in the torch twin.
            soft: terms.
        """
        outputs = [
            torch.empty_like(relative, memory_format=torch.contiguous_format),
            hips.new_empty(hips.shape),
        ]
        outputs += [mass.new_empty(len(hips)) for _ in range(2)]
        like = relative
        kernel = _kernel(scalar_name(like.dtype), lane_count(like), shared=constants[1])
        numbers = self._on_device(damping, like)
        given, _kept = self._soft(soft)
        frames = [one.contiguous() for one in (target, relative, hips, threshold, mass)]
        self.launch(
            kernel, constants[0], like,
            (*given, as_warp(numbers), longest, stiffness, *map(as_warp, frames), *map(as_warp, outputs)),
            task={"iterations": iterations, "forced": int(forced), "soft_count": len(soft.columns),
                  "hinge_end": self.columns if soft.hinged else self.driven, "apart": int(apart)},
        )  # fmt: skip
        return tuple(outputs)

    def _on_device(self, numbers: tuple[float, ...], like: Tensor) -> Tensor:
        """Few numbers, sent once."""
        if numbers not in self._sent:
            self._sent[numbers] = like.new_tensor(numbers)
        return self._sent[numbers]

    def walked(self, constants: tuple[Tensor, bool], relative: Tensor, hips: Tensor) -> tuple[Tensor, Tensor]:
        """World turns (F, J', 3, 3) and places (F, J', 3) of all joints."""
        return self._posed(constants, relative, hips, whole=False)[:2]

    def posed(
        self, constants: tuple[Tensor, bool], relative: Tensor, hips: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What :meth:`walked` gives, and what poses give the model's residual.

        Returns:
            Turns and places; ``G B^-1`` (F, J', 3, 4) of all joints; activations (F, C), what goes into them,
            and their slopes.
        """
        return self._posed(constants, relative, hips, whole=True)

    def _posed(self, constants, relative, hips, *, whole: bool):
        count, frames, few = self.counts["all_count"], len(hips), self.counts["activation_count"]
        turns, places = relative.new_empty(frames, count, 3, 3), hips.new_empty(frames, count, 3)
        transforms = relative.new_empty(frames if whole else 0, count, 3, 4)
        activations = [relative.new_empty(frames if whole else 0, few) for _ in range(3)]
        kernel = self._tree(relative, constants).posed
        given = relative.contiguous(), hips.contiguous(), turns, places, transforms, *activations
        self.launch(kernel, constants[0], relative, tuple(map(as_warp, given)), task={"outcome": int(whole)})
        return turns, places, transforms, *activations

    def slopes(
        self, constants: tuple[Tensor, bool], relative: Tensor, hips: Tensor, forces: Tensor,
        pull: Tensor | None, activity: Tensor | None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Half the slope (F, n + 1, 3) of the error, and the moments ``P`` (F, T, 3, 4) of what is left.

        Args:
            constants, relative, hips: of :meth:`posed`.
            forces: half the slope in the transforms, (F, J', 3, 4).
            pull: half the slope in the activations, (F, C); None without.
            activity: slopes of the activations, of :meth:`posed`; None without.
        """
        size = self.columns - self.driven + 1
        slope = hips.new_empty(len(hips), size, 3)
        residual = hips.new_empty(len(hips), self.counts["weighted_count"], 3, 4)
        none = hips.new_empty(len(hips), 0)
        frames = [relative, hips, forces, *(none if one is None else one for one in (pull, activity))]
        given = *(one.contiguous() for one in frames), slope, residual
        kernel = self._tree(relative, constants).slopes
        self.launch(kernel, constants[0], relative, tuple(map(as_warp, given)))
        return _ascending(slope), residual

    def moved(
        self, constants: tuple[Tensor, bool], relative: Tensor, hips: Tensor, step: Tensor, *, longest: float
    ) -> tuple[Tensor, Tensor]:
        """Poses after a step (F, n + 1, 3); hinges are as the step has them."""
        outputs = torch.empty_like(relative, memory_format=torch.contiguous_format), torch.empty_like(hips)
        given = relative.contiguous(), hips.contiguous(), _ascending(step).contiguous(), *outputs
        none = relative.new_zeros(1)
        softs = torch.zeros(1, dtype=torch.int32, device=relative.device)
        self.launch(
            step_kernels(scalar_name(relative.dtype), lane_count(relative), shared=constants[1]).moved,
            constants[0], relative,
            (as_warp(softs), as_warp(none), longest, *map(as_warp, given)), task={"hinge_end": self.driven},
        )  # fmt: skip
        return outputs

    def doubted(
        self, relative: Tensor, turns: Tensor, columns: Tensor, axes: Tensor, squares: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Doubt (F,) of joints' twists, and half its derivative (F, n + 1, 3) by the variables.

        Args:
            relative: (F, J, 3, 3).
            turns: of all joints in the world, (F, J', 3, 3).
            columns: (q,) int32 column of each joint.
            axes: (q, 3) of each twist.
            squares: (1 or F, q) of the doubt [1/rad^2].
        """
        share = relative.new_empty(len(relative))
        slope = relative.new_empty(len(relative), self.columns - self.driven + 1, 3)
        lanes = lane_count(relative)
        given = columns, axes.contiguous(), relative.contiguous(), turns.contiguous(), share, slope
        rows, shown = frame_rows(squares, lanes), tuple(map(as_warp, given))
        kernel = step_kernels(scalar_name(relative.dtype), lanes, shared=True).doubted
        shown = *shown[:2], as_rows(rows), *shown[2:]
        self.launch(kernel, relative.new_zeros(1, 1, 1), relative, shown, task={"soft_count": len(columns)})
        return share, _ascending(slope)

    @staticmethod
    def _tree(like: Tensor, constants: tuple[Tensor, bool]):
        return tree_kernels(scalar_name(like.dtype), lane_count(like), shared=constants[1])

    def factorise(
        self, constants: tuple[Tensor, bool], relative: Tensor, hips: Tensor, damping: Tensor, mass: Tensor,
        activity: Tensor | None, scale: Tensor | None, *, stiffness: float, soft: Soft,
    ) -> Factor:  # fmt: skip
        """The damped Gauss-Newton matrix of F poses, factorised."""
        lanes = lane_count(relative)
        groups = -(-len(hips) // lanes)
        kept = working_rows(relative, groups, self.kept, lanes)
        kernel = factor_kernel(scalar_name(relative.dtype), lanes, shared=constants[1])
        none = relative.new_zeros(1)
        frames = [one.contiguous() for one in (relative, hips, damping, mass)]
        frames += [none if one is None else one.contiguous() for one in (activity, scale)]
        given, _kept = self._soft(soft)
        self.launch(
            kernel, constants[0], relative, (*given, stiffness, *map(as_warp, frames)), kept=kept,
            task={"soft_count": len(soft.columns), "hinge_end": self.columns if soft.hinged else self.driven},
        )  # fmt: skip
        return Factor(kept=kept, count=len(hips))

    def solve(self, factor: Factor, slope: Tensor) -> Tensor:
        """Solution (F, n + 1, 3) for right-hand sides of the same shape."""
        given = _ascending(slope).contiguous()
        out = torch.empty_like(given)
        kernel = solution_kernels(scalar_name(slope.dtype), lane_count(slope)).solved
        none = slope.new_zeros(1, 1, 1)
        self.launch(kernel, none, slope, (as_warp(given), as_warp(out)), kept=factor.kept)
        return _ascending(out)

    def variances(self, factor: Factor) -> Tensor:
        """Traces (F, n) of the variables' own blocks of the matrix's inverse, ascending."""
        out = factor.kept.new_empty(factor.count, self.columns - self.driven)
        kernel = solution_kernels(scalar_name(out.dtype), lane_count(out)).varied
        self.launch(kernel, out.new_zeros(1, 1, 1), out, (as_warp(out),), kept=factor.kept)
        return out.flip(1)

    def _soft(self, soft: Soft):
        columns = soft.columns if len(soft.columns) else soft.columns.new_zeros(1)
        reference = soft.reference if len(soft.columns) else soft.numbers.new_zeros(1, 1)
        kept = columns, soft.numbers, frame_rows(reference.flatten(1), lane_count(reference))
        return (as_warp(columns), as_warp(soft.numbers), as_rows(kept[2])), kept

    def launch(self, kernel, constants: Tensor, like: Tensor, given: tuple, *, kept=None, task=None) -> None:
        """Start a kernel of the solver's tables and memory on the frames of `like`."""
        lanes = lane_count(like)
        frames = len(like)
        groups = -(-frames // lanes)

        def run(part: slice) -> None:
            workers = worker_count(part.stop - part.start, lanes)
            memory = working_rows(like, workers, self.memory, lanes)
            own = working_rows(like, workers, self.kept, lanes) if kept is None else kept
            numbers = Task()
            numbers.begin, numbers.end, numbers.frames = part.start, part.stop, frames
            for name, value in (task or {}).items():
                setattr(numbers, name, value)
            tables = as_warp(self.plan), as_warp(self.numbers), as_rows(constants)
            inputs = [numbers, *tables, as_rows(memory), as_rows(own), as_warp(self.at), *given]
            launch(kernel, workers, inputs, like)

        in_threads(run, groups, like)


def _before(sizes) -> np.ndarray:
    """Where each of consecutive parts begins."""
    lengths = [len(one) if isinstance(one, np.ndarray) else one for one in sizes]
    return np.concatenate([[0], np.cumsum(lengths)])[:-1].astype(np.int64)


def _ascending(rows: Tensor) -> Tensor:
    """Rows of variables, ascending, from those of columns, descending, or back; the translation last."""
    return torch.cat((rows[:, :-1].flip(1), rows[:, -1:]), 1)
