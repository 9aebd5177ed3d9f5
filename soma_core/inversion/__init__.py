"""Pose inversion: posed vertices of any backend to the rig's rotations (paper, section 3.6)."""

from soma_core.inversion.fit import PoseInversion
from soma_core.inversion.result import InversionResult

__all__ = ["InversionResult", "PoseInversion"]
