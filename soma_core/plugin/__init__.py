"""The plugin contract: all that the author of a backend imports, besides errors from `soma_core`.

Names are loaded when they are first used. Importing this package, and what a declaration needs of it, loads
neither torch nor the rest of the core.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from soma_core._lazy import lazy_names

if TYPE_CHECKING:
    from soma_core.cache import atomic_arrays, atomic_write, cached_arrays, content_key, file_sha256
    from soma_core.files import refuse_unreadable
    from soma_core.geometry.barycentric import closest_point_on_triangle
    from soma_core.geometry.rotations import axis_angle_to_matrix
    from soma_core.io.pickled_arrays import read_pickled_arrays
    from soma_core.io.text_numbers import numbers_of_text
    from soma_core.native.skinned import pose_skinned
    from soma_core.npz import open_npz_file
    from soma_core.obj import read_obj, write_obj
    from soma_core.paths import data_dir, model_folders
    from soma_core.plugin.checks import Check, CheckFailedError, CheckNotRunError, Level, check
    from soma_core.plugin.errors import BrokenBackendError, PluginError
    from soma_core.plugin.hookspecs import hookimpl
    from soma_core.plugin.registry import Registry
    from soma_core.plugin.spec import (
        API_VERSION,
        Axis,
        BackendSpec,
        Expressions,
        FileNeeded,
        Generator,
        HasExpressions,
        HasLinearBasis,
        HasPosed,
        HasPoseVector,
        HasRandomPoses,
        HasSkinning,
        HasTriangles,
        LinearBasis,
        ModelMotion,
        MotionFormat,
        Parameter,
        SkinnedModel,
        Unit,
        WrapPair,
    )
    from soma_core.topology.closest import ClosestFaces

__all__ = [
    "API_VERSION",
    "Axis",
    "BackendSpec",
    "BrokenBackendError",
    "Check",
    "CheckFailedError",
    "CheckNotRunError",
    "ClosestFaces",
    "Expressions",
    "FileNeeded",
    "Generator",
    "HasExpressions",
    "HasLinearBasis",
    "HasPoseVector",
    "HasPosed",
    "HasRandomPoses",
    "HasSkinning",
    "HasTriangles",
    "Level",
    "LinearBasis",
    "ModelMotion",
    "MotionFormat",
    "Parameter",
    "PluginError",
    "Registry",
    "SkinnedModel",
    "Unit",
    "WrapPair",
    "atomic_arrays",
    "atomic_write",
    "axis_angle_to_matrix",
    "cached_arrays",
    "check",
    "closest_point_on_triangle",
    "content_key",
    "data_dir",
    "file_sha256",
    "hookimpl",
    "model_folders",
    "numbers_of_text",
    "open_npz_file",
    "pose_skinned",
    "read_obj",
    "read_pickled_arrays",
    "refuse_unreadable",
    "write_obj",
]

_HOMES = {
    # Hooks, the declaration and the generator with its capabilities
    "soma_core.plugin.hookspecs": ["hookimpl"],
    "soma_core.plugin.spec": [
        *("API_VERSION", "Axis", "BackendSpec", "Expressions", "FileNeeded", "Generator", "HasExpressions"),
        *("HasLinearBasis", "HasPosed", "ModelMotion", "MotionFormat"),
        *("HasPoseVector", "HasRandomPoses", "HasSkinning", "HasTriangles", "LinearBasis", "Parameter"),
        *("SkinnedModel", "Unit", "WrapPair"),
    ],
    # Checks of its own, and the registry that its tests ask
    "soma_core.plugin.checks": ["Check", "CheckFailedError", "CheckNotRunError", "Level", "check"],
    "soma_core.plugin.registry": ["Registry"],
    "soma_core.plugin.errors": ["BrokenBackendError", "PluginError"],
    # Files of the user, read without running them, and what is derived from them
    "soma_core.paths": ["data_dir", "model_folders"],
    "soma_core.cache": ["atomic_arrays", "atomic_write", "cached_arrays", "content_key", "file_sha256"],
    "soma_core.files": ["refuse_unreadable"],
    "soma_core.npz": ["open_npz_file"],
    "soma_core.io.pickled_arrays": ["read_pickled_arrays"],
    "soma_core.io.text_numbers": ["numbers_of_text"],
    # Meshes and rotations
    "soma_core.obj": ["read_obj", "write_obj"],
    "soma_core.topology.closest": ["ClosestFaces"],
    "soma_core.geometry.barycentric": ["closest_point_on_triangle"],
    "soma_core.geometry.rotations": ["axis_angle_to_matrix"],
    "soma_core.native.skinned": ["pose_skinned"],
}

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
