"""C++ of the residual: what one block of threads does for a patch of skin; see ``_posing_text``.

A thread has one vertex slot and keeps its numbers in registers from one meeting to the next, so on CUDA a
block has as many threads as a patch has slots. Shared memory is used twice: rest points take the place of the
activations once all threads have moved theirs; what is pulled at them that of the transforms.
"""

from soma_core.kernels._patch_text import PATCH_BLENDED, PATCH_LOAD, PATCH_MOVED, patch_head

__all__ = ["FLAGS", "patch_residual_text"]

FLAGS = {"OWN_REST": 1, "OWN_WEIGHTS": 2, "CLIPPED": 4, "PULLS": 8, "MEASURED": 16}
"""What a launch is asked for, as bits."""


def patch_residual_text(frames: int, together: int) -> str:
    """Residual of one patch of the mesh in `frames` frames, whose numbers are loaded `together` at a time."""
    load = PATCH_LOAD.replace("FACTOR", " * scale.data[b < last ? b : last]")
    vertex = _SLOT, PATCH_MOVED, PATCH_BLENDED, _RESIDUAL, _BACK
    body = patch_head(frames, together) + "".join((_HEAD, load, _TARGETS, *vertex, _FORCES, _PULL, _ENERGY))
    for name, bit in FLAGS.items():
        body = body.replace(f"@{name}", f"((flags & {bit}) != 0)")
    return body


_HEAD = """
    constexpr int PLANE = 3 * SLOTS + 1;  // frames of a vertex in banks side by side
    SOMA_SHARED Group pulled[PLANE * Q];
#if defined(__CUDA_ARCH__)
    static_assert(ACTIVATIONS >= PLANE && JOINTS * 13 >= PLANE, "no room for vertices");
    Group *rested = acts, *backs = parts;
    __shared__ R lost[SLOTS / 32 * G];
#else
    R lost[SLOTS / 32 * G] = {};
    Group rested[PLANE * Q], backs[PLANE * Q];
#endif
    const int* run_patch = list_starts.data;
    const int* run_start = run_patch + patches + 1;
    const int* back_patch = run_start + run_patch[patches] + 1;
    const int* back_start = back_patch + patches + 1;
    const short* run_vertex = (const short*)list_vertices.data;
    const short* back_vertex = run_vertex + run_start[run_patch[patches]];
    const R* run_weight = list_values.data;
    const R* back_value = run_weight + run_start[run_patch[patches]];
    const long long body_stride = @OWN_REST ? 3 * (long long)vertices : 0, vertex_stride = 3, axis_stride = 1;
    const int moved = activations > 0;
    R* cell = sums.data + (long long)(index / patches) * cells * G;
"""

_TARGETS = """
    const int numbers = 3 * (vertex_start[patch + 1] - vertex_start[patch]);
    for (int e = lane; e < numbers; e += width) {
        #pragma unroll
        for (int q = 0; q < Q; q++) {
            Group group;
            #pragma unroll
            for (int p = 0; p < P; p++) {
                const long long b = first + q * P + p < last ? first + q * P + p : last;
                group.of[p] = targets.data[3 * (b * vertices + vertex_start[patch]) + e]
                    - origin.data[3 * b + e % 3];
            }
            pulled[q * PLANE + e] = group;
        }
    }
    MEET;
"""
"""Each vertex's place is read and written by its own thread from here on, until all have met again."""

_SLOT = """
    for (int slot = lane; slot < SLOTS; slot += width) {
        const int listed = slots[patch * SLOTS + slot], slice = patch * (SLOTS / 32) + slot / 32;
        const bool live = listed >= 0;
        const int local = live ? listed : 0, vertex = vertex_start[patch] + local;
        const bool needed = @OWN_WEIGHTS || @MEASURED || weights.data[vertex] > 0;
        const int moved = activations > 0 && live && needed;
"""

_RESIDUAL = """
        MEET;
        Group* place = pulled + 3 * local;
        #pragma unroll
        for (int q = 0; q < Q; q++) {
            if (!live) continue;
            #pragma unroll
            for (int r = 0; r < 3; r++) {
                Group point, miss = place[q * PLANE + r];
                #pragma unroll
                for (int p = 0; p < P; p++) {
                    point.of[p] = x[q * P + p][r];
                    miss.of[p] = y[q * P + p][r] - miss.of[p];
                }
                rested[q * PLANE + 3 * local + r] = point;
                place[q * PLANE + r] = miss;
            }
        }
        #pragma unroll 1
        for (int g = 0; g < G; g++) {
            const long long b = first + g < last ? first + g : last;
            R* miss = (R*)(place + g / P * PLANE) + g % P;
            R share = live ? weights.data[(@OWN_WEIGHTS ? b * vertices : 0) + vertex] : R(0);
            const bool counts = share > 0;
            R square = 0;
            if (live) square = miss[0] * miss[0] + miss[P] * miss[P] + miss[2 * P] * miss[2 * P];
            R far = @MEASURED || @CLIPPED ? ROOT(square) : R(0);
            if (@MEASURED && live && first + g <= last) distances.data[b * vertices + vertex] = far;
            R energy = share * (counts ? square : R(0));
            if (@CLIPPED) {
                const R limit = bound.data[b];
                far = counts ? far : R(0);
                const R near = far < limit ? far : limit;
                energy = share * near * (far + far - near);
                share *= limit / (far > limit ? far : limit);
            }
#if defined(__CUDA_ARCH__)
            for (int apart = 16; apart > 0; apart /= 2) energy += __shfl_xor_sync(~0u, energy, apart);
            if (lane % 32 == 0) lost[lane / 32 * G + g] = energy;
#else
            lost[slot / 32 * G + g] += energy;
#endif
            if (live)
                for (int r = 0; r < 3; r++) miss[r * P] = counts ? share * miss[r * P] : R(0);
        }
"""
"""Misses lie where targets did, then what they pull; one frame at a time, which spares registers.

The energies of a warp are added up on the way: no branch parts its threads here.
"""

