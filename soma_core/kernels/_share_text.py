"""Native body of the search of limbs' twist: see ``inversion.limbs.TwistShare``, its twin.

Names are those of :func:`soma_core.kernels._solver_text.prelude`. Shares are looked at in blocks, so that
products of activations with their shapes stay in registers.
"""

from soma_core.kernels._solver_text import QUATERNION
from soma_core.kernels._view_text import TANH

__all__ = ["BLOCK", "MOST_HELPERS", "MOST_SHARES", "SHARE", "share_room"]

BLOCK, MOST_SHARES, MOST_HELPERS = 5, 25, 8
"""Shares looked at together, and at most; helpers of a limb."""


def share_room(helpers: int, activations: int) -> int:
    """Vectors of working memory that a limb takes."""
    return 4 * helpers**2 + 20 * helpers + (1 + BLOCK) * activations + MOST_SHARES


_SINE = """
    #define SINE(x, s, c) do { V x_ = (x), s_ = zero, c_ = zero; \\
        if (sizeof(R) == 8 || N == 1) for (int n_ = 0; n_ < N; n_++) { \\
            ((R*)&s_)[n_] = wp::sin(((R*)&x_)[n_]); ((R*)&c_)[n_] = wp::cos(((R*)&x_)[n_]); } \\
        else { \\
            V k_ = (x_ * R(0.63661977236) + R(12582912)) - R(12582912); \\
            V r_ = (x_ - k_ * R(1.5703125)) - k_ * R(4.8382679e-4), q_ = r_ * r_; \\
            V a_ = r_ + r_ * q_ * (R(-1./6) + q_ * (R(1./120) + q_ * (R(-1./5040) + q_ * R(1./362880)))); \\
            V b_ = one + q_ * (R(-0.5) + q_ * (R(1./24) + q_ * (R(-1./720) + q_ * R(1./40320)))); \\
            for (int n_ = 0; n_ < N; n_++) { \\
                int t_ = (int)((R*)&k_)[n_] & 3; R u_ = ((R*)&a_)[n_], v_ = ((R*)&b_)[n_]; \\
                ((R*)&s_)[n_] = t_ == 0 ? u_ : t_ == 1 ? v_ : t_ == 2 ? -u_ : -v_; \\
                ((R*)&c_)[n_] = t_ == 0 ? v_ : t_ == 1 ? -u_ : t_ == 2 ? -v_ : u_; } \\
        } s = s_; c = c_; } while (0)
    #define ARC(x) do { for (int n_ = 0; n_ < N; n_++) \\
        ((R*)&(x))[n_] = wp::atan(((R*)&(x))[n_]); } while (0)
"""
"""Sine and cosine of an angle of some turns, and the inverse tangent in place."""

_PARTS = """
    const int W = 3 * feature_columns; constexpr int A = BLOCK;
    auto read_joint = [&](const V* m, const R* l, const R* d, V* o) {
        for (int r = 0; r < 3; r++) {
            V y[3];
            for (int c = 0; c < 3; c++) y[c] = l[3*r] * m[c] + l[3*r+1] * m[3+c] + l[3*r+2] * m[6+c];
            for (int c = 0; c < feature_columns; c++)
                *o++ = y[0] * d[c] + y[1] * d[feature_columns+c] + y[2] * d[2*feature_columns+c];
        }
    };
    auto squashed = [&](V x) {
        if (!squash) return x;
        x = x > zero ? x : zero;
        return squash > 1 ? tanh_of(x) : x;
    };
    auto times = [&](const V* a, const V* b, V* o) {
        o[0] = a[0]*b[0] - a[1]*b[1] - a[2]*b[2] - a[3]*b[3];
        o[1] = a[0]*b[1] + a[1]*b[0] + a[2]*b[3] - a[3]*b[2];
        o[2] = a[0]*b[2] + a[2]*b[0] + a[3]*b[1] - a[1]*b[3];
        o[3] = a[0]*b[3] + a[3]*b[0] + a[1]*b[2] - a[2]*b[1];
    };
    auto about = [&](const R* e, V s, V c, V* t) {
        V more = one - c;
        for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++) t[3*r+q] = (e[r] * e[q]) * more;
        for (int r = 0; r < 3; r++) t[4*r] += c;
        t[1] -= e[2] * s; t[2] += e[1] * s; t[3] += e[2] * s;
        t[5] -= e[0] * s; t[6] -= e[1] * s; t[7] += e[0] * s;
    };
"""
"""Features of a joint's rotation, activations, products of quaternions, a turn about an axis."""

