"""What is known of a pose besides its vertices: joint limits, hinges, a rest pose, smooth motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from soma_core.errors import InputError, check_type
from soma_core.geometry.constants import Kind
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.rotations import axis_angle_to_matrix

__all__ = [
    "HINGES",
    "UNTWISTED",
    "JointTerms",
    "PosePriors",
    "TwistDoubt",
    "expected_firmness",
    "expected_terms",
    "hinge_rotation",
    "joint_terms",
    "neighbour_mean",
    "part_of_terms",
    "twist_doubt",
    "with_references",
]

HINGES: Mapping[str, tuple[float, float, float]] = {
    "LeftForeArm": (0.0, 1.0, 0.0),
    "RightForeArm": (0.0, 1.0, 0.0),
    "LeftShin": (1.0, 0.0, 0.0),
    "RightShin": (1.0, 0.0, 0.0),
}
"""Elbows and knees: joint name -> axis in the world of the T-pose."""


def _untwisted() -> dict[str, tuple[tuple[float, float, float], float]]:
    along = {"ForeArm": ((1.0, 0.0, 0.0), 0.3), "Shin": ((0.0, 1.0, 0.0), 0.3)}
    fingers = {
        f"Hand{finger}{number}": ((1.0, 0.0, 0.0), 0.05)
        for finger in ("Index", "Middle", "Ring", "Pinky")
        for number in (2, 3, 4)
    }
    return {side + name: value for side in ("Left", "Right") for name, value in (along | fingers).items()}


UNTWISTED: Mapping[str, tuple[tuple[float, float, float], float]] = _untwisted()
"""Joints that hardly twist about the bone above them: name -> axis of that bone in the world of the T-pose,
and how much a twist is in doubt [1/rad]. Elbows and knees, of whose twist skin says next to nothing, and
fingers."""


_EXPECTED = {
    "Hips": 0.0, "Arm": 3e-3, "ForeArm": 4e-3, "Hand": 4e-3, "Leg": 2e-3, "Shin": 2e-3, "HandThumb1": 1e-3,
}  # fmt: skip
_EXPECTED_FINGER, _EXPECTED_PALM, _EXPECTED_OTHER = 5e-4, 2.5e-3, 1e-3
"""How firmly joints are held near turns that are expected of them [m/rad]: limbs above what the share of
their twist changes of skin, all of them far below what skin tells of a bend. Palms, which other rigs do
not have, would turn against the hand for a tenth of a millimetre."""


@dataclass(frozen=True, kw_only=True)
class PosePriors:
    """What is known of a pose besides its vertices.

    `untwisted` decides what the vertices do not tell. A joint that is twisted by an angle a raises the error,
    as a mean square, by the share ``(doubt a)^2``: where a model meets its target, that costs nothing and
    changes nothing; where another rig's skin leaves an error, it keeps a limb from wandering after the last
    hundredth of it. What is left counts as far as it is of one piece: noise of single vertices tells nothing
    of the model. ``untwisted={}`` turns it off. Only the fit through the full model has it: plain skinning
    leaves no such freedom.

    All else is off by default. A term of strength s [m/rad] that is off by an angle a costs as much as a root
    mean square vertex error of ``s a``.

    Attributes:
        untwisted: joint name -> axis and doubt, as in ``UNTWISTED``.
        untwist: factor on every doubt; 0 turns them off.
        expected: factor on how firmly joints are held near turns that a file tells, see
            ``GuidedInversion``; 0 leaves these out.
        limits: joint name -> largest angle from the T-pose [rad]; beyond it `limit_strength` pulls back.
        limit_strength: [m/rad].
        hinges: joint name -> axis in the world of the T-pose; the joint turns about it alone. ``HINGES`` has
            elbows and knees.
        rest_strength: pulls every joint towards the T-pose [m/rad].
        temporal_strength: pulls every joint towards the mean of its neighbours in time [m/rad].
        temporal_rounds: how often the neighbours are looked at again.
    """

    untwisted: Mapping[str, tuple[tuple[float, float, float], float]] = field(
        default_factory=lambda: UNTWISTED
    )
    untwist: float = 1.0
    expected: float = 1.0
    limits: Mapping[str, float] = field(default_factory=dict)
    limit_strength: float = 0.05
    hinges: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    rest_strength: float = 0.0
    temporal_strength: float = 0.0
    temporal_rounds: int = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTerms:
    """Terms ``stiffness * max(0, angle(R_j R_ref^T) - free)^2``, and hinges.

    Attributes:
        variable: (q,) position of each term's joint among the variable joints.
        stiffness: (q,), relative to the sum of vertex weights [m^2/rad^2].
        free: (q,) [rad].
        reference: (1 or F, q, 3, 3) T-pose-relative rotations.
        hinge_axis: (n, 3) unit axis of each variable joint in the world of the T-pose, zero where it is free.
    """

    variable: Tensor
    stiffness: Tensor
    free: Tensor
    reference: Tensor
    hinge_axis: Tensor

    def energy(self, rotations: Tensor) -> Tensor:
        """Sum of the terms (F,) at rotations (F, n, 3, 3) of the variable joints."""
        _, over, _ = self._deviation(rotations)
        return (self.stiffness * over * over).sum(1)

    def pulled(self, variables: Tensor) -> list[int]:
        """Those of the joints `variables` (n,) that a term pulls."""
        return list(variables[self.variable[self.stiffness > 0]].tolist())

    def single(self, chosen: Tensor, rotations: Tensor) -> Tensor:
        """Sum of the terms (F, a) on the variable joint that is `chosen` (n,), at rotations (F, a, 3, 3)."""
        which = torch.nonzero(chosen[self.variable]).flatten()
        reference = self.reference[:, which].expand(len(rotations), -1, 3, 3)
        one = replace(
            self, variable=which * 0, stiffness=self.stiffness[which], free=self.free[which],
            reference=reference.repeat_interleave(rotations.shape[1], 0),
        )  # fmt: skip
        return one.energy(rotations.flatten(0, 1)[:, None]).view(rotations.shape[:2])

    def normal_equations(self, rotations: Tensor, above: Tensor) -> tuple[Tensor, Tensor]:
        """Gauss-Newton blocks (F, n, 3, 3) and half gradients (F, n, 3) by world turns of the joints.

        Along the arc back a term is quadratic; across it, it curves with the share of the angle that is
        over, so that the block is never indefinite and is the identity for a term without free range.

        Args:
            rotations: (F, n, 3, 3) of the variable joints.
            above: (F, n, 3, 3) world turns of their parents.
        """
        axis, over, angle = self._deviation(rotations)
        world = (above[:, self.variable] @ axis[..., None]).squeeze(-1)
        share = torch.where(self.free > 0, over / angle.clamp_min(1e-6), torch.ones_like(over))
        across = self.stiffness * share
        along = torch.where(over > 0, self.stiffness.expand_as(across), across)
        eye = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        outer = world[..., :, None] * world[..., None, :]
        block = across[..., None, None] * eye + (along - across)[..., None, None] * outer
        slope = (self.stiffness * over)[..., None] * world
        blocks = torch.zeros_like(rotations).index_add(1, self.variable, block)
        slopes = torch.zeros_like(rotations[..., 0]).index_add(1, self.variable, slope)
        return blocks, slopes

    def _deviation(self, rotations: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Unit axis (F, q, 3) of ``R_j R_ref^T``, its angle beyond the free one, and its angle (F, q)."""
        turn = rotations[:, self.variable] @ self.reference.transpose(-1, -2)
        vee = _vee(turn)
        length = torch.linalg.vector_norm(vee, dim=-1)
        angle = torch.atan2(length, turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)
        axis = torch.where(length[..., None] > 1e-12, vee / length[..., None].clamp_min(1e-12), 0.0)
        return axis, (angle - self.free).clamp_min(0), angle


