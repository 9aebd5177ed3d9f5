"""Points row by row: all frames of a clip together, smooth in time, or as cameras see them.

Unlike moments, rows know the direction of each residual (a pixel says nothing of its depth) and the frames
around each frame. What is minimised is ``sum |r|^2 / noise^2`` over the rows, plus what is known of the
joints, plus ``sum |a / s|^2`` over second differences a of every joint's turn and of the Hips, with what is
usual for a person as s. Gauss-Newton steps on all frames; the matrix is banded, three frames wide.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, skew
from soma_core.inversion.point_model import PointModel, PointRest
from soma_core.inversion.problem import Pose

__all__ = ["PointRows", "Rows", "rows_of"]

Rows = Callable[[Tensor, slice], tuple[Tensor, Tensor]]

_WINDOW, _OVERLAP = 240, 24
"""Frames solved together, and how many of them two windows share."""

_STEPS = 12
"""Largest number of steps; a step that does not help is damped."""

_RIDGE = 1e-9
"""Relative to the diagonal: keeps what nothing holds finite."""

_RESTING = 1e-4
"""Relative change of the energy at which steps end."""


def rows_of(points: Tensor, weights: Tensor, noise: float) -> Rows:
    """Rows of points in space: targets (F, P, 3) [m] with weights (1 or F, P), 0 for what is not known."""
    scale = weights.expand(len(points), -1).sqrt() / noise

    def rows(found: Tensor, part: slice) -> tuple[Tensor, Tensor]:
        own = scale[part][..., None]
        return own * (found - points[part]), own[..., None] * torch.eye(3).to(points)

    return rows


class PointRows:
    """Minimises rows of points over all frames of a clip.

    Args:
        model: of the points.
        rest: of one identity, or of one a frame.
        rows: maps points (f, P, 3) [m] of some frames (a slice) to residuals (f, P, k), scaled by their
            noise, and their derivatives (f, P, k, 3) by the points.
        smooth: standard deviations (n + 1,) of second differences: of turns [rad] and of the Hips [m];
            None for frames that are apart.
        share: of what is known of joints, but for hinges, that one frame adds to the others.
        mean: where joints are expected, (J, 3, 3), instead of the model's.
    """

    def __init__(
        self,
        model: PointModel,
        rest: PointRest,
        rows: Rows,
        *,
        smooth: Tensor | None,
        share: float = 1.0,
        mean: Tensor | None = None,
    ) -> None:
        self.model, self.rest, self.rows, self.smooth = model, rest, rows, smooth
        variables = model.solver.variables
        above = torch.as_tensor(model.structure.ancestors, device=variables.device)
        self.below = above[variables][:, model.weighted].to(model.mean)  # (n, T)
        self.variables, self.above = variables, model.parents[variables]
        self.size = 3 * len(variables) + 3
        self.mean = (model.mean if mean is None else mean)[variables]
        share_of_each = torch.where(model.hinged, 1.0, share)[:, None, None]
        self.pull = (share_of_each * model.pull)[variables]

    def __call__(self, pose: Pose) -> Pose:
        """The pose of least energy near a pose of all frames."""
        count = len(pose.translation)
        if self.smooth is None or count <= _WINDOW:
            return self._window(pose, slice(0, count))
        for first in range(0, count - _OVERLAP, _WINDOW - _OVERLAP):
            part = slice(first, min(first + _WINDOW, count))
            done = self._window(Pose(**{key: value[part] for key, value in vars(pose).items()}), part)
            keep = slice(first + (_OVERLAP // 2 if first else 0), part.stop)
            inner = slice(keep.start - first, None)
            pose = Pose(**{
                key: torch.cat((value[: keep.start], vars(done)[key][inner], value[keep.stop :]))
                for key, value in vars(pose).items()
            })  # fmt: skip
        return pose

    def _window(self, pose: Pose, part: slice) -> Pose:
        energy, system = self._system(pose, part)
        damping = torch.full_like(energy, 1e-4)
        for _ in range(_STEPS):
            trial = self.moved(pose, self._step(system, damping))
            new, made = self._system(trial, part)
            better = new < energy
            gain = ((energy - new) / energy.clamp_min(1e-12)).max()
            pose = self._chosen(better, trial, pose)
            system = made if bool(better.all()) else self._system(pose, part)[1]
            energy = torch.where(better, new, energy)
            damping = (damping * torch.where(better, 0.2, 8.0)).clamp(1e-8, 1e6)
            if gain < _RESTING and bool(better.all()):
                break
            if not bool(better.any()) and float(damping.min()) > 1e4:
                break
        return pose

    def energy(self, pose: Pose) -> Tensor:
        """What is minimised, (F,), or (1,) of all frames together."""
        return self._system(pose, slice(0, len(pose.translation)))[0]

    def system(self, pose: Pose) -> tuple[Tensor, Tensor]:
        """Matrix (F, d, d) and half the slope (F, d), each frame's matrix on its own."""
        return self._system(pose, slice(0, len(pose.translation)))[1]

    def _inverse(self, pose: Pose) -> tuple[Tensor, Tensor]:
        """Matrix (F, d, d) of each frame on its own, and its inverse, float64.

        Rounded to float32, exact points would outweigh all that is known of the turns they leave open.
        """
        matrix = self._system(pose, slice(0, len(pose.translation)), torch.float64)[1][0]
        diagonal = matrix.diagonal(dim1=-2, dim2=-1)
        ridge = _RIDGE * (diagonal + diagonal.mean(1, keepdim=True))
        factor, _ = torch.linalg.cholesky_ex(matrix + torch.diag_embed(ridge))
        return matrix, torch.cholesky_inverse(factor)

    def angle_std(self, pose: Pose) -> Tensor:
        """Standard deviation (F, n) [degrees] of each variable's turn, by its own frame alone."""
        own = self._inverse(pose)[1].diagonal(dim1=-2, dim2=-1)[:, :-3]
        return own.unflatten(1, (-1, 3)).sum(-1).clamp_min(0).sqrt().rad2deg()

    def taken(self, pose: Pose) -> Tensor:
        """Degrees of freedom (F,) of each frame on its own that its rows take up."""
        inverse = self._inverse(pose)[1]
        zero = torch.zeros_like(pose.relative[:, 0, 0, 0])
        expected = torch.zeros_like(inverse)
        self._expected(pose, expected, zero[:, None].repeat(1, self.size).double())
        return self.size - (inverse * expected).sum((1, 2))

    @staticmethod
    def _chosen(better: Tensor, trial: Pose, pose: Pose) -> Pose:
        """The trial where it is better: frame by frame, or all together."""
        moved = better.expand(len(pose.translation))
        return Pose(
            relative=torch.where(moved[:, None, None, None], trial.relative, pose.relative),
            translation=torch.where(moved[:, None], trial.translation, pose.translation),
            accepted=pose.accepted + moved,
            last_change=pose.last_change,
        )

    def energy_near(self, pose: Pose, step: Tensor) -> Tensor:
        """What is minimised, of all frames, as a differentiable function of small turns and shifts (F, d)."""
        moved, whole = self.moved(pose, step), slice(0, len(pose.translation))
        turns, places = self.model.solver.walk_public(moved, self.rest.offsets)
        residual, _ = self.rows(self.model.points(self.rest, turns, places), whole)
        matrix = torch.zeros(len(step), self.size, self.size).to(step)
        energy = residual.square().sum() + self._expected(moved, matrix, torch.zeros_like(step)).sum()
        return energy if self.smooth is None else energy + self._accelerations(moved)[0]

    def moved(self, pose: Pose, step: Tensor) -> Pose:
        """The pose after small turns in the axes of the parents, and shifts (F, d)."""
        turns = axis_angle_to_matrix(step[:, :-3].unflatten(1, (-1, 3)).clamp(-1, 1))
        relative = pose.relative.clone()
        relative[:, self.variables] = turns @ pose.relative[:, self.variables]
        return Pose(
            relative=relative, translation=pose.translation + step[:, -3:], accepted=pose.accepted,
            last_change=pose.last_change,
        )  # fmt: skip

    def _system(
        self, pose: Pose, part: slice, dtype: torch.dtype | None = None
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Energy (F,) or (1,), and matrix (F, d, d) and slope (F, d) without what ties frames."""
        rest = self.rest
        if len(rest.local) > 1:
            rest = PointRest(local=rest.local[part], offsets=rest.offsets[part])
        turns, places = self.model.walk(pose, rest)
        points = self.model.points(rest, turns, places)
        residual, slopes = self.rows(points, part)
        dtype = residual.dtype if dtype is None else dtype
        jacobian = (slopes @ self.jacobian(rest, turns, places)).flatten(1, 2).to(dtype)
        residual = residual.flatten(1).to(dtype)
        matrix, slope = jacobian.mT @ jacobian, (jacobian * residual[..., None]).sum(1)
        energy = residual.square().sum(1) + self._expected(pose, matrix, slope)
        if self.smooth is not None:
            change, pulls = self._accelerations(pose)
            slope = slope + pulls
            energy = (energy.sum() + change)[None]
        return energy, (matrix, slope)

    def jacobian(self, rest: PointRest, turns: Tensor, places: Tensor) -> Tensor:
        """Derivative (f, P, 3, d) of points by small turns of the variables in the axes of their parents."""
        at = self.model.weighted
        local = rest.local
        y = torch.einsum(
            "ftab,iptb->fpta" if len(local) == 1 else "ftab,fptb->fpta", turns[:, at], local[..., :3]
        )
        mass = local[..., 3]
        y = y + mass[..., None] * places[:, None, at]
        moved = torch.einsum("fpta,nt->fpna", y, self.below)
        weight = torch.einsum("ipt,nt->ipn", mass, self.below)
        arms = moved - weight[..., None] * places[:, None, self.variables]
        by = -skew(arms) @ turns[:, None, self.above]  # (f, P, n, 3, 3)
        spins = by.permute(0, 1, 3, 2, 4).flatten(3)
        total = mass.sum(2).expand(len(turns), -1)
        shift = total[..., None, None] * torch.eye(3).to(places)
        return torch.cat((spins, shift), -1)

    def _expected(self, pose: Pose, matrix: Tensor, slope: Tensor) -> Tensor:
        """Energy (F,) of what is known of the joints; its matrix and slope are added."""
        own, rest = pose.relative[:, self.variables], self.mean
        pull = self.pull
        turned = own @ pull
        crossed = turned @ rest.mT
        trace = pull.diagonal(dim1=-2, dim2=-1).sum(-1)
        energy = 2 * (trace - crossed.diagonal(dim1=-2, dim2=-1).sum(-1)).sum(1)
        block = trace[:, None, None] * torch.eye(3).to(own) - turned @ own.mT
        torque = torch.stack([
            crossed[..., 2, 1] - crossed[..., 1, 2], crossed[..., 0, 2] - crossed[..., 2, 0],
            crossed[..., 1, 0] - crossed[..., 0, 1],
        ], -1)  # fmt: skip
        slope[:, :-3] += torque.flatten(1)
        n = len(self.variables)
        own = matrix[:, :-3, :-3].unflatten(2, (n, 3)).unflatten(1, (n, 3)).diagonal(dim1=1, dim2=3)
        own += block.permute(0, 2, 3, 1)  # (F, 3, 3, n)
        return energy

    def _velocity(self, pose: Pose) -> Tensor:
        """First differences (F - 1, d) of turns in the axes of the parents, and of the Hips."""
        own = pose.relative[:, self.variables]
        turn = matrix_to_axis_angle(own[1:] @ own[:-1].mT).flatten(1)
        return torch.cat((turn, pose.translation[1:] - pose.translation[:-1]), 1)

    def _accelerations(self, pose: Pose) -> tuple[Tensor, Tensor]:
        """Energy of second differences, and half its slope (F, d)."""
        assert self.smooth is not None
        if len(pose.translation) < 3:
            return pose.translation.new_zeros(()), torch.zeros(len(pose.translation), self.size).to(
                pose.translation
            )
        speed = self._velocity(pose)
        change = speed[1:] - speed[:-1]
        weight = self._stiffness()
        pull = change * weight
        by_speed = torch.zeros_like(speed)
        by_speed[1:] += pull
        by_speed[:-1] -= pull
        slope = pull.new_zeros(len(pose.translation), self.size)
        slope[1:] += _carried(speed, by_speed, 0.5)
        slope[:-1] -= _carried(speed, by_speed, -0.5)
        return (change * pull).sum(), slope

    def _stiffness(self) -> Tensor:
        assert self.smooth is not None
        return self.smooth.repeat_interleave(3) ** -2

    def _step(self, system: tuple[Tensor, Tensor], damping: Tensor) -> Tensor:
        """Damped step (F, d)."""
        return -self.solved(*system, damping)

    def solved(self, matrix: Tensor, slope: Tensor, damping: Tensor, *, double: float = 1.0) -> Tensor:
        """Motions (F, d) that the damped matrix maps to slopes; what ties frames counts `double` times."""
        diagonal = matrix.diagonal(dim1=-2, dim2=-1)
        extra = damping[:, None] * diagonal + 1e-9 * diagonal.mean(1, keepdim=True)
        matrix = matrix + torch.diag_embed(extra)
        if self.smooth is None or len(matrix) < 3:
            factor, _ = torch.linalg.cholesky_ex(matrix.double())
            return torch.cholesky_solve(slope.double()[..., None], factor).squeeze(-1).to(slope)
        return self._banded(matrix.double().numpy(), slope.double().numpy(), double).to(slope)

    def _banded(self, matrix: np.ndarray, slope: np.ndarray, double: float) -> Tensor:
        """Solution of all frames together, whose second differences are held."""
        frames, size = slope.shape
        weight = double * self._stiffness().double().numpy()
        second = np.zeros((frames, 3))  # products of second differences: own, next, after next
        second[: frames - 2, 0] += 1
        second[1 : frames - 1, 0] += 4
        second[2:, 0] += 1
        second[: frames - 2, 1] -= 2
        second[1 : frames - 1, 1] -= 2
        second[: frames - 2, 2] += 1
        band = np.zeros((2 * size + 1, frames, size))
        for row in range(size):
            lower = matrix[:, row:, : size - row].diagonal(0, 1, 2)  # entries (c + row, c)
            band[row, :, : size - row] = lower
        for far in range(3):
            band[far * size] += second[:, far, None] * weight
        return torch.as_tensor(
            scipy.linalg.solveh_banded(
                band.reshape(2 * size + 1, -1),
                slope.ravel(),
                lower=True,
                overwrite_ab=True,
                check_finite=False,
            ).reshape(frames, size)
        )


def _carried(speed: Tensor, slope: Tensor, half: float) -> Tensor:
    """Slopes (F, d) by differences of turns, as slopes by small turns after (0.5) or before (-0.5) them.

    The inverse right or left Jacobian of the rotation group, to the second order: nobody turns by more than
    half a radian between frames.
    """
    turn, torque = (one[:, :-3].unflatten(1, (-1, 3)) for one in (speed, slope))
    once = torch.linalg.cross(turn, torque, dim=-1)
    twice = torch.linalg.cross(turn, once, dim=-1)
    return torch.cat(((torque + half * once + twice / 12).flatten(1), slope[:, -3:]), 1)
