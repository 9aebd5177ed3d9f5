"""Native body of the pose solver that reads blocks of the inverse from a factor: see :mod:`._solver_text`.

Of ``Z = A^-1``, with ``A = L L^T``, only blocks within the pattern of L are made, last column first
(Takahashi's recursion: Erisman and Tinney 1975). With I the rows of column n and ``Y = L_In L_nn^-1``::

    Z_In = -Z_II Y,    Z_nn = L_nn^-T L_nn^-1 + Y^T Z_II Y
"""

__all__ = ["SELECTED"]

SELECTED = """
    M below = selected + 9 * slot_count; M corner = below + 9 * column_count;
    #define OPENED(l1, l2, i) V i0 = (i)[0], i1 = (i)[1], i2 = (i)[2], m10 = -(l1)[0] * i0 * i1; \\
        V m21 = -(l2)[1] * i1 * i2, m20 = -((l2)[0] * i0 + (l2)[1] * m10) * i2;
    #define SQUARED(o) do { (o)[0] = i0*i0 + m10*m10 + m20*m20; (o)[4] = i1*i1 + m21*m21; (o)[8] = i2*i2; \\
        (o)[1] = (o)[3] = m10*i1 + m20*m21; (o)[2] = (o)[6] = m20*i2; (o)[5] = (o)[7] = m21*i2; } while (0)
    #define TIMES(o, m, y) do { for (int r_ = 0; r_ < 3; r_++) for (int c_ = 0; c_ < 3; c_++) \\
        (o)[3*r_+c_] += (m)[3*r_] * (y)[c_] + (m)[3*r_+1] * (y)[3+c_] + (m)[3*r_+2] * (y)[6+c_]; } while (0)
    #define TURNED(o, m, y) do { for (int r_ = 0; r_ < 3; r_++) for (int c_ = 0; c_ < 3; c_++) \\
        (o)[3*r_+c_] += (m)[r_] * (y)[c_] + (m)[3+r_] * (y)[3+c_] + (m)[6+r_] * (y)[6+c_]; } while (0)
    {
        OPENED(last + 3, last + 6, inverse + 3 * column_count)
        SQUARED(corner);
    }
    M y = spread; M z = column;
    for (int n = column_count - 1; n >= driven_count; n--) {
        int first = block_start[n] + 1, count = block_start[n+1] - first, e = update_start[n];
        M d = blocks + 12 * (first - 1);
        OPENED(d + 4, d + 8, inverse + 3*n)
        for (int q = 0; q <= count; q++) for (int r = 0; r < 3; r++) {
            M x = q < count ? blocks + 12 * (first + q) + 4*r : carry + 9*n + 3*r;
            M o = y + 9*q + 3*r;
            o[0] = x[0] * i0 + x[1] * m10 + x[2] * m20; o[1] = x[1] * i1 + x[2] * m21; o[2] = x[2] * i2;
            z[9*q+3*r] = z[9*q+3*r+1] = z[9*q+3*r+2] = zero;
        }
        M end = z + 9 * count; M tail = y + 9 * count;
        TIMES(end, corner, tail);
        for (int a = 0; a < count; a++) {
            V own[9], sum[9];
            for (int i = 0; i < 9; i++) { own[i] = y[9*a+i]; sum[i] = z[9*a+i]; }
            M m = selected + 9 * update_target[e++];
            TIMES(sum, m, own);
            for (int b = a + 1; b < count; b++) {
                m = selected + 9 * update_target[e++];
                M o = z + 9*b; M other = y + 9*b;
                TIMES(o, m, own);
                TURNED(sum, m, other);
            }
            m = below + 9 * block_row[first + a];
            TIMES(end, m, own);
            TURNED(sum, m, tail);
            for (int i = 0; i < 9; i++) z[9*a+i] = sum[i];
        }
        M o = selected + 9 * (first - 1);
        SQUARED(o);
        for (int q = 0; q <= count; q++) TURNED(o, z + 9*q, y + 9*q);
        for (int i = 0; i < 9 * count; i++) selected[9*first+i] = -z[i];
        for (int i = 0; i < 9; i++) below[9*n+i] = -end[i];
        slope[2 * driven_count + n] = o[0] + o[4] + o[8];
    }
"""
