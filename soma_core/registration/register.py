"""Register the canonical mesh to a human mesh: parametric fit, smooth deformation, projection, fill."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse
import torch
from scipy.sparse.linalg import splu

from soma_core.errors import InputError
from soma_core.geometry.mesh import vertex_normals
from soma_core.layer import SomaLayer
from soma_core.paths import shipped_assets
from soma_core.plugin.spec import Axis, Unit
from soma_core.progress import progress
from soma_core.registration.alignment import find_starts
from soma_core.registration.body_fit import BodyFit, fit_body, place_hands
from soma_core.registration.body_model import BodyModel
from soma_core.registration.coverage import without_digits
from soma_core.registration.deform import Smoothness, deform
from soma_core.registration.digits import Digits, Marks, digit_guide
from soma_core.registration.folds import lay_down
from soma_core.registration.strangers import refuse_distant, refuse_unlike
from soma_core.registration.surface import Surface
from soma_core.registration.target import Frame, Skin, find_skin
from soma_core.rig.mesh import CanonicalMesh
from soma_core.topology.fill import FillOperator, build_fill

__all__ = ["FILLED", "Registration", "WrapOptions", "register"]

_log = logging.getLogger(__name__)

FILLED = ("eye_bags", "mouth_bag", "between_toes")
"""Segments without a counterpart on most bodies."""

_STARTS = 4
_ROUGH = [0.2] * 4 + [0.1] * 3
_STAGES = (([0.1] * 6, 20.0), ([0.05] * 6, 20.0), ([0.03] * 6, 8.0), ([0.02] * 6, 4.0), ([0.02] * 6, 2.0))
"""Scale [m] of each step of a stage, and how stiff fingers and feet are in it."""

_GRIP = ([0.03] * 3 + [0.02] * 3, 8.0)
"""The same, once limbs are in place, from hands spun by a finger's width to either side."""

_SPIN, _CLEARLY = 0.3, 0.8
"""A finger's width at the fingertips [rad], and the share of the cost that makes spinning worth it."""

_LOOKS = (1, 3)
"""Stages before which fingers and toes are told apart; before the last, hands are placed over theirs."""

_HELD, _TOLD = 3, 4
"""Last stages in which parts of fingers are held where they belong, and in which skin keeps to its finger;
then they lie right, and where a finger begins is better told by the surface than by a distance."""

_TRIAL = 2
"""Steps after which hands and feet taken from the other side are compared."""

_COARSE = (8.0, 8.0, 6.0, 6.0, 4.0, 4.0, 3.0, 3.0, 2.0, 2.0)
_FINE = (6.0, 6.0, 4.0, 4.0, 3.0, 3.0, 2.0, 2.0, 1.5, 1.5)
"""Lengths, in edges of the low and of the mid LOD, over which displacements are smooth."""

_COARSE_SCALE, _FINE_SCALE = 0.03, 0.02

_SYMMETRIC = 1.5e-3
"""Mean distance [m] of a body from its mirror image up to which it counts as symmetric."""

_NOT_HUMAN = 0.01
"""Mean distance of fitted body and surface, as a share of the stature, beyond which it is no human body."""

_NOTHING_LIKE = 0.04
"""The same for the rough fit, to say so early."""

_ANCHOR = 1e4


@dataclass(frozen=True, kw_only=True)
class WrapOptions:
    """What a user may say about a mesh; what is None is found.

    Attributes:
        unit, up, forward: of the native mesh.
        fill: canonical segments without a counterpart on it.
        landmarks: canonical vertex id (mid LOD) -> native vertex id. Those of the low LOD (below 4,505) guide
            the pose as well.
        masked: native vertices that are no skin.
        symmetric: whether to wrap both sides alike.
    """

    unit: Unit | None = None
    up: Axis | None = None
    forward: Axis | None = None
    fill: Sequence[str] = FILLED
    landmarks: Mapping[int, int] = field(default_factory=dict)
    masked: Sequence[int] = ()
    symmetric: bool | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Registration:
    """The canonical mesh on a native surface.

    Attributes:
        wrap: (v, 3) native unit and axes, canonical vertex order.
        frame: the unit and axes found.
        skin: the native surface it lies on.
        filled: (v,) whether a vertex was filled, or drawn over what is masked.
        symmetric: whether both sides were wrapped alike.
        fitted: (v, 3) the parametric body, native unit and axes.
        notes: what was found and left out, for people.
        told: hands and feet all whose fingers or toes have a landmark.
    """

    wrap: np.ndarray
    frame: Frame
    skin: Skin
    filled: np.ndarray
    symmetric: bool
    fitted: np.ndarray
    notes: tuple[str, ...]
    told: tuple[str, ...] = ()


