"""Functions of the Gauss-Newton kernel that factorise and solve: sparse Cholesky by 3 x 3 blocks."""

import functools
from types import SimpleNamespace

import warp as wp

from soma_core.kernels._gn_assembly import Plan
from soma_core.kernels._lanes import lane_types

__all__ = ["factor_functions"]


@functools.cache
def factor_functions(scalar: str, lanes: int) -> SimpleNamespace:
    """Damp, factorise and solve; `blocks` is (slots, 3, 4) with an unused last column.

    The translation is the last variable: `carry` (n, 9) holds its row of the factor, `last` (9) its
    diagonal block. `inverse` (n + 1, 3) holds the reciprocal diagonal of the factor.
    """
    types = lane_types(scalar, lanes)
    frames = wp.array2d(dtype=types.vec)
    triangle = _triangle(types, frames)
    eliminate = _eliminate(types, frames)
    return SimpleNamespace(
        factorise=_factorise(types, frames, triangle, eliminate),
        solve=_solve(frames, _forward(frames), _backward(frames)),
    )


def _triangle(types, frames):
    real, inverse_root = types.real, types.inverse_root

    @wp.func
    def triangle(w: int, a: frames, at: int, stride: int, inverse: frames, k: int):
        """Factorise one 3 x 3 diagonal block in place, its lower triangle, and keep reciprocals."""
        tiny = real(1e-30)
        i0 = inverse_root(a[w, at], tiny)
        l10 = wp.cw_mul(a[w, at + stride], i0)
        l20 = wp.cw_mul(a[w, at + 2 * stride], i0)
        i1 = inverse_root(a[w, at + stride + 1] - wp.cw_mul(l10, l10), tiny)
        l21 = wp.cw_mul(a[w, at + 2 * stride + 1] - wp.cw_mul(l20, l10), i1)
        i2 = inverse_root(a[w, at + 2 * stride + 2] - wp.cw_mul(l20, l20) - wp.cw_mul(l21, l21), tiny)
        a[w, at + stride] = l10
        a[w, at + 2 * stride] = l20
        a[w, at + 2 * stride + 1] = l21
        inverse[w, 3 * k] = i0
        inverse[w, 3 * k + 1] = i1
        inverse[w, 3 * k + 2] = i2

    return triangle


def _eliminate(types, frames):
    @wp.func
    def eliminate(
        w: int, a: frames, left: int, left_stride: int, b: frames, right: int, right_stride: int, out: frames,
        at: int, stride: int,
    ):  # fmt: skip
        """``out -= A B^T`` for 3 x 3 blocks."""
        b00 = b[w, right]
        b01 = b[w, right + 1]
        b02 = b[w, right + 2]
        b10 = b[w, right + right_stride]
        b11 = b[w, right + right_stride + 1]
        b12 = b[w, right + right_stride + 2]
        b20 = b[w, right + 2 * right_stride]
        b21 = b[w, right + 2 * right_stride + 1]
        b22 = b[w, right + 2 * right_stride + 2]
        for r in range(3):
            x = a[w, left + left_stride * r]
            y = a[w, left + left_stride * r + 1]
            z = a[w, left + left_stride * r + 2]
            out[w, at + stride * r] -= wp.cw_mul(x, b00) + wp.cw_mul(y, b01) + wp.cw_mul(z, b02)
            out[w, at + stride * r + 1] -= wp.cw_mul(x, b10) + wp.cw_mul(y, b11) + wp.cw_mul(z, b12)
            out[w, at + stride * r + 2] -= wp.cw_mul(x, b20) + wp.cw_mul(y, b21) + wp.cw_mul(z, b22)

    return eliminate


def _factorise(types, frames, triangle, eliminate):
    @wp.func
    def factorise(w: int, plan: Plan, blocks: frames, carry: frames, last: frames, inverse: frames):
        for k in range(plan.joint.shape[0]):
            first = plan.block_start[k]
            stop = plan.block_start[k + 1]
            d = 12 * first
            triangle(w, blocks, d, 4, inverse, k)
            l10 = blocks[w, d + 4]
            l20 = blocks[w, d + 8]
            l21 = blocks[w, d + 9]
            i0 = inverse[w, 3 * k]
            i1 = inverse[w, 3 * k + 1]
            i2 = inverse[w, 3 * k + 2]
            for s in range(first + 1, stop):
                for r in range(3):
                    b = 12 * s + 4 * r
                    x = wp.cw_mul(blocks[w, b], i0)
                    y = wp.cw_mul(blocks[w, b + 1] - wp.cw_mul(x, l10), i1)
                    blocks[w, b] = x
                    blocks[w, b + 1] = y
                    blocks[w, b + 2] = wp.cw_mul(blocks[w, b + 2] - wp.cw_mul(x, l20) - wp.cw_mul(y, l21), i2)
            for r in range(3):
                b = 9 * k + 3 * r
                x = wp.cw_mul(carry[w, b], i0)
                y = wp.cw_mul(carry[w, b + 1] - wp.cw_mul(x, l10), i1)
                carry[w, b] = x
                carry[w, b + 1] = y
                carry[w, b + 2] = wp.cw_mul(carry[w, b + 2] - wp.cw_mul(x, l20) - wp.cw_mul(y, l21), i2)
            e = plan.update_start[k]
            for s in range(first + 1, stop):
                for q in range(s, stop):
                    eliminate(w, blocks, 12 * q, 4, blocks, 12 * s, 4, blocks, 12 * plan.update_target[e], 4)
                    e += 1
                eliminate(w, carry, 9 * k, 3, blocks, 12 * s, 4, carry, 9 * plan.block_row[s], 3)
            eliminate(w, carry, 9 * k, 3, carry, 9 * k, 3, last, 0, 3)
        triangle(w, last, 0, 3, inverse, plan.joint.shape[0])

    return factorise


