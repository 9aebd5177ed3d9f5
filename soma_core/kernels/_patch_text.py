"""C++ of the fused forward pose: what one block of threads does for a patch of skin; see ``_posing_text``."""

from soma_core.kernels._posing_text import THREADS

__all__ = [
    "PATCH_ACTIVATIONS",
    "PATCH_BLENDED",
    "PATCH_JOINTS",
    "PATCH_LOAD",
    "PATCH_MOVED",
    "PATCH_VERTICES",
    "patch_head",
    "patch_text",
]

PATCH_VERTICES, PATCH_JOINTS, PATCH_ACTIVATIONS = 128, 40, 448
"""Most vertices of a patch, transforms that they lie on, and activations that move them."""


def patch_head(bodies: int, together: int) -> str:
    """Sizes, threads, and where the tables of a patch begin."""
    sizes = (
        f"constexpr int G = {bodies}, P = {together}, Q = G / P, SLOTS = {PATCH_VERTICES}, "
        f"ACTIVATIONS = {PATCH_ACTIVATIONS}, JOINTS = {PATCH_JOINTS};\n"
    )
    return THREADS + sizes + _TABLES


def patch_text(bodies: int, together: int) -> str:
    """Skin of one patch of the mesh on `bodies` bodies, whose numbers are loaded `together` at a time."""
    staged = "SOMA_SHARED R staged[G * SLOTS * 3];\n"
    steps = staged, PATCH_LOAD.replace("FACTOR", ""), _LOOP, PATCH_MOVED, PATCH_BLENDED, _OUT
    return patch_head(bodies, together) + "".join(steps)


_TABLES = """
    struct alignas(P * sizeof(R) < 16 ? P * sizeof(R) : 16) Group { R of[P]; };
    SOMA_SHARED Group acts[ACTIVATIONS * Q], parts[JOINTS * 13 * Q];
    const int patch = index % patches, first = index / patches * G, last = batch - 1;
    const int* vertex_start = ints.data;
    const int* act_start = vertex_start + patches + 1;
    const int* joint_start = act_start + patches + 1;
    const int* move_start = joint_start + patches + 1;
    const int* blend_start = move_start + patches * (SLOTS / 32) + 1;
    const short* slots = (const short*)shorts.data;
    const short* acts_used = slots + patches * SLOTS;
    const short* joints_used = acts_used + act_start[patches];
    const short* move_id = joints_used + joint_start[patches];
    const short* blend_id = move_id + move_start[patches * (SLOTS / 32)];
    const R* move_value = reals.data;
    const R* blend_value = move_value + 3 * (long long)move_start[patches * (SLOTS / 32)];
"""
"""Shared memory and tables of a patch: ``index`` counts groups of ``G`` bodies, and patches within them."""

PATCH_LOAD = """
    const int act_count = moved ? act_start[patch + 1] - act_start[patch] : 0;
    for (int e = lane; e < act_count; e += width) {
        int id = acts_used[act_start[patch] + e];
        #pragma unroll
        for (int q = 0; q < Q; q++) {
            Group group;
            #pragma unroll
            for (int p = 0; p < P; p++) {
                int b = first + q * P + p;
                group.of[p] = active.data[(long long)(b < last ? b : last) * activations + id]FACTOR;
            }
            acts[q * ACTIVATIONS + e] = group;
        }
    }
    const int part_count = 12 * (joint_start[patch + 1] - joint_start[patch]);
    for (int e = lane; e < part_count; e += width) {
        int id = 12 * joints_used[joint_start[patch] + e / 12] + e % 12;
        #pragma unroll
        for (int q = 0; q < Q; q++) {
            Group group;
            #pragma unroll
            for (int p = 0; p < P; p++) {
                int b = first + q * P + p;
                group.of[p] = skin.data[(long long)(b < last ? b : last) * (12 * transforms) + id];
            }
            parts[(q * JOINTS + e / 12) * 13 + e % 12] = group;
        }
    }
"""
"""Activations, times ``FACTOR``, and transforms of the group into shared memory."""

_LOOP = """
    MEET;
    for (int slot = lane; slot < SLOTS; slot += width) {
        const int local = slots[patch * SLOTS + slot], slice = patch * (SLOTS / 32) + slot / 32;
        if (local < 0) continue;
        const int vertex = vertex_start[patch] + local;
"""

PATCH_MOVED = """
        R x[G][3], y[G][3];
        const R* rest = points.data + (long long)vertex * vertex_stride;
        if (body_stride == 0) {
            R one[3] = {rest[0], rest[axis_stride], rest[2 * axis_stride]};
            #pragma unroll
            for (int g = 0; g < G; g++) { x[g][0] = one[0]; x[g][1] = one[1]; x[g][2] = one[2]; }
        } else {
            #pragma unroll
            for (int g = 0; g < G; g++) {
                const R* own = rest + (long long)(first + g < last ? first + g : last) * body_stride;
                x[g][0] = own[0]; x[g][1] = own[axis_stride]; x[g][2] = own[2 * axis_stride];
            }
        }
        const int move_count = moved ? move_start[slice + 1] - move_start[slice] : 0;
        const short* id = move_id + move_start[slice] + slot % 32;
        const R* value = move_value + 3 * (long long)move_start[slice] + slot % 32;
        for (int e = 0; e < move_count; e += 32) {
            const int a = id[e];
            const R wx = value[3 * e], wy = value[3 * e + 32], wz = value[3 * e + 64];
            #pragma unroll
            for (int q = 0; q < Q; q++) {
                const Group group = acts[q * ACTIVATIONS + a];
                #pragma unroll
                for (int p = 0; p < P; p++) {
                    x[q * P + p][0] += wx * group.of[p];
                    x[q * P + p][1] += wy * group.of[p];
                    x[q * P + p][2] += wz * group.of[p];
                }
            }
        }
"""
"""What a thread does for one slot: rest points ``x`` of all bodies, moved by the correctives."""

PATCH_BLENDED = """
        #pragma unroll
        for (int g = 0; g < G; g++) { y[g][0] = 0; y[g][1] = 0; y[g][2] = 0; }
        const int blend_count = blend_start[slice + 1] - blend_start[slice];
        id = blend_id + blend_start[slice] + slot % 32;
        value = blend_value + blend_start[slice] + slot % 32;
        for (int e = 0; e < blend_count; e += 32) {
            const int j = id[e];
            const R w = value[e];
            #pragma unroll
            for (int q = 0; q < Q; q++) {
                #pragma unroll
                for (int r = 0; r < 3; r++) {
                    const Group* row = parts + (q * JOINTS + j) * 13 + 4 * r;
                    const Group mx = row[0], my = row[1], mz = row[2], shift = row[3];
                    #pragma unroll
                    for (int p = 0; p < P; p++) {
                        const R* at = x[q * P + p];
                        R reached = mx.of[p] * at[0] + my.of[p] * at[1] + mz.of[p] * at[2] + shift.of[p];
                        y[q * P + p][r] += w * reached;
                    }
                }
            }
        }
"""
"""Then ``y``, the points on the skin."""

_OUT = """
        #pragma unroll
        for (int g = 0; g < G; g++)
            for (int r = 0; r < 3; r++) staged[(g * SLOTS + local) * 3 + r] = y[g][r];
    }
    MEET;
    const int numbers = 3 * (vertex_start[patch + 1] - vertex_start[patch]);
    for (int g = 0; g < G; g++) {
        if (first + g > last) break;
        R* to = out.data + ((long long)(first + g) * vertices + vertex_start[patch]) * 3;
        for (int e = lane; e < numbers; e += width) to[e] = staged[g * SLOTS * 3 + e];
    }
"""
