"""The forward model of a layer as a fit sees it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from soma_core.geometry.constants import Kind
from soma_core.inversion.driven import DrivenJoints, rig_with_helpers
from soma_core.inversion.limbs import LimbStart, TwistShare
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.offsets import PoseOffsets
from soma_core.inversion.priors import JointTerms
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.skin_model import SkinModel
from soma_core.inversion.structure import skin_structure
from soma_core.layer import SomaLayer
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity

__all__ = ["PoseModel"]

_MOST_FRAMES, _SHARE_OF_MEMORY = 65536, 0.4
"""Frames fitted at a time on a GPU, and what they may take of its free memory."""


class PoseModel(SkinModel):
    """Skinning of one layer, with or without twist joints and correctives, and the solver of its poses.

    Args:
        layer: the forward model.
        plain: skinning by the public joints alone, whatever the layer adds.
        warp: run the Warp twins.
        some: ids of vertices that are looked at; None for all.

    Attributes:
        share: search of the limbs' twist; None where nothing but skinning tells it.
    """

    def __init__(self, layer: SomaLayer, *, plain: bool, warp: bool, some: np.ndarray | None = None) -> None:
        kind: Kind = {"dtype": layer.dtype, "device": layer.device}
        fitted = np.ones(layer.mesh.vertex_count, bool)
        fitted[layer.mesh.face_interior] = False
        whole, twisting = layer.rig, layer.procedural and not plain
        if some is not None:
            fitted, whole = fitted[some], _rig_of(whole, some)
        rig = rig_with_helpers(whole) if twisting else whole
        structure = skin_structure(rig, fitted)
        driven = DrivenJoints(whole, **kind) if twisting else None
        limbs = None if driven is None else LimbStart(whole, driven, structure.joints)
        correctives = None if plain else layer.correctives
        offsets = share = None
        if correctives is not None and len(correctives.owner):  # some move no vertex at all
            offsets = PoseOffsets.of_correctives(
                correctives, rig, structure.joints, fitted, some=some, **kind
            )
            if driven is not None:
                share = TwistShare(whole, driven, offsets, structure.joints, structure.pairs)
        super().__init__(
            rig, structure, layer.animation, driven=driven, offsets=offsets, limbs=limbs, warp=warp, **kind
        )
        self.correctives, self.share = correctives, share
        self.some = None if some is None else torch.as_tensor(some.copy(), device=layer.device)

    def seen(self, identity: Identity) -> Identity:
        """The identity with the vertices that are looked at."""
        return identity if self.some is None else replace(identity, rest=identity.rest[:, self.some])

    def problem(
        self,
        vertices: Tensor,
        identity: Identity,
        weights: Tensor,
        bone_scale: Tensor | None,
        terms: JointTerms | None,
        rest: RestMoments | None,
    ) -> Problem:
        """The problem of some frames for this model.

        Args:
            vertices: (F, v, 3) [m] of the whole mesh, finite.
            identity: batch of 1 or F.
            weights: (1 or F, v).
            bone_scale: (1 or F, J - 1); None without.
            terms: soft terms and hinges.
            rest: of the one identity, where it is known already.
        """
        if self.some is not None:
            vertices, weights = vertices[:, self.some], weights[:, self.some]
        seen = self.seen(identity)
        if rest is None and (identity.batch_size > 1 or len(weights) > 1):
            rest, target, origin = self.each(vertices, seen, weights, bone_scale)
        else:
            rest = self.rest(seen, weights, bone_scale) if rest is None else rest
            if bone_scale is not None:
                rest = replace(rest, offsets=self.bone_offsets(identity, bone_scale))
            target, origin = self.moments.target(vertices, rest)
        return Problem(
            vertices=vertices, weights=weights, identity=seen, rest=rest, target=target, origin=origin,
            bone_scale=bone_scale, terms=terms,
        )  # fmt: skip

    def prepared(self, identity: Identity, weights: Tensor) -> RestMoments:
        """Moments of one identity of the whole mesh, for :meth:`problem`."""
        if self.some is not None:
            weights = weights[:, self.some]
        return self.rest(self.seen(identity), weights)

    def frames_on_gpu(self) -> int:
        """Frames that are fitted together on a GPU: as many as it has room for, since more use it better."""
        where = self.solver.eye
        if not where.is_cuda:
            return 0
        free, _ = torch.cuda.mem_get_info(where.device)
        free += torch.cuda.memory_reserved(where.device) - torch.cuda.memory_allocated(where.device)
        return min(int(_SHARE_OF_MEMORY * free / self.frame_bytes), _MOST_FRAMES)

    @property
    def frame_bytes(self) -> int:
        """What a frame takes in a fit by kernels on a GPU, its targets among it."""
        solver = 0 if self.steps is None else self.steps.memory + 2 * self.steps.kept
        vertices = 9 * len(self.fitted)  # targets, some of them once more, distances and their marks
        return (solver + vertices + 8192) * self.solver.eye.element_size()

    def scale(self, problem: Problem) -> Tensor:
        """Size of the bodies beside the canonical one, (1 or F,)."""
        if self.correctives is None:
            return problem.origin.new_ones(1)
        return self.correctives.scale(problem.identity.bind_world)

    def determined(self, kept: Tensor, below: Tensor | None = None) -> Tensor:
        """Whether each user joint is determined, (F, J - 1), by which weighted joints (F, T) are.

        Joints right below one of `below` (F, J - 1) that is not determined now are not, either.
        """
        count = self.solver.public_count
        known = kept.new_zeros(len(kept), self.solver.joint_count)
        known[:, self.moments.joints] = kept
        if self.driven is not None:  # a bone whose skin lies on twist joints is known by theirs
            known = known[:, :count] | _any_of(known[:, count:], self.driven.start, count)
        if below is None:
            return known[:, 1:]
        lost = torch.nn.functional.pad(below, (1, 0)) & ~known[:, :count]
        return (known[:, :count] & ~lost[:, self.solver.parents[:count]])[:, 1:]

    def angle_std(self, problem: Problem, pose: Pose, energy: Tensor) -> Tensor:
        """Standard deviations (F, J - 1) [degrees] of joint angles, where the noise is what is left.

        Weights count as inverse variances, up to a factor that is estimated.
        """
        variables = self.solver.variables
        spare = 3 * (problem.weights > 0).sum(1) - 3 * (len(variables) + 1)
        noise = torch.where(spare > 0, energy / spare.clamp_min(1), torch.nan)
        angle = (self.angle_variance(problem, pose) * noise[:, None]).clamp_min(0).sqrt().rad2deg()
        every = angle.new_full((len(angle), self.solver.public_count - 1), torch.nan)
        return every.index_copy(1, variables - 1, angle)


def _any_of(flags: Tensor, owner: Tensor, count: int) -> Tensor:
    """(F, count) whether any flag (F, H) of each owner is set."""
    total = flags.new_zeros(len(flags), count, dtype=torch.int64).index_add(1, owner, flags.long())
    return total > 0


def _rig_of(rig: Rig, some: np.ndarray) -> Rig:
    """The rig of a part of the vertices."""
    procedural = rig.procedural
    if procedural is not None:
        procedural = replace(procedural, weights=procedural.weights[some])
    return replace(rig, bind_shape=rig.bind_shape[some], weights=rig.weights[some], procedural=procedural)
