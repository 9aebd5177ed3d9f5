"""The result of the way back: a motion in a native model's own parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

__all__ = ["NativeMotion"]


@dataclass(frozen=True, kw_only=True, eq=False)
class NativeMotion:
    """Pose parameters of every frame, one body for all, and how well they explain the target.

    ``generator.posed(motion.params, {"rotations": motion.rotations, "translation": motion.translation})``
    is the reconstruction.

    Attributes:
        joint_names: J names, in the model's order.
        rotations: local rotations relative to the rest pose, axis-angle [rad], (frames, J, 3). Joints that
            the target does not determine keep zero.
        translation: what is added to all vertices, native unit and axes, (frames, 3).
        params: the body, batch of 1; as given, or fitted.
        vertices: the reconstruction, native unit and axes, (frames, n, 3).
        vertex_error: its distance to each native target vertex [m], (frames, n); NaN where the vertex has
            no counterpart, or the frame is not valid.
        determined: (J,) bool; False for joints that move no vertex with a counterpart.
        valid: (frames,) bool; False where the target is not finite. Rotations and translation are zero there.
        converged: (frames,) bool; the last step no longer lowered the error noticeably.
        iterations: (frames,) int, accepted steps under the whole model.
        residual: root mean square of the weighted vertex error [m], (frames,); NaN where not valid.
    """

    joint_names: tuple[str, ...]
    rotations: Tensor
    translation: Tensor
    params: Mapping[str, Tensor]
    vertices: Tensor
    vertex_error: Tensor
    determined: Tensor
    valid: Tensor
    converged: Tensor
    iterations: Tensor
    residual: Tensor
