"""Moments of one rest shape in Warp: the twin of ``SkinMoments.rest``, a joint or a pair of joints a thread.

The four entries of a point ``(b; 1)`` are the lanes of one vector.
"""

import warp as wp
from torch import Tensor

from soma_core.kernels._native import native
from soma_core.kernels._runtime import as_warp, launching, loaded, once, scalar_name

__all__ = ["rest_moments"]

_ids = wp.array(dtype=wp.int64)


@once
def _kernel(scalar: str, lanes: int):
    real = wp.array(dtype=getattr(wp, scalar))
    place, couple = _bodies(real, scalar, lanes)
    module = wp.get_module(f"soma_rest_moments_{scalar}_{lanes}")

    @wp.kernel(module=module, enable_backward=False)
    def joints(
        start: _ids, vertex: _ids, skin: real, turn: real, centre: real, rest: real, weight: real,
        point: real, own: real,
    ):  # fmt: skip
        place(wp.tid(), start, vertex, skin, turn, centre, rest, weight, point, own)

    @wp.kernel(module=module, enable_backward=False)
    def pairs(
        start: _ids, influences: _ids, vertex: _ids, skin: real, weight: real, point: real, second: real
    ):
        couple(wp.tid(), start, influences, vertex, skin, weight, point, second)

    return joints, pairs


def _bodies(real, scalar: str, lanes: int) -> tuple[wp.Function, wp.Function]:
    def place(
        t: int, start: _ids, vertex: _ids, skin: real, turn: real, centre: real, rest: real, weight: real,
        point: real, own: real,
    ):  # fmt: skip
        ...

    def couple(
        p: int, start: _ids, influences: _ids, vertex: _ids, skin: real, weight: real, point: real,
        second: real,
    ):  # fmt: skip
        ...

    return native(_PLACE, scalar, lanes, place), native(_COUPLE, scalar, lanes, couple)


_PLACE = """
    const R *m = turn.data + 9 * t, *c = centre.data + 3 * t;
    V sum[16 / N];
    for (int i = 0; i < 16 / N; i++) sum[i] = V{};
    for (long long e = start.data[t]; e < start.data[t + 1]; e++) {
        const long long v = vertex.data[e];
        const R *x = rest.data + 3 * v, s = skin.data[e] * weight.data[v];
        const R a = x[0] - c[0], b = x[1] - c[1], d = x[2] - c[2];
        R* b4 = point.data + 4 * e;
        for (int i = 0; i < 3; i++) b4[i] = m[3 * i] * a + m[3 * i + 1] * b + m[3 * i + 2] * d;
        b4[3] = 1;
        for (int i = 0; i < 4; i++)
            for (int k = 0; k < 4 / N; k++) sum[i * (4 / N) + k] += (s * b4[i]) * ((V*)b4)[k];
    }
    for (int i = 0; i < 16 / N; i++) ((V*)(own.data + 16 * t))[i] = sum[i];
"""

_COUPLE = """
    V sum[16 / N];
    for (int i = 0; i < 16 / N; i++) sum[i] = V{};
    for (long long q = start.data[p]; q < start.data[p + 1]; q++) {
        const long long first = influences.data[2 * q], other = influences.data[2 * q + 1];
        const R s = skin.data[first] * skin.data[other] * weight.data[vertex.data[first]];
        const R* a = point.data + 4 * first;
        const V* b = (const V*)(point.data + 4 * other);
        for (int i = 0; i < 4; i++)
            for (int k = 0; k < 4 / N; k++) sum[i * (4 / N) + k] += (s * a[i]) * b[k];
    }
    for (int i = 0; i < 16 / N; i++) ((V*)(second.data + 16 * p))[i] = sum[i];
"""


def rest_moments(
    joints: tuple[Tensor, Tensor, Tensor], pairs: tuple[Tensor, Tensor], turn: Tensor, centre: Tensor,
    rest: Tensor, weight: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Points (e, 4) of one identity, ``(b; 1)`` [m], and sums over joints (T, 4, 4) and pairs (p, 4, 4).

    Args:
        joints: row starts (T + 1,), vertices (e,) and skin weights (e,) of the joints' influences.
        pairs: row starts (p + 1,), and two influences of a vertex that both joints of a pair move (m, 2).
        turn: from the identity's axes to those of the T-pose, (T, 3, 3).
        centre: bind positions (T, 3) [m].
        rest: (v, 3) [m].
        weight: of vertices, (v,).
    """
    place, couple = _kernel(scalar_name(rest.dtype), _lanes(rest))
    point = rest.new_empty(len(joints[1]), 4)
    own, coupled = rest.new_empty(len(centre), 4, 4), rest.new_empty(len(pairs[0]) - 1, 4, 4)
    given = [one.contiguous() for one in (turn, centre, rest, weight)]
    start, vertex, skin = map(as_warp, joints)
    turn_, centre_, rest_, weight_, point_, own_, coupled_ = (
        as_warp(one.view(-1)) for one in (*given, point, own, coupled)
    )
    first = [start, vertex, skin, turn_, centre_, rest_, weight_, point_, own_]
    second = [as_warp(pairs[0]), as_warp(pairs[1].view(-1)), vertex, skin, weight_, point_, coupled_]
    with launching(rest) as device:
        wp.launch(loaded(place, device), dim=len(own), inputs=first, device=device)
        wp.launch(loaded(couple, device), dim=len(coupled), inputs=second, device=device)
    return point, own, coupled


def _lanes(tensor: Tensor) -> int:
    """Entries of a point that one instruction treats."""
    return 1 if tensor.is_cuda else 4
