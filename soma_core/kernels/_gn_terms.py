"""Functions of the Gauss-Newton kernel for terms on single joints, and for hinges."""

import functools
from types import SimpleNamespace

import warp as wp

from soma_core.kernels._gn_assembly import Plan
from soma_core.kernels._lanes import lane_types

__all__ = ["term_functions", "terms_struct"]


@functools.cache
def terms_struct(scalar: str, lanes: int):
    """``inversion.priors.JointTerms`` as device arrays.

    `mass` is the sum of the vertex weights of each frame, `hinges` the number of columns, or zero where no
    joint is a hinge.
    """
    types = lane_types(scalar, lanes)
    numbers = wp.array(dtype=types.real)

    @wp.struct
    class Terms:
        count: int
        hinges: int
        column: wp.array(dtype=wp.int32)
        stiffness: numbers
        free: numbers
        axis: numbers
        reference: wp.array2d(dtype=types.vec)
        mass: wp.array2d(dtype=types.vec)

    return Terms


@functools.cache
def term_functions(scalar: str, lanes: int) -> SimpleNamespace:
    """Energy, gradient and matrix of the terms; stiffening and projection of hinges."""
    types, terms = lane_types(scalar, lanes), terms_struct(scalar, lanes)
    frames = wp.array2d(dtype=types.vec)
    deviation, hinge_axis = _deviation(types, frames, terms), _hinge(types, frames, terms)
    return SimpleNamespace(
        add=_add(types, frames, terms, deviation),
        energy=_energy(types, frames, terms, deviation),
        stiffen=_stiffen(types, frames, terms, hinge_axis),
        project=_project(frames, terms, hinge_axis),
    )


def _deviation(types, frames, terms):
    real, vec, width = types.real, types.vec, types.lanes

    @wp.func
    def deviation(w: int, g: int, q: int, j: int, relative: frames, t: terms, out: frames):
        """Unit axis of ``R_j R_ref^T`` and its angle beyond `free` and in all, into `out` (0..4)."""
        trace = vec(real(0.0))
        for i in range(9):
            trace += wp.cw_mul(relative[w, 9 * j + i], t.reference[g, 9 * q + i])
        # Entry (a, b) of R_j R_ref^T is the product of row a of R_j and row b of R_ref.
        x = vec(real(0.0))
        y = vec(real(0.0))
        z = vec(real(0.0))
        for i in range(3):
            r0 = relative[w, 9 * j + i]
            r1 = relative[w, 9 * j + 3 + i]
            r2 = relative[w, 9 * j + 6 + i]
            s0 = t.reference[g, 9 * q + i]
            s1 = t.reference[g, 9 * q + 3 + i]
            s2 = t.reference[g, 9 * q + 6 + i]
            x += wp.cw_mul(r2, s1) - wp.cw_mul(r1, s2)
            y += wp.cw_mul(r0, s2) - wp.cw_mul(r2, s0)
            z += wp.cw_mul(r1, s0) - wp.cw_mul(r0, s1)
        free = t.free[q]
        over = vec(real(0.0))
        angle = vec(real(0.0))
        scale = vec(real(0.0))
        for c in range(width):
            length = wp.sqrt(x[c] * x[c] + y[c] * y[c] + z[c] * z[c])
            theta = wp.atan2(length, trace[c] - real(1.0))
            angle[c] = theta
            over[c] = wp.max(theta - free, real(0.0))
            scale[c] = wp.where(length > real(1e-12), real(1.0) / wp.max(length, real(1e-12)), real(0.0))
        out[w, 0] = wp.cw_mul(x, scale)
        out[w, 1] = wp.cw_mul(y, scale)
        out[w, 2] = wp.cw_mul(z, scale)
        out[w, 3] = over
        out[w, 4] = angle

    return deviation


def _energy(types, frames, terms, deviation):
    real, vec = types.real, types.vec

    @wp.func
    def energy(w: int, g: int, plan: Plan, relative: frames, t: terms, scratch: frames):
        """Sum of the terms."""
        total = vec(real(0.0))
        for q in range(t.count):
            deviation(w, g, q, plan.joint[t.column[q]], relative, t, scratch)
            total += t.stiffness[q] * wp.cw_mul(scratch[w, 3], scratch[w, 3])
        return wp.cw_mul(total, t.mass[g, 0])

    return energy


