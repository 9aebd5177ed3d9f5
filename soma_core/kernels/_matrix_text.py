"""Native bodies of the solver's matrix: moments of the skin, twists and modes as coordinates, factorisation.

Names are those of :func:`soma_core.kernels._solver_text.prelude`.
"""

__all__ = ["ASSEMBLE", "FACTOR", "MODES", "TWISTS"]

ASSEMBLE = """
    for (int i = 0; i < 12 * slot_count; i++) blocks[i] = zero;
    for (int i = 0; i < 4 * column_count; i++) root[i] = zero;
    for (int i = 0; i < 3 * twist_rows; i++) twists[i] = zero;
    for (int i = 0; i < 3 * channel_count; i++) twist_force[i] = zero;
    for (int i = 0; i < channel_count * channel_count; i++) twist_pair[i] = zero;
    for (int n = 0; n < column_count; n++) {
        int u = joint[n];
        for (int e = row_start[n]; e < row_start[n+1]; e++) {
            M x = column + 16 * row_joint[e]; for (int c = 0; c < 16; c++) x[c] = zero;
        }
        V du[9]; for (int i = 0; i < 9; i++) du[i] = turns[9*u+i];
        for (int e = near_start[n]; e < near_start[n+1]; e++) {
            int t = near_joint[e]; L m = second + 16 * near_pair[e];
            int row = near_flip[e] ? 1 : 4, col = near_flip[e] ? 4 : 1;
            M dt = turns + 9 * t; M x = column + 16 * t;
            for (int r = 0; r < 3; r++) {
                V d0 = dt[3*r], d1 = dt[3*r+1], d2 = dt[3*r+2];
                V x0 = m[0] * d0 + m[row] * d1 + m[2*row] * d2;
                V x1 = m[col] * d0 + m[col+row] * d1 + m[col+2*row] * d2;
                V x2 = m[2*col] * d0 + m[2*col+row] * d1 + m[2*col+2*row] * d2;
                x[4*r+3] = m[3*col] * d0 + m[3*col+row] * d1 + m[3*col+2*row] * d2;
                for (int c = 0; c < 3; c++) x[4*r+c] = x0 * du[3*c] + x1 * du[3*c+1] + x2 * du[3*c+2];
            }
            L b = m + 3 * row;
            for (int c = 0; c < 3; c++) x[12+c] = b[0] * du[3*c] + b[col] * du[3*c+1] + b[2*col]
                * du[3*c+2];
            x[15] = zero + b[3*col];
        }
        for (int e = row_start[n]; e < row_start[n+1]; e++) {
            int i = row_joint[e]; M x = column + 16 * i;
            if (row_slot[e] >= 0) { M b = blocks + 12 * row_slot[e]; for (int c = 0; c < 12;
                c++) b[c] += x[c]; }
            if (i == 0) { for (int c = 0; c < 4; c++) root[4*n+c] += x[12+c]; continue; }
            int p = row_parent[e]; M y = column + 16 * p;
            for (int r = 0; r < 3; r++) {
                V shift = places[3*i+r] - places[3*p+r];
                for (int c = 0; c < 4; c++) y[4*r+c] += x[4*r+c] + shift * x[12+c];
            }
            for (int c = 0; c < 4; c++) y[12+c] += x[12+c];
        }
        if (n < driven_count) {
            int h = u - joint_count; const R* e = spin_axis + 3 * h; M d = turns + 9 * parents[u];
            V a0 = d[0]*e[0] + d[1]*e[1] + d[2]*e[2], a1 = d[3]*e[0] + d[4]*e[1] + d[5]*e[2];
            V a2 = d[6]*e[0] + d[7]*e[1] + d[8]*e[2];
            helper_axis[3*h] = a0; helper_axis[3*h+1] = a1; helper_axis[3*h+2] = a2;
            for (int i = drive_start[n]; i < drive_start[n+1]; i++) {
                M x = column + 16 * drive_row[i]; M y = twists + 3 * drive_slot[i];
                    R m = drive_value[i];
                V trace = x[0] + x[5] + x[10];
                y[0] += m * (trace * a0 - x[0] * a0 - x[4] * a1 - x[8] * a2);
                y[1] += m * (trace * a1 - x[1] * a0 - x[5] * a1 - x[9] * a2);
                y[2] += m * (trace * a2 - x[2] * a0 - x[6] * a1 - x[10] * a2);
            }
            for (int i = cross_start[n]; i < cross_start[n+1]; i++) {
                int f = cross_row[i]; M x = column + 16 * f; R m = cross_value[i];
                const R* g = spin_axis + 3 * (f - joint_count); M q = turns + 9 * parents[f];
                V b0 = q[0]*g[0] + q[1]*g[1] + q[2]*g[2], b1 = q[3]*g[0] + q[4]*g[1] + q[5]*g[2];
                V b2 = q[6]*g[0] + q[7]*g[1] + q[8]*g[2];
                V trace = x[0] + x[5] + x[10];
                twist_pair[cross_slot[i]] += m * (b0 * (trace * a0 - x[0] * a0 - x[4] * a1 - x[8] * a2)
                    + b1 * (trace * a1 - x[1] * a0 - x[5] * a1 - x[9] * a2)
                    + b2 * (trace * a2 - x[2] * a0 - x[6] * a1 - x[10] * a2));
            }
            M x = column + 12;
            for (int i = mix_start[h]; i < mix_start[h+1]; i++) {
                M y = twist_force + 3 * mix_channel[i]; R m = mix_value[i];
                y[0] += m * (a1 * x[2] - a2 * x[1]); y[1] += m * (a2 * x[0] - a0 * x[2]);
                y[2] += m * (a0 * x[1] - a1 * x[0]);
            }
        }
        if (parent_column[n] >= 0) {
            int p = parent[n], above = parent_column[n];
            V s0 = places[3*u] - places[3*p], s1 = places[3*u+1] - places[3*p+1],
                s2 = places[3*u+2] - places[3*p+2];
            for (int e = push_start[n]; e < push_start[n+1]; e++) for (int r = 0; r < 3; r++) {
                M a = blocks + 12 * push_source[e] + 4*r; M b = blocks + 12 * push_target[e] + 4*r;
                V last = a[3];
                b[0] += a[0] + last * s0; b[1] += a[1] + last * s1; b[2] += a[2] + last * s2; b[3] += last;
            }
            V m = root[4*n+3]; M y = root + 4 * above;
            y[0] += root[4*n] + m * s0; y[1] += root[4*n+1] + m * s1; y[2] += root[4*n+2] + m * s2;
                y[3] += m;
        }
    }
    for (int i = 0; i < slot_count; i++) {
        M b = blocks + 12 * i; V x = b[0], y = b[5], z = b[10];
        b[0] = y + z; b[5] = x + z; b[10] = x + y;
        for (int r = 0; r < 3; r++) for (int c = 0; c < r; c++) {
            V lower = b[4*r+c]; b[4*r+c] = -b[4*c+r]; b[4*c+r] = -lower;
        }
    }
"""

