"""Native bodies round the model's residual: what a pose gives it, and what its sums say of the joints.

Names are those of :func:`soma_core.kernels._solver_text.prelude`.
"""

__all__ = ["ACTIVATE", "DOUBT", "KEEP", "PULL", "TANH", "TRANSFORM", "TURN"]

TRANSFORM = """
    for (int j = 0; j < all_count; j++) {
        L b = binds + 12*j; M d = turns + 9*j; M o = transform + 12*j;
        for (int r = 0; r < 3; r++, o += 4) {
            for (int c = 0; c < 3; c++) o[c] = d[3*r] * b[c] + d[3*r+1] * b[4+c] + d[3*r+2] * b[8+c];
            o[3] = places[3*j+r] - (o[0] * b[3] + o[1] * b[7] + o[2] * b[11]);
        }
    }
"""
"""``G B^-1`` of every joint."""

TANH = """
    #if defined(__clang__)
    auto tanh_of = [&](V x) {
        if (sizeof(R) == 8 || N == 1) {
            for (int n = 0; n < N; n++) ((R*)&x)[n] = wp::tanh(((R*)&x)[n]);
            return x;
        }
        V y = R(-2) * x; y = y > R(-40) ? y : zero - R(40);
        V k = (y * R(1.442695041) + R(12582912)) - R(12582912);
        V r = (y - k * R(0.693359375)) - k * R(-2.12194440e-4);
        V p = R(1./720) + r * R(1./5040);
        p = R(1./24) + r * (R(1./120) + r * p);
        p = r * (one + r * (R(0.5) + r * (R(1./6) + r * p)));
        V s = zero;
        for (int n = 0; n < N; n++) {
            union { int i; float f; } power; power.i = ((int)((R*)&k)[n] + 127) << 23; ((R*)&s)[n] = power.f;
        }
        V e = s * p + (s - one);
        return -e / (R(2) + e);
    };
    #else
    auto tanh_of = [&](V x) { return wp::tanh(x); };
    #endif
"""
"""Hyperbolic tangent of what is not negative, by ``exp(-2 x) - 1`` with the argument near zero."""

ACTIVATE = (
    TANH
    + """
    const int W = 3 * feature_columns;
    M to = feature;
    for (int i = 0; i < feature_count; i++) {
        M x = relative + 9 * feature_joint[i];
        const R* l = feature_left + 9*i; const R* d = feature_right + W*i; const R* o = feature_still + W*i;
        for (int r = 0; r < 3; r++, l += 3) {
            V y0 = l[0] * x[0] + l[1] * x[3] + l[2] * x[6], y1 = l[0] * x[1] + l[1] * x[4] + l[2] * x[7];
            V y2 = l[0] * x[2] + l[1] * x[5] + l[2] * x[8];
            for (int c = 0; c < feature_columns; c++)
                *to++ = y0 * d[c] + y1 * d[feature_columns+c] + y2 * d[2*feature_columns+c] - *o++;
        }
    }
    for (int c = 0; c < activation_count; c++) {
        V sum = zero;
        for (int e = weigh_start[c]; e < weigh_start[c+1]; e++)
            sum += weigh_value[e] * feature[weigh_feature[e]];
        before[c] = active[c] = sum; activity[c] = one;
        if (!squash) continue;
        V value = sum > zero ? sum : zero, rising = sum > zero ? one : zero;
        if (squash > 1) { value = tanh_of(value); rising *= one - value * value; }
        active[c] = value; activity[c] = rising;
    }
"""
)
"""Activations, what goes into them, and their slopes."""

PULL = """
    for (int t = 0; t < weighted_count; t++) {
        L b = binds + 12 * weighted[t]; M f = push + 12 * weighted[t]; M x = residual + 12*t;
        for (int r = 0; r < 3; r++, f += 4, x += 4) {
            V a0 = f[0] - f[3] * b[3], a1 = f[1] - f[3] * b[7], a2 = f[2] - f[3] * b[11];
            for (int c = 0; c < 3; c++) x[c] = a0 * b[4*c] + a1 * b[4*c+1] + a2 * b[4*c+2];
            x[3] = f[3];
        }
    }
"""
"""Forces on transforms as moments of what is left, in the joints' own axes."""

TURN = """
    const int W = 3 * feature_columns;
    for (int i = 0; i < W * feature_count; i++) feature[i] = zero;
    for (int c = 0; c < activation_count; c++) {
        V g = pull[c] * activity[c];
        for (int e = weigh_start[c]; e < weigh_start[c+1]; e++)
            feature[weigh_feature[e]] += weigh_value[e] * g;
    }
    for (int i = 0; i < feature_count; i++) {
        int n = feature_column[i]; if (n < 0) continue;
        const R* l = feature_left + 9*i; const R* d = feature_right + W*i; M g = feature + W*i;
        M x = relative + 9 * feature_joint[i]; V m[9], y[9], p[9];
        for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++) {
            V sum = zero;
            for (int q = 0; q < feature_columns; q++) sum += g[r*feature_columns+q] * d[c*feature_columns+q];
            m[3*r+c] = sum;
        }
        for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++)
            y[3*r+c] = l[r] * m[c] + l[3+r] * m[3+c] + l[6+r] * m[6+c];
        for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++)
            p[3*r+c] = x[3*r] * y[3*c] + x[3*r+1] * y[3*c+1] + x[3*r+2] * y[3*c+2];
        V s0 = p[5] - p[7], s1 = p[6] - p[2], s2 = p[1] - p[3];
        M a = turns + 9 * parent[n];
        for (int r = 0; r < 3; r++) slope[3*n+r] += a[3*r] * s0 + a[3*r+1] * s1 + a[3*r+2] * s2;
    }
"""
"""What the activations' pull adds to the slope."""

KEEP = """
    for (int i = 0; i < 9 * joint_count; i++) trial_relative[i] = relative[i];
    for (int i = 3 * driven_count; i < 3 * column_count + 3; i++) slope[i] = -slope[i];
"""
"""A step as what a solver gives, which it is the negative of, and rotations of joints that do not move."""

DOUBT = """
    const int* column_of = columns.data; const R* axis = spins.data; M square = (M)squares.data;
    V total = zero;
    for (int i = 3 * driven_count; i < 3 * column_count + 3; i++) slope[i] = zero;
    for (int q = 0; q < count; q++, axis += 3) {
        int n = column_of[q]; M x = relative + 9 * joint[n]; M d = turns + 9 * parent[n];
        V real = one + x[0] + x[4] + x[8]; real = real > R(1e-6) ? real : zero + R(1e-6);
        V v[3] = {x[7] - x[5], x[2] - x[6], x[3] - x[1]}, g[3];
        V along = v[0] * axis[0] + v[1] * axis[1] + v[2] * axis[2], ratio = along / real;
        for (int i = 0; i < N; i++) ((R*)&ratio)[i] = wp::atan(((R*)&ratio)[i]);
        V twist = R(2) * ratio, pull_ = square[q] * twist, over = pull_ / (real * real + along * along);
        total += pull_ * twist;
        for (int r = 0; r < 3; r++) {
            int a = (r + 1) % 3, b = (r + 2) % 3;
            g[r] = over * (real * (real * axis[r] + v[a] * axis[b] - v[b] * axis[a]) + along * v[r]);
        }
        for (int r = 0; r < 3; r++) slope[3*n+r] += d[3*r] * g[0] + d[3*r+1] * g[1] + d[3*r+2] * g[2];
    }
    gained[0] = total;
"""
"""Doubt of joints' twists, and its slope."""
