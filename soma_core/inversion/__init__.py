"""Pose inversion: posed vertices of any backend to the rig's rotations (paper, section 3.6)."""

from soma_core.inversion.analytical import AnalyticalOptions
from soma_core.inversion.autograd import AutogradOptions
from soma_core.inversion.fit import PoseInversion
from soma_core.inversion.priors import HINGES, PosePriors
from soma_core.inversion.result import IdentityFit, InversionResult

__all__ = [
    "HINGES",
    "AnalyticalOptions",
    "AutogradOptions",
    "IdentityFit",
    "InversionResult",
    "PoseInversion",
    "PosePriors",
]
