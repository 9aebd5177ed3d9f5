"""The search of how limbs share their twist in Warp: the twin of ``inversion.limbs.TwistShare``."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from soma_core.kernels._lanes import lane_count, row_of
from soma_core.kernels._native import transposing
from soma_core.kernels._runtime import as_warp, scalar_name
from soma_core.kernels._share_text import MOST_HELPERS, MOST_SHARES, share_room
from soma_core.kernels._solver_functions import Task, of_identities, share_function, solver_functions

if TYPE_CHECKING:
    from soma_core.kernels.pose_solver_wp import PoseSolver

__all__ = ["LimbTables", "limb_tables", "shared_twists"]

_ids = wp.array(dtype=wp.int32)


@of_identities
def _kernel(scalar: str, lanes: int, *, shared: bool):
    number = getattr(wp, scalar)
    real, rows = wp.array(dtype=number), wp.array3d(dtype=number)
    body, share = solver_functions(scalar, lanes, shared=shared), share_function(scalar, lanes, shared=shared)
    (load, store), row, width = transposing(scalar, lanes), row_of(scalar), lanes
    walk, still = body.walk, body.still
    module = wp.get_module(f"soma_twist_share_{scalar}_{lanes}_{'one' if shared else 'each'}")

    @wp.kernel(module=module, enable_backward=False)
    def search(
        task: Task, plan: _ids, numbers: real, constants: rows, memory: rows, kept: rows, at: _ids,
        limbs: _ids, values: real, angles: real, doubts: real, dear: number, least: number,
        relative: real, hips: real, residual: real, before: real, pull: real, energy: real, scale: real,
        mass: real, out: real,
    ):  # fmt: skip
        w = wp.tid()
        for g in range(task.begin + w, task.end, memory.shape[0] * memory.shape[1]):
            f, last = g * width, task.frames - 1
            s, m, k = row(memory, w), row(kept, w), row(constants, g)
            still(plan, numbers, k, s, m, number(0.0))
            load(relative, wp.int64(at[5]), 0, at[5], f, last, s, at[7])
            load(hips, wp.int64(3), 0, 3, f, last, s, at[8])
            walk(plan, numbers, k, s, m, 0)
            load(residual, wp.int64(at[6]), 0, at[6], f, last, s, at[15])
            load(before, wp.int64(at[20]), 0, at[20], f, last, s, at[24])
            load(pull, wp.int64(at[20]), 0, at[20], f, last, s, at[26])
            load(energy, wp.int64(1), 0, 1, f, last, s, at[27])
            load(scale, wp.int64(1), 0, 1, f, last, s, at[21])
            load(mass, wp.int64(1), 0, 1, f, last, s, at[4])
            share(
                plan, numbers, k, s, m, limbs, values, angles, doubts, task.soft_count, task.hinge_end, dear,
                least,
            )  # fmt: skip
            store(s, at[7], at[5], out, wp.int64(at[5]), 0, f, last)

    return search


class LimbTables(NamedTuple):
    """Constants of some limbs, one after the other: integers and numbers."""

    lists: Tensor
    numbers: Tensor


def limb_tables(
    limbs: Sequence, mix: Tensor, public_count: int, features: tuple[Tensor, Tensor], room: int, count: int
) -> LimbTables:
    """Tables of limbs.

    Args:
        limbs: ``inversion.limbs.Limb``.
        mix: (H, K) helper angles from channels.
        public_count: joints before the helpers.
        features: `left` and `right`, cut to the columns that count, of ``inversion.offsets.PoseOffsets``.
        room: vectors of working memory.
        count: shares looked at.
    """
    lists, numbers = [[len(limbs)]], []
    for limb in limbs:
        helpers, ids, rank = len(limb.helpers), len(limb.ids), limb.shapes.shape[1]
        needed = share_room(helpers, ids)
        assert count <= MOST_SHARES, count
        assert helpers <= MOST_HELPERS, helpers
        assert needed <= room, (needed, room)
        wide = -(-rank // 4) * 4
        shapes = torch.nn.functional.pad(limb.shapes, (0, wide - rank)).view(ids, -1, 4).transpose(0, 1)
        sizes = (limb.own, limb.end, *limb.channels, helpers, len(limb.pairs), ids, wide)
        parts = (public_count + limb.helpers, limb.clouds, limb.pairs, limb.first, limb.second, limb.ids)
        lists += [sizes, *(part.tolist() for part in parts)]
        own, end = (torch.cat([part[joint].flatten() for part in features]) for joint in (limb.own, limb.end))
        reads = torch.cat((limb.by_own, limb.by_end), 1)
        numbers += [limb.axis, mix[limb.helpers][:, list(limb.channels)].T, own, end, reads, shapes]
    where = mix.device
    return LimbTables(
        lists=torch.as_tensor(np.concatenate([np.asarray(one, np.int32) for one in lists])).to(where),
        numbers=torch.cat([one.flatten() for one in numbers]).to(mix),
    )


def shared_twists(
    solver: "PoseSolver", constants: tuple[Tensor, bool], tables: LimbTables, angle: Tensor, doubts: Tensor,
    held: int, frames: Sequence[Tensor], *, dear: float, least: float,
) -> Tensor:  # fmt: skip
    """Rotations (F, J, 3, 3) with the best share of every limb.

    Args:
        solver, constants: of the rig and the identities.
        tables: of :func:`limb_tables`.
        angle: shares looked at (a,) [rad], evenly spaced.
        doubts: axis and square [1/rad^2] of the doubt of each limb's next joint, (L, 4).
        held: one bit a limb: limbs that stay.
        frames: rotations (F, J, 3, 3), Hips (F, 3), moments of what is left (F, T, 3, 4), what goes into
            activations and half the slope by them (F, C), the error that doubt is measured by, size of the
            offsets, and mass (F,).
        dear, least: cost of a joint near half a turn, and cosine of half its angle where that begins.
    """
    relative = frames[0]
    out = torch.empty_like(relative, memory_format=torch.contiguous_format)
    half = 0.5 * angle
    angles = torch.stack((angle, angle.sin(), angle.cos(), half.sin(), half.cos()), 1)
    kernel = _kernel(scalar_name(relative.dtype), lane_count(relative), shared=constants[1])
    kept = [tables.lists, *(one.contiguous().view(-1) for one in (tables.numbers, angles, doubts))]
    given = [one.contiguous() for one in frames]
    solver.launch(
        kernel, constants[0], relative,
        (*map(as_warp, kept), dear, least, *map(as_warp, given), as_warp(out)),
        task={"soft_count": len(angle), "hinge_end": held},
    )  # fmt: skip
    return out
