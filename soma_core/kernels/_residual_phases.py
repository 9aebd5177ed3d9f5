"""Steps of the model's residual on one tile of vertices, as native bodies: see ``model_residual_wp``.

A tile's buffer holds planes of vertices, three vectors of frames a vertex: rest points, targets, weighted
residuals and what these pull at the rest points; then weights, lengths, and what a frame has one of.
"""

from types import SimpleNamespace

import warp as wp

from soma_core.kernels._native import native

__all__ = ["BLEND", "OFFSET", "TILE", "phases", "tile_slots"]

TILE = 64
"""Vertices treated together, so that what they share is read from the first cache; also those whose energy
is added up before it joins the frame's."""

_POINT, _TARGET, _PULLED, _BACK = (3 * TILE * i for i in range(4))
_WEIGHT, _LENGTH = 12 * TILE, 13 * TILE
_FRAME = 14 * TILE
_SLOTS = {
    "POINT": _POINT, "TARGET": _TARGET, "PULLED": _PULLED, "BACK": _BACK,
    "WEIGHT": _WEIGHT, "LENGTH": _LENGTH,
    "ORIGIN": _FRAME, "SCALE": _FRAME + 3, "BOUND": _FRAME + 4, "ENERGY": _FRAME + 5,
}  # fmt: skip


def tile_slots() -> SimpleNamespace:
    """Where in a tile's buffer what lies, in vectors; ``size`` of them in all."""
    return SimpleNamespace(**{name.lower(): at for name, at in _SLOTS.items()}, size=_FRAME + 6)


def phases(scalar: str, lanes: int) -> SimpleNamespace:
    """Steps of a kernel family: ``clear``, ``points``, ``moved``, ``residual``, ``pulled``, ``forces``."""
    real = wp.array(dtype=getattr(wp, scalar))
    ids, short = wp.array(dtype=wp.int32), wp.array(dtype=wp.int16)

    def points(rest: real, first: int, stop: int, tile: real): ...

    def moved(
        start: ids, activation: short, value: real, active: real, first: int, stop: int, tile: real
    ):  # fmt: skip
        ...

    def residual(
        start: ids, joint: short, value: real, transforms: real, weight: real, own: int, clipped: int,
        measured: int, pulls: int, first: int, stop: int, tile: real,
    ):  # fmt: skip
        ...

    def pulled(
        start: ids, activation: short, value: real, first: int, stop: int, tile: real, out: real
    ):  # fmt: skip
        ...

    def forces(
        run: ids, joint: short, start: ids, row: short, value: real, t: int, end: int, tile: real, out: real
    ): ...

    def clear(out: real, at: int, count: int): ...

    bodies = {
        clear: _CLEAR, points: _POINTS, moved: _MOVED, residual: _RESIDUAL, pulled: _PULL, forces: _FORCES
    }  # fmt: skip
    made = {}
    for stub, body in bodies.items():
        name = stub.__name__
        for slot, at in _SLOTS.items():
            body = body.replace(f"@{slot}", f"((M)tile.data + {at})")
        body = body.replace("BLEND\n", BLEND).replace("OFFSET\n", OFFSET)
        made[name] = native(body, scalar, lanes, stub)
    return SimpleNamespace(**made)


BLEND = """
        V m[12];
        for (int k = 0; k < 12; k++) m[k] = V{};
        for (int e = start.data[v]; e < start.data[v + 1]; e++) {
            M t = transform + 12 * joint.data[e];
            const R w = value.data[e];
            for (int k = 0; k < 12; k++) m[k] += w * t[k];
        }
"""
"""What moves vertex v: the transforms of its joints, blended."""

OFFSET = """
        V p = V{}, q = V{}, r = V{};
        for (int e = start.data[v]; e < start.data[v + 1]; e++) {
            const R* move = value.data + 3 * e;
            const V b = a[activation.data[e]];
            p += move[0] * b;
            q += move[1] * b;
            r += move[2] * b;
        }
"""
"""What the activations add to vertex v."""

_CLEAR = """
    M to = (M)out.data + at;
    for (int i = 0; i < count; i++) to[i] = V{};
"""

_POINTS = """
    M x = @POINT;
    for (int i = 3 * first; i < 3 * stop; i++) *x++ = V{} + rest.data[i];
"""

_MOVED = """
    M a = (M)active.data;
    const V scale = *@SCALE;
    M x = @POINT;
    for (int v = first; v < stop; v++, x += 3) {
        OFFSET
        x[0] += scale * p;
        x[1] += scale * q;
        x[2] += scale * r;
    }
"""

_RESIDUAL = """
    M transform = (M)transforms.data, origin = @ORIGIN, x = @POINT, y = @TARGET, o = @WEIGHT;
    const V scale = *@SCALE, bound = *@BOUND, zero = V{};
    M r = @PULLED, back = @BACK, length = @LENGTH;
    V energy = V{};
    for (int v = first; v < stop; v++, x += 3, y += 3, r += 3, back += 3, o++, length++) {
        if (!own && !measured && !(weight.data[v] > 0)) {
            for (int i = 0; i < 3; i++) r[i] = back[i] = V{};
            continue;
        }
        V m[9], d[3], share = own ? *o : V{} + weight.data[v];
        for (int i = 0; i < 3; i++) {  // row by row, which narrow processors have registers for
            V a = V{}, b = V{}, c = V{}, s = V{};
            for (int e = start.data[v]; e < start.data[v + 1]; e++) {
                M t = transform + 12 * joint.data[e] + 4 * i;
                const R w = value.data[e];
                a += w * t[0];
                b += w * t[1];
                c += w * t[2];
                s += w * t[3];
            }
            m[3 * i] = a;
            m[3 * i + 1] = b;
            m[3 * i + 2] = c;
            d[i] = a * x[0] + b * x[1] + c * x[2] + s - (y[i] - origin[i]);
        }
        if (measured) *length = ROOT(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        for (int i = 0; i < 3; i++) d[i] = share > 0 ? d[i] : zero;
        V square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
        if (clipped) {
            V far = ROOT(square);
            V near = far < bound ? far : bound;
            energy += share * near * (far + far - near);
            share *= bound / (far > bound ? far : bound);
        } else energy += share * square;
        if (!pulls) continue;
        for (int i = 0; i < 3; i++) d[i] *= share;
        for (int i = 0; i < 3; i++) {
            r[i] = d[i];
            back[i] = scale * (m[i] * d[0] + m[3 + i] * d[1] + m[6 + i] * d[2]);
        }
    }
    *@ENERGY += energy;
"""

_PULL = """
    M g = @BACK, to = (M)out.data;
    for (int v = first; v < stop; v++, g += 3) {
        const V x = g[0], y = g[1], z = g[2];
        for (int e = start.data[v]; e < start.data[v + 1]; e++) {
            const R* move = value.data + 3 * e;
            to[activation.data[e]] += move[0] * x + move[1] * y + move[2] * z;
        }
    }
"""

_FORCES = """
    M x = @POINT, r = @PULLED;
    for (int p = run.data[t]; p < run.data[end]; p++) {
        for (int i = 0; i < 3; i++) {
            V f[4] = {V{}, V{}, V{}, V{}};
            for (int q = start.data[p]; q < start.data[p + 1]; q++) {
                const int u = 3 * row.data[q];
                const V a = value.data[q] * r[u + i];
                for (int k = 0; k < 3; k++) f[k] += a * x[u + k];
                f[3] += a;
            }
            M to = (M)out.data + 12 * joint.data[p] + 4 * i;
            for (int k = 0; k < 4; k++) to[k] += f[k];
        }
    }
"""