@dataclass(frozen=True, kw_only=True, eq=False)
class TwistDoubt:
    """Twists of joints about the bone above them, as a share ``S`` of the error: E becomes ``E (1 + S)``.

    Attributes:
        variable: (q,) position of each joint among the variable joints.
        axis: (q, 3) unit axis in the world of the T-pose.
        square: square of the doubt [1/rad^2], (q,) or of each frame (F, q).
    """

    variable: Tensor
    axis: Tensor
    square: Tensor

    def weighed(self, weight: Tensor) -> TwistDoubt:
        """The doubt times a weight (F,) of each frame."""
        return replace(self, square=weight[:, None] * self.square)

    def share(self, rotations: Tensor) -> Tensor:
        """``S`` (F,) of rotations (F, n, 3, 3) of the variable joints."""
        return (self.square * self._twist(rotations)[0].square()).sum(1)

    def slope(self, rotations: Tensor, above: Tensor) -> Tensor:
        """Half the derivative (F, n, 3) of ``S`` by world turns; `above` are those of the joints' parents."""
        twist, slope = self._twist(rotations)
        world = (above[:, self.variable] @ slope[..., None]).squeeze(-1)
        pull = (self.square * twist)[..., None] * world
        return torch.zeros_like(rotations[..., 0]).index_add(1, self.variable, pull)

    def blocks(self, rotations: Tensor) -> JointTerms:
        """Terms whose matrix bounds that of ``S`` from above, and whose slope is zero."""
        return JointTerms(
            variable=self.variable,
            stiffness=self.square,
            free=torch.zeros_like(self.square),
            reference=rotations[:, self.variable],
            hinge_axis=self.axis.new_zeros(rotations.shape[1], 3),
        )

    def _twist(self, rotations: Tensor) -> tuple[Tensor, Tensor]:
        """Angles (F, q) and their gradients (F, q, 3) by a turn on the left.

        With the quaternion (w, v), ``4 w^2`` and ``4 w v`` are read from the matrix.
        """
        rotation = rotations[:, self.variable]
        real = (1 + rotation.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)).clamp_min(1e-6)
        vector = _vee(rotation)
        along = (vector * self.axis).sum(-1, keepdim=True)
        across = torch.linalg.cross(vector, self.axis.expand_as(vector), dim=-1)
        slope = real * (real * self.axis + across) + along * vector
        return 2 * torch.atan(along / real).squeeze(-1), slope / (real * real + along * along)


