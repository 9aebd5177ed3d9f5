"""Why a fit is no fit: mirrored, in another order, of another person or several, on its head, all noise."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from soma_core.errors import InputError
from soma_core.inversion.cloud_strain import MEAN_OF_NOISE, CloudStrain, SkinClouds
from soma_core.layer import SomaLayer
from soma_core.skeleton.identity import Identity

__all__ = ["Cause", "Diagnosis", "Leaning", "diagnose_fit", "leaning"]

Cause = Literal["missing", "order", "mirrored", "change", "person", "unexplained", "axis", "noise"]

_APART = 0.005
"""Share of vertices away from their neighbours: 0 on every sound body, at 20 mm of noise as well."""

_SHUFFLED, _STEADY = 0.5, 3.0
"""Neighbours out of place by half an edge, by as many standard errors: persons differ by 0.1 edges, bent or
not, and noise by one standard error; neighbours that changed places by 0.9 edges."""

_MIRRORED = 0.5
"""Share of mirrored clouds: 0 to 0.04 on a body, 1 on its mirror image, at 20 mm of noise too."""

_NO_FIT, _DOUBTFUL = 0.03, 0.015
"""Error that noise does not explain, over the body's size (0.65 m in a T-pose): 19 mm and 9 mm on an adult.
A body of the rig has 0.001, one that another rig posed up to 0.009, another adult 0.008 to 0.08."""

_OTHER_SIZE = 0.15
"""Logarithm of a size that makes a doubtful fit none: 0.01 on the own body, 0 to 0.31 between two adults."""

_UNEXPLAINED = 0.05
"""The same where the shape is that of the identity: something else went wrong, which a rough method may."""

_NOISE_SHARE = 0.4
"""Error beyond noise, over that of noise, which is not told from noise below: 0.1 on 20 mm of noise alone."""

_PERSON = 0.01
"""Strain of the clouds of another person, over the body's size: 0.006 on the person's own, up to 0.02 where
an extreme pose is held, 0.009 to 0.07 between two adults, 0.05 to 0.1 between adult and child. It tells
whether an error is another person's; the error tells whether there is one."""

_CHANGE, _CHANGE_NOISE, _CHANGE_SHARE = 0.012, 0.35, 0.5
"""Strain between neighbouring stretches of time, over the size or over the noise: poses 0.016 at
most, two adults 0.013 to 0.04, adult and child 0.07; noise alone 0.3 of itself. And over the lesser strain of
the two: a person who is another all the time is strained alike throughout."""

_WINDOW, _LEAST = 5, 3
"""Frames on either side of a change, at most and in a sequence of eight or more at least."""

_ALONG = 0.7
"""Cosine between the trunk's mean upward direction and an axis that it is said to follow."""

_NOISY = 0.025
"""Noise of a coordinate [m] that leaves joints of the body 8 degrees off and more; recorded and estimated
bodies have less than 6 mm."""