def register(
    vertices: np.ndarray,
    triangles: np.ndarray,
    *,
    options: WrapOptions | None = None,
) -> Registration:
    """Lay the canonical mesh on a human mesh in a T-, A- or similar pose.

    Args:
        vertices: (n, 3), any unit, any axis up.
        triangles: (t, 3).
        options: what is known about the mesh.

    Raises:
        InputError: a broken mesh, one that shows no human body, or options that do not fit it.
    """
    options = options or WrapOptions()
    skin = find_skin(vertices, triangles, masked=options.masked)
    # The shipped body, whatever folder is in use: its shape space is known to fit, and the mesh is the same.
    coarse, fine = (
        BodyModel(SomaLayer("soma", lod=lod, procedural=False, assets=shipped_assets()))
        for lod in ("low", "mid")
    )
    marks = _landmarks(options, vertices, fine.mesh.vertex_count)
    filled = _filled(options.fill, fine.mesh)
    light = skin.lighter()
    fit, frame = _fit_best(light, coarse, options, marks)
    surface, whole = light.surface(frame), skin.surface(frame)
    refuse_distant(fit, coarse, surface, share=_NOTHING_LIKE)
    symmetric = options.symmetric if options.symmetric is not None else _is_symmetric(surface)
    marks = _in_frame(marks, frame, fine.mesh.vertex_count)
    fit = _refine(fit, (coarse, fine), surface, symmetric, marks)
    refuse_distant(fit, coarse, surface, share=_NOT_HUMAN)
    fitted, _ = fine.evaluate(fit.pose)
    digits = digit_guide().find(surface, fitted, marks=marks)
    wrap = _lay_on(fitted, (surface, whole), coarse.mesh, fine.mesh, filled, marks, symmetric, digits)
    filled |= whole.facing(wrap, vertex_normals(wrap, fine.triangles)).open
    notes = (
        f"unit {frame.unit}, up {frame.up}, facing {frame.forward}",
        f"{'symmetric' if symmetric else 'not symmetric'}",
        *skin.notes,
        *without_digits(digits.counts),
    )
    return Registration(
        wrap=frame.to_native(wrap), frame=frame, skin=skin, filled=filled, symmetric=symmetric,
        fitted=frame.to_native(fitted), notes=notes, told=digit_guide().told(options.landmarks),
    )  # fmt: skip


def _fit_best(skin: Skin, model: BodyModel, options: WrapOptions, marks: Marks) -> tuple[BodyFit, Frame]:
    """The best of several starts, each fitted roughly."""
    starts = find_starts(
        skin, model, unit=options.unit, up=options.up, forward=options.forward, count=_STARTS
    )
    refuse_unlike(starts[0])
    fits = []
    for start in progress(starts, label="standing the body into the mesh", total=len(starts)):
        placed = _in_frame(marks, start.frame, model.mesh.vertex_count)
        surface = skin.surface(start.frame)
        fits.append(
            fit_body(model, surface, start.pose, scales=_ROUGH, ends=20.0, samples=1500, landmarks=placed)
        )
    best = min(range(len(fits)), key=lambda i: fits[i].cost)
    return fits[best], starts[best].frame


def _landmarks(options: WrapOptions, vertices: np.ndarray, count: int) -> Marks:
    """Canonical ids and native positions; refuses ids out of range."""
    if not options.landmarks:
        return None
    ids = np.array(list(options.landmarks.keys()), np.int64)
    native = np.array(list(options.landmarks.values()), np.int64)
    for name, values, size in (("canonical", ids, count), ("native", native, len(vertices))):
        strange = values[(values < 0) | (values >= size)]
        if len(strange):
            raise InputError(
                "landmarks",
                got=f"{name} vertex {strange[0]}",
                expected=f"ids from 0 to {size - 1}",
                fix="Correct the landmarks: canonical vertex id -> native vertex id.",
            )
    return ids, vertices[native].astype(np.float64)


def _in_frame(marks: Marks, frame: Frame, count: int) -> Marks:
    """Marks on the first `count` vertices, in metres, +Y up."""
    return None if marks is None else _first((marks[0], frame.to_canonical(marks[1])), count)


def _first(marks: Marks, count: int) -> Marks:
    """Marks on the first `count` vertices, if any."""
    if marks is None:
        return None
    kept = marks[0] < count
    return (marks[0][kept], marks[1][kept]) if kept.any() else None


def _is_symmetric(surface: Surface) -> bool:
    mirrored = surface.vertices * [-1, 1, 1]
    gap = np.linalg.norm(surface.closest(mirrored).points - mirrored, axis=1)
    return bool(gap.mean() < _SYMMETRIC)


def _refine(
    fit: BodyFit, models: tuple[BodyModel, BodyModel], surface: Surface, symmetric: bool, marks: Marks
) -> BodyFit:
    """Fit in stages, from coarse to fine; of a symmetric body the better side is kept.

    Fingers and toes are told apart as soon as limbs are nearly in place, and again when they are.
    """
    model, fine = models
    digits = None
    low = _first(marks, model.mesh.vertex_count)
    for number, (scales, ends) in enumerate(
        progress(_STAGES, label="fitting shape and pose", total=len(_STAGES)), start=1
    ):
        if number in _LOOKS:
            digits = digit_guide().find(surface, fine.evaluate(fit.pose)[0], marks=marks)
            surface = surface.labelled(digits.labels)
            if number == _LOOKS[-1]:
                fit = replace(fit, pose=place_hands(model, fit.pose, digits))
        if number > _TOLD:
            digits, surface = None, surface.labelled(None)
        elif number > _HELD and digits is not None:
            digits = digits.released()
        if number == len(_STAGES) - 1:
            fit = _better_grip(fit, model, surface, symmetric, low, digits)
        fit = fit_body(model, surface, fit.pose, scales=scales, ends=ends, landmarks=low, digits=digits)
        fit = _better_side(fit, model, surface, symmetric, digits, scale=scales[-1], ends=ends)
    return fit


