"""SOMA Core: any parametric human body model on one canonical mesh, skeleton and motion.

The public names are loaded when they are first used, so that importing the package costs
milliseconds and loads neither torch nor Warp. What backend authors need is in `soma_core.plugin`,
what their tests need in `soma_core.testing`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from soma_core._lazy import lazy_names
from soma_core._version import __version__

if TYPE_CHECKING:
    from soma_core.animation.posed import Posed
    from soma_core.errors import AssetError, InputError, SomaError
    from soma_core.inversion.analytical import AnalyticalOptions
    from soma_core.inversion.autograd import AutogradOptions
    from soma_core.inversion.diagnosis import diagnose_fit
    from soma_core.inversion.fit import PoseInversion
    from soma_core.inversion.point_identity import fit_point_identity
    from soma_core.inversion.point_priors import JointPrior, JointRange
    from soma_core.inversion.points import PointInversion
    from soma_core.inversion.priors import HINGES, PosePriors
    from soma_core.inversion.result import IdentityFit, InversionResult, PointResult
    from soma_core.io.amass import SmplMotion, write_amass
    from soma_core.io.camera import Camera, read_camera, read_cameras
    from soma_core.io.clip import SkinnedClip, skinned_clip
    from soma_core.io.gltf import write_gltf
    from soma_core.io.joint_order import USER_JOINTS
    from soma_core.io.motion import Motion
    from soma_core.io.motion_files import read_motion, write_motion
    from soma_core.io.sam3d import Sam3dFrames, read_sam3d
    from soma_core.io.smpl_files import SmplChoices, read_amass, read_smpl
    from soma_core.io.usd import write_usd
    from soma_core.io.vertex_files import open_vertex_sequence
    from soma_core.io.vertex_sequence import VertexSequence
    from soma_core.layer import SomaLayer
    from soma_core.native.fit import NativeFit
    from soma_core.native.identity import fit_identity
    from soma_core.native.motion import NativeMotion
    from soma_core.native.parameters import ParameterFit
    from soma_core.native.transfer import NativeTransfer
    from soma_core.paths import assets_dir
    from soma_core.plugin.errors import BackendError
    from soma_core.plugin.registry import default_registry
    from soma_core.points.point_set import Point, PointSet, load_point_set
    from soma_core.rig.canonical import load_canonical
    from soma_core.rig.landmarks import canonical_landmarks
    from soma_core.rig.mesh import CanonicalMesh
    from soma_core.rig.neutral import ShapeSpace, load_shape_space
    from soma_core.rig.skeleton import Rig
    from soma_core.skeleton.identity import Identity

__all__ = [
    "HINGES",
    "USER_JOINTS",
    "AnalyticalOptions",
    "AssetError",
    "AutogradOptions",
    "BackendError",
    "Camera",
    "CanonicalMesh",
    "Identity",
    "IdentityFit",
    "InputError",
    "InversionResult",
    "JointPrior",
    "JointRange",
    "Motion",
    "NativeFit",
    "NativeMotion",
    "NativeTransfer",
    "ParameterFit",
    "Point",
    "PointInversion",
    "PointResult",
    "PointSet",
    "PoseInversion",
    "PosePriors",
    "Posed",
    "Rig",
    "Sam3dFrames",
    "ShapeSpace",
    "SkinnedClip",
    "SmplChoices",
    "SmplMotion",
    "SomaError",
    "SomaLayer",
    "VertexSequence",
    "__version__",
    "assets_dir",
    "canonical_landmarks",
    "default_registry",
    "diagnose_fit",
    "fit_identity",
    "fit_point_identity",
    "load_canonical",
    "load_point_set",
    "load_shape_space",
    "open_vertex_sequence",
    "read_amass",
    "read_camera",
    "read_cameras",
    "read_motion",
    "read_sam3d",
    "read_smpl",
    "skinned_clip",
    "write_amass",
    "write_gltf",
    "write_motion",
    "write_usd",
]

_HOMES = {
    # A body: from parameters to posed vertices
    "soma_core.layer": ["SomaLayer"],
    "soma_core.skeleton.identity": ["Identity"],
    "soma_core.animation.posed": ["Posed"],
    # The canonical mesh, its rig and its shape space
    "soma_core.rig.canonical": ["load_canonical"],
    "soma_core.rig.landmarks": ["canonical_landmarks"],
    "soma_core.rig.mesh": ["CanonicalMesh"],
    "soma_core.rig.skeleton": ["Rig"],
    "soma_core.rig.neutral": ["ShapeSpace", "load_shape_space"],
    "soma_core.paths": ["assets_dir"],
    # The way back: from vertices to poses and bodies
    "soma_core.inversion.fit": ["PoseInversion"],
    "soma_core.inversion.result": ["IdentityFit", "InversionResult", "PointResult"],
    "soma_core.native.identity": ["fit_identity"],
    "soma_core.inversion.priors": ["HINGES", "PosePriors"],
    "soma_core.inversion.diagnosis": ["diagnose_fit"],
    "soma_core.inversion.analytical": ["AnalyticalOptions"],
    "soma_core.inversion.autograd": ["AutogradOptions"],
    "soma_core.inversion.points": ["PointInversion"],
    "soma_core.inversion.point_identity": ["fit_point_identity"],
    "soma_core.inversion.point_priors": ["JointPrior", "JointRange"],
    # Named points: keypoints, markers, joints of other rigs
    "soma_core.points.point_set": ["Point", "PointSet", "load_point_set"],
    "soma_core.io.camera": ["Camera", "read_camera", "read_cameras"],
    # To the meshes and poses of other models
    "soma_core.native.fit": ["NativeFit"],
    "soma_core.native.motion": ["NativeMotion"],
    "soma_core.native.parameters": ["ParameterFit"],
    "soma_core.native.transfer": ["NativeTransfer"],
    # Motions
    "soma_core.io.motion": ["Motion"],
    "soma_core.io.joint_order": ["USER_JOINTS"],
    "soma_core.io.motion_files": ["read_motion", "write_motion"],
    "soma_core.io.amass": ["SmplMotion", "write_amass"],
    "soma_core.io.smpl_files": ["SmplChoices", "read_amass", "read_smpl"],
    "soma_core.io.sam3d": ["Sam3dFrames", "read_sam3d"],
    # Moving meshes, and scenes that other programs open
    "soma_core.io.vertex_sequence": ["VertexSequence"],
    "soma_core.io.vertex_files": ["open_vertex_sequence"],
    "soma_core.io.clip": ["SkinnedClip", "skinned_clip"],
    "soma_core.io.gltf": ["write_gltf"],
    "soma_core.io.usd": ["write_usd"],
    # Backends that are installed
    "soma_core.plugin.registry": ["default_registry"],
    # Errors
    "soma_core.errors": ["AssetError", "InputError", "SomaError"],
    "soma_core.plugin.errors": ["BackendError"],
    # In `soma_core.plugin` now; plugins that were written before go on
    "soma_core.plugin.spec": ["BackendSpec", "Generator", "LinearBasis", "Parameter", "WrapPair"],
    "soma_core.plugin.hookspecs": ["hookimpl"],
}

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
