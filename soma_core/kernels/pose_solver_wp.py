"""The pose solver in Warp: Levenberg-Marquardt on moments, and steps on the matrix of the whole model.

Frames lie in SIMD lanes; a thread takes a group of them through the whole solve, and nothing returns to Python
between steps. Matrices are sparse by blocks. The twins are ``inversion.gauss_newton`` and ``inversion.offsets``.
"""

import functools
from collections.abc import Mapping
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from soma_core.kernels import _solver_text as text
from soma_core.kernels import _variance_text as variance
from soma_core.kernels._lanes import in_threads, lane_count, to_lanes
from soma_core.kernels._native import native, transposing
from soma_core.kernels._runtime import as_warp, launching, scalar_name

__all__ = ["Factor", "PoseSolver", "Soft"]

_ids = wp.array(dtype=wp.int32)

_COUNTS = (
    "joint_count", "all_count", "weighted_count", "pair_count", "column_count", "driven_count", "slot_count",
    "channel_count", "helper_count", "add_count", "twist_count", "chain_count", "twist_rows", "block_count",
    "feature_columns", "used_count",
)  # fmt: skip
_LISTS = (
    "parents", "weighted", "pairs", "joint", "parent", "parent_column", "near_start", "near_joint", "near_pair",
    "near_flip", "row_start", "row_joint", "row_parent", "row_slot", "push_start", "push_source", "push_target",
    "block_start", "block_row", "update_start", "update_target",
    "channel_joint", "channel_reference", "mix_start", "mix_channel", "drive_start", "drive_row", "drive_slot",
    "cross_start", "cross_row", "cross_slot", "add_slot", "add_pair", "add_channel", "twist_slot", "twist_channel",
    "twist_block", "twist_kind", "chain_channel", "chain_column",
    "mode_size", "taken_start", "taken", "read_start", "read_used", "read_column", "response_start", "tree_start",
    "tree_joint", "tree_up", "tree_row", "cloud_start", "cloud_tree", "cloud_weighted", "fold_start", "fold_tree", "fold_helper",
    "fold_channel", "fold_row", "mode_row_count", "apply_start", "apply_row", "apply_read", "apply_block",
    "apply_kind", "near_start_mode", "near_block", "near_rows", "used_joint",
)  # fmt: skip
_NUMBERS = (
    "mix_value", "drive_value", "cross_value", "spin_axis", "gate", "mode", "cloud_moment", "fold_value", "gram",
    "left", "right",
)  # fmt: skip
_KEPT = ("blocks", "carry", "last", "inverse")


def _slot_sizes(n: Mapping[str, int]) -> dict[str, int]:
    """Vectors of working memory by name."""
    a, t, k, c = n["all_count"], 12 * n["weighted_count"], n["channel_count"], n["column_count"]
    return {
        "relative": 9 * a, "trial_relative": 9 * a, "turns": 9 * a, "trial_turns": 9 * a,
        "places": 3 * a, "trial_places": 3 * a, "hips": 3, "trial_hips": 3,
        "steer": 3 * k, "trial_steer": 3 * k, "twist": k,
        "change": t, "product": t, "residual": t, "target": t, "column": 16 * a, "root": 4 * c,
        "spread": 9 * a, "force": 3 * a, "slope": 3 * c + 3, "twists": 3 * n["twist_rows"],
        "twist_force": 3 * k, "twist_pair": k * k, "helper_axis": 3 * n["helper_count"],
        "gained": 1, "damping": 1, "moving": 1, "accepted": 1, "last_change": 1, "threshold": 1, "mass": 1,
        "soft_energy": 1, "scale": 1, "activity": n["activation_count"],
        "features": 9 * n["feature_columns"] * n["used_count"], "response": n["response_size"],
        "mode_rows": n["mode_rows"], "mode_tree": n["mode_tree"], "mode_force": 9 * c if n["block_count"] else 0,
        "selected": 9 * (n["slot_count"] + c + 1),
    }  # fmt: skip


_SLOTS = tuple(
    _slot_sizes(dict.fromkeys((*_COUNTS, "activation_count", "response_size", "mode_rows", "mode_tree"), 0))
)


