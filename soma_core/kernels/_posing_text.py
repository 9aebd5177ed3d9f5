"""C++ of the fused forward pose: what one block of threads does for one body.

The text is the same on CPU and CUDA. On CUDA the threads of a block share memory and meet at ``MEET``; on the
CPU a block is one thread, memory is local, and nothing is left to meet. Every loop runs from ``lane`` in
steps of ``width``, and no ``MEET`` stands inside a branch that threads could take apart.
"""

from collections.abc import Sequence

__all__ = [
    "BODY_INTS",
    "BODY_REALS",
    "JOINT_LIMIT",
    "THREADS",
    "body_text",
]

JOINT_LIMIT = 128
"""Most joints, and most twist channels, of a body: what fits into shared memory in float64."""

BODY_INTS = (
    "order", "level_start", "parents", "start", "end_user", "place_start", "place_id", "mix_start", "mix_id",
    "joint", "reference", "low", "high", "mode", "euler_axis", "first_start", "first_id",
)  # fmt: skip
"""Integer tables of a body, one behind the other; the header says where each begins."""

BODY_REALS = (
    "orient", "parent_orient", "left", "right", "place_value", "mix_value", "axis", "source_axis",
    "euler_sign", "first_value", "bone_length",
)  # fmt: skip
"""Tables of numbers of a body."""

THREADS = """
#if defined(__CUDA_ARCH__)
#define SOMA_SHARED __shared__
#define MEET __syncthreads()
    const int lane = threadIdx.x, width = blockDim.x;
#else
#define SOMA_SHARED
#define MEET
    const int lane = 0, width = 1;
#endif
"""
"""Who a thread is, at the head of every text."""


def _pointers(names: Sequence[str], kind: str, base: str, header: int) -> str:
    """Declare where each table begins, as the header in ``I`` says."""
    lines = (f"const {kind}* {name} = {base} + I[{header + at}];" for at, name in enumerate(names))
    return "\n".join(lines)


def body_text() -> str:
    """Kinematics, twist joints, skinning transforms and activations of body `index`."""
    head = "const int* I = ints.data; const R* C = reals.data;\n"
    head += "const int J = I[0], H = I[1], K = I[2], A = I[3], L = I[4], squash = I[5];\n"
    tables = _pointers(BODY_INTS, "int", "I", 6) + "\n" + _pointers(BODY_REALS, "R", "C", 6 + len(BODY_INTS))
    steps = (THREADS, head, tables, _MEMORY, _LOAD, _WALK, _TRANSFORMS, _CHANNELS, _HELPERS, _ACTIVATIONS)
    return "\n".join(steps).replace("LIMIT", str(JOINT_LIMIT))


_MEMORY = """
    SOMA_SHARED R rel[LIMIT * 9], turn[LIMIT * 9], away[LIMIT * 3], place[LIMIT * 3], spin[LIMIT * 9];
    SOMA_SHARED R feature[LIMIT * 6], channel[LIMIT], bone[LIMIT], part[8];
    const R* bind = bind_world.data + (long long)index * bind_stride;
    const R* given = rotations.data + (long long)index * rotation_stride;
    const R* hips = translation.data + (long long)index * translation_stride;
    const R* stretch = bone_scale.data + (long long)index * scale_stride;
"""

