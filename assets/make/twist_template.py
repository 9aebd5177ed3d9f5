"""The twist segments of the shipped rig, as the document that ``python -m assets.make`` writes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from soma_core.rig.procedural import MODES

__all__ = ["FRACTIONS", "procedural_document"]

FRACTIONS = (0.05, 0.3333333, 0.6666667, 0.95)
"""Where the helpers of a segment sit, from its start (0) to its end (1)."""

_SEGMENTS = (
    ("Arm", "ForeArm", "Shoulder"),
    ("ForeArm", "Hand", None),
    ("Leg", "Shin", "Hips"),
    ("Shin", "Foot", None),
)
"""Start, end, and the parent against which a reversed segment measures its own twist."""


def _segment(side: str, start: str, end: str, parent: str | None) -> dict[str, Any]:
    above = None if parent is None else parent if parent == "Hips" else side + parent
    return {
        "start_joint": side + start,
        "end_joint": side + end,
        "parent_joint": above,
        "reverse": parent is not None,
        "source_axis": "x",
        "source_sign": 1,
        "twist_joints": [f"{side}{start}Twist{number}" for number in range(1, len(FRACTIONS) + 1)],
    }


def _entries(segments: Sequence[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    """Entries of one of the two matrices; the fractions are those of :data:`FRACTIONS`."""
    entries = []
    for segment in segments:
        start, end = segment["start_joint"], segment["end_joint"]
        for helper, fraction in zip(segment["twist_joints"], FRACTIONS, strict=True):
            rest = round(1 - fraction, 7)
            if kind == "translation":
                entries.append({"row": helper, "column": start, "value": rest})
            elif segment["reverse"]:
                entries.append({"row": helper, "column": start, "value": -rest})
            entries.append({"row": helper, "column": end, "value": fraction})
    return entries


def _matrix(segments: Sequence[dict[str, Any]], kind: str) -> dict[str, Any]:
    return {"format": "sparse_coo_named", "dtype": "float32", "entries": _entries(segments, kind)}


def procedural_document(joint_names: Sequence[str]) -> dict[str, Any]:
    """Return the content of ``SOMA_procedural_transforms.json``, schema 1.1.0.

    Args:
        joint_names: the public joints in the order of a pose, Root included.
    """
    segments = [_segment(side, *part) for side in ("Left", "Right") for part in _SEGMENTS]
    helpers = sum(len(segment["twist_joints"]) for segment in segments)
    return {
        "schema_version": "1.1.0",
        "definition_name": "SOMA twist joints",
        "template_asset": {"file": "SOMA_template_rig.usda", "joint_count": len(joint_names) + helpers},
        "conventions": {
            "linear_unit": "centimeters",
            "angular_unit": "radians",
            "matrix_storage": "row_major",
            "quaternion_order": "xyzw",
            "up_axis": "+Y",
            "forward_axis": "+Z",
            "handedness": "right",
        },
        "modes": list(MODES),
        "channel_extractors": {
            "local_x_euler": {"input": "local rotation", "formula": "atan2(A[2][1], A[1][1])"},
            "local_x_swing_twist": {
                "input": "local rotation",
                "formula": "4 atan2(q_v . e, 1 + q_w), q_w >= 0",
            },
            "aligned_x_swing_twist": {
                "input": "world rotations of two joints, each relative to its bind rotation",
                "formula": "4 atan2(q_v . x, 1 + q_w), q_w >= 0",
                "x": "unit vector from start to end at bind, along the positive source axis",
            },
        },
        "rotation_extraction": "aligned_x_swing_twist",
        "public_rig_derivation": {
            "main_joint_names": list(joint_names),
            "removed_joint_parent_remap": "nearest_kept_ancestor",
            "removed_skin_weight_aggregation": "add_to_nearest_kept_ancestor",
        },
        "segments": segments,
        "parameter_matrices": {kind: _matrix(segments, kind) for kind in ("rotation", "translation")},
        "evaluation_order": [
            "forward kinematics of the main joints",
            "twist channel of each source joint from the posed rotations",
            "angle of each twist joint: rotation matrix times channels",
            "position of each twist joint: translation matrix times bind positions of the main joints",
            "world transform: start joint, then the bind step, then the angle about source_axis",
            "skinning over all joints",
        ],
    }