def twist_doubt(
    priors: PosePriors, names: list[str], *, dtype: torch.dtype, device: torch.device
) -> TwistDoubt | None:
    """Doubt of the joints among `names` that are no hinges; None where there are none.

    Raises:
        InputError: an axis of no length, a negative doubt or factor.
    """
    if not priors.untwist >= 0:
        raise InputError(
            "priors.untwist", got=priors.untwist, expected="at least 0", fix="Use 1, or 0 for none."
        )
    rows = []
    for name, (axis, doubt) in priors.untwisted.items():
        length = float(np.linalg.norm(axis))
        if not (length > 0 and doubt >= 0):
            where = f"priors.untwisted[{name!r}]"
            expected = "an axis of some length, and a doubt of at least 0"
            raise InputError(where, got=(tuple(axis), doubt), expected=expected, fix="See UNTWISTED.")
        doubt *= priors.untwist
        if doubt and name in names and name not in priors.hinges:
            rows.append((names.index(name), np.asarray(axis) / length, doubt**2))
    if not rows:
        return None
    variable, axes, squares = zip(*rows, strict=True)
    kind: Kind = {"dtype": dtype, "device": device}
    return TwistDoubt(
        variable=torch.tensor(variable, dtype=torch.int64, device=device),
        axis=torch.as_tensor(np.array(axes), **kind),
        square=torch.tensor(squares, **kind),
    )


def joint_terms(
    priors: PosePriors, names: list[str], *, dtype: torch.dtype, device: torch.device
) -> JointTerms | None:
    """Terms of `priors` for the variable joints `names`; None where there are none.

    Raises:
        InputError: a joint that no fit can determine, an axis of no length, a negative strength.
    """
    check_type("priors", priors, PosePriors, fix="Pass PosePriors(...), or None.")
    for key in ("limit_strength", "rest_strength", "temporal_strength", "expected"):
        if not getattr(priors, key) >= 0:
            raise InputError(f"priors.{key}", got=getattr(priors, key), expected="at least 0", fix="Use 0.")
    strength = priors.limit_strength
    rows = [(_find(name, names, "limits"), strength, limit) for name, limit in priors.limits.items()]
    if priors.rest_strength:
        rows += [(k, priors.rest_strength, 0.0) for k in range(len(names))]
    hinges = np.zeros((len(names), 3))
    for name, axis in priors.hinges.items():
        length = float(np.linalg.norm(axis))
        if not length > 0:
            where = f"priors.hinges[{name!r}]"
            raise InputError(where, got=tuple(axis), expected="an axis of some length", fix="See HINGES.")
        hinges[_find(name, names, "hinges")] = np.asarray(axis) / length
    if not rows and not hinges.any():
        return None
    kind: Kind = {"dtype": dtype, "device": device}
    variable, strengths, free = zip(*rows, strict=True) if rows else ((), (), ())
    return JointTerms(
        variable=torch.tensor(variable, dtype=torch.int64, device=device),
        stiffness=torch.tensor(strengths, **kind) ** 2,
        free=torch.tensor(free, **kind),
        reference=torch.eye(3, **kind).expand(1, len(rows), 3, 3),
        hinge_axis=torch.as_tensor(hinges, **kind),
    )


