"""Native bodies of kernels: one group of frames a call, each number a vector of the compiler's own type.

Warp's own vectors are structures, which its compiler loads and stores entry by entry. A body that is written
in C++ on clang's vector type is compiled to SIMD instructions, wide vectors split where the processor is
narrower. The same text serves CUDA with one frame a group, where the vector is a plain number.

A body is the text of one function. In it ``R`` is the number, ``V`` the vector of ``N`` numbers, ``M`` a
pointer to vectors in a group's working memory.
"""

from collections.abc import Callable

import warp as wp

from soma_core.kernels._lanes import ABREAST
from soma_core.kernels._runtime import once

__all__ = ["HALVES", "native", "transposing"]

_BYTES = 64
"""A square of vectors of this size is transposed in registers."""


def native(body: str, scalar: str, lanes: int, stub: Callable) -> wp.Function:
    """Function of Warp kernels with the arguments of `stub` and a C++ body.

    Args:
        body: of the function; ``ROOT(x)`` is the root of each lane.
        scalar: ``float32`` or ``float64``.
        lanes: numbers in a vector.
        stub: names and types of the arguments; it does nothing.
    """
    number, size = ("float", 4) if scalar == "float32" else ("double", 8)
    vector = f"typedef {number} R; typedef R V"
    if lanes > 1:  # aligned like one number: torch gives rows that start anywhere
        vector += f" __attribute__((vector_size({size * lanes}), aligned({size})))"
    root = "__builtin_elementwise_sqrt(" if lanes > 1 else "wp::sqrt("
    memory = "typedef V* M;" if lanes > 1 else _ABREAST
    text = f"{{\n{_FUSED}{vector}; constexpr int N = {lanes};\n{memory}\n{body}}}".replace("ROOT(", root)
    # Warp tells functions apart by name and arguments, which are alike for all numbers of lanes.
    stub.__name__ = f"{stub.__name__}_{scalar}_{lanes}"
    stub.__qualname__ = stub.__name__
    return wp.func_native(text)(stub)


HALVES = """
#if defined(__CUDA_ARCH__) || !defined(__clang__)
    typedef V H; typedef M HM;
#elif defined(__AVX512F__)
    typedef V H; typedef H* HM;
#else
    typedef R H __attribute__((vector_size(sizeof(V) > 32 ? 32 : sizeof(V)), aligned(sizeof(R))));
    typedef H* HM;
#endif
    constexpr int P = sizeof(V) / sizeof(H);
"""
"""What a register holds: ``P`` parts ``H`` of a vector, one behind the other, at ``HM``. A dozen sums of
whole vectors do not fit into the registers of a processor without AVX-512."""


_ABREAST = f"""
struct M {{
    R* p;
    explicit CUDA_CALLABLE M(R* begin): p(begin) {{}}
    CUDA_CALLABLE R& operator[](long long i) const {{ return p[i * {ABREAST}]; }}
    CUDA_CALLABLE R& operator*() const {{ return *p; }}
    CUDA_CALLABLE M operator+(long long i) const {{ return M(p + i * {ABREAST}); }}
    CUDA_CALLABLE M operator-(long long i) const {{ return M(p - i * {ABREAST}); }}
    CUDA_CALLABLE M& operator+=(long long i) {{ p += i * {ABREAST}; return *this; }}
    CUDA_CALLABLE M operator++(int) {{ M here = *this; p += {ABREAST}; return here; }}
    CUDA_CALLABLE explicit operator R*() const {{ return p; }}
}};
"""
"""Memory of frames that lie abreast: what neighbours read at once lies together."""

_FUSED = """
#if defined(__clang__)
#pragma clang fp contract(fast)
#endif
"""
"""Let products and sums join into one instruction, which clang otherwise leaves apart in vectors."""