_LOAD = """
    for (int j = lane; j < J; j += width) {
        R m[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, h[9];
        if (j > 0 && axis_angle) {
            const R* v = given + (j - 1) * 3;
            R x = v[0], y = v[1], z = v[2], q = x * x + y * y + z * z, a, b;
            if (q < (R)(sizeof(R) == 4 ? 1e-4 : 1e-8)) {
                a = R(1) - q / R(6) + q * q / R(120);
                b = R(0.5) - q / R(24) + q * q / R(720);
            } else {
                R angle = wp::sqrt(q), half = wp::sin(R(0.5) * angle) / (R(0.5) * angle);
                a = wp::sin(angle) / angle;
                b = R(0.5) * half * half;
            }
            m[0] = R(1) - b * (y * y + z * z); m[1] = b * x * y - a * z; m[2] = b * x * z + a * y;
            m[3] = b * x * y + a * z; m[4] = R(1) - b * (x * x + z * z); m[5] = b * y * z - a * x;
            m[6] = b * x * z - a * y; m[7] = b * y * z + a * x; m[8] = R(1) - b * (x * x + y * y);
        } else if (j > 0) {
            for (int e = 0; e < 9; e++) m[e] = given[(j - 1) * 9 + e];
        }
        const R* up = parent_orient + 9 * j;
        const R* own = orient + 9 * j;
        if (j > 0 && absolute) {
            for (int e = 0; e < 9; e++) {
                const R* u = up + e / 3 * 3;
                h[e] = u[0] * m[e % 3] + u[1] * m[3 + e % 3] + u[2] * m[6 + e % 3];
            }
            for (int e = 0; e < 9; e++) {
                const R *u = h + e / 3 * 3, *o = own + e % 3 * 3;
                m[e] = u[0] * o[0] + u[1] * o[1] + u[2] * o[2];
            }
        }
        for (int e = 0; e < 9; e++) rel[9 * j + e] = m[e];
        R size = 0;
        if (j < 2) {
            for (int c = 0; c < 3; c++) away[3 * j + c] = j == 0 ? R(0) : hips[c];
        } else {
            const R *w = bind + 16 * j, *p = bind + 16 * parents[j];
            R d[3], q[3], longer = scaled ? stretch[j - 1] : R(1);
            for (int c = 0; c < 3; c++) d[c] = w[4 * c + 3] - p[4 * c + 3];
            for (int c = 0; c < 3; c++) q[c] = p[c] * d[0] + p[4 + c] * d[1] + p[8 + c] * d[2];
            for (int c = 0; c < 3; c++)
                away[3 * j + c] = longer * (up[3 * c] * q[0] + up[3 * c + 1] * q[1] + up[3 * c + 2] * q[2]);
            size = wp::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        }
        bone[j] = size;
        if (j == 0) {
            for (int e = 0; e < 9; e++) turn[e] = m[e];
            for (int c = 0; c < 3; c++) place[c] = 0;
        }
    }
"""

_WALK = """
    for (int i = 0; i < L; i++) {
        MEET;
        int first = level_start[i], count = 12 * (level_start[i + 1] - first);
        for (int e = lane; e < count; e += width) {
            int j = order[first + e / 12], c = e % 12, p = parents[j];
            const R* t = turn + 9 * p + (c < 9 ? c / 3 : c - 9) * 3;
            if (c < 9) {
                const R* r = rel + 9 * j + c % 3;
                turn[9 * j + c] = t[0] * r[0] + t[1] * r[3] + t[2] * r[6];
            } else {
                const R* o = away + 3 * j;
                place[3 * j + c - 9] = place[3 * p + c - 9] + t[0] * o[0] + t[1] * o[1] + t[2] * o[2];
            }
        }
    }
    MEET;
"""