def _add(types, frames, terms, deviation):
    real, vec, width = types.real, types.vec, types.lanes

    @wp.func
    def add(
        w: int, g: int, plan: Plan, relative: frames, turns: frames, t: terms, scratch: frames,
        blocks: frames, slope: frames,
    ):  # fmt: skip
        """Add half gradient and Gauss-Newton block of every term, and return their sum."""
        total = vec(real(0.0))
        for q in range(t.count):
            k = t.column[q]
            p = plan.parent[k]
            deviation(w, g, q, plan.joint[k], relative, t, scratch)
            stiffness = t.stiffness[q] * t.mass[g, 0]
            over = scratch[w, 3]
            angle = scratch[w, 4]
            total += wp.cw_mul(stiffness, wp.cw_mul(over, over))
            across = vec(real(0.0))
            along = vec(real(0.0))
            for c in range(width):
                share = over[c] / wp.max(angle[c], real(1e-6))
                across[c] = wp.where(t.free[q] > real(0.0), share, real(1.0)) * stiffness[c]
                along[c] = wp.where(over[c] > real(0.0), stiffness[c], across[c])
            d = 12 * plan.block_start[k]
            for r in range(3):
                scratch[w, 5 + r] = (
                    wp.cw_mul(turns[w, 9 * p + 3 * r], scratch[w, 0])
                    + wp.cw_mul(turns[w, 9 * p + 3 * r + 1], scratch[w, 1])
                    + wp.cw_mul(turns[w, 9 * p + 3 * r + 2], scratch[w, 2])
                )
                slope[w, 3 * k + r] += wp.cw_mul(stiffness, wp.cw_mul(over, scratch[w, 5 + r]))
            for r in range(3):
                blocks[w, d + 5 * r] += across
                for c in range(3):
                    outer = wp.cw_mul(scratch[w, 5 + r], scratch[w, 5 + c])
                    blocks[w, d + 4 * r + c] += wp.cw_mul(along - across, outer)
        return total

    return add


def _hinge(types, frames, terms):
    real = types.real

    @wp.func
    def hinge_axis(w: int, k: int, plan: Plan, turns: frames, t: terms, scratch: frames):
        """World axis of column k's hinge into `scratch` (0..2); whether there is a hinge."""
        a = t.axis[3 * k]
        b = t.axis[3 * k + 1]
        c = t.axis[3 * k + 2]
        p = 9 * plan.parent[k]
        for r in range(3):
            scratch[w, r] = (
                a * turns[w, p + 3 * r] + b * turns[w, p + 3 * r + 1] + c * turns[w, p + 3 * r + 2]
            )
        return a * a + b * b + c * c > real(0.0)

    return hinge_axis


def _stiffen(types, frames, terms, hinge_axis):
    real = types.real

    @wp.func
    def stiffen(w: int, plan: Plan, hinge: real, turns: frames, t: terms, scratch: frames, blocks: frames):
        """Make every turn of a hinge off its axis so costly that the solution has none."""
        for k in range(t.hinges):
            if hinge_axis(w, k, plan, turns, t, scratch):
                d = 12 * plan.block_start[k]
                big = hinge * (blocks[w, d] + blocks[w, d + 5] + blocks[w, d + 10])
                for i in range(9):
                    outer = wp.cw_mul(scratch[w, i // 3], scratch[w, i % 3])
                    blocks[w, d + 4 * (i // 3) + i % 3] -= wp.cw_mul(big, outer)
                for r in range(3):
                    blocks[w, d + 5 * r] += big

    return stiffen


def _project(frames, terms, hinge_axis):
    @wp.func
    def project(w: int, plan: Plan, turns: frames, t: terms, scratch: frames, step: frames):
        """Keep the part of each hinge's step that lies along its axis."""
        for k in range(t.hinges):
            if hinge_axis(w, k, plan, turns, t, scratch):
                along = wp.cw_mul(scratch[w, 0], step[w, 3 * k])
                along += wp.cw_mul(scratch[w, 1], step[w, 3 * k + 1])
                along += wp.cw_mul(scratch[w, 2], step[w, 3 * k + 2])
                for r in range(3):
                    step[w, 3 * k + r] = wp.cw_mul(along, scratch[w, r])

    return project
