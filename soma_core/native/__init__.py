"""The way back: SOMA bodies on a native topology, and in a native model's own pose parameters."""

from soma_core.native.fit import NativeFit
from soma_core.native.motion import NativeMotion
from soma_core.native.parameters import ParameterFit, ParameterMotion
from soma_core.native.transfer import NativeTransfer

__all__ = ["NativeFit", "NativeMotion", "NativeTransfer", "ParameterFit", "ParameterMotion"]
