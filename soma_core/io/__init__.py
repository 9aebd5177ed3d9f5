"""Motion files, vertices over time, and skinned animations as UsdSkel and glTF."""

from __future__ import annotations

from soma_core.io.amass import SmplMotion, write_amass
from soma_core.io.clip import SkinnedClip, skinned_clip
from soma_core.io.gltf import write_gltf
from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.motion import Convention, Motion
from soma_core.io.motion_files import check_rig, read_motion, write_motion, write_motion_parts
from soma_core.io.sam3d import Sam3dFrames, read_sam3d
from soma_core.io.smpl_files import SmplChoices, read_amass, read_smpl
from soma_core.io.usd import write_usd
from soma_core.io.vertex_files import open_vertex_sequence
from soma_core.io.vertex_sequence import VertexSequence

__all__ = [
    "USER_JOINTS",
    "Convention",
    "Motion",
    "Sam3dFrames",
    "SkinnedClip",
    "SmplChoices",
    "SmplMotion",
    "VertexSequence",
    "check_rig",
    "open_vertex_sequence",
    "read_amass",
    "read_motion",
    "read_sam3d",
    "read_smpl",
    "skinned_clip",
    "write_amass",
    "write_gltf",
    "write_motion",
    "write_motion_parts",
    "write_usd",
]