@functools.cache
def _bodies(scalar: str, lanes: int, *, shared: bool) -> SimpleNamespace:
    real = wp.array(dtype=getattr(wp, scalar))
    number = getattr(wp, scalar)
    begin = text.prelude(_COUNTS, _LISTS, _NUMBERS, _SLOTS, _KEPT, shared=shared)

    def made(body: str, stub):
        stub.__name__ += "_one" if shared else "_each"
        return native(begin + body, scalar, lanes, stub)

    def walk(plan: _ids, numbers: real, k: real, s: real, f: real, trial: int): ...

    def change(plan: _ids, numbers: real, k: real, s: real, f: real, begin: int): ...

    def copy(plan: _ids, numbers: real, k: real, s: real, f: real, forced: int): ...

    def assemble(plan: _ids, numbers: real, k: real, s: real, f: real): ...

    def twists(plan: _ids, numbers: real, k: real, s: real, f: real): ...

    def forces(plan: _ids, numbers: real, k: real, s: real, f: real): ...

    def modes(plan: _ids, numbers: real, k: real, s: real, f: real): ...

    def factor(plan: _ids, numbers: real, k: real, s: real, f: real): ...

    def solve(plan: _ids, numbers: real, k: real, s: real, f: real): ...

    def selected(plan: _ids, numbers: real, k: real, s: real, f: real): ...

    def terms(
        plan: _ids, numbers: real, k: real, s: real, f: real, softs: _ids, stiffs: real, reference: real,
        soft_count: int, hinge_end: int, stiffness: number, trial: int,
    ): ...  # fmt: skip

    def move(
        plan: _ids, numbers: real, k: real, s: real, f: real, stiffs: real, soft_count: int, hinge_end: int,
        longest: number,
    ): ...  # fmt: skip

    def accept(
        plan: _ids, numbers: real, k: real, s: real, f: real, lower: number, higher: number, least: number,
        most: number,
    ) -> int:  # fmt: skip
        return 0

    def root_turn(plan: _ids, numbers: real, k: real, s: real, f: real, damping_start: number): ...

    still = """
        for (int i = 0; i < 9; i++) {
            turns[i] = trial_turns[i] = relative[i] = trial_relative[i] = i % 4 ? zero : one;
        }
        for (int r = 0; r < 3; r++) places[r] = trial_places[r] = zero;
        damping[0] = zero + damping_start; moving[0] = one; accepted[0] = zero; soft_energy[0] = zero;
    """
    bodies = {
        "walk": (text.WALK, walk), "change": (text.CHANGE, change), "copy": (text.BEGIN, copy),
        "assemble": (text.ASSEMBLE, assemble), "twists": (text.TWISTS, twists), "forces": (text.FORCES, forces),
        "modes": (text.MODES, modes), "factor": (text.FACTOR, factor), "solve": (text.SOLVE, solve),
        "terms": (text.TERMS, terms), "move": (text.MOVE, move), "accept": (text.ACCEPT, accept),
        "still": (still, root_turn), "selected": (variance.SELECTED, selected),
    }  # fmt: skip
    return SimpleNamespace(**{name: made(*given) for name, given in bodies.items()})


@wp.struct
class _Task:
    """Counts of one launch; groups begin .. end of frames."""

    begin: int
    end: int
    frames: int
    iterations: int
    forced: int
    soft_count: int
    hinge_end: int
    outcome: int


_FIT, _FACTOR, _WALKED, _SLOPES = 0, 1, 2, 3


