"""Native bodies of the pose solver: walk, change of the energy, slopes, solution, terms, step.

Every body begins with names of the lists and of the memory of one group of frames (:func:`prelude`). ``S`` is
that memory, ``K`` an identity's constants: numbers where one identity serves all frames, else vectors; on a
GPU one body serves both.
"""

import re
from collections.abc import Sequence

__all__ = ["ACCEPT", "BEGIN", "CHANGE", "FORCES", "MOVE", "QUATERNION", "SOLVE", "STILL", "TERMS", "WALK",
           "prelude"]  # fmt: skip


def prelude(
    counts: Sequence[str], lists: Sequence[str], numbers: Sequence[str], slots: Sequence[str],
    kept: Sequence[str], body: str, *, lanes: int, shared: bool,
) -> str:  # fmt: skip
    """Names for what the arrays `plan`, `numbers`, `k` and `s` hold, as far as a body uses them.

    A name costs a compiler time, in every body that has it and in those that this is put into.
    """
    lines = {
        "L": _STRIDED if lanes == 1 else f"typedef {'const R*' if shared else 'M'} L;",
        "K": "L K(k.data, k.strides[0] / (long long)sizeof(R));" if lanes == 1 else "L K = (L)k.data;",
        "P": "const int* P = plan.data;", "S": "M S = (M)s.data;", "F": "M F = (M)f.data;",
        "Q": "const R* Q = numbers.data;", "zero": "const V zero = V{};", "one": "const V one = zero + R(1);",
    }  # fmt: skip
    lines |= {name: f"const int {name} = P[{at}];" for at, name in enumerate(counts)}
    at = len(counts)
    parts = (lists, "const int*", "P"), (numbers, "const R*", "Q"), (slots, "M", "S"), (kept, "M", "F")
    for names, kind, base in parts:
        lines |= {name: f"{kind} {name} = {base} + P[{at + i}];" for i, name in enumerate(names)}
        at += len(names)
    begin = "K"
    for name, size in _CONSTANTS.items():
        lines[name] = f"L {name} = {begin};"
        begin = f"{name} + {size}"
    needed, used = set(_words(body)), []
    for name, line in reversed(lines.items()):
        if name in needed:
            used.append(line)
            needed.update(_words(line))
    return "\n".join(reversed(used)) + "\n"


_STRIDED = """
struct L {
    const R* p; int step;
    CUDA_CALLABLE L(const R* begin, int stride): p(begin), step(stride) {}
    CUDA_CALLABLE const R& operator[](int i) const { return p[i * step]; }
    CUDA_CALLABLE L operator+(int i) const { return L(p + i * step, step); }
};
"""
"""Constants of one identity, or of one of those that lie abreast."""

_words = re.compile(r"[A-Za-z_]\w*").findall

_CONSTANTS = {
    "second": "16 * pair_count", "offsets": "3 * all_count", "lefts": "9 * channel_count",
    "rights": "9 * channel_count", "axes": "3 * channel_count", "binds": "12 * all_count",
    "sizes": "weighted_count", "shares": "",
}  # fmt: skip
"""An identity's constants, one after the other, and how many numbers each has."""


STILL = """
    for (int i = 0; i < 9; i++) {
        turns[i] = trial_turns[i] = relative[i] = trial_relative[i] = i % 4 ? zero : one;
    }
    for (int r = 0; r < 3; r++) places[r] = trial_places[r] = zero;
    damping[0] = zero + damping_start; moving[0] = one; accepted[0] = zero; soft_energy[0] = zero;
"""