_BACK = """
        R back[G][3];
        #pragma unroll
        for (int q = 0; q < Q; q++) {
            #pragma unroll
            for (int r = 0; r < 3; r++) {
                Group force = {};
                if (live) force = place[q * PLANE + r];
                #pragma unroll
                for (int p = 0; p < P; p++) {
                    y[q * P + p][r] = force.of[p];
                    back[q * P + p][r] = 0;
                }
            }
        }
        id = blend_id + blend_start[slice] + slot % 32;
        value = blend_value + blend_start[slice] + slot % 32;
        const int back_count = @PULLS && moved ? blend_count : 0;
        for (int e = 0; e < back_count; e += 32) {
            const int j = id[e];
            const R w = value[e];
            #pragma unroll
            for (int q = 0; q < Q; q++) {
                #pragma unroll
                for (int r = 0; r < 3; r++) {
                    const Group* row = parts + (q * JOINTS + j) * 13 + 4 * r;
                    const Group mx = row[0], my = row[1], mz = row[2];
                    #pragma unroll
                    for (int p = 0; p < P; p++) {
                        const R force = w * y[q * P + p][r];
                        back[q * P + p][0] += mx.of[p] * force;
                        back[q * P + p][1] += my.of[p] * force;
                        back[q * P + p][2] += mz.of[p] * force;
                    }
                }
            }
        }
        MEET;
        #pragma unroll
        for (int q = 0; q < Q; q++) {
            if (!live) continue;
            #pragma unroll
            for (int r = 0; r < 3; r++) {
                Group group;
                #pragma unroll
                for (int p = 0; p < P; p++) {
                    const int b = first + q * P + p < last ? first + q * P + p : last;
                    group.of[p] = scale.data[b] * back[q * P + p][r];
                }
                backs[q * PLANE + 3 * local + r] = group;
            }
        }
    }
    MEET;
"""
"""What the correctives' offsets feel: the blended rotation's transpose, summed influence by influence."""

_FORCES = """
    const int run_count = @PULLS ? run_patch[patch + 1] - run_patch[patch] : 0;
    for (int e = lane; e < run_count * G; e += width) {
        const int run = run_patch[patch] + e / G, g = e % G, plane = g / P * PLANE;
        const R* point = (const R*)(rested + plane) + g % P;
        const R* pull = (const R*)(pulled + plane) + g % P;
        R f[12] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
        for (int i = run_start[run]; i < run_start[run + 1]; i++) {
            const int at = 3 * P * run_vertex[i];
            const R w = run_weight[i], x = point[at], y = point[at + P], z = point[at + 2 * P];
            #pragma unroll
            for (int r = 0; r < 3; r++) {
                const R force = w * pull[at + r * P];
                f[4 * r] += force * x;
                f[4 * r + 1] += force * y;
                f[4 * r + 2] += force * z;
                f[4 * r + 3] += force;
            }
        }
        #pragma unroll
        for (int k = 0; k < 12; k++) cell[(patches + 12 * run + k) * G + g] = f[k];
    }
"""

_PULL = """
    const int slice_count = @PULLS && moved ? back_patch[patch + 1] - back_patch[patch] : 0;
    Group* drawn = (Group*)cell + (patches + 12 * run_patch[patches] + act_start[patch]) * Q;
    for (int e = lane; e < 32 * slice_count; e += width) {
        const int slice = back_patch[patch] + e / 32, begin = back_start[slice];
        const short* id = back_vertex + begin + e % 32;
        const R* value = back_value + 3 * (long long)begin + e % 32;
        R sum[G];
        #pragma unroll
        for (int g = 0; g < G; g++) sum[g] = 0;
        for (int i = 0; i < back_start[slice + 1] - begin; i += 32) {
            const Group* row = backs + 3 * id[i];
            const R wx = value[3 * i], wy = value[3 * i + 32], wz = value[3 * i + 64];
            #pragma unroll
            for (int q = 0; q < Q; q++) {
                const Group bx = row[q * PLANE], by = row[q * PLANE + 1], bz = row[q * PLANE + 2];
                #pragma unroll
                for (int p = 0; p < P; p++)
                    sum[q * P + p] += wx * bx.of[p] + wy * by.of[p] + wz * bz.of[p];
            }
        }
        if (e >= act_count) continue;
        #pragma unroll
        for (int q = 0; q < Q; q++) {
            Group group;
            for (int p = 0; p < P; p++) group.of[p] = sum[q * P + p];
            drawn[e * Q + q] = group;
        }
    }
"""

_ENERGY = """
    for (int g = lane; g < G; g += width) {
        R sum = 0;
        for (int i = 0; i < SLOTS / 32; i++) sum += lost[i * G + g];
        cell[patch * G + g] = sum;
    }
"""