_TWISTS = """
        V before_[4], first_[4], last_[4], after_[4], m[9], x[9];
        {
            M a = turns + 9 * channel_reference[own_channel]; M b = turns + 9 * own; M e_ = turns + 9 * end;
            L l = lefts + 9 * own_channel; L d = rights + 9 * own_channel;
            for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++)
                x[3*r+q] = a[r] * b[q] + a[3+r] * b[3+q] + a[6+r] * b[6+q];
            for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++)
                m[3*r+q] = l[r] * x[q] + l[3+r] * x[3+q] + l[6+r] * x[6+q];
            quaternion_of(m, before_);
            for (int i = 0; i < 9; i++) m[i] = zero + d[i];
            quaternion_of(m, first_);
            L left_ = lefts + 9 * end_channel; L right_ = rights + 9 * end_channel;
            for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++) m[3*r+q] = zero + left_[3*q+r];
            quaternion_of(m, last_);
            for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++)
                x[3*r+q] = b[r] * e_[q] + b[3+r] * e_[3+q] + b[6+r] * e_[6+q];
            for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++)
                m[3*r+q] = x[3*r] * right_[q] + x[3*r+1] * right_[3+q] + x[3*r+2] * right_[6+q];
            quaternion_of(m, after_);
        }
        auto twisted = [&](R s, R c, V* found, V& clear) {
            V turn_[4] = {zero + c, zero + s * axis[0], zero + s * axis[1], zero + s * axis[2]}, y[4], z[4];
            for (int which = 0; which < 2; which++) {
                times(which ? last_ : before_, turn_, y);
                times(y, which ? after_ : first_, z);
                V sign = z[0] < zero ? -one : one;
                L e = axes + 3 * (which ? end_channel : own_channel);
                V along = sign * (z[1] * e[0] + z[2] * e[1] + z[3] * e[2]) / (one + sign * z[0]);
                ARC(along);
                found[which] = R(4) * along;
                V near = sign * z[0];
                if (which) near = near > clear ? clear : near;
                clear = near;
                for (int r = 1; r < 4; r++) turn_[r] = -turn_[r];
            }
        };
        auto doubted_ = [&](const V* t) {
            V y[9]; M e_ = relative + 9 * end;
            for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++)
                y[3*r+q] = t[r] * e_[q] + t[3+r] * e_[3+q] + t[6+r] * e_[6+q];
            V real = one + y[0] + y[4] + y[8]; real = real > R(1e-6) ? real : zero + R(1e-6);
            V ratio = ((y[7] - y[5]) * doubt[0] + (y[2] - y[6]) * doubt[1] + (y[3] - y[1]) * doubt[2]) / real;
            ARC(ratio);
            return doubt[3] * R(4) * ratio * ratio;
        };
"""
"""Twists of the bone and of the next one when the bone turns, least cosine of half their angles, doubt."""

