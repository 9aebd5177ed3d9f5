"""A fit of another rig's skin by one who knows how that rig turned its joints."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from soma_core._derived import own_precision
from soma_core.errors import InputError
from soma_core.inversion._inputs import without_gaps
from soma_core.inversion.fit import PoseInversion, Topology
from soma_core.inversion.priors import expected_terms
from soma_core.inversion.problem import Pose, Problem
from soma_core.inversion.result import InversionResult
from soma_core.inversion.targets import Frames, Targets
from soma_core.skeleton.identity import Identity

__all__ = ["GuidedInversion"]


class GuidedInversion(PoseInversion):
    """``PoseInversion`` that also takes turns that joints are expected to have.

    Skin of another rig does not tell how the twist of a limb is shared between its two bones. Expected turns
    do: they weigh so little that skin is hardly moved.
    """

    @own_precision
    def guided(
        self, vertices: Tensor, identity: Identity, expected: Tensor, *, topology: Topology = "canonical"
    ) -> InversionResult:
        """Fit every frame on its own; no gradients.

        Plain skinning leaves no share of twists open and is not guided; nor is a fit that a temporal prior
        guides.

        Args:
            vertices, identity, topology: see :meth:`PoseInversion.forward`.
            expected: (F, 77, 3, 3) rotations from the T-pose against the parent.

        Raises:
            InputError: as :meth:`PoseInversion.forward`; a number of expected turns that differs.
        """
        if self.ladder.plain or self.priors.temporal_strength or not self.priors.expected:
            return self(vertices, identity, topology=topology)
        if len(expected) != len(vertices):
            raise InputError(
                "expected", got=f"{len(expected)} frames", expected=f"{len(vertices)} frames",
                fix="Give turns of the same frames.",
            )  # fmt: skip
        with torch.no_grad():
            canonical = self.canonical(vertices, topology).contiguous()
            frames = self._frames(canonical, identity, None, None, None)
            reference = expected.to(canonical)[:, self.model.solver.variables - 1]
            return self._fit_all(replace(frames, reference=reference))

    def _posed(self, frames: Frames, robust: float | None = None, **kind: Any) -> tuple[Pose, Problem]:
        """With expected turns where the frames have such."""
        if frames.reference is None or self.priors.temporal_strength:
            return super()._posed(frames, robust, **kind)
        vertices, _ = without_gaps(frames.vertices, frames.weights, self.layer)
        names = [self.layer.rig.joint_names[joint] for joint in self.model.solver.variables.tolist()]
        targets = Targets(
            vertices=vertices, identity=frames.identity, weights=frames.weights,
            terms=expected_terms(self.terms, frames.reference, names, self.priors.expected),
            bone_scale=frames.bone_scale, doubt=self.doubt, rest=frames.rest, robust=robust, **kind,
        )  # fmt: skip
        return self.ladder(targets, None if frames.initial is None else frames.initial.pose())

    def _described(self, frames: Frames, problem: Problem, result: InversionResult) -> InversionResult:
        """Whether another rig moved the skin is told without what is expected."""
        return super()._described(replace(frames, reference=None), problem, result)