@once
def transposing(scalar: str, lanes: int) -> tuple[wp.Function, wp.Function]:
    """Functions that bring rows of frames into lanes, and back.

    ``load(source, stride, offset, count, first, last, out, at)`` writes numbers offset .. offset + count of
    the frames first .. first + N, each `stride` numbers long and none behind `last`, to ``out[at ..]`` of
    vectors. ``store(values, at, count, out, stride, offset, first, last)`` is its inverse.
    """
    numbers = wp.array(dtype=getattr(wp, scalar))

    def load(
        source: numbers, stride: wp.int64, offset: int, count: int, first: int, last: int, out: numbers,
        at: int,
    ):  # fmt: skip
        ...

    def store(
        values: numbers, at: int, count: int, out: numbers, stride: wp.int64, offset: int, first: int,
        last: int,
    ):  # fmt: skip
        ...

    if lanes == 1:
        return native(_LOAD_ONE, scalar, 1, load), native(_STORE_ONE, scalar, 1, store)
    unit = min(lanes, _BYTES // (4 if scalar == "float32" else 8))
    square = _square(unit) if unit > 1 else ""
    whole = _LOAD_SQUARES.replace("SQUARE", square) if unit > 1 else ""
    back = _STORE_SQUARES.replace("SQUARE", square) if unit > 1 else ""
    size = f"constexpr int U = {unit};\n"
    return (
        native(size + _LOAD.replace("SQUARES", whole), scalar, lanes, load),
        native(size + _STORE.replace("SQUARES", back), scalar, lanes, store),
    )


def _square(unit: int) -> str:
    """Transposition of `unit` vectors ``a`` of as many numbers, by exchanging ever larger blocks."""
    lines, step = [], 1
    while step < unit:
        low = [i if not i & step else unit + i - step for i in range(unit)]
        high = [i + step if not i & step else unit + i for i in range(unit)]
        for i in range(unit):
            if i & step:
                continue
            pair = f"a[{i}], a[{i + step}], "
            lines.append(
                f"{{ S p = __builtin_shufflevector({pair}{', '.join(map(str, low))});"
                f" a[{i + step}] = __builtin_shufflevector({pair}{', '.join(map(str, high))}); a[{i}] = p; }}"
            )
        step *= 2
    return "\n".join(lines)


_LOAD_ONE = """
    const R* row = source.data + (long long)(first < last ? first : last) * stride + offset;
    M to = (M)out.data + at;
    for (int i = 0; i < count; i++) to[i] = row[i];
"""

_STORE_ONE = """
    if (first > last) return;
    M from = (M)values.data + at;
    R* row = out.data + (long long)first * stride + offset;
    for (int i = 0; i < count; i++) row[i] = from[i];
"""

_SQUARE_TYPE = "typedef R S __attribute__((vector_size(sizeof(R) * U), aligned(sizeof(R))));\n"

_LOAD = """
    const R* rows[N];
    for (int c = 0; c < N; c++) {
        int f = first + c < last ? first + c : last;
        rows[c] = source.data + (long long)f * stride + offset;
    }
    R* to = out.data + (long long)at * N;
    int i = 0;
    SQUARES
    for (; i < count; i++)
        for (int c = 0; c < N; c++) to[i * N + c] = rows[c][i];
"""

_LOAD_SQUARES = (
    _SQUARE_TYPE
    + """
    for (; i + U <= count; i += U)
        for (int b = 0; b < N; b += U) {
            S a[U];
            for (int c = 0; c < U; c++) {
                a[c] = *(const S*)(rows[b + c] + i);
                __builtin_prefetch(rows[b + c] + i + count);
            }
            SQUARE
            for (int c = 0; c < U; c++) *(S*)(to + (i + c) * N + b) = a[c];
        }
"""
)

_STORE = """
    const R* from = values.data + (long long)at * N;
    R* to = out.data + (long long)first * stride + offset;
    int frames = last + 1 - first < N ? last + 1 - first : N;
    int i = 0;
    SQUARES
    for (; i < count; i++)
        for (int c = 0; c < frames; c++) to[c * stride + i] = from[i * N + c];
"""

_STORE_SQUARES = (
    _SQUARE_TYPE
    + """
    for (; i + U <= count; i += U)
        for (int b = 0; b < frames; b += U) {
            S a[U];
            for (int c = 0; c < U; c++) a[c] = *(const S*)(from + (i + c) * N + b);
            SQUARE
            for (int c = 0; c < U; c++)
                if (b + c < frames) *(S*)(to + (b + c) * stride + i) = a[c];
        }
"""
)
