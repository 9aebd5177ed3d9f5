"""Functions of the Gauss-Newton kernel that walk the joint tree or the pairs of joints."""

import functools
from types import SimpleNamespace

import warp as wp

from soma_core.kernels._lanes import lane_types

__all__ = ["Indices", "tree_functions"]

Indices = wp.array(dtype=wp.int32)


@functools.cache
def tree_functions(scalar: str, lanes: int, *, shared: bool) -> SimpleNamespace:
    """Forward kinematics, products with ``N`` and the retraction; `shared`: one identity for all frames."""
    types = lane_types(scalar, lanes)
    frames = wp.array2d(dtype=types.vec)
    constants = wp.array2d(dtype=types.real if shared else types.vec)
    scaled = _scaled(types, constants, shared=shared)
    return SimpleNamespace(
        frames=frames,
        constants=constants,
        scaled=scaled,
        walk=_walk(types, frames, constants, scaled),
        times_second=_times_second(types, frames, constants, scaled),
        retract=_retract(types, frames),
    )


def _scaled(types, constants, *, shared: bool):
    vec = types.vec

    if shared:

        @wp.func
        def scaled(table: constants, g: int, i: int, x: vec):
            return table[0, i] * x
    else:

        @wp.func
        def scaled(table: constants, g: int, i: int, x: vec):
            return wp.cw_mul(table[g, i], x)

    return scaled


def _walk(types, frames, constants, scaled):
    @wp.func
    def walk(
        w: int, g: int, parents: Indices, offsets: constants, relative: frames, hips: frames,
        turns: frames, places: frames,
    ):  # fmt: skip
        """World turns and places (row w) of the pose in row w of `relative` and `hips`; offsets in row g."""
        for j in range(1, parents.shape[0]):
            p = parents[j]
            for r in range(3):
                a0 = turns[w, 9 * p + 3 * r]
                a1 = turns[w, 9 * p + 3 * r + 1]
                a2 = turns[w, 9 * p + 3 * r + 2]
                for c in range(3):
                    turns[w, 9 * j + 3 * r + c] = (
                        wp.cw_mul(a0, relative[w, 9 * j + c])
                        + wp.cw_mul(a1, relative[w, 9 * j + 3 + c])
                        + wp.cw_mul(a2, relative[w, 9 * j + 6 + c])
                    )
                if p == 0:
                    places[w, 3 * j + r] = hips[w, r]
                else:
                    step = scaled(offsets, g, 3 * j, a0) + scaled(offsets, g, 3 * j + 1, a1)
                    places[w, 3 * j + r] = places[w, 3 * p + r] + step + scaled(offsets, g, 3 * j + 2, a2)

    return walk


