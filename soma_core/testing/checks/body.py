"""Checks of the default body on the canonical mesh: upright, of human size."""

from __future__ import annotations

import itertools

import numpy as np

from soma_core.plugin.checks import CheckFailedError, check
from soma_core.plugin.spec import Axis
from soma_core.testing.context import Context

__all__ = ["CHECKS"]

_TILT_DEG = 30.0
"""Degrees: between the tilt that a rest pose may have and a wrong axis, which is 90 or more."""

_STATURE_M = (0.25, 3.0)
"""Metres: from a premature newborn to a giant; a wrong unit is wrong by a factor of ten."""


@check(
    "upright",
    mend="declare the axes that the message names",
    level="core",
    needs=(
        "neutral-equals-obj",
        "linear-basis",
        "wrap-faces",
        "wrap-distance",
        "batch-invariant",
        "inputs-unchanged",
        "group-defaults",
    ),
)
def upright(context: Context) -> None:
    """The default body stands upright, faces forward, and is not mirrored."""
    body = context.bodies.identity.fitted_rest[0].numpy()
    reference = context.mesh.vertices
    left, stretch, right = np.linalg.svd((body - body.mean(0)).T @ (reference - reference.mean(0)))
    flip = np.linalg.det(left @ right)
    if flip < 0 and stretch[2] > 0:
        raise CheckFailedError(
            "the default body",
            got="the mirror image of the canonical body",
            expected="its left side where the canonical body has it, on +X",
            fix="Correct the declared axes, or the export that swapped left and right.",
        )
    turn = left @ right
    angle = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    if angle > _TILT_DEG:
        up, forward = _fitting_axes(turn.T @ context.native_frame / context.metres)
        raise CheckFailedError(
            "the default body",
            got=f"turned by {angle:.0f} degrees from the canonical body with up={context.spec.up!r}, "
            f"forward={context.spec.forward!r}",
            expected=f"at most {_TILT_DEG:g} degrees",
            fix=f"Declare up={up!r}, forward={forward!r}, which fit the body best.",
        )


def _fitting_axes(rotation: np.ndarray) -> tuple[Axis, Axis]:
    """Axes up and forward whose rows of the native-to-canonical rotation are nearest to `rotation`."""
    axes: dict[Axis, np.ndarray] = {}
    for sign, (index, letter) in itertools.product("+-", enumerate("xyz")):
        axes[f"{sign}{letter}"] = np.eye(3)[index] * (1 if sign == "+" else -1)  # type: ignore[index]
    pairs = [(a, b) for a in axes for b in axes if a[1] != b[1]]
    return max(pairs, key=lambda pair: axes[pair[0]] @ rotation[1] + axes[pair[1]] @ rotation[2])


@check("stature", mend="correct `unit`, or the ranges", level="core", needs=("upright",))
def stature(context: Context) -> None:
    """The default body and random ones are of human size."""
    for row, body in enumerate(context.bodies.identity.fitted_rest.numpy()):
        height = float(np.ptp(body[:, 1]))
        if not _STATURE_M[0] <= height <= _STATURE_M[1]:
            raise CheckFailedError(
                f"{context.bodies.label(row)}",
                got=f"a stature of {height:.3g} m with unit={context.spec.unit!r}",
                expected=f"{_STATURE_M[0]:g} to {_STATURE_M[1]:g} m",
                fix="Correct the declared unit." if row == 0 else "Narrow the ranges of the parameters.",
            )


CHECKS = (upright, stature)
