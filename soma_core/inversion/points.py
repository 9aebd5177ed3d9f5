"""Pose from points: joints, keypoints or markers to the rig's rotations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from soma_core._derived import Derived, kind_of, own_precision
from soma_core._inputs import check_bone_scale, check_choice
from soma_core.errors import InputError, check_type
from soma_core.inversion._inputs import check_weights, refuse_transforms
from soma_core.inversion.point_fit import SEVERAL, PointFit
from soma_core.inversion.point_gradient import attach_point_gradient
from soma_core.inversion.point_model import PointModel
from soma_core.inversion.point_priors import JointPrior
from soma_core.inversion.point_rows import PointRows
from soma_core.inversion.point_start import PointStart
from soma_core.inversion.point_views import Views
from soma_core.inversion.result import InversionResult, PointResult
from soma_core.inversion.view_fit import ViewFit
from soma_core.io.camera import Camera
from soma_core.kernels._threads import side_by_side
from soma_core.layer import Kernels, SomaLayer
from soma_core.points.places import PointPlaces
from soma_core.points.point_set import PointSet, load_point_set
from soma_core.skeleton.identity import Identity

__all__ = ["PointInversion", "PointResult"]


_SHORT = 0.04
"""Shorter bones tell no length of a person [m]."""


class PointInversion(Derived):
    """Recovers the rig's rotations from named points; keeps no state between calls.

    The solver is that of :class:`PoseInversion`: points are a cloud of few. What they leave open is left to
    what is known of a person's joints, weighed against the points by their noise, which is estimated from
    what the fit leaves: exact points are met exactly, noisy ones are not followed into impossible poses.

    Args:
        layer: makes identities and poses them.
        points: a point set, its name (``soma points list``) or its file.
        prior: what is known of the joints.
        noise: standard deviation of a coordinate [m], of points in pictures [px]; None estimates one for all
            frames of a call.
        iterations: largest number of steps of each look.
        kernels: ``torch`` (the reference), ``warp`` or ``auto``.

    Raises:
        InputError: an unknown point set, or one that this layer's mesh does not have.
    """

    def __init__(
        self,
        layer: SomaLayer,
        points: PointSet | Path | str = "soma77",
        *,
        prior: JointPrior | None = None,
        noise: float | None = None,
        iterations: int = 20,
        kernels: Kernels = "auto",
    ) -> None:
        super().__init__(locals(), *kind_of(layer))
        check_choice("kernels", kernels, ("auto", "torch", "warp"))
        check_type("prior", prior, JointPrior, type(None), fix="Pass JointPrior(...), or None.")
        check_type("noise", noise, Real, type(None), fix="Leave it out to have it estimated.")
        check_type("iterations", iterations, int, fix="Leave it out for 20.")
        if noise is not None and not 0 < noise < torch.inf:
            raise InputError(
                "noise",
                got=noise,
                expected="a length above zero [m]",
                fix="Leave it out to have it estimated.",
            )
        self.layer, self.points = layer, load_point_set(points)
        self.prior, self.noise, self.iterations, self.kernels = (
            prior or JointPrior(),
            noise,
            iterations,
            kernels,
        )
        self._build(self.device, self.dtype)

    def _build(self, device: torch.device, dtype: torch.dtype) -> None:
        layer = self.layer.to(device, dtype)
        self.device, self.dtype = device, dtype
        places = PointPlaces(self.points, layer.mesh, layer.rig, dtype=dtype, device=device)
        warp = self.kernels != "torch"
        self.model = PointModel(layer, places, self.prior, warp=warp)
        self.start = PointStart(self.model, self.prior.hinges(layer.rig.joint_names), warp=warp)

    @own_precision
    def forward(
        self,
        points: Tensor,
        identity: Identity,
        *,
        weights: Tensor | None = None,
        bone_scale: Tensor | None = None,
        initial: InversionResult | None = None,
        fps: float | None = None,
        noise: float | None = None,
        cameras: Camera | Sequence[Camera] | None = None,
    ) -> PointResult:
        """Fit every frame, on its own unless `fps` is given.

        Args:
            points: (F, P, 3) [m], +Y up, in the order of the point set; NaN where a point is not known. With
                `cameras` (F, P, 2) [px], or (V, F, P, 2) of several.
            identity: batch of 1, shared by all frames, or of F.
            weights: (P,) or (F, P), relative inverse variances such as a detector's confidence; 0 leaves out.
                With several cameras also (V, F, P).
            bone_scale: (1 or F, J - 1) known factors of the bone vectors, as in ``SomaLayer.pose``.
            initial: an earlier result for these frames, to begin from.
            fps: frames per second of one motion: joints then turn at their usual pace, and frames with too
                few points, which are not `valid`, are bridged. None for frames that are apart.
            noise: instead of that of the inversion.
            cameras: that see the points, one or V. `noise`, ``point_error`` (the mean over the views) and
                ``residual`` are then in pixels, and the size of the body has to be known for one view.

        Raises:
            InputError: a wrong shape, a negative weight, points in another unit than they should be.
        """
        refuse_transforms()
        layer = self.layer
        if (layer.device, layer.dtype) != (self.device, self.dtype):
            self._build(layer.device, layer.dtype)
        layer.check_identity(identity)
        if cameras is not None:
            given = (cameras,) if isinstance(cameras, Camera) else tuple(cameras)
            views = self._views(points, given, weights)
            count, joints = views.weights.shape[1], len(layer.joint_names)
            scale = check_bone_scale(bone_scale, count, joints, layer.dtype, layer.device)
            fit = ViewFit(
                self.model, self.start, views, identity, scale, noise=noise or self.noise, fps=fps
            )  # fmt: skip
            with torch.no_grad():
                result = fit(initial)
            return self._tracked(result, points, lambda seen: fit.lowered(self._views(seen, given, weights)))
        points = self._checked(points)
        return self._of_places(points, identity, weights, bone_scale, initial, fps, noise or self.noise)

    if TYPE_CHECKING:  # torch says that a module returns anything
        __call__ = forward

    @torch.no_grad()
    def _of_places(
        self,
        points: Tensor,
        identity: Identity,
        weights: Tensor | None,
        bone_scale: Tensor | None,
        initial: InversionResult | None,
        fps: float | None,
        noise: float | None,
    ) -> PointResult:
        """:meth:`forward` of points in space."""
        layer, count = self.layer, len(points)
        weights = check_weights(weights, points.new_ones(points.shape[1]), count)
        bone_scale = check_bone_scale(bone_scale, count, len(layer.joint_names), layer.dtype, layer.device)
        with side_by_side(count, SEVERAL, points) as threads:
            known, clean = torch.isfinite(points).all(-1), points
            if not bool(known.all()):
                weights, clean = weights * known, torch.where(known[..., None], points, 0.0)
            fit = PointFit(
                self.model, self.start, clean, weights, identity, bone_scale, noise=noise,
                iterations=self.iterations, threads=threads,
            )  # fmt: skip
            fit.begin(initial)
            fit.run()
            if fps is not None:
                fit.smooth(fps)
            result = fit.result(known)
        return self._tracked(result, points, lambda clean: fit.lowered(clean, fps))

    def _tracked(
        self, result: PointResult, points: Tensor, rows: Callable[[Tensor], PointRows]
    ) -> PointResult:
        """A result whose pose carries the gradient of its points."""
        if not points.requires_grad:
            return result
        known = torch.isfinite(points)
        with torch.enable_grad():
            clean = torch.where(known, points, 0.0)
            rotations, translation = attach_point_gradient(
                clean, result.rotations, result.translation, rows=rows
            )
        return replace(result, rotations=rotations, translation=translation)

    def _views(self, pixels: Tensor, cameras: Sequence[Camera], weights: Tensor | None) -> Views:
        """Points in pictures, checked."""
        wanted, pixels = len(self.points), self._floating(pixels)
        pixels = pixels[None] if pixels.ndim == 3 else pixels
        if pixels.ndim != 4 or len(pixels) != len(cameras) or tuple(pixels.shape[2:]) != (wanted, 2):
            raise InputError(
                "points", got=tuple(pixels.shape),
                expected=f"({len(cameras)}, frames, {wanted}, 2): {self.points.name} for each camera",
                fix="Give as many cameras as views, and the points in the order of soma points show.",
            )  # fmt: skip
        count = pixels.shape[1]
        for camera in cameras:
            if len(camera.extrinsics) not in (1, count):
                raise InputError(
                    "camera", got=f"extrinsics of {len(camera.extrinsics)} frames",
                    expected=f"one, or one for each of the {count} frames",
                    fix="Give one matrix for a camera that stands.",
                )  # fmt: skip
        each = [weights] * len(cameras)
        if isinstance(weights, Tensor) and weights.ndim == 3:
            each = list(weights.expand(len(cameras), -1, -1))
        plain, known = pixels.new_ones(wanted), torch.isfinite(pixels).all(-1)
        own = torch.stack([check_weights(one, plain, count).expand(count, -1) for one in each]) * known
        return Views.of(cameras, torch.where(known[..., None], pixels, 0.0), own)

    @own_precision
    def bone_scale(
        self, points: Tensor, identity: Identity, *, cameras: Sequence[Camera] | None = None
    ) -> Tensor:
        """Factors (1, J - 1) of the bone vectors that make a body as long in its parts as one that was seen.

        A bone between two joints whose centres are points has the median of its lengths, the same on both
        sides; all others have the factor of the whole body.

        Args:
            points: (F, P, 3) [m] of one person; NaN where a point is not known. With `cameras` (V, F, P, 2)
                [px] of at least two.
            identity: the body that is scaled, batch of 1.
            cameras: that see the points.

        Raises:
            InputError: a wrong shape; a single camera, which tells no length.
        """
        layer = self.layer
        if cameras is not None:
            points, _ = self.triangulated(points, cameras)
        points = self._checked(points)
        length = layer.animation.bone_vectors(identity).norm(dim=-1)[0]
        centre, parents = self.start.centres, layer.rig.parents
        seen: dict[str, list[float]] = {}
        totals = [0.0, 0.0]
        for joint, name in enumerate(layer.rig.joint_names):
            above = int(parents[joint])
            if joint < 2 or min(centre[joint], centre[above]) < 0 or length[joint] < _SHORT:
                continue
            away = (points[:, centre[joint]] - points[:, centre[above]]).norm(dim=-1).nanmedian()
            if bool(torch.isfinite(away)):
                seen.setdefault(_sideless(name), []).append(float(away / length[joint]))
                totals = [totals[0] + float(away), totals[1] + float(length[joint])]
        whole = totals[0] / totals[1] if totals[1] else self._size(points, identity)
        known = {name: sum(values) / len(values) for name, values in seen.items()}
        factors = [known.get(_sideless(name), whole) for name in layer.joint_names]
        return points.new_tensor([factors])

    def triangulated(
        self, points: Tensor, cameras: Sequence[Camera], weights: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Places (F, P, 3) [m] where the rays of pixels (V, F, P, 2) meet, NaN where none do; and weights."""
        places, met = self._views(points, cameras, weights).triangulated()
        return torch.where(met[..., None] > 0, places, torch.nan), met

    def _size(self, points: Tensor, identity: Identity) -> float:
        """Size of a person beside a body, where no bone is seen."""
        known = torch.isfinite(points).all(-1)
        rest = self.model.rest(identity)
        return float(
            self.start.sizes(rest, points.nan_to_num(0.0), known.to(points)).nanmedian().nan_to_num(1.0)
        )

    def _floating(self, points: object) -> Tensor:
        if not isinstance(points, Tensor) or not points.is_floating_point():
            raise InputError(
                "points", got=points.dtype if isinstance(points, Tensor) else type(points).__name__,
                expected="a floating torch.Tensor", fix="Wrap it: torch.as_tensor(points).",
            )  # fmt: skip
        return points.to(self.layer.device, self.layer.dtype)

    def _checked(self, points: object) -> Tensor:
        points, wanted = self._floating(points), len(self.points)
        if points.ndim != 3 or tuple(points.shape[1:]) != (wanted, 3):
            raise InputError(
                "points", got=tuple(points.shape), expected=f"(frames, {wanted}, 3) of {self.points.name}",
                fix="Order them as soma points show lists them, or take another point set; points of a "
                "picture need cameras=.",
            )  # fmt: skip
        return points


def _sideless(name: str) -> str:
    """A joint's name without its side."""
    return name.removeprefix("Left").removeprefix("Right")