_HELPERS = """
        M square_ = scratch; M pulled_ = scratch + 4 * helpers * helpers; M basis_ = pulled_ + 2 * helpers;
        for (int i = 0; i < 4 * helpers * helpers + 2 * helpers; i++) square_[i] = zero;
        for (int h = 0; h < helpers; h++) {
            M d = turns + 9 * helper[h]; M p = residual + 12 * cloud[h]; M o = basis_ + 18 * h;
            for (int r = 0; r < 3; r++) {
                o[3*r] = d[3*r+1] * axis[2] - d[3*r+2] * axis[1];
                o[3*r+1] = d[3*r+2] * axis[0] - d[3*r] * axis[2];
                o[3*r+2] = d[3*r] * axis[1] - d[3*r+1] * axis[0];
                o[9+3*r] = o[3*r+1] * axis[2] - o[3*r+2] * axis[1];
                o[9+3*r+1] = o[3*r+2] * axis[0] - o[3*r] * axis[2];
                o[9+3*r+2] = o[3*r] * axis[1] - o[3*r+1] * axis[0];
            }
            for (int k_ = 0; k_ < 2; k_++) for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++)
                pulled_[2*h+k_] += o[9*k_+3*r+c] * p[4*r+c];
        }
        for (int q = 0; q < pairs_; q++) {
            int a = first[q], b = last_of[q]; L n = second + 16 * pair[q];
            for (int x_ = 0; x_ < 2; x_++) {
                M u = basis_ + 18 * a + 9 * x_; V y[9];
                for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++)
                    y[3*r+c] = u[3*r] * n[c] + u[3*r+1] * n[4+c] + u[3*r+2] * n[8+c];
                for (int y_ = 0; y_ < 2; y_++) {
                    M v = basis_ + 18 * b + 9 * y_; V sum = zero;
                    for (int i = 0; i < 9; i++) sum += y[i] * v[i];
                    square_[2*helpers*(2*a+x_) + 2*b+y_] += a == b ? sum : R(2) * sum;
                }
            }
        }
"""
"""Products of the helpers' motions, which are sines and cosines of their spins, and what pulls at them."""

_MOVED = """
        M calm = basis_ + 18 * helpers; M moved_ = calm + ids; M energies = moved_ + A * ids;
        for (int c = 0; c < ids; c++) calm[c] = squashed(before[id[c]]);
        V still_[18], twist_0[2], clear = one, u[9], v[9];
        for (int i = 0; i < 9; i++) { u[i] = relative[9*own+i]; v[i] = relative[9*end+i]; }
        read_joint(u, left_own, right_own, still_);
        read_joint(v, left_end, right_end, still_ + W);
        twisted(R(0), R(1), twist_0, clear);
        about(axis, zero, one, x);
        V doubt_0 = doubted_(x), size2 = scale[0] * scale[0];
        for (int a0 = 0; a0 < count; a0 += A) {
            V change_[A*18], energy_[A];
            for (int a = 0; a < A; a++) {
                const R* angle = angles.data + 5 * (a0 + a < count ? a0 + a : count - 1);
                V turn_[9], other[9], twist_[2];
                about(axis, zero + angle[1], zero + angle[2], turn_);
                for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++) {
                    m[3*r+c] = u[3*r] * turn_[c] + u[3*r+1] * turn_[3+c] + u[3*r+2] * turn_[6+c];
                    other[3*r+c] = turn_[r] * v[c] + turn_[3+r] * v[3+c] + turn_[6+r] * v[6+c];
                }
                V* to = change_ + 18 * a;
                read_joint(m, left_own, right_own, to); read_joint(other, left_end, right_end, to + W);
                for (int i = 0; i < 2*W; i++) to[i] -= still_[i];
                twisted(angle[3], angle[4], twist_, clear);
                V sum = gained[0] * (doubted_(turn_) - doubt_0), part[2*8];
                for (int h = 0; h < helpers; h++) {
                    V spin = (twist_[0] - twist_0[0]) * mix[h] + (twist_[1] - twist_0[1]) * mix[helpers+h]
                        + angle[0], s_i, c_i;
                    SINE(spin, s_i, c_i);
                    part[2*h] = s_i; part[2*h+1] = one - c_i;
                }
                for (int i = 0; i < 2*helpers; i++) {
                    V row = R(2) * pulled_[i];
                    for (int j = 0; j < 2*helpers; j++) row += square_[2*helpers*j+i] * part[j];
                    sum += part[i] * row;
                }
                energy_[a] = sum + (clear < clear_least ? dear * dear * mass[0] : zero);
            }
            const R* by = reads;
            for (int c = 0; c < ids; c++, by += 2*W) {
                V b = before[id[c]], p = R(2) * pull[id[c]], s_[A];
                for (int a = 0; a < A; a++) s_[a] = b;
                for (int i = 0; i < 2*W; i++) for (int a = 0; a < A; a++) s_[a] += by[i] * change_[18*a+i];
                for (int a = 0; a < A; a++) {
                    V v = squashed(s_[a]) - calm[c];
                    moved_[A*c+a] = v; energy_[a] += p * v;
                }
            }
            for (int r = 0; r < ranks; r += 4) {
                V sum[4*A]; for (int i = 0; i < 4*A; i++) sum[i] = zero;
                const R* w = shapes + r * ids; M v = moved_;
                for (int c = 0; c < ids; c++, w += 4, v += A)
                    for (int i = 0; i < 4; i++) for (int a = 0; a < A; a++) sum[A*i+a] += w[i] * v[a];
                for (int i = 0; i < 4; i++) for (int a = 0; a < A; a++)
                    energy_[a] += size2 * sum[A*i+a] * sum[A*i+a];
            }
            for (int a = 0; a < A && a0 + a < count; a++) energies[a0+a] = energy_[a];
        }
"""
"""Energies of all shares of a limb."""

