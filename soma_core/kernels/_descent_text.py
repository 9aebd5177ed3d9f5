"""Native bodies of a descent on the whole model, between those of the solver and of the model's residual.

Names are those of :func:`soma_core.kernels._solver_text.prelude`. A pose that is looked at takes the place of
the current one, which is kept as the trial until it is known to be worse.
"""

__all__ = ["ACCEPTED", "BEGUN", "BROUGHT", "COMBINED", "DOUBTED", "DRAWN", "GIVEN", "JUDGED", "MEMORY",
           "MIXED", "TAKEN", "WEIGHED"]  # fmt: skip

MEMORY = 5
"""Earlier steps that a new one is made from."""

_RANGE = (
    f"const int from_ = 3 * driven_count, size_ = 3 * column_count + 3; constexpr int memory_ = {MEMORY};\n"
)

BEGUN = (
    _RANGE
    + """
    for (int i = 0; i < 9 * joint_count; i++) trial_relative[i] = relative[i];
    moving[0] = one; accepted[0] = zero;
    if (again > 1) return;
    if (!again) for (int i = 0; i < memory_; i++) past_inverse[i] = zero;
    if (!again) for (int i = 0; i < 2 * memory_ * size_; i++) past[i] = zero;
    for (int i = from_; i < size_; i++) gradient[i] = fresh[i];
    energy[0] = reached[0]; pressing[0] = pressing_next[0]; shrink[0] = one;
    V more = reached[0] / mass[0] * growth; damping[0] = more > damping[0] ? more : damping[0];
"""
)

GIVEN = """
    M turn_ = (M)turned.data, source_ = (M)source.data;
    for (int i = 0; i < 12 * all_count; i++) turn_[i] = transform[i];
    for (int i = 0; i < activation_count; i++) source_[i] = active[i];
"""
"""What the model's residual takes of a pose."""

BROUGHT = """
    M force_ = (M)forced.data, back_ = (M)back.data;
    for (int i = 0; i < 12 * all_count; i++) push[i] = force_[i];
    for (int i = 0; i < activation_count; i++) pull[i] = back_[i];
    reached[0] = ((M)tile.data)[at];
"""
"""What it says of the pose."""

WEIGHED = (
    _RANGE
    + """
    M square_ = (M)squares.data;
    for (int i = from_; i < size_; i++) fresh[i] = slope[i];
    pressing_next[0] = zero;
    if (first) {
        V forces_ = zero;
        for (int t = 0; t < weighted_count; t++) for (int r = 0; r < 3; r++)
            forces_ += residual[12*t+4*r+3] * residual[12*t+4*r+3];
        V alone = reached[0] / mass[0], pieces = unit * forces_ / (alone > least ? alone : zero + least);
        doubt_weight[0] = pieces < one ? pieces : one;
    }
    for (int q = 0; q < count; q++) square_[q] = base.data[q] * doubt_weight[0];
"""
)
"""How much doubt of twists weighs, ``clumping`` of the descent's twin; `unit` is the constant in it."""

COMBINED = (
    _RANGE
    + """
    V gain_ = gained[0], whole_ = one + gain_;
    V unit_ = clipped ? mass[0] * typical[0] * typical[0] : reached[0] / whole_;
    for (int i = from_; i < size_; i++) fresh[i] += unit_ * slope[i];
    reached[0] = clipped ? reached[0] + unit_ * gain_ : reached[0] * whole_;
    pressing_next[0] = unit_;
"""
)
"""Doubt joins the error."""

DOUBTED = """
    M square_ = (M)squares.data;
    for (int q = 0; q < count; q++) {
        M b = blocks + 12 * block_start[columns.data[q]]; V more = square_[q] * pressing[0];
        for (int r = 0; r < 3; r++) b[5*r] += more;
    }
"""
"""Doubt joins the matrix."""

DRAWN = (
    _RANGE
    + """
    for (int i = from_; i < size_; i++) slope[i] = gradient[i];
    for (int p = 0; p < memory_; p++) {
        M s = past + p * size_; M y = past + (memory_ + p) * size_;
        V sum = zero; for (int i = from_; i < size_; i++) sum += s[i] * slope[i];
        V part = sum * past_inverse[p];
        past_share[p] = part;
        for (int i = from_; i < size_; i++) slope[i] -= part * y[i];
    }
"""
)
"""First half of the two loops of limited-memory BFGS; the latest step is the first."""