_PLACED = """
#define PLACE(block, kind, y, g) do { M b_ = blocks + 12 * (block); \\
        if ((kind) == 0) { for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++) \\
            b_[4*r+c] += (y)[r] * (g)[c] + (g)[r] * (y)[c]; } \\
        else if ((kind) == 1) { for (int r = 0; r < 3; r++) for (int c = 0; c < 3; \\
        c++) b_[4*r+c] += (y)[r] * (g)[c]; } \\
        else { for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++) b_[4*r+c] += (g)[r] * (y)[c]; \\
        } } while (0)
"""

TWISTS = (
    _PLACED
    + """
    for (int i = 0; i < add_count; i++) {
        V half = R(0.5) * twist_pair[add_pair[i]]; M g = steer + 3 * add_channel[i];
            M y = twists + 3 * add_slot[i];
        for (int r = 0; r < 3; r++) y[r] += half * g[r];
    }
    for (int i = 0; i < twist_count; i++) {
        M y = twists + 3 * twist_slot[i]; M g = steer + 3 * twist_channel[i];
        PLACE(twist_block[i], twist_kind[i], y, g);
    }
"""
)

_MIXED = """
#define MIX(by, count, from, width, size, to, stride, more, unit) do { \\
    for (int r = 0; r < (width); r++) { \\
        M x_ = (from) + 3*r, t_ = (to); int m = 0; \\
        for (; m + 4 <= (size); m += 4) { \\
            const R* g_ = (by) + m * (count); V s_[12]; for (int i = 0; i < 12; i++) s_[i] = zero; \\
            for (int l = 0; l < (count); l++, g_++) { \\
                V x0 = x_[3*(width)*l], x1 = x_[3*(width)*l+1], x2 = x_[3*(width)*l+2]; \\
                for (int i = 0; i < 4; i++) { R f = g_[i * (count)]; \\
                    s_[3*i] += f * x0; s_[3*i+1] += f * x1; s_[3*i+2] += f * x2; } \\
            } \\
            for (int i = 0; i < 4; i++) { M o_ = t_ + (stride) * (m + i); for (int k = 0; k < 3; k++) \\
                o_[k] = (more) ? o_[k] + (unit) * s_[3*i+k] : (unit) * s_[3*i+k]; } \\
        } \\
        for (; m < (size); m++) { \\
            const R* g_ = (by) + m * (count); V s_[3] = {zero, zero, zero}; \\
            for (int l = 0; l < (count); l++) for (int k = 0; k < 3; k++) \\
                s_[k] += g_[l] * x_[3*(width)*l+k]; \\
            M o_ = t_ + (stride) * m; for (int k = 0; k < 3; k++) \\
                o_[k] = (more) ? o_[k] + (unit) * s_[k] : (unit) * s_[k]; \\
        } \\
    } } while (0)
"""
"""Products of a small matrix with vectors of three, four rows at a time; each sum is written once."""

