"""Rotations in Warp: twins of ``geometry.kabsch`` and ``geometry.rotations``, for use inside kernels."""

import warp as wp

from soma_core.geometry.kabsch import PRIOR_STRENGTH

__all__ = ["bone_functions", "kabsch_function"]

_NEWTON_STEPS = 9


def _nearest_function(scalar: str, module: wp.Module, cofactor: wp.Function) -> wp.Function:
    """Proper polar factor by scaled Newton, as ``geometry.kabsch`` describes it."""
    real = getattr(wp, scalar)
    mat33 = wp.types.matrix((3, 3), real)
    tiny = wp.constant(real(1e-30 if scalar == "float32" else 1e-100))
    newton_steps = wp.constant(_NEWTON_STEPS)
    converged = wp.constant(real(1e-9 if scalar == "float32" else 1e-20))

    @wp.func(module=module)
    def nearest(covariance: mat33):
        gram = wp.transpose(covariance) * covariance
        mean = wp.trace(gram) / real(3.0)
        centred = gram - mean * wp.identity(n=3, dtype=real)
        spread = wp.sqrt(wp.ddot(centred, centred) / real(6.0))
        half = real(0.5) * wp.determinant(centred / wp.max(spread, tiny))
        angle = wp.acos(wp.clamp(half, real(-1.0), real(1.0))) / real(3.0)
        scale = wp.sqrt(wp.max(mean + real(2.0) * spread * wp.cos(angle), real(0.0)))
        unit = covariance / wp.max(scale, tiny)
        x = unit + cofactor(unit)
        step = int(0)  # noqa: UP018, RUF046 - a dynamic variable to Warp, so that the loop can end early
        while step < newton_steps:
            step += 1
            adjugate = cofactor(x)
            det = x[0, 0] * adjugate[0, 0] + x[0, 1] * adjugate[0, 1] + x[0, 2] * adjugate[0, 2]
            if wp.abs(det) < real(1e-30):
                det = real(1e-30)
            stretch = wp.sqrt(wp.sqrt(wp.ddot(adjugate, adjugate) / wp.ddot(x, x)) / wp.abs(det))
            following = real(0.5) * (stretch * x + adjugate / (stretch * det))
            change = following - x
            x = following
            if wp.ddot(change, change) < converged:
                break
        change = x - cofactor(x)  # zero for a rotation; not a number where reflections tie exactly
        if not (wp.ddot(change, change) < real(1e-6) and wp.determinant(x) > real(0.5)):
            x = wp.identity(n=3, dtype=real)
        return x

    return nearest


def kabsch_function(scalar: str, module: wp.Module) -> wp.Function:
    """``rotation_from_covariance`` as a Warp function of `module`."""
    real = getattr(wp, scalar)
    vec3, mat33 = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    prior = wp.constant(real(PRIOR_STRENGTH))
    floor = wp.constant(real(1e-24 if scalar == "float32" else 1e-162))

    @wp.func(module=module)
    def cofactor(m: mat33):
        a, b, c = (
            vec3(m[0, 0], m[0, 1], m[0, 2]),
            vec3(m[1, 0], m[1, 1], m[1, 2]),
            vec3(m[2, 0], m[2, 1], m[2, 2]),
        )
        return wp.matrix_from_rows(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))

    nearest = _nearest_function(scalar, module, cofactor)

    @wp.func(module=module)
    def from_covariance(covariance: mat33):
        pull = prior * wp.sqrt(wp.ddot(covariance, covariance) + floor)
        return nearest(covariance + pull * wp.identity(n=3, dtype=real))

    return from_covariance


def bone_functions(scalar: str, module: wp.Module) -> tuple[wp.Function, wp.Function]:
    """``shortest_arc`` and the covariance of a pair of bones' normals, as Warp functions of `module`."""
    real = getattr(wp, scalar)
    vec3 = wp.types.vector(3, real)
    floor = wp.constant(real(1e-18 if scalar == "float32" else 1e-150))  # its square is still a number
    opposite = wp.constant(real(1e-7 if scalar == "float32" else 1e-12))

    @wp.func(module=module)
    def arc(source: vec3, target: vec3):
        a, b = wp.normalize(source), wp.normalize(target)
        total = a + b
        if wp.dot(total, total) < opposite:
            axis = vec3(real(0.0), real(0.0), real(1.0))
            if wp.abs(a[0]) <= wp.abs(a[1]) and wp.abs(a[0]) <= wp.abs(a[2]):
                axis = vec3(real(1.0), real(0.0), real(0.0))
            elif wp.abs(a[1]) <= wp.abs(a[2]):
                axis = vec3(real(0.0), real(1.0), real(0.0))
            total = wp.cross(a, axis)
        middle = wp.normalize(total)
        eye = wp.identity(n=3, dtype=real)
        return (real(2.0) * wp.outer(middle, middle) - eye) * (real(2.0) * wp.outer(a, a) - eye)

    @wp.func(module=module)
    def pair_normal(first: vec3, second: vec3, first_goal: vec3, second_goal: vec3):
        source, goal = wp.cross(first, second), wp.cross(first_goal, second_goal)
        area = wp.sqrt(wp.sqrt((wp.dot(source, source) + floor) * (wp.dot(goal, goal) + floor)))
        return wp.outer(goal, source) / area

    return arc, pair_normal
