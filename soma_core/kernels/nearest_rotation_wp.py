"""Nearest rotations in Warp: twin of ``rotation_from_covariance`` in ``geometry.kabsch``, forward only."""

import math

import torch
import warp as wp
from torch import Tensor

from soma_core.geometry.kabsch import PRIOR_STRENGTH
from soma_core.kernels._lanes import (
    as_rows,
    lane_count,
    launch,
    row_of,
    worker_count,
    working_rows,
)
from soma_core.kernels._native import native, transposing
from soma_core.kernels._runtime import as_warp, once, scalar_name
from soma_core.kernels._threads import in_threads

__all__ = ["NEWTON_STEPS", "nearest_functions", "nearest_rotation"]

NEWTON_STEPS = 9
"""As many as the reference takes."""

_FLOORS = {"float32": (1e-24, 1e-30, 1e-30), "float64": (math.ulp(0.0) ** 0.5, 1e-100, 1e-200)}
"""Of the squared covariance, its Gram matrix's spread and its largest singular value: the reference's."""


@once
def _kernel(scalar: str, lanes: int):
    width, number, steps = lanes, getattr(wp, scalar), NEWTON_STEPS
    real, rows = wp.array(dtype=number), wp.array3d(dtype=number)
    (load, store), row = transposing(scalar, lanes), row_of(scalar)
    shift, polar, checked = nearest_functions(scalar, lanes)
    module = wp.get_module(f"soma_nearest_rotation_{scalar}_{lanes}")

    @wp.kernel(module=module, enable_backward=False)
    def nearest(first: int, stop: int, count: int, given: real, work: rows, out: real):
        w = wp.tid()
        matrix = row(work, w)
        for g in range(first + w, stop, work.shape[0] * work.shape[1]):
            load(given, wp.int64(9), 0, 9, g * width, count - 1, matrix, 0)
            shift(matrix)
            for _ in range(steps):
                polar(matrix)
            checked(matrix)
            store(matrix, 0, 9, out, wp.int64(9), 0, g * width, count - 1)

    return nearest


@once
def nearest_functions(scalar: str, lanes: int) -> tuple[wp.Function, wp.Function, wp.Function]:
    """Functions that turn a covariance into its rotation: before, of and after the Newton steps."""
    real = wp.array(dtype=getattr(wp, scalar))
    shift, polar, checked = (_native(one, real, scalar, lanes) for one in ("shift", "polar", "checked"))
    return shift, polar, checked


def _native(name: str, real, scalar: str, lanes: int) -> wp.Function:
    def stub(matrix: real): ...

    stub.__name__ = name
    squared, spread, largest = _FLOORS[scalar]
    constants = (
        f"constexpr R PULL = {PRIOR_STRENGTH!r}, SQUARED = {squared!r}, SPREAD = {spread!r}, "
        f"LARGEST = {largest!r};\n"
    )
    return native(constants + _COFACTOR + _BODIES[name], scalar, lanes, stub)


_COFACTOR = """
    M x = (M)matrix.data;
    auto cofactor = [](const auto& m, V* c) {
        for (int i = 0; i < 3; i++) {
            const auto a = m + 3 * ((i + 1) % 3), b = m + 3 * ((i + 2) % 3);
            for (int k = 0; k < 3; k++) {
                const int p = (k + 1) % 3, q = (k + 2) % 3;
                c[3 * i + k] = a[p] * b[q] - a[q] * b[p];
            }
        }
    };
    auto squares = [](const auto& m) {
        V sum = V{};
        for (int i = 0; i < 9; i++) sum += m[i] * m[i];
        return sum;
    };
    auto size = [](V a) { return a < 0 ? -a : a; };
"""

_BODIES = {
    # H + cof(H) of the covariance with its prior, scaled to a largest singular value of one.
    "shift": """
    const V pull = PULL * ROOT(squares(x) + SQUARED);
    for (int i = 0; i < 9; i += 4) x[i] += pull;
    V gram[9], cof[9], mean = V{};
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++) gram[3 * i + k] = x[i] * x[k] + x[3 + i] * x[3 + k] + x[6 + i] * x[6 + k];
    mean = (gram[0] + gram[4] + gram[8]) / 3;
    for (int i = 0; i < 9; i += 4) gram[i] -= mean;
    const V spread = ROOT(squares(gram) / 6), least = V{} + SPREAD, one = V{} + 1;
    const V safe = spread < least ? least : spread;
    for (int i = 0; i < 9; i++) gram[i] /= safe;
    cofactor(gram, cof);
    V half = (gram[0] * cof[0] + gram[1] * cof[1] + gram[2] * cof[2]) / 2;
    half = half < -one ? -one : half;
    half = half > one ? one : half;
    V root = half;
    for (int c = 0; c < N; c++) ((R*)&root)[c] = wp::cos(wp::acos(((R*)&half)[c]) / 3);
    V squared = mean + 2 * spread * root;
    squared = squared < 0 ? V{} : squared;
    const V scale = ROOT(squared), tiny = V{} + LARGEST;
    const V divisor = scale < tiny ? tiny : scale;
    for (int i = 0; i < 9; i++) x[i] /= divisor;
    cofactor(x, cof);
    for (int i = 0; i < 9; i++) x[i] += cof[i];
""",
    # One scaled Newton step.
    "polar": """
    V cof[9];
    cofactor(x, cof);
    V det = x[0] * cof[0] + x[1] * cof[1] + x[2] * cof[2];
    const V least = V{} + (R)1e-30;
    det = size(det) < least ? least : det;
    const V stretch = ROOT(ROOT(squares(cof)) / size(det) / ROOT(squares(x)));
    const V inverse = 1 / (stretch * det);
    for (int i = 0; i < 9; i++) x[i] = (stretch * x[i] + cof[i] * inverse) / 2;
""",
    # What did not arrive becomes the identity.
    "checked": """
    V cof[9], far = V{};
    cofactor(x, cof);
    const V det = x[0] * cof[0] + x[1] * cof[1] + x[2] * cof[2], bound = V{} + (R)1e-3;
    for (int i = 0; i < 9; i++) far = size(x[i] - cof[i]) < far ? far : size(x[i] - cof[i]);
    for (int i = 0; i < 9; i++) {
        const V other = V{} + (R)(i % 4 == 0);
        x[i] = far < bound ? (det > 0 ? x[i] : other) : other;
    }
""",
}


def nearest_rotation(covariance: Tensor) -> Tensor:
    """Rotations that maximise ``<R, H>``, (..., 3, 3), contiguous, from covariances (..., 3, 3)."""
    given = covariance.contiguous()
    count, lanes, scalar = given.numel() // 9, lane_count(given), scalar_name(given.dtype)
    kernel, groups, out = _kernel(scalar, lanes), -(-count // lanes), torch.empty_like(given)

    def run(part: slice) -> None:
        workers = worker_count(part.stop - part.start, lanes)
        work = working_rows(given, workers, 9, lanes)
        flat = as_warp(given.view(-1)), as_rows(work), as_warp(out.view(-1))
        launch(kernel, workers, [part.start, part.stop, count, *flat], given)

    in_threads(run, groups, given)
    return out