QUATERNION = """
    auto quaternion_of = [&](const V* x, V* q) {
        for (int n = 0; n < N; n++) {
            R y[9]; for (int i = 0; i < 9; i++) y[i] = ((const R*)(x + i))[n];
            R t0 = 1 + y[0] + y[4] + y[8], t1 = 1 + y[0] - y[4] - y[8];
            R t2 = 1 + y[4] - y[0] - y[8], t3 = 1 + y[8] - y[0] - y[4];
            R p[4];
            if (t0 >= t1 && t0 >= t2 && t0 >= t3) {
                p[0] = t0; p[1] = y[7] - y[5]; p[2] = y[2] - y[6]; p[3] = y[3] - y[1];
            } else if (t1 >= t2 && t1 >= t3) {
                p[0] = y[7] - y[5]; p[1] = t1; p[2] = y[1] + y[3]; p[3] = y[2] + y[6];
            } else if (t2 >= t3) {
                p[0] = y[2] - y[6]; p[1] = y[1] + y[3]; p[2] = t2; p[3] = y[5] + y[7];
            } else {
                p[0] = y[3] - y[1]; p[1] = y[2] + y[6]; p[2] = y[5] + y[7]; p[3] = t3;
            }
            R f = 1 / wp::sqrt(p[0]*p[0] + p[1]*p[1] + p[2]*p[2] + p[3]*p[3]);
            if (p[0] < 0) f = -f;
            for (int i = 0; i < 4; i++) ((R*)(q + i))[n] = f*p[i];
        }
    };
"""
"""Quaternion w, x, y, z of a rotation, with w >= 0."""

WALK = (
    QUATERNION
    + """
    M rel = trial ? trial_relative : relative; M tr = trial ? trial_turns : turns;
    M pl = trial ? trial_places : places; M hp = trial ? trial_hips : hips;
    M st = trial ? trial_steer : steer;
    for (int j = 1; j < all_count; j++) {
        if (j == joint_count) {
            for (int c = 0; c < channel_count; c++) {
                M a = tr + 9 * channel_reference[c]; M b = tr + 9 * channel_joint[c];
                V m[9], x[9];
                for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++)
                    x[3*r+q] = a[r] * b[q] + a[3+r] * b[3+q] + a[6+r] * b[6+q];
                L l = lefts + 9 * c; L d = rights + 9 * c; L e = axes + 3 * c;
                for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++)
                    m[3*r+q] = l[r] * x[q] + l[3+r] * x[3+q] + l[6+r] * x[6+q];
                for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++)
                    x[3*r+q] = m[3*r] * d[q] + m[3*r+1] * d[3+q] + m[3*r+2] * d[6+q];
                V q_[4]; quaternion_of(x, q_);
                V w = q_[0], u = q_[1], v = q_[2], z = q_[3];
                V along = e[0] * u + e[1] * v + e[2] * z; V more = one + w;
                V f = R(2) / (more * more + along * along);
                V g0 = f * (more * (e[0] * w + e[2] * v - e[1] * z) + along * u);
                V g1 = f * (more * (e[1] * w + e[0] * z - e[2] * u) + along * v);
                V g2 = f * (more * (e[2] * w + e[1] * u - e[0] * v) + along * z);
                V h0 = l[0] * g0 + l[1] * g1 + l[2] * g2, h1 = l[3] * g0 + l[4] * g1 + l[5] * g2;
                V h2 = l[6] * g0 + l[7] * g1 + l[8] * g2;
                for (int r = 0; r < 3; r++) st[3*c+r] = a[3*r] * h0 + a[3*r+1] * h1 + a[3*r+2] * h2;
                for (int n = 0; n < N; n++)
                    ((R*)(twist + c))[n] = 4 * wp::atan2(((R*)&along)[n], ((R*)&more)[n]);
            }
            for (int h = 0; h < helper_count; h++) {
                V angle = zero, sine, cosine;
                for (int i = mix_start[h]; i < mix_start[h+1];
                    i++) angle += mix_value[i] * twist[mix_channel[i]];
                for (int n = 0; n < N; n++) {
                    ((R*)&sine)[n] = wp::sin(((R*)&angle)[n]); ((R*)&cosine)[n] = wp::cos(((R*)&angle)[n]);
                }
                const R* e = spin_axis + 3 * h; M o = rel + 9 * (joint_count + h); V more = one - cosine;
                for (int r = 0; r < 3; r++) {
                    for (int q = 0; q < 3; q++) o[3*r+q] = (e[r] * e[q]) * more;
                    o[4*r] += cosine;
                }
                o[1] -= e[2] * sine; o[2] += e[1] * sine; o[3] += e[2] * sine;
                o[5] -= e[0] * sine; o[6] -= e[1] * sine; o[7] += e[0] * sine;
            }
        }
        int p = parents[j]; M a = tr + 9 * p; M b = rel + 9 * j; L o = offsets + 3 * j;
        for (int r = 0; r < 3; r++) {
            V a0 = a[3*r], a1 = a[3*r+1], a2 = a[3*r+2];
            for (int c = 0; c < 3; c++) tr[9*j+3*r+c] = a0 * b[c] + a1 * b[3+c] + a2 * b[6+c];
            pl[3*j+r] = p == 0 ? hp[r] : pl[3*p+r] + o[0] * a0 + o[1] * a1 + o[2] * a2;
        }
    }
"""
)