_TRANSFORMS = """
    for (int e = lane; e < 3 * J; e += width) {
        int j = e / 3, r = e % 3;
        const R *t = turn + 9 * j + 3 * r, *o = orient + 9 * j, *w = bind + 16 * j;
        R m[3], s[3], shift = place[3 * j + r];
        for (int c = 0; c < 3; c++) m[c] = t[0] * o[c] + t[1] * o[3 + c] + t[2] * o[6 + c];
        R* to = world.data + ((long long)index * J + j) * 16 + 4 * r;
        to[0] = m[0]; to[1] = m[1]; to[2] = m[2]; to[3] = shift;
        if (r == 2) { to[4] = 0; to[5] = 0; to[6] = 0; to[7] = 1; }
        if (j > 0) joints.data[((long long)index * (J - 1) + j - 1) * 3 + r] = shift;
        if (!skinned) continue;
        for (int c = 0; c < 3; c++) s[c] = m[0] * w[4 * c] + m[1] * w[4 * c + 1] + m[2] * w[4 * c + 2];
        for (int c = 0; c < 3; c++) spin[9 * j + 3 * r + c] = s[c];
        to = skin.data + ((long long)index * (J + H) + j) * 12 + 4 * r;
        to[0] = s[0]; to[1] = s[1]; to[2] = s[2];
        to[3] = shift - (s[0] * w[3] + s[1] * w[7] + s[2] * w[11]);
    }
    if (!skinned) return;
    for (int e = lane; e < (A > 0 ? 6 * J : 0); e += width) {
        int j = e / 6, r = e % 6 / 2, c = e % 2;
        R f = 0;
        if (j > 0) {
            const R *u = left + 9 * (j - 1) + 3 * r, *m = rel + 9 * j, *v = right + 9 * (j - 1) + c;
            for (int k = 0; k < 3; k++, m += 3) f += u[k] * (m[0] * v[0] + m[1] * v[3] + m[2] * v[6]);
            f -= r == c ? R(1) : R(0);
        }
        feature[e] = f;
    }
    for (int e = lane; e < 8; e += width) {
        R sum = 0;
        for (int j = e; j < J; j += 8) sum += bone[j];
        part[e] = sum;
    }
    MEET;
"""

_CHANNELS = """
    auto twist_angle = [](const R* m, const R* axis) {  // 4 atan2(q_v . e, 1 + q_w), q_w >= 0
        R four[4] = {R(1) + m[0] + m[4] + m[8], R(1) + m[0] - m[4] - m[8], R(1) + m[4] - m[0] - m[8],
                     R(1) + m[8] - m[0] - m[4]};
        int best = 0;
        for (int k = 1; k < 4; k++) if (four[k] > four[best]) best = k;
        R a = m[7] - m[5], b = m[2] - m[6], c = m[3] - m[1];
        R xy = m[1] + m[3], xz = m[2] + m[6], yz = m[5] + m[7];
        R w = best == 0 ? four[0] : best == 1 ? a : best == 2 ? b : c;
        R x = best == 0 ? a : best == 1 ? four[1] : best == 2 ? xy : xz;
        R y = best == 0 ? b : best == 1 ? xy : best == 2 ? four[2] : yz;
        R z = best == 0 ? c : best == 1 ? xz : best == 2 ? yz : four[3];
        R size = wp::sqrt(w * w + x * x + y * y + z * z) * (w < R(0) ? R(-1) : R(1));
        R along = (x * axis[0] + y * axis[1] + z * axis[2]) / size;
        return R(4) * wp::atan2(along, R(1) + w / size);
    };
    auto safe_atan2 = [](R y, R x) {
        R eps = sizeof(R) == 4 ? R(1.1920928955078125e-7) : R(2.220446049250313e-16);
        return wp::atan2(y, x * x + y * y < eps * eps ? R(1) : x);
    };
    for (int k = lane; k < K; k += width) {
        const R *before = spin + 9 * reference[k], *after = spin + 9 * joint[k];
        R m[9], h[9], axis_now[3];
        for (int e = 0; e < 9; e++)
            m[e] = before[e / 3] * after[e % 3] + before[3 + e / 3] * after[3 + e % 3]
                + before[6 + e / 3] * after[6 + e % 3];
        const R* source = source_axis + 3 * k;
        if (mode[k] == 0) {
            const R *a = bind + 16 * low[k], *b = bind + 16 * high[k];
            R own[3], size = 0, dot = 0;
            for (int c = 0; c < 3; c++) {
                axis_now[c] = b[4 * c + 3] - a[4 * c + 3];
                own[c] = a[4 * c] * source[0] + a[4 * c + 1] * source[1] + a[4 * c + 2] * source[2];
                size += axis_now[c] * axis_now[c];
            }
            size = wp::sqrt(size);
            for (int c = 0; c < 3; c++) {
                axis_now[c] = size > R(1e-8) ? axis_now[c] / size : own[c];
                dot += axis_now[c] * own[c];
            }
            for (int c = 0; c < 3; c++) axis_now[c] = dot < R(0) ? -axis_now[c] : axis_now[c];
            channel[k] = twist_angle(m, axis_now);
        } else {
            const R *u = bind + 16 * reference[k], *v = bind + 16 * joint[k];
            for (int e = 0; e < 9; e++)
                h[e] = u[e / 3] * m[e % 3] + u[4 + e / 3] * m[3 + e % 3] + u[8 + e / 3] * m[6 + e % 3];
            for (int e = 0; e < 9; e++) {
                const R* row = h + e / 3 * 3;
                m[e] = row[0] * v[e % 3] + row[1] * v[4 + e % 3] + row[2] * v[8 + e % 3];
            }
            R eps = sizeof(R) == 4 ? R(1.1920928955078125e-7) : R(2.220446049250313e-16);
            R across = wp::sqrt(wp::max(m[0] * m[0] + m[1] * m[1], eps * eps));
            R euler = euler_axis[k] == 0 ? safe_atan2(m[7], m[4])
                : euler_axis[k] == 1 ? wp::atan2(m[2], across) : safe_atan2(-m[1], m[0]);
            channel[k] = mode[k] == 1 ? twist_angle(m, source) : euler_sign[k] * euler;
        }
    }
    MEET;
"""