def _times_second(types, frames, constants, scaled):
    real, vec = types.real, types.vec

    @wp.func
    def add_pair(
        w: int, g: int, n: int, row: int, col: int, t: int, u: int, second: constants, x: frames, out: frames
    ):
        """Add ``x_t N_tu`` to block u of `out`; `row` and `col` are the strides of N."""
        for r in range(3):
            k = 12 * t + 4 * r
            x0 = x[w, k]
            x1 = x[w, k + 1]
            x2 = x[w, k + 2]
            x3 = x[w, k + 3]
            for c in range(4):
                m = n + col * c
                first = scaled(second, g, m, x0) + scaled(second, g, m + row, x1)
                other = scaled(second, g, m + 2 * row, x2) + scaled(second, g, m + 3 * row, x3)
                out[w, 12 * u + 4 * r + c] += first + other

    @wp.func
    def times_second(w: int, g: int, pairs: Indices, second: constants, x: frames, out: frames):
        """``out = x N``, rows of 3 x 4 blocks; N holds each pair of joints once."""
        for i in range(out.shape[1]):
            out[w, i] = vec(real(0.0))
        for k in range(pairs.shape[0] // 2):
            t = pairs[2 * k]
            u = pairs[2 * k + 1]
            add_pair(w, g, 16 * k, 4, 1, t, u, second, x, out)
            if t != u:
                add_pair(w, g, 16 * k, 1, 4, u, t, second, x, out)

    return times_second


def _retract(types, frames):
    real, vec = types.real, types.vec

    @wp.func
    def retract(
        w: int, j: int, p: int, x: vec, y: vec, z: vec, turns: frames, relative: frames, out: frames,
    ):  # fmt: skip
        """Turn joint j by the Cayley map of the world vector (x, y, z), then undo rounding."""
        half = real(0.5)
        a = half * (wp.cw_mul(turns[w, 9 * p], x) + wp.cw_mul(turns[w, 9 * p + 3], y)
                    + wp.cw_mul(turns[w, 9 * p + 6], z))  # fmt: skip
        b = half * (wp.cw_mul(turns[w, 9 * p + 1], x) + wp.cw_mul(turns[w, 9 * p + 4], y)
                    + wp.cw_mul(turns[w, 9 * p + 7], z))  # fmt: skip
        c = half * (wp.cw_mul(turns[w, 9 * p + 2], x) + wp.cw_mul(turns[w, 9 * p + 5], y)
                    + wp.cw_mul(turns[w, 9 * p + 8], z))  # fmt: skip
        one = vec(real(1.0))
        f = wp.cw_div(vec(real(2.0)), one + wp.cw_mul(a, a) + wp.cw_mul(b, b) + wp.cw_mul(c, c))
        fa = wp.cw_mul(f, a)
        fb = wp.cw_mul(f, b)
        fc = wp.cw_mul(f, c)
        m00 = one - wp.cw_mul(fb, b) - wp.cw_mul(fc, c)
        m11 = one - wp.cw_mul(fa, a) - wp.cw_mul(fc, c)
        m22 = one - wp.cw_mul(fa, a) - wp.cw_mul(fb, b)
        ab = wp.cw_mul(fa, b)
        ac = wp.cw_mul(fa, c)
        bc = wp.cw_mul(fb, c)
        for k in range(3):
            r0 = relative[w, 9 * j + k]
            r1 = relative[w, 9 * j + 3 + k]
            r2 = relative[w, 9 * j + 6 + k]
            out[w, 9 * j + k] = wp.cw_mul(m00, r0) + wp.cw_mul(ab - fc, r1) + wp.cw_mul(ac + fb, r2)
            out[w, 9 * j + 3 + k] = wp.cw_mul(ab + fc, r0) + wp.cw_mul(m11, r1) + wp.cw_mul(bc - fa, r2)
            out[w, 9 * j + 6 + k] = wp.cw_mul(ac - fb, r0) + wp.cw_mul(bc + fa, r1) + wp.cw_mul(m22, r2)
        # One Newton step towards the nearest orthogonal matrix: M (3 I - M^T M) / 2.
        o0 = out[w, 9 * j]
        o1 = out[w, 9 * j + 1]
        o2 = out[w, 9 * j + 2]
        o3 = out[w, 9 * j + 3]
        o4 = out[w, 9 * j + 4]
        o5 = out[w, 9 * j + 5]
        o6 = out[w, 9 * j + 6]
        o7 = out[w, 9 * j + 7]
        o8 = out[w, 9 * j + 8]
        three = vec(real(3.0))
        g00 = half * (three - wp.cw_mul(o0, o0) - wp.cw_mul(o3, o3) - wp.cw_mul(o6, o6))
        g11 = half * (three - wp.cw_mul(o1, o1) - wp.cw_mul(o4, o4) - wp.cw_mul(o7, o7))
        g22 = half * (three - wp.cw_mul(o2, o2) - wp.cw_mul(o5, o5) - wp.cw_mul(o8, o8))
        g01 = -half * (wp.cw_mul(o0, o1) + wp.cw_mul(o3, o4) + wp.cw_mul(o6, o7))
        g02 = -half * (wp.cw_mul(o0, o2) + wp.cw_mul(o3, o5) + wp.cw_mul(o6, o8))
        g12 = -half * (wp.cw_mul(o1, o2) + wp.cw_mul(o4, o5) + wp.cw_mul(o7, o8))
        for r in range(3):
            s0 = out[w, 9 * j + 3 * r]
            s1 = out[w, 9 * j + 3 * r + 1]
            s2 = out[w, 9 * j + 3 * r + 2]
            out[w, 9 * j + 3 * r] = wp.cw_mul(s0, g00) + wp.cw_mul(s1, g01) + wp.cw_mul(s2, g02)
            out[w, 9 * j + 3 * r + 1] = wp.cw_mul(s0, g01) + wp.cw_mul(s1, g11) + wp.cw_mul(s2, g12)
            out[w, 9 * j + 3 * r + 2] = wp.cw_mul(s0, g02) + wp.cw_mul(s1, g12) + wp.cw_mul(s2, g22)

    return retract