CHANGE = """
    for (int t = 0; t < weighted_count; t++) {
        int j = weighted[t];
        for (int r = 0; r < 3; r++) {
            for (int c = 0; c < 3; c++) {
                V x = trial_turns[9*j+3*r+c]; change[12*t+4*r+c] = begin ? x : x - turns[9*j+3*r+c];
            }
            V x = trial_places[3*j+r]; change[12*t+4*r+3] = begin ? x : x - places[3*j+r];
        }
    }
    for (int i = 0; i < 12 * weighted_count; i++) product[i] = zero;
    for (int n = 0; n < pair_count; n++) {
        int t = pairs[2*n], u = pairs[2*n+1]; L m = second + 16 * n;
        for (int r = 0; r < 3; r++) {
            M x = change + 12*t + 4*r; M y = product + 12*u + 4*r;
            for (int c = 0; c < 4; c++) y[c] += m[c] * x[0] + m[4+c] * x[1] + m[8+c] * x[2] + m[12+c]
                * x[3];
        }
        if (t != u) for (int r = 0; r < 3; r++) {
            M x = change + 12*u + 4*r; M y = product + 12*t + 4*r;
            for (int c = 0; c < 4; c++)
                y[c] += m[4*c] * x[0] + m[4*c+1] * x[1] + m[4*c+2] * x[2] + m[4*c+3] * x[3];
        }
    }
    V sum = zero;
    if (!begin) for (int i = 0; i < 12 * weighted_count;
        i++) sum += change[i] * (product[i] + R(2) * residual[i]);
    gained[0] = sum;
"""

BEGIN = """
    for (int i = 0; i < 9 * all_count; i++) { turns[i] = trial_turns[i]; relative[i] = trial_relative[i]; }
    for (int i = 0; i < 3 * all_count; i++) places[i] = trial_places[i];
    for (int i = 0; i < 3 * channel_count; i++) steer[i] = trial_steer[i];
    for (int r = 0; r < 3; r++) hips[r] = trial_hips[r];
    if (forced) for (int i = 0; i < 12 * weighted_count; i++) residual[i] = target[i];
    else for (int i = 0; i < 12 * weighted_count; i++) residual[i] = product[i] - target[i];
"""

