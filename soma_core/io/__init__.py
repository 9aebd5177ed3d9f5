"""Motion files, and skinned animations as UsdSkel and glTF."""

from __future__ import annotations

from soma_core.io.clip import SkinnedClip, skinned_clip
from soma_core.io.gltf import write_gltf
from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.motion import Convention, Motion
from soma_core.io.motion_files import check_rig, read_motion, write_motion
from soma_core.io.usd import write_usd

__all__ = [
    "USER_JOINTS",
    "Convention",
    "Motion",
    "SkinnedClip",
    "check_rig",
    "read_motion",
    "skinned_clip",
    "write_gltf",
    "write_motion",
    "write_usd",
]