_LEAST = """
        V best = zero;
        for (int n = 0; n < N; n++) {
            R low = ((R*)&energies[0])[n]; int at_ = 0;
            for (int a = 1; a < count; a++) {
                R e = ((R*)&energies[a])[n]; if (e < low) { low = e; at_ = a; }
            }
            R angle = angles.data[5*at_];
            if (at_ > 0 && at_ < count - 1) {
                R below = ((R*)&energies[at_-1])[n], above = ((R*)&energies[at_+1])[n];
                R bend = below - 2 * low + above, shift = bend > 0 ? R(0.5) * (below - above) / bend : R(0);
                shift = shift > R(0.5) ? R(0.5) : shift < R(-0.5) ? R(-0.5) : shift == shift ? shift : R(0);
                angle += shift * (angles.data[5] - angles.data[0]);
            }
            ((R*)&best)[n] = angle;
        }
        V s_b, c_b; SINE(best, s_b, c_b);
        about(axis, s_b, c_b, x);
        M to_own = relative + 9 * own; M to_end = relative + 9 * end;
        for (int r = 0; r < 3; r++) for (int q = 0; q < 3; q++) {
            to_own[3*r+q] = u[3*r] * x[q] + u[3*r+1] * x[3+q] + u[3*r+2] * x[6+q];
            to_end[3*r+q] = x[r] * v[q] + x[3+r] * v[3+q] + x[6+r] * v[6+q];
        }
"""
"""The share of least energy, between those looked at by a parabola, and the limb turned by it."""

_SHARE = (
    QUATERNION
    + TANH
    + _SINE
    + _PARTS
    + """
    const int* I = limbs.data; const R* X = values.data; M scratch = response;
    const int limb_count = *I++;
    for (int limb = 0; limb < limb_count; limb++) {
        const int own = I[0], end = I[1], own_channel = I[2], end_channel = I[3], helpers = I[4];
        const int pairs_ = I[5], ids = I[6], ranks = I[7];
        const int* helper = I + 8; const int* cloud = helper + helpers; const int* pair = cloud + helpers;
        const int* first = pair + pairs_; const int* last_of = first + pairs_;
        const int* id = last_of + pairs_;
        I = id + ids;
        const R* axis = X; const R* mix = axis + 3; const R* left_own = mix + 2 * helpers;
        const R* right_own = left_own + 9; const R* left_end = right_own + W;
        const R* right_end = left_end + 9;
        const R* reads = right_end + W; const R* shapes = reads + 2 * W * ids;
        X = shapes + ids * ranks;
        const R* doubt = doubts.data + 4 * limb;
        if (held >> limb & 1) continue;
"""
    + _TWISTS
    + _HELPERS
    + _MOVED
    + _LEAST
    + "    }\n"
)

SHARE = _SHARE.replace("BLOCK", str(BLOCK))