MIXED = (
    _RANGE
    + """
    for (int p = memory_ - 1; p >= 0; p--) {
        M s = past + p * size_; M y = past + (memory_ + p) * size_;
        V sum = zero; for (int i = from_; i < size_; i++) sum += y[i] * slope[i];
        V part = past_share[p] - sum * past_inverse[p];
        for (int i = from_; i < size_; i++) slope[i] += part * s[i];
    }
    for (int n = driven_count; n < column_count; n++) {
        M x = slope + 3*n; V q = x[0]*x[0] + x[1]*x[1] + x[2]*x[2], length = ROOT(q);
        V cut = length > longest ? longest / length : one;
        for (int r = 0; r < 3; r++) x[r] *= cut;
    }
"""
)
"""Second half, and no joint turned too far."""

JUDGED = (
    _RANGE
    + """
    V sum = zero; for (int i = from_; i < size_; i++) sum += slope[i] * gradient[i];
    V change_ = ROOT((sum > zero ? sum * shrink[0] : zero * sum) / mass[0]);
    V least_ = ROOT(energy[0] / mass[0]) * share; least_ = least_ > tolerance ? least_ : zero + tolerance;
    int more = 0;
    for (int n = 0; n < N; n++) {
        R d = ((R*)&change_)[n]; R* go = (R*)moving + n;
        if (!(d >= ((R*)&least_)[n])) *go = 0;
        ((R*)last_change)[n] = *go > R(0.5) || d != d ? d : R(0);
        if (*go > R(0.5)) more++;
    }
    for (int i = from_; i < size_; i++) { slope[i] *= shrink[0]; step[i] = -slope[i]; }
    return more;
"""
)
"""Which frames a Newton step would still change."""

TAKEN = """
    for (int i = 0; i < 9 * joint_count; i++) { V x = relative[i]; relative[i] = trial_relative[i];
        trial_relative[i] = x; }
    for (int i = 0; i < 3; i++) { V x = hips[i]; hips[i] = trial_hips[i]; trial_hips[i] = x; }
    for (int i = 0; i < 9 * all_count; i++) trial_turns[i] = turns[i];
    for (int i = 0; i < 3 * all_count; i++) trial_places[i] = places[i];
    for (int i = 0; i < 3 * channel_count; i++) trial_steer[i] = steer[i];
"""

ACCEPTED = (
    _RANGE
    + """
    V bound_ = energy[0] * (one + noise) + mass[0] * floor_, better = zero, refused = zero;
    for (int n = 0; n < N; n++) {
        R good = ((R*)moving)[n] > R(0.5) && ((R*)reached)[n] < ((R*)&bound_)[n] ? R(1) : R(0);
        ((R*)&better)[n] = good; ((R*)&refused)[n] = ((R*)moving)[n] - good;
    }
    const V half = zero + R(0.5);
    for (int p = memory_ - 1; p > 0; p--) {
        past_inverse[p] = better > half ? past_inverse[p-1] : past_inverse[p];
        M s = past + p * size_; M y = past + (memory_ + p) * size_;
        for (int i = from_; i < size_; i++) {
            s[i] = better > half ? s[i-size_] : s[i]; y[i] = better > half ? y[i-size_] : y[i];
        }
    }
    M s = past; M y = past + memory_ * size_;
    V product_ = zero, ss = zero, yy = zero;
    for (int i = from_; i < size_; i++) {
        V a = better > half ? step[i] : s[i], b = better > half ? fresh[i] - gradient[i] : y[i];
        s[i] = a; y[i] = b; product_ += a * b; ss += a * a; yy += b * b;
        gradient[i] = better > half ? fresh[i] : gradient[i];
    }
    V known = product_ > R(1e-6) * ROOT(ss) * ROOT(yy) ? one : zero;
    past_inverse[0] = known > half ? one / (known > half ? product_ : one) : zero;
    for (int i = 0; i < memory_; i++) past_inverse[i] = refused > half ? zero : past_inverse[i];
    #define KEEP(a, b, count) for (int i = 0; i < (count); i++) (a)[i] = better > half ? (a)[i] : (b)[i];
    KEEP(relative, trial_relative, 9 * joint_count)
    KEEP(turns, trial_turns, 9 * all_count)
    KEEP(places, trial_places, 3 * all_count)
    KEEP(steer, trial_steer, 3 * channel_count)
    KEEP(hips, trial_hips, 3)
    for (int i = 0; i < 9 * joint_count; i++) trial_relative[i] = relative[i];
    energy[0] = better > half ? reached[0] : energy[0];
    pressing[0] = better > half ? pressing_next[0] : pressing[0];
    accepted[0] += better;
    V shorter = shrink[0] * shorten, longer = shrink[0] / shorten; longer = longer < one ? longer : one;
    shrink[0] = better > half ? longer : shorter;
    V lower_ = damping[0] * lower, higher = damping[0] * raise_;
    higher = higher > least ? higher : zero + least; higher = higher < most ? higher : zero + most;
    damping[0] = better > half ? lower_ : higher;
"""
)
"""Steps that do not lower the error are undone, and shorter ones tried until the matrix is made anew."""