def _forward(frames):
    @wp.func
    def forward(w: int, plan: Plan, blocks: frames, carry: frames, last: frames, inverse: frames, x: frames):
        """Solve with the factor; the translation all the way."""
        count = plan.joint.shape[0]
        for k in range(count):
            d = 12 * plan.block_start[k]
            y0 = wp.cw_mul(x[w, 3 * k], inverse[w, 3 * k])
            y1 = wp.cw_mul(x[w, 3 * k + 1] - wp.cw_mul(blocks[w, d + 4], y0), inverse[w, 3 * k + 1])
            y2 = x[w, 3 * k + 2] - wp.cw_mul(blocks[w, d + 8], y0) - wp.cw_mul(blocks[w, d + 9], y1)
            y2 = wp.cw_mul(y2, inverse[w, 3 * k + 2])
            x[w, 3 * k] = y0
            x[w, 3 * k + 1] = y1
            x[w, 3 * k + 2] = y2
            for s in range(plan.block_start[k] + 1, plan.block_start[k + 1]):
                i = 3 * plan.block_row[s]
                for r in range(3):
                    b = 12 * s + 4 * r
                    x[w, i + r] -= (
                        wp.cw_mul(blocks[w, b], y0) + wp.cw_mul(blocks[w, b + 1], y1)
                        + wp.cw_mul(blocks[w, b + 2], y2)
                    )  # fmt: skip
            for r in range(3):
                b = 9 * k + 3 * r
                x[w, 3 * count + r] -= (
                    wp.cw_mul(carry[w, b], y0) + wp.cw_mul(carry[w, b + 1], y1)
                    + wp.cw_mul(carry[w, b + 2], y2)
                )  # fmt: skip
        t = 3 * count
        t0 = wp.cw_mul(x[w, t], inverse[w, t])
        t1 = wp.cw_mul(x[w, t + 1] - wp.cw_mul(last[w, 3], t0), inverse[w, t + 1])
        t2 = x[w, t + 2] - wp.cw_mul(last[w, 6], t0) - wp.cw_mul(last[w, 7], t1)
        t2 = wp.cw_mul(wp.cw_mul(t2, inverse[w, t + 2]), inverse[w, t + 2])
        t1 = wp.cw_mul(t1 - wp.cw_mul(last[w, 7], t2), inverse[w, t + 1])
        t0 = wp.cw_mul(t0 - wp.cw_mul(last[w, 3], t1) - wp.cw_mul(last[w, 6], t2), inverse[w, t])
        x[w, t] = t0
        x[w, t + 1] = t1
        x[w, t + 2] = t2

    return forward


def _backward(frames):
    @wp.func
    def backward(w: int, plan: Plan, blocks: frames, carry: frames, inverse: frames, x: frames):
        """Solve with the transposed factor, the translation being known."""
        count = plan.joint.shape[0]
        t = 3 * count
        for n in range(count):
            k = count - 1 - n
            d = 12 * plan.block_start[k]
            c = 9 * k
            z0 = x[w, 3 * k]
            z1 = x[w, 3 * k + 1]
            z2 = x[w, 3 * k + 2]
            for r in range(3):
                v = x[w, t + r]
                z0 -= wp.cw_mul(carry[w, c + 3 * r], v)
                z1 -= wp.cw_mul(carry[w, c + 3 * r + 1], v)
                z2 -= wp.cw_mul(carry[w, c + 3 * r + 2], v)
            for s in range(plan.block_start[k] + 1, plan.block_start[k + 1]):
                i = 3 * plan.block_row[s]
                for r in range(3):
                    b = 12 * s + 4 * r
                    v = x[w, i + r]
                    z0 -= wp.cw_mul(blocks[w, b], v)
                    z1 -= wp.cw_mul(blocks[w, b + 1], v)
                    z2 -= wp.cw_mul(blocks[w, b + 2], v)
            z2 = wp.cw_mul(z2, inverse[w, 3 * k + 2])
            z1 = wp.cw_mul(z1 - wp.cw_mul(blocks[w, d + 9], z2), inverse[w, 3 * k + 1])
            z0 = wp.cw_mul(
                z0 - wp.cw_mul(blocks[w, d + 4], z1) - wp.cw_mul(blocks[w, d + 8], z2), inverse[w, 3 * k]
            )
            x[w, 3 * k] = z0
            x[w, 3 * k + 1] = z1
            x[w, 3 * k + 2] = z2

    return backward


def _solve(frames, forward, backward):
    @wp.func
    def solve(w: int, plan: Plan, blocks: frames, carry: frames, last: frames, inverse: frames, x: frames):
        """Replace the right-hand side `x` (n + 1, 3) by the solution."""
        forward(w, plan, blocks, carry, last, inverse, x)
        backward(w, plan, blocks, carry, inverse, x)

    return solve