MODES = (
    _PLACED
    + _MIXED
    + """
    V size = scale[0], most = size * shares[weighted_count];
    for (int i = 0; i < 9 * column_count; i++) mode_force[i] = zero;
    const int W = 3 * feature_columns;
    for (int i = 0; i < used_count; i++) {
        int j = used_joint[i]; M a = turns + 9 * (parents[j] < 0 ? 0 : parents[j]);
            M x = relative + 9*j;
        const R* l = left + 9*i; const R* d = right + W*i;
        for (int w = 0; w < 3; w++) {
            V k0 = a[3*w], k1 = a[3*w+1], k2 = a[3*w+2], m[9], y[9];
            for (int c = 0; c < 3; c++) {
                m[c] = k1 * x[6+c] - k2 * x[3+c]; m[3+c] = k2 * x[c] - k0 * x[6+c];
                    m[6+c] = k0 * x[3+c] - k1 * x[c];
            }
            for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++)
                y[3*r+c] = l[3*r] * m[c] + l[3*r+1] * m[3+c] + l[3*r+2] * m[6+c];
            for (int r = 0; r < 3; r++) for (int c = 0; c < feature_columns; c++) {
                V sum = zero; for (int q = 0; q < 3; q++) sum += y[3*r+q] * d[q*feature_columns+c];
                features[3*W*i + W*w + r*feature_columns + c] = sum;
            }
        }
    }
    const R* gates = gate; const R* mixed = mode;
    for (int p = 0; p < block_count; p++) {
        int reads = read_start[p+1] - read_start[p], size_p = mode_size[p],
            ids = taken_start[p+1] - taken_start[p];
        M o = opened;
        for (int c = 0; c < ids; c++) {
            V open = activity[taken[taken_start[p] + c]];
            for (int r = 0; r < reads; r++, gates += W, o += 3) {
                M x = features + 3*W * read_used[read_start[p] + r]; V v0 = zero, v1 = zero, v2 = zero;
                for (int q = 0; q < W; q++) { v0 += gates[q] * x[q]; v1 += gates[q] * x[W+q];
                    v2 += gates[q] * x[2*W+q]; }
                o[0] = v0 * open; o[1] = v1 * open; o[2] = v2 * open;
            }
        }
        M y = response + response_start[p];
        MIX(mixed, ids, opened, reads, size_p, y + 3*r, 3*reads, false, one);
        mixed += size_p * ids;
    }
    const R* moment = cloud_moment; const R* grams = gram; const int* into = near_rows;
    for (int p = 0; p < block_count; p++) {
        int rows = mode_row_count[p], size_p = mode_size[p], first = tree_start[p],
            nodes = tree_start[p+1] - first;
        int reads = read_start[p+1] - read_start[p];
        M tree = mode_tree; M y = mode_rows;
        for (int i = 0; i < 6 * size_p * nodes; i++) tree[i] = zero;
        for (int i = 0; i < 3 * size_p * (rows + 1); i++) y[i] = zero;
        for (int e = cloud_start[p]; e < cloud_start[p+1]; e++) {
            int node = cloud_tree[e]; M d = turns + 9 * tree_joint[first + node];
            V share = zero + shares[cloud_weighted[e]], arm = share * sizes[cloud_weighted[e]];
            for (int m = 0; m < size_p; m++, moment += 6) {
                M x = tree + 6 * (size_p * node + m);
                for (int r = 0; r < 3; r++) {
                    x[r] += arm * (d[3*r] * moment[0] + d[3*r+1] * moment[1] + d[3*r+2] * moment[2]);
                    x[3+r] += share * (d[3*r] * moment[3] + d[3*r+1] * moment[4] + d[3*r+2] * moment[5]);
                }
            }
        }
        int f = fold_start[p];
        for (int node = 0; node < nodes; node++) {
            int j = tree_joint[first + node], up = tree_up[first + node], row = tree_row[first + node];
            for (; f < fold_start[p+1] && fold_tree[f] == node; f++) {
                M a = helper_axis + 3 * fold_helper[f]; M g = steer + 3 * fold_channel[f];
                for (int m = 0; m < size_p; m++) {
                    M x = tree + 6 * (size_p * node + m); M o = y + 3 * (size_p * fold_row[f] + m);
                    V t = fold_value[f] * (a[0] * x[0] + a[1] * x[1] + a[2] * x[2]);
                    for (int r = 0; r < 3; r++) o[r] += t * g[r];
                }
            }
            int at = j == 0 ? rows : row;
            if (at >= 0) for (int m = 0; m < size_p; m++) {
                M x = tree + 6 * (size_p * node + m) + (j == 0 ? 3 : 0);
                    M o = y + 3 * (size_p * at + m);
                for (int r = 0; r < 3; r++) o[r] += x[r];
            }
            if (up < 0) continue;
            int q = tree_joint[first + up];
            V s0 = places[3*j] - places[3*q], s1 = places[3*j+1] - places[3*q+1],
                s2 = places[3*j+2] - places[3*q+2];
            for (int m = 0; m < size_p; m++) {
                M x = tree + 6 * (size_p * node + m); M o = tree + 6 * (size_p * up + m);
                o[0] += x[0] + s1 * x[5] - s2 * x[4]; o[1] += x[1] + s2 * x[3] - s0 * x[5];
                o[2] += x[2] + s0 * x[4] - s1 * x[3];
                o[3] += x[3]; o[4] += x[4]; o[5] += x[5];
            }
        }
        for (int e = near_start_mode[p]; e < near_start_mode[p+1]; e++) {
            int b = near_block[e], size_b = mode_size[b], seen = read_start[b+1] - read_start[b];
            MIX(grams, size_b, response + response_start[b], seen, size_p, y + 3 * size_p * into[r], 3, true,
                most);
            grams += size_p * size_b; into += seen;
        }
        M a = response + response_start[p];
        for (int e = apply_start[p]; e < apply_start[p+1]; e++) {
            V sum[9]; for (int i = 0; i < 9; i++) sum[i] = zero;
            M u = y + 3 * size_p * apply_row[e];
            for (int m = 0; m < size_p; m++) {
                M g = a + 3 * (m*reads + apply_read[e]); M v = u + 3*m;
                for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++) sum[3*r+c] += v[r] * g[c];
            }
            M b = blocks + 12 * apply_block[e];
            for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++) {
                if (apply_kind[e] == 0) b[4*r+c] += size * (sum[3*r+c] + sum[3*c+r]);
                else if (apply_kind[e] == 1) b[4*r+c] += size * sum[3*r+c];
                else b[4*r+c] += size * sum[3*c+r];
            }
        }
        for (int r = 0; r < reads; r++) {
            M t = mode_force + 9 * read_column[read_start[p] + r];
            for (int m = 0; m < size_p; m++) {
                M g = a + 3 * (m*reads + r); M v = y + 3 * (size_p * rows + m);
                for (int i = 0; i < 3; i++) for (int c = 0; c < 3; c++) t[3*i+c] += size * v[i] * g[c];
            }
        }
    }
"""
)