FORCES = """
    for (int i = 0; i < 9 * all_count; i++) spread[i] = zero;
    for (int i = 0; i < 3 * all_count; i++) force[i] = zero;
    for (int t = 0; t < weighted_count; t++) {
        int j = weighted[t]; M d = turns + 9*j; M x = residual + 12*t;
        for (int r = 0; r < 3; r++) {
            force[3*j+r] = x[4*r+3];
            for (int c = 0; c < 3; c++)
                spread[9*j+3*r+c] = d[3*r] * x[4*c] + d[3*r+1] * x[4*c+1] + d[3*r+2] * x[4*c+2];
        }
    }
    for (int n = 0; n < column_count; n++) {
        int j = joint[n], p = parent[n];
        for (int r = 0; r < 3; r++) {
            V shift = places[3*j+r] - places[3*p+r];
            for (int c = 0; c < 3; c++) spread[9*p+3*r+c] += spread[9*j+3*r+c] + shift * force[3*j+c];
        }
        for (int r = 0; r < 3; r++) force[3*p+r] += force[3*j+r];
        M x = spread + 9*j;
        slope[3*n] = x[5] - x[7]; slope[3*n+1] = x[6] - x[2]; slope[3*n+2] = x[1] - x[3];
    }
    for (int r = 0; r < 3; r++) slope[3*column_count+r] = force[r];
    for (int c = 0; c < channel_count; c++) twist[c] = zero;
    for (int n = 0; n < driven_count; n++) {
        int h = joint[n] - joint_count; const R* e = spin_axis + 3*h;
            M d = turns + 9 * parents[joint[n]];
        V torque = zero;
        for (int r = 0; r < 3; r++) torque += slope[3*n+r] * (d[3*r]*e[0] + d[3*r+1]*e[1] + d[3*r+2]*e[2]);
        for (int i = mix_start[h]; i < mix_start[h+1]; i++) twist[mix_channel[i]] += mix_value[i] * torque;
    }
    for (int i = 0; i < chain_count; i++) {
        M y = slope + 3 * chain_column[i]; M g = steer + 3 * chain_channel[i];
            V t = twist[chain_channel[i]];
        for (int r = 0; r < 3; r++) y[r] += t * g[r];
    }
"""

SOLVE = """
    for (int n = driven_count; n < column_count; n++) {
        M d = blocks + 12 * block_start[n]; M i = inverse + 3*n; M x = slope + 3*n;
        V y0 = x[0] * i[0], y1 = (x[1] - d[4] * y0) * i[1], y2 = (x[2] - d[8] * y0 - d[9] * y1) * i[2];
        x[0] = y0; x[1] = y1; x[2] = y2;
        for (int q = block_start[n] + 1; q <= block_start[n+1]; q++) {
            bool own = q < block_start[n+1];
            M o = slope + 3 * (own ? block_row[q] : column_count);
                M b = own ? blocks + 12*q : carry + 9*n;
            int w = own ? 4 : 3;
            for (int r = 0; r < 3; r++) o[r] -= b[w*r] * y0 + b[w*r+1] * y1 + b[w*r+2] * y2;
        }
    }
    M t = slope + 3 * column_count; M i = inverse + 3 * column_count;
    V t0 = t[0] * i[0], t1 = (t[1] - last[3] * t0) * i[1], t2 = (t[2] - last[6] * t0 - last[7] * t1) * i[2];
    t2 = t2 * i[2]; t1 = (t1 - last[7] * t2) * i[1]; t0 = (t0 - last[3] * t1 - last[6] * t2) * i[0];
    t[0] = t0; t[1] = t1; t[2] = t2;
    for (int n = column_count - 1; n >= driven_count; n--) {
        M d = blocks + 12 * block_start[n]; M v = inverse + 3*n; M x = slope + 3*n;
        V z0 = x[0], z1 = x[1], z2 = x[2];
        for (int q = block_start[n] + 1; q <= block_start[n+1]; q++) {
            bool own = q < block_start[n+1];
            M o = slope + 3 * (own ? block_row[q] : column_count);
                M b = own ? blocks + 12*q : carry + 9*n;
            int w = own ? 4 : 3;
            for (int r = 0; r < 3; r++) { z0 -= b[w*r] * o[r]; z1 -= b[w*r+1] * o[r];
                z2 -= b[w*r+2] * o[r]; }
        }
        z2 = z2 * v[2]; z1 = (z1 - d[9] * z2) * v[1]; z0 = (z0 - d[4] * z1 - d[8] * z2) * v[0];
        x[0] = z0; x[1] = z1; x[2] = z2;
    }
"""