def with_references(
    terms: JointTerms | None, reference: Tensor, strength: float | Sequence[float]
) -> JointTerms:
    """Add a pull of every variable joint to rotations of its own in every frame, (F, n, 3, 3)."""
    frames, count = reference.shape[:2]
    strengths = reference.new_tensor([strength] * count if isinstance(strength, float) else strength)
    new = JointTerms(
        variable=torch.arange(count, device=reference.device),
        stiffness=strengths**2,
        free=reference.new_zeros(count),
        reference=reference,
        hinge_axis=reference.new_zeros(count, 3),
    )
    if terms is None:
        return new
    return JointTerms(
        variable=torch.cat((terms.variable, new.variable)),
        stiffness=torch.cat((terms.stiffness, new.stiffness)),
        free=torch.cat((terms.free, new.free)),
        reference=torch.cat((terms.reference.expand(frames, -1, 3, 3), reference), 1),
        hinge_axis=terms.hinge_axis,
    )


def part_of_terms(terms: JointTerms | None, rows: slice) -> JointTerms | None:
    """The terms of some frames."""
    return terms if terms is None else replace(terms, reference=terms.reference[rows])


def expected_terms(
    terms: JointTerms | None, expected: Tensor, names: Sequence[str], factor: float
) -> JointTerms:
    """Add a faint pull to expected rotations (F, n, 3, 3) of the variable joints `names`."""
    return with_references(terms, expected, [factor * expected_firmness(name) for name in names])


def expected_firmness(name: str) -> float:
    """How firmly a joint is held near an expected turn [m/rad]."""
    part = name.removeprefix("Left").removeprefix("Right")
    if part in _EXPECTED:
        return _EXPECTED[part]
    if part.startswith("Hand") and part[-1].isdigit():
        return _EXPECTED_PALM if part[-1] == "1" else _EXPECTED_FINGER
    return _EXPECTED_OTHER


def neighbour_mean(rotations: Tensor, valid: Tensor) -> Tensor:
    """Mean of the rotations before and after each frame, (F, n, 3, 3); frames that are not valid have no say.

    A frame without a valid neighbour keeps its own.
    """
    weighted = rotations * valid[:, None, None, None].to(rotations)
    none = torch.zeros_like(rotations[:1])
    total = torch.cat((none, weighted[:-1])) + torch.cat((weighted[1:], none))
    alone = (total == 0).all(-1).all(-1)
    return rotation_from_covariance(torch.where(alone[..., None, None], rotations, total))


def _find(name: str, names: list[str], where: str) -> int:
    if name not in names:
        raise InputError(
            f"priors.{where}",
            got=repr(name),
            expected="joints that move vertices: " + ", ".join(names[:4]) + ", ...",
            fix="Take a name from layer.joint_names.",
        )
    return names.index(name)


def hinge_rotation(rotation: Tensor, axis: Tensor) -> Tensor:
    """Part of a rotation (..., 3, 3) about an axis (..., 3); rotations about a zero axis stay as they are."""
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = 2 * torch.atan2((_vee(rotation) * axis).sum(-1), 1 + trace)
    free = (axis == 0).all(-1)
    return torch.where(free[..., None, None], rotation, axis_angle_to_matrix(angle[..., None] * axis))


def _vee(m: Tensor) -> Tensor:
    """Twice the axis times the sine of the angle of rotations (..., 3, 3)."""
    parts = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    return torch.stack(parts, -1)