_HELPERS = """
    for (int h = lane; h < H; h += width) {
        R angle = 0, at[3] = {0, 0, 0}, d[3], q[3], n[3], m[9];
        for (int e = mix_start[h]; e < mix_start[h + 1]; e++) angle += mix_value[e] * channel[mix_id[e]];
        for (int e = place_start[h]; e < place_start[h + 1]; e++)
            for (int c = 0; c < 3; c++) at[c] += place_value[e] * bind[16 * place_id[e] + 4 * c + 3];
        const R *w = bind + 16 * start[h], *own = axis + 3 * h, *s = spin + 9 * start[h];
        R longer = scaled ? stretch[end_user[h]] : R(1), cosine = wp::cos(angle), sine = wp::sin(angle);
        for (int c = 0; c < 3; c++) n[c] = w[4 * c] * own[0] + w[4 * c + 1] * own[1] + w[4 * c + 2] * own[2];
        for (int e = 0; e < 9; e++) m[e] = (R(1) - cosine) * n[e / 3] * n[e % 3];
        m[0] += cosine; m[4] += cosine; m[8] += cosine;
        m[1] -= sine * n[2]; m[2] += sine * n[1]; m[3] += sine * n[2];
        m[5] -= sine * n[0]; m[6] -= sine * n[1]; m[7] += sine * n[0];
        for (int c = 0; c < 3; c++) d[c] = longer * (at[c] - w[4 * c + 3]);
        for (int c = 0; c < 3; c++)
            q[c] = d[c] - (m[3 * c] * at[0] + m[3 * c + 1] * at[1] + m[3 * c + 2] * at[2]);
        R* to = skin.data + ((long long)index * (J + H) + J + h) * 12;
        for (int r = 0; r < 3; r++) {
            const R* row = s + 3 * r;
            for (int c = 0; c < 3; c++) to[4 * r + c] = row[0] * m[c] + row[1] * m[3 + c] + row[2] * m[6 + c];
            to[4 * r + 3] = place[3 * start[h] + r] + row[0] * q[0] + row[1] * q[1] + row[2] * q[2];
        }
    }
"""

_ACTIVATIONS = """
    R scale = 0;
    for (int e = 0; e < 8; e++) scale += part[e];
    scale = scale / bone_length[0];
    for (int a = lane; a < A; a += width) {
        if (squash > 1) {  // what goes into the activations, and the size, for who makes them
            active.data[(long long)index * A + a] = a < 6 * J ? feature[a] : scale;
            continue;
        }
        int s = a / 32, count = first_start[s + 1] - first_start[s];
        const int* id = first_id + first_start[s] + a % 32;
        const R* value = first_value + first_start[s] + a % 32;
        R sum = 0;
        for (int e = 0; e < count; e += 32) sum += value[e] * feature[id[e]];
        sum = sum > R(0) ? sum : R(0);
        active.data[(long long)index * A + a] = scale * (squash ? wp::tanh(sum) : sum);
    }
"""