_DEVIATION = """
#define DEVIATE(q, rel) \\
        int k_ = soft[q]; M x = (rel) + 9 * joint[k_]; \\
        M y = (M)reference.data + 9*(q); \\
        V tr_ = zero; for (int i = 0; i < 9; i++) tr_ += x[i] * y[i]; \\
        V a0 = zero, a1 = zero, a2 = zero; \\
        for (int i = 0; i < 3; i++) { a0 += x[6+i] * y[3+i] - x[3+i] * y[6+i]; \\
            a1 += x[i] * y[6+i] - x[6+i] * y[i]; a2 += x[3+i] * y[i] - x[i] * y[3+i]; } \\
        V angle, over, reach; R free_ = stiff[soft_count + (q)]; \\
        for (int n = 0; n < N; n++) { R u = ((R*)&a0)[n], v = ((R*)&a1)[n], z = ((R*)&a2)[n]; \\
            R len = wp::sqrt(u*u + v*v + z*z); R th = wp::atan2(len, ((R*)&tr_)[n] - 1); \\
            ((R*)&angle)[n] = th; ((R*)&over)[n] = th > free_ ? th - free_ : R(0); \\
            ((R*)&reach)[n] = len > R(1e-12) ? 1 / len : R(0); } \\
        a0 *= reach; a1 *= reach; a2 *= reach;
"""

TERMS = (
    _DEVIATION
    + """
    const int* soft = softs.data; const R* stiff = stiffs.data;
    V total = zero;
    for (int q = 0; q < soft_count; q++) {
        DEVIATE(q, trial ? trial_relative : relative)
        V own = stiff[q] * mass[0];
        total += own * over * over;
        if (trial) continue;
        V across, along;
        for (int n = 0; n < N; n++) {
            R o = ((R*)&over)[n], g = ((R*)&angle)[n], s_ = ((R*)&own)[n];
            R t = free_ > 0 ? s_ * o / (g > R(1e-6) ? g : R(1e-6)) : s_;
            ((R*)&across)[n] = t; ((R*)&along)[n] = o > 0 ? s_ : t;
        }
        M d = turns + 9 * parent[k_]; V w[3];
        for (int r = 0; r < 3; r++) { w[r] = d[3*r]*a0 + d[3*r+1]*a1 + d[3*r+2]*a2;
            slope[3*k_+r] += own * over * w[r]; }
        M b = blocks + 12 * block_start[k_];
        for (int r = 0; r < 3; r++) {
            b[5*r] += across;
            for (int c = 0; c < 3; c++) b[4*r+c] += (along - across) * w[r] * w[c];
        }
    }
    if (trial) gained[0] += total - soft_energy[0]; else soft_energy[0] = total;
    const R* hinge = stiff + 2 * soft_count;
    if (!trial) for (int n = driven_count; n < hinge_end; n++) {
        const R* e = hinge + 3*n; if (e[0] == 0 && e[1] == 0 && e[2] == 0) continue;
        M d = turns + 9 * parent[n]; M b = blocks + 12 * block_start[n]; V w[3];
        for (int r = 0; r < 3; r++) w[r] = d[3*r]*e[0] + d[3*r+1]*e[1] + d[3*r+2]*e[2];
        V big = stiffness * (b[0] + b[5] + b[10]);
        for (int r = 0; r < 3; r++) { b[5*r] += big; for (int c = 0; c < 3;
            c++) b[4*r+c] -= big * w[r] * w[c]; }
    }
"""
)