def _better_grip(
    fit: BodyFit, model: BodyModel, surface: Surface, symmetric: bool, marks: Marks, digits: Digits | None
) -> BodyFit:
    """Hands whose fingers may lie on the wrong neighbours are tried a finger further to either side."""
    scales, ends = _GRIP
    known = () if digits is None else digits.tips
    for side in ("Left",) if symmetric else ("Left", "Right"):
        if f"{side}Hand" in known:
            continue
        spun = [model.spun(fit.pose, side, angle) for angle in (-_SPIN, _SPIN)]
        poses = [fit.pose, *([model.like(pose, side) for pose in spun] if symmetric else spun)]
        same, *others = (
            fit_body(model, surface, pose, scales=scales, ends=ends, landmarks=marks, digits=digits)
            for pose in poses
        )
        best = min(others, key=lambda each: each.cost)
        fit = best if best.cost < _CLEARLY * same.cost else fit
    return fit


def _better_side(
    fit: BodyFit,
    model: BodyModel,
    surface: Surface,
    symmetric: bool,
    digits: Digits | None,
    *,
    scale: float,
    ends: float,
) -> BodyFit:
    """Fingers and toes that took the wrong place on one side are tried as they are on the other.

    A symmetric body becomes one like its better side; another may keep both as they are.
    """
    tried = [(model.like if symmetric else model.ends_like)(fit.pose, side) for side in ("Left", "Right")]
    poses = tried if symmetric else [fit.pose, *tried]
    steps = [
        fit_body(model, surface, pose, scales=[scale] * _TRIAL, ends=ends, digits=digits) for pose in poses
    ]
    best = min(range(len(poses)), key=lambda i: steps[i].cost)
    if symmetric:
        return BodyFit(pose=poses[best], vertices=model.evaluate(poses[best])[0], cost=steps[best].cost)
    return steps[best]


def _filled(names: Sequence[str], mesh: CanonicalMesh) -> np.ndarray:
    unknown = sorted(set(names) - set(mesh.segments))
    if unknown:
        raise InputError(
            "fill",
            got=", ".join(unknown),
            expected="names among " + ", ".join(sorted(mesh.segments)),
            fix="Correct the names.",
        )
    filled = np.zeros(mesh.vertex_count, bool)
    for name in names:
        filled[mesh.segments[name]] = True
    return filled


def _lay_on(
    fitted: np.ndarray,
    surfaces: tuple[Surface, Surface],
    low: CanonicalMesh,
    mid: CanonicalMesh,
    filled: np.ndarray,
    marks: Marks,
    symmetric: bool,
    digits: Digits,
) -> np.ndarray:
    """Deform coarse to fine on the first surface, fingers matched at first; project on the second, fill."""
    surface, whole = surfaces
    count = low.vertex_count
    coarse = Smoothness.of(low.triangles.astype(np.int64), digits.own[:count])
    fine = Smoothness.of(mid.triangles.astype(np.int64), digits.own)
    low_marks = _first(marks, count)
    start = fitted[:count]
    moved = deform(
        start, surface.labelled(digits.labels), coarse, free=filled[:count], reaches=_COARSE,
        scale=_COARSE_SCALE, landmarks=low_marks,
    )  # fmt: skip
    vertices = _both_sides(fitted + _spread(moved - start, fine), mid.mirror, symmetric)
    vertices = deform(vertices, surface, fine, free=filled, reaches=_FINE, scale=_FINE_SCALE, landmarks=marks)
    vertices = _both_sides(vertices, mid.mirror, symmetric)
    on_skin = lay_down(vertices, fitted, whole, fine, free=filled, scale=_FINE_SCALE)
    regions = build_fill(vertices, fine.triangles, np.flatnonzero(filled))
    fill = FillOperator(regions, dtype=torch.float64, device="cpu")
    return fill(torch.as_tensor(on_skin)).numpy()


def _both_sides(vertices: np.ndarray, mirror: np.ndarray, symmetric: bool) -> np.ndarray:
    return (vertices + vertices[mirror] * [-1, 1, 1]) / 2 if symmetric else vertices


def _spread(displacement: np.ndarray, smooth: Smoothness) -> np.ndarray:
    """Displacements of the first vertices carried smoothly to all."""
    count = smooth.laplacian.shape[0]
    anchor = np.zeros(count)
    anchor[: len(displacement)] = _ANCHOR
    right = np.zeros((count, 3))
    right[: len(displacement)] = _ANCHOR * displacement
    return splu((scipy.sparse.diags_array(anchor) + smooth.energy).tocsc()).solve(right)
