"""Checks of the wrap pair: the canonical mesh, vertex for vertex, on the native surface."""

from __future__ import annotations

import numpy as np

from soma_core.plugin.checks import CheckFailedError, check
from soma_core.registration.coverage import COVERED, coverage, faults, matches
from soma_core.registration.digits import digit_guide
from soma_core.registration.surface import Surface
from soma_core.testing.context import Context
from soma_core.topology.wrap_pair import check_count, check_faces, check_order

__all__ = ["CHECKS"]

_STRAY_RATIO = 4.0
"""A vertex this many times further from its neighbours than any on the canonical mesh was exchanged with
another one: wraps stretch single edges, but never across the body."""

_CLOSE = 0.0025
"""Distance to the native surface, relative to the body's diagonal, that registered vertices keep: 5 mm."""
_ASTRAY = 0.01
"""Part of the covered vertices that need not be close; nails, lips and armpits rarely are."""
_LOOSE = 0.025
"""What no covered vertex may exceed, relative to the diagonal: 5 cm of 2 m is another part of the body."""

_APART = 0.05
"""What no native vertex may exceed, relative to the diagonal: 10 cm of 2 m is a limb, a hat or a tail."""


def _no_wrap(context: Context) -> str:
    return "the native topology is the canonical one" if context.spec.wrap is None else ""


@check("wrap-reads", mend="export them again", level="core", needs=("declares",), unless=_no_wrap)
def wrap_reads(context: Context) -> None:
    """Both files of the wrap pair are there and hold a mesh."""
    _ = context.wrap


@check(
    "wrap-count",
    mend="export without merging or splitting",
    level="core",
    needs=("wrap-reads",),
    unless=_no_wrap,
)
def wrap_count(context: Context) -> None:
    """The wrap has one vertex for each canonical vertex."""
    check_count(context.wrap.vertices, context.mesh, path=context.wrap.path)


@check(
    "wrap-order",
    mend="export with the vertex order kept",
    level="core",
    needs=("wrap-count",),
    unless=_no_wrap,
)
def wrap_order(context: Context) -> None:
    """The wrap's vertices are in canonical order."""
    check_order(context.wrap.vertices, context.mesh, path=context.wrap.path)
    edges = context.mesh.edges()
    limit = _STRAY_RATIO * _relative_reach(context.mesh.vertices, edges).max()
    reach = _relative_reach(context.wrap.vertices, edges)
    worst = int(reach.argmax())
    if reach[worst] > limit:
        raise CheckFailedError(
            f"wrap {context.wrap.path}, {context.vertex(worst)}",
            got=f"neighbours {reach[worst]:.1%} of the body's diagonal away",
            expected=f"at most {limit:.1%}",
            fix="The vertex took the place of another; export again with the vertex order kept.",
        )


def _relative_reach(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Mean distance of each vertex to its neighbours, relative to the body's diagonal, (v,)."""
    start, end = edges.T
    length = np.linalg.norm(points[start] - points[end], axis=1) / np.linalg.norm(np.ptp(points, axis=0))
    both = np.concatenate((start, end))
    return np.bincount(both, np.tile(length, 2), len(points)) / np.bincount(both, minlength=len(points))


@check("wrap-faces", mend="the same", level="core", needs=("wrap-order",), unless=_no_wrap)
def wrap_faces(context: Context) -> None:
    """The wrap's faces are those of the canonical mesh."""
    check_faces(context.wrap.triangles, context.mesh, path=context.wrap.path)


@check(
    "wrap-distance",
    mend="register again; name what the model lacks in `fill_segments`",
    level="core",
    needs=("wrap-faces", "fill-segments"),
    unless=_no_wrap,
)
def wrap_distance(context: Context) -> None:
    """The wrap lies on the native surface, filled segments apart."""
    diagonal = float(np.linalg.norm(np.ptp(context.wrap.native, axis=0)))
    distance = np.where(context.covered, context.correspondence.distances, 0.0)
    worst, millimetres = int(distance.argmax()), 1000 * context.metres
    astray = float((distance > _CLOSE * diagonal).sum() / context.covered.sum())
    if astray > _ASTRAY or distance[worst] > _LOOSE * diagonal:
        raise CheckFailedError(
            f"wrap {context.wrap.path}, {context.vertex(worst)}",
            got=f"{millimetres * distance[worst]:.0f} mm to the native surface, and {astray:.1%} of the "
            f"vertices further than {millimetres * _CLOSE * diagonal:.0f} mm",
            expected=f"at most {millimetres * _LOOSE * diagonal:.0f} mm, and {_ASTRAY:.0%}",
            fix="Register the wrap again, or name the segment in fill_segments if the model lacks it.",
        )


def _skin(context: Context) -> tuple[np.ndarray, Surface]:
    """Wrap and native surface in metres, +Y up; vertices without a face are no skin."""
    triangles = context.wrap.native_triangles
    used, place = np.unique(triangles, return_inverse=True)
    native = context.wrap.native[used] @ context.wrap_frame.T
    return context.wrap.vertices @ context.wrap_frame.T, Surface(native, place.reshape(-1, 3))


@check(
    "wrap-coverage",
    mend="register that part again, or leave its faces out of `native.obj`",
    level="core",
    needs=("wrap-distance",),
    unless=_no_wrap,
)
def wrap_coverage(context: Context) -> None:
    """Each segment of the wrap lies on the native surface, and what is native there under it."""
    wrap, surface = _skin(context)
    back = Surface(wrap, context.mesh.triangles.astype(np.int64)).closest(surface.vertices).points
    away = np.linalg.norm(back - surface.vertices, axis=1) / np.linalg.norm(np.ptp(wrap, axis=0))
    if away.max() > _APART:
        raise CheckFailedError(
            f"native mesh {context.wrap.native_path}, around {surface.vertices[away.argmax()].round(2)} m",
            got=f"{away.max():.1%} of the body's diagonal from the wrap",
            expected=f"at most {_APART:.0%}",
            fix="The wrap misses this part: register it there, or take the part out of the native OBJ.",
        )
    found = coverage(wrap, surface, context.mesh, context.rig, ~context.covered)
    worst = min(found, key=lambda name: found[name].least)
    if found[worst].least < COVERED:
        share = found[worst]
        raise CheckFailedError(
            f"wrap {context.wrap.path}, {worst}",
            got=f"{share.wrap:.0%} of it on the native surface, and {share.native:.0%} of that under it",
            expected=f"at least {COVERED:.0%} both ways",
            fix="Register the wrap there again, or name the segment in fill_segments if the model lacks it.",
        )


def _no_fingers(context: Context) -> str:
    if context.mesh.revision != digit_guide().mesh.revision:
        return "the canonical mesh is not the shipped one"
    return _no_wrap(context)


@check(
    "wrap-fingers",
    mend="`soma wrap`, or landmarks on the tips",
    level="core",
    needs=("wrap-distance",),
    unless=_no_fingers,
)
def wrap_fingers(context: Context) -> None:
    """Each finger and toe of the wrap lies on one of the native surface, in their order."""
    wrap, surface = _skin(context)
    digits = digit_guide().find(surface, wrap)
    found = faults({}, matches(wrap, surface, digits, digit_guide()), dict(digits.counts), told=digits.counts)
    if found:
        raise CheckFailedError(
            f"wrap {context.wrap.path}",
            got="; ".join(found),
            expected="fingers and toes one to one, where those of the native surface stand apart",
            fix="Register the hand or foot again; soma wrap matches them one to one.",
        )


CHECKS = (wrap_reads, wrap_count, wrap_order, wrap_faces, wrap_distance, wrap_coverage, wrap_fingers)