@functools.cache
def _kernel(scalar: str, lanes: int, *, shared: bool):
    real, rows, number = wp.array(dtype=getattr(wp, scalar)), wp.array2d(dtype=getattr(wp, scalar)), getattr(wp, scalar)
    body, width = _bodies(scalar, lanes, shared=shared), lanes
    load, store = transposing(scalar, lanes)
    walk, change, copy, assemble, twists = body.walk, body.change, body.copy, body.assemble, body.twists
    forces, factor, solve, terms, move, accept = body.forces, body.factor, body.solve, body.terms, body.move, body.accept
    still = body.still
    module = wp.get_module(f"soma_pose_solver_{scalar}_{lanes}_{'one' if shared else 'each'}")

    @wp.kernel(module=module, enable_backward=False)
    def fit(
        task: _Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        softs: _ids, stiffs: real, reference: rows, damping: real, longest: number, stiffness: number,
        target: real, relative: real, hips: real, threshold: real, mass: real,
        relative_out: real, hips_out: real, accepted: real, last_change: real,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(task.begin + w, task.end, memory.shape[0]):
            f, last = g * width, task.frames - 1
            s, m, k = memory[w], kept[w], constants[wp.min(g, constants.shape[0] - 1)]
            own = reference[wp.min(g, reference.shape[0] - 1)]
            still(plan, numbers, k, s, m, damping[0])
            turn, moments = wp.int64(at[5]), wp.int64(at[6])
            load(relative, turn, 0, at[5], f, last, s, at[0])
            load(hips, wp.int64(3), 0, 3, f, last, s, at[1])
            load(target, moments, 0, at[6], f, last, s, at[2])
            load(threshold, wp.int64(1), 0, 1, f, last, s, at[3])
            load(mass, wp.int64(1), 0, 1, f, last, s, at[4])
            walk(plan, numbers, k, s, m, 1)
            change(plan, numbers, k, s, m, 1)
            copy(plan, numbers, k, s, m, task.forced)
            for _ in range(task.iterations):
                assemble(plan, numbers, k, s, m)
                twists(plan, numbers, k, s, m)
                forces(plan, numbers, k, s, m)
                terms(plan, numbers, k, s, m, softs, stiffs, own, task.soft_count, task.hinge_end, stiffness, 0)
                factor(plan, numbers, k, s, m)
                solve(plan, numbers, k, s, m)
                move(plan, numbers, k, s, m, stiffs, task.soft_count, task.hinge_end, longest)
                walk(plan, numbers, k, s, m, 1)
                change(plan, numbers, k, s, m, 0)
                terms(plan, numbers, k, s, m, softs, stiffs, own, task.soft_count, task.hinge_end, stiffness, 1)
                if accept(plan, numbers, k, s, m, damping[1], damping[2], damping[3], damping[4]) == 0:
                    break
            store(s, at[7], at[5], relative_out, turn, 0, f, last)
            store(s, at[8], 3, hips_out, wp.int64(3), 0, f, last)
            store(s, at[9], 1, accepted, wp.int64(1), 0, f, last)
            store(s, at[10], 1, last_change, wp.int64(1), 0, f, last)

    return fit


@functools.cache
def _step_kernels(scalar: str, lanes: int, *, shared: bool) -> SimpleNamespace:
    """Kernels of single steps: the tree, slopes, and the factorised matrix of the whole model."""
    real, rows, number = wp.array(dtype=getattr(wp, scalar)), wp.array2d(dtype=getattr(wp, scalar)), getattr(wp, scalar)
    body, width = _bodies(scalar, lanes, shared=shared), lanes
    load, store = transposing(scalar, lanes)
    walk, assemble, twists, forces, modes = body.walk, body.assemble, body.twists, body.forces, body.modes
    factor, solve, terms, still, selected = body.factor, body.solve, body.terms, body.still, body.selected
    module = wp.get_module(f"soma_pose_steps_{scalar}_{lanes}_{'one' if shared else 'each'}")

    @wp.func
    def enter(
        plan: _ids, numbers: real, k: real, s: real, m: real, at: _ids, f: int, last: int, relative: real, hips: real
    ):
        still(plan, numbers, k, s, m, number(0.0))
        load(relative, wp.int64(at[5]), 0, at[5], f, last, s, at[7])
        load(hips, wp.int64(3), 0, 3, f, last, s, at[8])
        walk(plan, numbers, k, s, m, 0)

    @wp.kernel(module=module, enable_backward=False)
    def walked(
        task: _Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        relative: real, hips: real, turns: real, places: real,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(task.begin + w, task.end, memory.shape[0]):
            f, last = g * width, task.frames - 1
            s, m, k = memory[w], kept[w], constants[wp.min(g, constants.shape[0] - 1)]
            enter(plan, numbers, k, s, m, at, f, last, relative, hips)
            store(s, at[11], at[12], turns, wp.int64(at[12]), 0, f, last)
            store(s, at[13], at[14], places, wp.int64(at[14]), 0, f, last)

    @wp.kernel(module=module, enable_backward=False)
    def slopes(
        task: _Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        relative: real, hips: real, residual: real, slope: real,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(task.begin + w, task.end, memory.shape[0]):
            f, last = g * width, task.frames - 1
            s, m, k = memory[w], kept[w], constants[wp.min(g, constants.shape[0] - 1)]
            enter(plan, numbers, k, s, m, at, f, last, relative, hips)
            load(residual, wp.int64(at[6]), 0, at[6], f, last, s, at[15])
            forces(plan, numbers, k, s, m)
            store(s, at[16], at[17], slope, wp.int64(at[17]), 0, f, last)

    @wp.kernel(module=module, enable_backward=False)
    def factorise(
        task: _Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        softs: _ids, stiffs: real, reference: rows, stiffness: number,
        relative: real, hips: real, damping: real, mass: real, activity: real, scale: real,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(task.begin + w, task.end, memory.shape[0]):
            f, last = g * width, task.frames - 1
            s, m, k = memory[w], kept[g], constants[wp.min(g, constants.shape[0] - 1)]
            own = reference[wp.min(g, reference.shape[0] - 1)]
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

    @wp.kernel(module=module, enable_backward=False)
    def solved(
        task: _Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids, slope: real,
        out: real,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(task.begin + w, task.end, memory.shape[0]):
            f, last = g * width, task.frames - 1
            s, m, k = memory[w], kept[g], constants[0]
            load(slope, wp.int64(at[17]), 0, at[17], f, last, s, at[16])
            solve(plan, numbers, k, s, m)
            store(s, at[16], at[17], out, wp.int64(at[17]), 0, f, last)

    @wp.kernel(module=module, enable_backward=False)
    def varied(
        task: _Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids, out: real
    ):
        w, count = wp.tid(), at[17] // 3 - 1
        for g in range(task.begin + w, task.end, memory.shape[0]):
            s, m, k = memory[w], kept[g], constants[0]
            selected(plan, numbers, k, s, m)
            store(s, at[16], count, out, wp.int64(count), 0, g * width, task.frames - 1)

    return SimpleNamespace(walked=walked, slopes=slopes, factorise=factorise, solved=solved, varied=varied)


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
        self, counts: Mapping[str, int], lists: Mapping[str, np.ndarray], numbers: Mapping[str, np.ndarray], *,
        dtype: torch.dtype, device: torch.device,
    ) -> None:  # fmt: skip
        extra = ("activation_count", "response_size", "mode_rows", "mode_tree")
        self.counts = counts = {name: int(counts.get(name, 0)) for name in (*_COUNTS, *extra)}
        slots, c = _slot_sizes(counts), counts["column_count"]
        kept = {"blocks": 12 * counts["slot_count"], "carry": 9 * c, "last": 9, "inverse": 3 * c + 3}
        header = len(_COUNTS) + len(_LISTS) + len(_NUMBERS) + len(slots) + len(kept)
        values = [np.asarray(lists.get(name, ()), np.int32).ravel() for name in _LISTS]
        reals = [np.asarray(numbers.get(name, ()), np.float64).ravel() for name in _NUMBERS]
        starts = (
            header + _before(values), _before(reals), _before(list(slots.values())), _before(list(kept.values())),
        )  # fmt: skip
        plan = np.concatenate([[counts[name] for name in _COUNTS], *starts, *values, [0]]).astype(np.int32)
        self.plan = torch.as_tensor(plan, device=device)
        self.numbers = torch.as_tensor(np.concatenate([*reals, [0.0]])).to(device, dtype)
        place = dict(zip(slots, starts[2].tolist(), strict=True))
        d = counts["driven_count"]
        at = (
            place["trial_relative"], place["trial_hips"], place["target"], place["threshold"], place["mass"],
            9 * counts["joint_count"], 12 * counts["weighted_count"], place["relative"], place["hips"],
            place["accepted"], place["last_change"], place["turns"], 9 * counts["all_count"], place["places"],
            3 * counts["all_count"], place["residual"], place["slope"] + 3 * d, 3 * (c - d) + 3, place["damping"],
            place["activity"], counts["activation_count"], place["scale"],
        )  # fmt: skip
        self.at = torch.tensor(at, dtype=torch.int32, device=device)
        self.memory, self.kept = sum(slots.values()), sum(kept.values())
        self.driven, self.columns = d, c

    def constants(self, *parts: Tensor) -> tuple[Tensor, bool]:
        """Numbers of identities in one: (1, size) of one for all frames, else (groups, size x lanes)."""
        shared = all(len(part) == 1 for part in parts)
        count = max(len(part) for part in parts)
        flat = torch.cat([part.flatten(1).expand(count, -1) for part in parts], 1).contiguous()
        return (flat, True) if shared else (to_lanes(flat, lane_count(flat)).flatten(1), False)

    def fit(
        self, constants: tuple[Tensor, bool], target: Tensor, relative: Tensor, hips: Tensor, threshold: Tensor,
        mass: Tensor, *, forced: bool, iterations: int, damping: tuple[float, ...], longest: float,
        stiffness: float, soft: Soft,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        """Refined rotations (F, J, 3, 3), Hips (F, 3) [m], accepted steps (F,), last energy change (F,) [m^2].

        Args:
            constants: of :meth:`constants`.
            target: ``R`` (F, T, 3, 4); with `forced` the residual's moments at the start.
            relative, hips: where to begin.
            threshold: (F,) a frame is done when a step changes its energy by less [m^2].
            mass: (F,) sums of the vertex weights.
            iterations, damping (start, lower, raise, least, most), longest [rad], stiffness: as in the torch twin.
            soft: terms.
        """
        outputs = [torch.empty_like(relative, memory_format=torch.contiguous_format), hips.new_empty(hips.shape)]
        outputs += [mass.new_empty(len(hips)) for _ in range(2)]
        like = relative
        kernel = _kernel(scalar_name(like.dtype), lane_count(like), shared=constants[1])
        numbers = like.new_tensor(damping)
        given, _kept = self._soft(soft)
        frames = [one.contiguous() for one in (target, relative, hips, threshold, mass)]
        self._launch(
            kernel, constants[0], like,
            (*given, as_warp(numbers), longest, stiffness, *map(as_warp, frames), *map(as_warp, outputs)),
            task={"iterations": iterations, "forced": int(forced), "soft_count": len(soft.columns),
                  "hinge_end": self.columns if soft.hinged else self.driven},
        )  # fmt: skip
        return tuple(outputs)

    def walked(self, constants: tuple[Tensor, bool], relative: Tensor, hips: Tensor) -> tuple[Tensor, Tensor]:
        """World turns (F, J', 3, 3) and places (F, J', 3) of all joints."""
        count = self.counts["all_count"]
        turns, places = relative.new_empty(len(hips), count, 3, 3), hips.new_empty(len(hips), count, 3)
        kernel = _step_kernels(scalar_name(relative.dtype), lane_count(relative), shared=constants[1]).walked
        frames = relative.contiguous(), hips.contiguous()
        self._launch(kernel, constants[0], relative, tuple(map(as_warp, (*frames, turns, places))))
        return turns, places

    def slopes(
        self, constants: tuple[Tensor, bool], relative: Tensor, hips: Tensor, residual: Tensor
    ) -> Tensor:
        """``J^T r`` (F, n + 1, 3) by turns of the variables, ascending, and by the translation."""
        size = self.columns - self.driven + 1
        slope = hips.new_empty(len(hips), size, 3)
        kernel = _step_kernels(scalar_name(relative.dtype), lane_count(relative), shared=constants[1]).slopes
        frames = relative.contiguous(), hips.contiguous(), residual.contiguous()
        self._launch(kernel, constants[0], relative, tuple(map(as_warp, (*frames, slope))))
        return _ascending(slope)

    def factorise(
        self, constants: tuple[Tensor, bool], relative: Tensor, hips: Tensor, damping: Tensor, mass: Tensor,
        activity: Tensor | None, scale: Tensor | None, *, stiffness: float, soft: Soft,
    ) -> Factor:  # fmt: skip
        """The damped Gauss-Newton matrix of F poses, factorised."""
        lanes = lane_count(relative)
        groups = -(-len(hips) // lanes)
        kept = relative.new_empty(groups, self.kept * lanes)
        kernel = _step_kernels(scalar_name(relative.dtype), lanes, shared=constants[1]).factorise
        none = relative.new_zeros(1)
        frames = [one.contiguous() for one in (relative, hips, damping, mass)]
        frames += [none if one is None else one.contiguous() for one in (activity, scale)]
        given, _kept = self._soft(soft)
        self._launch(
            kernel, constants[0], relative, (*given, stiffness, *map(as_warp, frames)), kept=kept,
            task={"soft_count": len(soft.columns), "hinge_end": self.columns if soft.hinged else self.driven},
        )  # fmt: skip
        return Factor(kept=kept, count=len(hips))

    def solve(self, factor: Factor, slope: Tensor) -> Tensor:
        """Solution (F, n + 1, 3) for right-hand sides of the same shape."""
        given = _ascending(slope).contiguous()
        out = torch.empty_like(given)
        kernel = _step_kernels(scalar_name(slope.dtype), lane_count(slope), shared=True).solved
        none = slope.new_zeros(1, 1)
        self._launch(kernel, none, slope, (as_warp(given), as_warp(out)), kept=factor.kept)
        return _ascending(out)

    def variances(self, factor: Factor) -> Tensor:
        """Traces (F, n) of the variables' own blocks of the matrix's inverse, ascending."""
        out = factor.kept.new_empty(factor.count, self.columns - self.driven)
        kernel = _step_kernels(scalar_name(out.dtype), lane_count(out), shared=True).varied
        self._launch(kernel, out.new_zeros(1, 1), out, (as_warp(out),), kept=factor.kept)
        return out.flip(1)

    def _soft(self, soft: Soft):
        columns = soft.columns if len(soft.columns) else soft.columns.new_zeros(1)
        lanes = lane_count(soft.numbers)
        reference = soft.reference
        flat = to_lanes(reference, lanes) if len(soft.columns) else soft.numbers.new_zeros(1, 1, lanes)
        kept = columns, soft.numbers, flat.flatten(1)
        return tuple(map(as_warp, kept)), kept

    def _launch(self, kernel, constants: Tensor, like: Tensor, given: tuple, *, kept=None, task=None) -> None:
        lanes = lane_count(like)
        frames = len(like)
        groups = -(-frames // lanes)

        def run(part: slice) -> None:
            workers = part.stop - part.start if like.is_cuda else 1
            memory = like.new_empty(workers, self.memory * lanes)
            own = like.new_empty(workers, self.kept * lanes) if kept is None else kept
            numbers = _Task()
            numbers.begin, numbers.end, numbers.frames = part.start, part.stop, frames
            for name, value in (task or {}).items():
                setattr(numbers, name, value)
            with launching(like) as device:
                wp.launch(
                    kernel, dim=workers,
                    inputs=[numbers, as_warp(self.plan), as_warp(self.numbers), as_warp(constants), as_warp(memory),
                            as_warp(own), as_warp(self.at), *given],
                    device=device,
                )  # fmt: skip

        in_threads(run, groups, like)


def _before(sizes) -> np.ndarray:
    """Where each of consecutive parts begins."""
    lengths = [len(one) if isinstance(one, np.ndarray) else one for one in sizes]
    return np.concatenate([[0], np.cumsum(lengths)])[:-1].astype(np.int64)


def _ascending(rows: Tensor) -> Tensor:
    """Rows of variables, ascending, from those of columns, descending, or back; the translation stays last."""
    return torch.cat((rows[:, :-1].flip(1), rows[:, -1:]), 1)
