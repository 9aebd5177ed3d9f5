"""Names that files have for the parts of an SMPL motion, and what is known of the tools that write them.

A name counts without the prefixes and suffixes of `_PREFIXES` and `_SPACES`: ``smpl_params_global/body_pose``
is the body in the world. Layouts are those of the projects' own demos and data sheets, as of 2026.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

__all__ = ["PARTS", "RATES", "TOOLS", "Space", "Tool", "frame_number", "part_of", "space_of", "tool_of"]

Space = Literal["world", "camera"]

PARTS: dict[str, tuple[str, ...]] = {
    "pose": ("rotmat", "rotmats", "poses", "pose", "fullpose", "full_pose", "thetas", "theta", "pose_aa"),
    "root": (
        "global_orient", "root_orient", "rh", "poses_root", "pose_root", "root_pose", "global_rot",
        "global_orientation", "root_rotation", "orient",
    ),
    "body": ("body_pose", "pose_body", "poses_body", "body_rotmat"),
    "hands": ("pose_hand", "hand_pose", "hands_pose", "poses_hand", "pose_hands"),
    "left_hand": ("left_hand_pose", "handl", "pose_lhand", "lhand_pose", "poses_lhand", "left_hand"),
    "right_hand": ("right_hand_pose", "handr", "pose_rhand", "rhand_pose", "poses_rhand", "right_hand"),
    "jaw": ("jaw_pose", "pose_jaw", "poses_jaw"),
    "eyes": ("pose_eye", "eye_pose", "eyes_pose"),
    "left_eye": ("leye_pose", "left_eye_pose", "pose_leye"),
    "right_eye": ("reye_pose", "right_eye_pose", "pose_reye"),
    "trans": (
        "trans", "transl", "translation", "th", "root_translation", "root_trans", "root_transl",
        "global_translation", "global_trans",
    ),
    "betas": ("betas", "beta", "shape", "shapes", "body_shape"),
    "gender": ("gender", "genders", "sex"),
    "scaling": ("scaling",),
    "frames": ("frame_ids", "frame_id", "frames", "frame", "img_frame_ids", "frame_idx"),
    "model": ("surface_model_type", "model_type", "body_model", "smpl_type"),
    "rate": ("mocap_framerate",),
    "rate_2": ("mocap_frame_rate",),
    "rate_3": ("fps", "frame_rate", "framerate", "video_fps"),
    "seconds": ("mocap_time_length",),
    "flat": ("flat_hand_mean",),
    "expression": ("expression", "expressions", "expr", "face_expr"),
    "camera": ("camera_crop", "cam", "orig_cam", "camera", "weak_cam"),
}  # fmt: skip
"""Part -> its names, the one that tells most first."""

RATES = ("rate", "rate_2", "rate_3")
"""Parts that are a frame rate; files of AMASS have one, others may have several that differ."""

_PART_OF = {name: part for part, names in PARTS.items() for name in names}

_EXACT: dict[str, tuple[str, Space | None] | None] = {
    "world_trans": ("trans", "world"), "world_transl": ("trans", "world"),
    "world_global_rots": ("root", "world"),
    "cam_trans": ("trans", "camera"), "cam_t": ("trans", "camera"), "camera_translation": ("trans", "camera"),
    "orig_cam": ("camera", None), "pred_cam": ("camera", None),
    "cam_poses": None, "cam_pose": None, "camera_pose": None, "camera_poses": None,
}  # fmt: skip
"""Names that the rules would take for something else; None for what is no part."""

_HUMP = re.compile(r"(?<=[a-z])(?=[A-Z][a-z])")
_FRAME_NAME = re.compile(r"(\d{3,9})|.*?(\d{1,9})\.(?:jpe?g|png|bmp|webp)", re.IGNORECASE)
_PREFIXES = ("pred_", "smplx_", "smplh_", "smpl_", "opt_", "est_")
_SPACES: dict[str, Space] = {
    "world": "world", "global": "world", "glob": "world", "w": "world",
    "incam": "camera", "camera": "camera", "cam": "camera", "c": "camera",
}  # fmt: skip


def part_of(key: str) -> tuple[str, Space | None, int] | None:
    """Part that a key names, the space that its name tells, and its rank among the names of that part."""
    name, space = key.lower(), None
    if name not in _PART_OF:
        name = _HUMP.sub("_", key).lower()
    if name in _EXACT:
        found = _EXACT[name]
        return None if found is None else (*found, 0)
    while name not in _PART_OF and name.startswith(_PREFIXES):
        name = name.partition("_")[2]
    stem, _, last = name.rpartition("_")
    if name not in _PART_OF and last in _SPACES:
        name, space = stem, _SPACES[last]
    part = _PART_OF.get(name)
    return None if part is None else (part, space, PARTS[part].index(name))


def space_of(component: str) -> Space | None:
    """Space that a part of a path tells, as ``smplx_world`` does."""
    return next((_SPACES[word] for word in component.lower().split("_") if word in _SPACES), None)


def frame_number(key: object) -> int | None:
    """Number of a frame that is called by it or by its picture, as ``000012`` and ``img_12.png`` are."""
    if type(key) is int:
        return key
    found = _FRAME_NAME.fullmatch(str(key))
    return int(found[1] or found[2]) if found else None


@dataclass(frozen=True, kw_only=True)
class Tool:
    """A tool or data set: how it is told, and what its files leave unsaid.

    Attributes:
        name: of it.
        keys: all of these are among the names on the way to a body, or beside its parts.
        fps: usual frame rate; None where files have their own, or it is not known.
        up: upward axis of its world; None where it is told by how the body stands.
        space: of what it does not call world or camera.
        gender: of the bodies, where the file does not say.
        no_betas: whether the mean shape is meant where there are none.
        about: what the root rotation turns about.
        most_betas: that are its model's shape; those behind mean something else.
        camera: name of the file beside its own, or above, that has the path of the camera.
    """

    name: str
    keys: tuple[str, ...]
    fps: float | None = None
    up: Literal["+y", "+z"] | None = None
    space: Space | None = None
    gender: str | None = None
    no_betas: bool = False
    about: Literal["pelvis", "origin"] = "pelvis"
    most_betas: int | None = None
    camera: str = ""


TOOLS = (
    Tool(name="GVHMR", keys=("smpl_params_global",), fps=30, up="+y", gender="neutral"),
    Tool(name="GVHMR", keys=("smpl_params_incam",), fps=30, gender="neutral"),
    Tool(name="GENMO", keys=("body_params_global",), fps=30, up="+y", gender="neutral"),
    Tool(name="GENMO", keys=("body_params_incam",), fps=30, gender="neutral"),
    Tool(name="PromptHMR", keys=("people", "smplx_world"), fps=30, up="+y", gender="neutral"),
    Tool(name="PromptHMR", keys=("people", "smplx_cam"), fps=30, gender="neutral"),
    Tool(name="WHAM", keys=("pose_world", "trans_world"), fps=30, up="+y", gender="neutral", space="camera"),
    Tool(name="WHAM", keys=("pose", "trans", "frame_ids", "verts"), fps=30, gender="neutral", space="camera"),
    Tool(name="VIBE", keys=("orig_cam", "pose"), fps=30, gender="neutral", space="camera"),
    Tool(name="4D-Humans", keys=("tracks",), fps=30, gender="neutral", space="camera"),
    Tool(
        name="TRAM",
        keys=("pred_rotmat", "pred_shape"),
        fps=30,
        gender="neutral",
        space="camera",
        camera="camera.npy",
    ),
    Tool(name="3DPW", keys=("poses", "genders", "cam_poses"), fps=30, up="+y"),
    Tool(name="EMDB", keys=("poses_root", "poses_body"), fps=30, up="+y"),
    Tool(name="AIST++", keys=("smpl_poses", "smpl_scaling"), fps=60, up="+y", gender="male", no_betas=True),
    Tool(name="MOYO", keys=("fullpose", "stageii_debug_details"), fps=60, up="+z", gender="neutral"),
    Tool(name="MoSh++", keys=("fullpose",), up="+z"),
    Tool(name="EasyMocap", keys=("Rh", "Th"), gender="neutral", about="origin"),
    Tool(name="MDM", keys=("thetas", "root_translation"), fps=20, up="+y", gender="neutral", no_betas=True),
    Tool(name="Motion-X", keys=("motion_x_322",), fps=30, up="+y", gender="neutral"),
    Tool(name="Inter-X", keys=("pose_lhand", "pose_rhand")),
    Tool(name="TRACE", keys=("smpl_thetas", "world_trans"), fps=30, gender="neutral"),
    Tool(
        name="ROMP or BEV",
        keys=("smpl_thetas", "cam_trans"),
        fps=30,
        gender="neutral",
        space="camera",
        most_betas=10,
    ),
    Tool(name="SLAHMR", keys=("root_orient", "pose_body", "cam_R"), fps=30, gender="neutral"),
    Tool(name="the smplx library", keys=("global_orient", "body_pose"), gender="neutral"),
)


def tool_of(names: Collection[str]) -> Tool | None:
    """The tool that writes such names."""
    return next((tool for tool in TOOLS if set(tool.keys) <= set(names)), None)