FACTOR = """
    V whole = zero, mean = zero;
    for (int n = driven_count; n < column_count; n++) {
        M x = carry + 9*n; M t = root + 4*n;
        if (parent_column[n] < 0) whole += t[3];
        M d = blocks + 12 * block_start[n]; mean += d[0] + d[5] + d[10];
        M more = mode_force + 9*n;
        for (int i = 0; i < 9; i++) x[i] = block_count ? more[i] : zero;
        x[1] += t[2]; x[2] -= t[1]; x[3] -= t[2]; x[5] += t[0]; x[6] += t[1]; x[7] -= t[0];
    }
    for (int i = 0; i < chain_count; i++) {
        M x = carry + 9 * chain_column[i]; M f = twist_force + 3 * chain_channel[i];
        M g = steer + 3 * chain_channel[i];
        for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++) x[3*r+c] += f[r] * g[c];
    }
    V grow = one + damping[0];
    V ridge = (R(1e-9) / R(3 * (column_count - driven_count) + 3)) * (mean + R(3) * whole);
    for (int n = driven_count; n < column_count; n++) for (int r = 0; r < 3; r++) {
        M d = blocks + 12 * block_start[n] + 5*r; d[0] = d[0] * grow + ridge;
    }
    for (int i = 0; i < 9; i++) last[i] = zero;
    for (int r = 0; r < 3; r++) last[4*r] = whole * grow + ridge;
    #define INVERSE(y, x) do { V x_ = (x); for (int n_ = 0; n_ < N; n_++) { R v_ = ((R*)&x_)[n_]; \\
        ((R*)&x_)[n_] = v_ > R(1e-30) ? v_ : R(1e-30); } y = R(1) / ROOT(x_); } while (0)
    #define TRIANGLE(a, w, i) do { V i0, i1, i2; INVERSE(i0, (a)[0]); \\
        V l10_ = (a)[w] * i0, l20_ = (a)[2*(w)] * i0; INVERSE(i1, (a)[(w)+1] - l10_ * l10_); \\
        V l21_ = ((a)[2*(w)+1] - l20_ * l10_) * i1; \\
        INVERSE(i2, (a)[2*(w)+2] - l20_ * l20_ - l21_ * l21_); \\
        (a)[w] = l10_; (a)[2*(w)] = l20_; (a)[2*(w)+1] = l21_; (i)[0] = i0; (i)[1] = i1; (i)[2] = i2; \\
        } while (0)
    #define ELIMINATE(o, w, a, wa, b, wb) do { for (int r_ = 0; r_ < 3; r_++) { \\
        V x_ = (a)[(wa)*r_], y_ = (a)[(wa)*r_+1], z_ = (a)[(wa)*r_+2]; \\
        for (int c_ = 0; c_ < 3; c_++) (o)[(w)*r_+c_] -= \\
            x_ * (b)[(wb)*c_] + y_ * (b)[(wb)*c_+1] + z_ * (b)[(wb)*c_+2]; } } while (0)
    for (int n = driven_count; n < column_count; n++) {
        int first = block_start[n], stop = block_start[n+1], e = update_start[n];
        M d = blocks + 12 * first; M i = inverse + 3*n;
        TRIANGLE(d, 4, i);
        V l10 = d[4], l20 = d[8], l21 = d[9];
        for (int q = first + 1; q <= stop; q++) for (int r = 0; r < 3; r++) {
            M b = q < stop ? blocks + 12*q + 4*r : carry + 9*n + 3*r;
            V x = b[0] * i[0], y = (b[1] - x * l10) * i[1];
            b[0] = x; b[1] = y; b[2] = (b[2] - x * l20 - y * l21) * i[2];
        }
        for (int a = first + 1; a < stop; a++) {
            M from = blocks + 12*a; V own[9];
            for (int r = 0; r < 3; r++) for (int c = 0; c < 3; c++) own[3*r+c] = from[4*r+c];
            for (int b = a; b < stop; b++, e++)
                ELIMINATE(blocks + 12 * update_target[e], 4, blocks + 12*b, 4, own, 3);
            ELIMINATE(carry + 9 * block_row[a], 3, carry + 9*n, 3, own, 3);
        }
        ELIMINATE(last, 3, carry + 9*n, 3, carry + 9*n, 3);
    }
    TRIANGLE(last, 3, inverse + 3 * column_count);
"""