MOVE = """
    const R* hinge = stiffs.data + 2 * soft_count;
    for (int n = driven_count; n < hinge_end; n++) {
        const R* e = hinge + 3*n; if (e[0] == 0 && e[1] == 0 && e[2] == 0) continue;
        M d = turns + 9 * parent[n]; M x = slope + 3*n; V w[3];
        for (int r = 0; r < 3; r++) w[r] = d[3*r]*e[0] + d[3*r+1]*e[1] + d[3*r+2]*e[2];
        V along = w[0]*x[0] + w[1]*x[1] + w[2]*x[2]; for (int r = 0; r < 3; r++) x[r] = along * w[r];
    }
    auto cayley = [&](M d, V x, V y, V z, V* m) {
        V a = d[0]*x + d[3]*y + d[6]*z, b = d[1]*x + d[4]*y + d[7]*z, c = d[2]*x + d[5]*y + d[8]*z;
        V f = R(2) / (one + a*a + b*b + c*c), fa = f*a, fb = f*b, fc = f*c;
        m[0] = one - fb*b - fc*c; m[1] = fa*b - fc; m[2] = fa*c + fb;
        m[3] = fa*b + fc; m[4] = one - fa*a - fc*c; m[5] = fb*c - fa;
        m[6] = fa*c - fb; m[7] = fb*c + fa; m[8] = one - fa*a - fb*b;
    };
    for (int n = column_count - 1; n >= driven_count; n--) {
        M x = slope + 3*n; V q = x[0]*x[0] + x[1]*x[1] + x[2]*x[2], cut;
        for (int i = 0; i < N; i++) {
            R len = wp::sqrt(((R*)&q)[i]); ((R*)&cut)[i] = R(0.5) * (len > longest ? longest / len : R(1));
        }
        int above = parent_column[n]; M d = turns + 9 * parent[n];
        V u0 = -cut*x[0], u1 = -cut*x[1], u2 = -cut*x[2], m[9];
        if (apart && above >= 0) {
            M y = slope + 3 * above; V a[9], b[9];
            u0 += y[0]; u1 += y[1]; u2 += y[2];
            cayley(d, y[0], y[1], y[2], a); cayley(d, u0, u1, u2, b);
            for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++)
                m[3*r+c] = a[r] * b[c] + a[3+r] * b[3+c] + a[6+r] * b[6+c];
        } else cayley(d, u0, u1, u2, m);
        if (apart) { x[0] = u0; x[1] = u1; x[2] = u2; }
        M u = relative + 9 * joint[n]; M o = trial_relative + 9 * joint[n]; V t[9], g[9];
        for (int r = 0; r < 3; r++) for (int k_ = 0; k_ < 3; k_++)
            t[3*r+k_] = m[3*r] * u[k_] + m[3*r+1] * u[3+k_] + m[3*r+2] * u[6+k_];
        for (int r = 0; r < 3; r++) for (int k_ = 0; k_ < 3; k_++)
            g[3*r+k_] = (r == k_ ? R(1.5) : R(0)) - R(0.5) * (t[r]*t[k_] + t[3+r]*t[3+k_] + t[6+r]*t[6+k_]);
        for (int r = 0; r < 3; r++) for (int k_ = 0; k_ < 3; k_++)
            o[3*r+k_] = t[3*r] * g[k_] + t[3*r+1] * g[3+k_] + t[3*r+2] * g[6+k_];
    }
    for (int r = 0; r < 3; r++) trial_hips[r] = hips[r] - slope[3*column_count+r];
"""

ACCEPT = """
    V better; int left_over = 0;
    for (int n = 0; n < N; n++) {
        R* go = (R*)moving + n; R gain = ((R*)gained)[n]; R good = (*go > R(0.5) && gain < 0) ? R(1) : R(0);
        ((R*)&better)[n] = good; ((R*)accepted)[n] += good;
        R* damp = (R*)damping + n; R next = *damp * (good > R(0.5) ? lower : higher);
        *damp = next < most ? (next > least ? next : least) : most;
        if (*go > R(0.5)) {
            ((R*)last_change)[n] = gain;
            R size = gain < 0 ? -gain : gain; if (size < ((R*)threshold)[n]) *go = 0;
        }
        if (*go > R(0.5)) left_over++;
    }
    const V half = zero + R(0.5);
    #define CHOOSE(a, b, count) for (int i = 0; i < (count); i++) \\
        (a)[i] = better > half ? (b)[i] : (a)[i];
    for (int i = 0; i < 12 * weighted_count; i++) product[i] += residual[i];
    CHOOSE(residual, product, 12 * weighted_count)
    CHOOSE(relative, trial_relative, 9 * all_count)
    CHOOSE(turns, trial_turns, 9 * all_count)
    CHOOSE(places, trial_places, 3 * all_count)
    CHOOSE(steer, trial_steer, 3 * channel_count)
    CHOOSE(hips, trial_hips, 3)
    return left_over;
"""