_MM = 1e3


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What is wrong with a fit.

    Attributes:
        cause: ``missing``: no frame shows a body; ``order``: vertices in another order; ``mirrored``;
            ``change``: another person from some frame on; ``person``: another person than the identity;
            ``unexplained``: none of these; ``axis``: the body lies or stands on its head; ``noise``: more of
            it than tells a pose.
        sentence: cause, and the setting that mends it.
        failed: whether the fit is no fit; otherwise the sentence is a warning.
        frame: where the person changes, the first frame after it that was looked at.
    """

    cause: Cause
    sentence: str
    failed: bool = True
    frame: int | None = None

    def __post_init__(self) -> None:
        if self.cause not in get_args(Cause):
            raise InputError("cause", got=repr(self.cause), expected=get_args(Cause), fix="Correct the name.")


@torch.no_grad()
def diagnose_fit(
    layer: SomaLayer,
    identity: Identity,
    vertices: Tensor,
    *,
    errors: Tensor | np.ndarray | None = None,
    frames: Sequence[int] | None = None,
    searched: bool = False,
    axes: np.ndarray | None = None,
    ups: Collection[str] = ("y", "z"),
) -> Diagnosis | None:
    """Find out why the fit of an identity to posed vertices is no fit, if it is none.

    Needs no pose: skin that hangs on one joint moves almost rigidly, so its strain against the identity tells
    mirrored, shuffled and other bodies from noise. Two frames are enough; some dozens, spread over the
    sequence, are better.

    Args:
        layer: that of the fit.
        identity: batch of 1.
        vertices: targets of some frames, (F, v, 3) canonical [m], as ``PoseInversion.canonical`` gives them;
            frames with gaps are passed over.
        errors: vertex errors of these frames, (F, v), or their means, (F,) [m]. Without them only what the
            vertices tell by themselves is looked for: gaps, order, mirror images and axes.
        frames: numbers (F,) of the frames in their sequence, ascending.
        searched: whether the identity was itself found from the vertices.
        axes: rotation (3, 3) from the axes of the file to +Y up, to name axes as the file has them.
        ups: values that the setting ``up`` can take.

    Returns:
        The first cause that applies, and None for a good fit, however noisy.

    Raises:
        InputError: a wrong shape, or an identity of several bodies.
    """
    _check(layer, identity, vertices, errors, frames)
    numbers = np.arange(len(vertices)) if frames is None else np.asarray(frames)
    clouds = SkinClouds(layer.mesh, layer.rig)
    points = vertices.detach().cpu().double().numpy()
    whole = clouds.whole(points)
    if not whole.any():
        return Diagnosis(
            cause="missing",
            sentence=f"no frame can be used: each of the {len(whole)} looked at has missing vertices (NaN) "
            "or has collapsed to a point; export the body again, with a value for every vertex",
        )
    strain = clouds.strain(identity.rest[0].detach().cpu().double().numpy(), points[whole])
    found = _broken(strain, layer)
    if found is None and errors is not None:
        mean = _mean_errors(errors, clouds)[whole]
        found = _changed(strain, mean, numbers[whole]) or _unfitting(strain, mean, searched)
    if found is not None and found.failed:
        return found
    return found or _leaning(strain, np.eye(3) if axes is None else np.asarray(axes), ups) or _noisy(strain)


def _check(layer: SomaLayer, identity: Identity, vertices: Tensor, errors: object, frames: object) -> None:
    layer.check_identity(identity)
    if identity.batch_size != 1:
        raise InputError(
            "identity", got=f"a batch of {identity.batch_size}", expected="one body",
            fix="Ask for one body after the other.",
        )  # fmt: skip
    count = layer.mesh.vertex_count
    if vertices.ndim != 3 or tuple(vertices.shape[1:]) != (count, 3) or not len(vertices):
        raise InputError(
            "vertices", got=tuple(vertices.shape), expected=f"(frames, {count}, 3)",
            fix="Pass what PoseInversion.canonical returns, of one frame at least.",
        )  # fmt: skip
    for name, values in (("errors", errors), ("frames", frames)):
        if values is not None and len(values) != len(vertices):  # type: ignore[arg-type]
            raise InputError(
                name, got=f"{len(values)} frames", expected=f"{len(vertices)}, as vertices",  # type: ignore[arg-type]
                fix="Give them for the same frames.",
            )  # fmt: skip


def _mean_errors(errors: Tensor | np.ndarray, clouds: SkinClouds) -> np.ndarray:
    """Mean error of the skin in each frame (F,) [m]; NaN where a frame could not be fitted."""
    values = torch.as_tensor(errors).detach().cpu().double().numpy()
    if values.ndim == 1:
        return values
    skin = values[:, clouds.skin]
    known = np.isfinite(skin)
    total = np.where(known, skin, 0).sum(axis=1)
    return np.where(known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan)


def _broken(strain: CloudStrain, layer: SomaLayer) -> Diagnosis | None:
    """What is no body of this mesh at all."""
    apart = strain.apart
    shuffled = strain.displaced > max(_SHUFFLED, _STEADY * strain.displaced_by_chance)
    if apart > _APART or shuffled:
        share = f"{apart:.1%} of the vertices are" if apart > _APART else "vertices are"
        return Diagnosis(
            cause="order",
            sentence=f"{share} not beside their neighbours in the mesh, in every frame: they come in another "
            f"order than that of {layer.backend!r} and the canonical mesh; export them in the model's own "
            "order, neither sorted, merged nor split, or pass the right backend= and topology=",
        )
    if np.median(strain.mirrored) > _MIRRORED:
        return Diagnosis(cause="mirrored", sentence=_mirror_sentence(strain.upward))
    return None


def _mirror_sentence(upward: np.ndarray) -> str:
    mean = upward.mean(axis=0)
    mend = "negate x of the vertices"
    if mean[1] < -_ALONG:
        mend = "negate the upward axis of the vertices"
    elif abs(mean[2]) > _ALONG:
        mend = "swap y and z of the vertices"
    return (
        f"the body is mirrored, as by an export with left-handed axes: {mend} and fit again, or put left and "
        "right back where their vertex numbers were swapped"
    )


def _changed(strain: CloudStrain, errors: np.ndarray, numbers: np.ndarray) -> Diagnosis | None:
    """Another person from some frame on, if the identity does not fit both."""
    count = len(numbers)
    jumps = np.zeros(count)
    for frame in range(1, count):
        width = min(_WINDOW, frame, count - frame)
        if width >= _LEAST or count < 2 * _LEAST + 2:
            jumps[frame] = strain.between(slice(frame - width, frame), slice(frame, frame + width))
    first = int(jumps.argmax())
    usual = _CHANGE * strain.size * max(strain.scale, 1.0)
    alike = _CHANGE_SHARE * min(strain.of(slice(first)), strain.of(slice(first, None))) if first else np.inf
    if jumps[first] < max(usual, _CHANGE_NOISE * strain.noise, alike):
        return None
    sides = [_typical(errors[:first]), _typical(errors[first:])]
    if not max(sides) > _limit(_DOUBTFUL, strain):
        return None
    before, after = int(numbers[first - 1]), int(numbers[first])
    where = f"from frame {after} on" if after == before + 1 else f"between frames {before} and {after}"
    return Diagnosis(
        cause="change",
        frame=after,
        sentence=f"the body becomes another person's {where} (errors of {_MM * sides[0]:.3g} mm before and "
        f"{_MM * sides[1]:.3g} mm after): cut the file there, and fit each part with its own identity or "
        "with identity=unknown",
    )


def _typical(errors: np.ndarray) -> float:
    known = errors[np.isfinite(errors)]
    return float(np.median(known)) if len(known) else np.nan


def _limit(relative: float, strain: CloudStrain) -> float:
    """Mean error [m] above which noise and `relative` of the size do not explain it."""
    noise = MEAN_OF_NOISE * strain.noise
    return float(np.hypot(noise, max(relative * strain.size, _NOISE_SHARE * noise)))


def _unfitting(strain: CloudStrain, errors: np.ndarray, searched: bool) -> Diagnosis | None:
    """A fit whose error is not that of noise."""
    error = _typical(errors)
    other = strain.of() > _PERSON * strain.size
    told = f"{_MM * error:.3g} mm on average"
    if other and error > _limit(_DOUBTFUL, strain):
        failed = bool(error > _limit(_NO_FIT, strain) or abs(np.log(strain.scale)) > _OTHER_SIZE)
        mend = (
            "is no body that this backend describes: pass another backend=, or identity.method=unpose"
            if searched
            else "is another person than the identity: pass identity=unknown, or the right backend.params"
        )
        doubt = "seems to be of another shape" if failed else "may be of another shape"
        return Diagnosis(
            cause="person",
            failed=failed,
            sentence=f"the body {doubt} than its identity ({strain.scale:.2f} times its size, {told} left by "
            f"the fit); perhaps it {mend}",
        )
    if error > _limit(_UNEXPLAINED, strain) or not np.isfinite(error):
        left = f"{told} are left" if np.isfinite(error) else "no frame could be used"
        return Diagnosis(
            cause="unexplained",
            sentence=f"the fit does not explain the vertices: {left}, which is more than their noise; check "
            "backend=, topology= and unit=, or pass identity=unknown",
        )
    return None


@dataclass(frozen=True, kw_only=True)
class Leaning:
    """How a body lies.

    Attributes:
        sentence: what was found.
        along: axis of the file that its head points along, as the setting ``up`` has it.
    """

    sentence: str
    along: str


def leaning(upward: np.ndarray, axes: np.ndarray) -> Leaning | None:
    """Tell whether a body lies, or stands on its head, in most frames; None for one that stands or sits.

    Args:
        upward: (frames, 3) direction from its hips to its head, +Y up.
        axes: rotation (3, 3) from the axes of the file to +Y up.
    """
    mean = upward.mean(axis=0)
    along = int(np.abs(mean).argmax())
    if abs(mean[along]) < _ALONG or (along == 1 and mean[1] > 0):
        return None
    own = axes.T @ mean
    axis = int(np.abs(own).argmax())
    name = ("" if own[axis] > 0 else "-") + "xyz"[axis]
    posture = "upside down" if along == 1 else "lying"
    return Leaning(
        sentence=f"the body is {posture} on the whole, its head along {name} of the file", along=name
    )


def _leaning(strain: CloudStrain, axes: np.ndarray, ups: Collection[str]) -> Diagnosis | None:
    """The same as a cause, with the setting that mends it."""
    found = leaning(strain.upward, axes)
    if found is None:
        return None
    name = found.along
    mend = f"pass up={name}" if name in ups else f"turn the vertices until {name} points up"
    return Diagnosis(
        cause="axis", failed=False, sentence=f"{found.sentence}; if that is not its pose, {mend}"
    )


def _noisy(strain: CloudStrain) -> Diagnosis | None:
    """Noise that leaves little of a pose."""
    if strain.noise < _NOISY:
        return None
    return Diagnosis(
        cause="noise",
        failed=False,
        sentence=f"the vertices are noisy by {_MM * strain.noise:.2g} mm in every coordinate, which leaves "
        "joints many degrees off; inversion.priors.temporal_strength=1 lets frames steady each other",
    )
