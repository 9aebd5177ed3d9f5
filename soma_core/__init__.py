"""SOMA Core: any parametric human body model on one canonical mesh, skeleton and motion.

The public names are loaded when they are first used, so that importing the package costs
milliseconds and loads neither torch nor Warp.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from soma_core._version import __version__

if TYPE_CHECKING:
    from soma_core.animation.posed import Posed
    from soma_core.errors import AssetError, InputError, SomaError
    from soma_core.inversion import InversionResult, PoseInversion
    from soma_core.io import read_motion, write_motion
    from soma_core.io.motion import Motion
    from soma_core.layer import SomaLayer
    from soma_core.plugin.errors import BackendError
    from soma_core.plugin.hookspecs import hookimpl
    from soma_core.plugin.spec import BackendSpec, Generator, LinearBasis, Parameter, WrapPair
    from soma_core.rig import load_canonical
    from soma_core.skeleton.identity import Identity

__all__ = [
    "AssetError",
    "BackendError",
    "BackendSpec",
    "Generator",
    "Identity",
    "InputError",
    "InversionResult",
    "LinearBasis",
    "Motion",
    "Parameter",
    "PoseInversion",
    "Posed",
    "SomaError",
    "SomaLayer",
    "WrapPair",
    "__version__",
    "hookimpl",
    "load_canonical",
    "read_motion",
    "write_motion",
]

_HOME = {
    "AssetError": "soma_core.errors",
    "BackendError": "soma_core.plugin.errors",
    "BackendSpec": "soma_core.plugin.spec",
    "Generator": "soma_core.plugin.spec",
    "Identity": "soma_core.skeleton.identity",
    "InputError": "soma_core.errors",
    "InversionResult": "soma_core.inversion",
    "LinearBasis": "soma_core.plugin.spec",
    "Motion": "soma_core.io.motion",
    "Parameter": "soma_core.plugin.spec",
    "PoseInversion": "soma_core.inversion",
    "Posed": "soma_core.animation.posed",
    "SomaError": "soma_core.errors",
    "SomaLayer": "soma_core.layer",
    "WrapPair": "soma_core.plugin.spec",
    "hookimpl": "soma_core.plugin.hookspecs",
    "load_canonical": "soma_core.rig",
    "read_motion": "soma_core.io",
    "write_motion": "soma_core.io",
}


def __getattr__(name: str) -> Any:
    """Load a public name on first use (PEP 562) and keep it in the module."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it offers {', '.join(__all__)}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted({*globals(), *__all__})
