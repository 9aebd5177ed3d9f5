"""Motion files, and skinned animations as UsdSkel and glTF."""

from __future__ import annotations

from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.motion import Convention, Motion
from soma_core.io.motion_files import check_rig, read_motion, write_motion

__all__ = ["USER_JOINTS", "Convention", "Motion", "check_rig", "read_motion", "write_motion"]
