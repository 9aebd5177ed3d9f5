"""Joint orders that motion files use; index 0 of every order here is Hips, Root is left out."""

from __future__ import annotations

__all__ = [
    "CONTACT_JOINTS", "KIMODO_30_JOINTS", "PARENT_NAMES", "USER_JOINTS", "nearest_ancestors", "other_side",
    "other_sides",
]  # fmt: skip

_FINGERS = {"Thumb": 3, "Index": 4, "Middle": 4, "Ring": 4, "Pinky": 4}


def _hand(side: str) -> dict[str, str]:
    """Finger joints of one hand with their parents, chain by chain."""
    found: dict[str, str] = {}
    for finger, count in _FINGERS.items():
        parent = f"{side}Hand"
        for part in (*map(str, range(1, count + 1)), "End"):
            name = f"{side}Hand{finger}{part}"
            found[name] = parent
            parent = name
    return found


def _chain(first_parent: str, *names: str) -> dict[str, str]:
    return dict(zip(names, (first_parent, *names), strict=False))


def _arm(side: str) -> dict[str, str]:
    names = [side + part for part in ("Shoulder", "Arm", "ForeArm", "Hand")]
    return _chain("Chest", *names) | _hand(side)


def _leg(side: str) -> dict[str, str]:
    return _chain("Hips", *(side + part for part in ("Leg", "Shin", "Foot", "ToeBase", "ToeEnd")))


PARENT_NAMES: dict[str, str] = (
    _chain("Root", "Hips", "Spine1", "Spine2", "Chest", "Neck1", "Neck2", "Head", "HeadEnd")
    | dict.fromkeys(("Jaw", "LeftEye", "RightEye"), "Head")
    | _arm("Left")
    | _arm("Right")
    | _leg("Left")
    | _leg("Right")
)
"""Parent of each user joint; the keys are in the order of the skeleton."""

USER_JOINTS: tuple[str, ...] = tuple(PARENT_NAMES)
"""The 77 joints that a pose controls, Hips first."""

CONTACT_JOINTS = ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")
"""Joints at heels and toes, in the order of a file's foot contacts."""


def _kimodo_arm(side: str) -> tuple[str, ...]:
    ends = (f"{side}HandThumbEnd", f"{side}HandMiddleEnd")
    return (f"{side}Shoulder", f"{side}Arm", f"{side}ForeArm", f"{side}Hand", *ends)


KIMODO_30_JOINTS: tuple[str, ...] = (
    *("Hips", "Spine1", "Spine2", "Chest", "Neck1", "Neck2", "Head", "Jaw", "LeftEye", "RightEye"),
    *_kimodo_arm("Left"),
    *_kimodo_arm("Right"),
    *("LeftLeg", "LeftShin", "LeftFoot", "LeftToeBase"),
    *("RightLeg", "RightShin", "RightFoot", "RightToeBase"),
)
"""Order of the reduced kimodo skeleton; its finger ends hang directly on the hand."""


def nearest_ancestors(names: tuple[str, ...]) -> tuple[int, ...]:
    """Index in `names` of each joint's nearest ancestor that is in `names`; -1 where there is none."""
    found = []
    for name in names:
        parent = PARENT_NAMES[name]
        while parent != "Root" and parent not in names:
            parent = PARENT_NAMES[parent]
        found.append(-1 if parent == "Root" else names.index(parent))
    return tuple(found)


def other_side(name: str) -> str:
    """Name of a joint's partner; of one in the middle its own."""
    for side, other in (("Left", "Right"), ("Right", "Left")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


def other_sides(names: tuple[str, ...]) -> list[int]:
    """Index of each joint's partner."""
    return [names.index(other_side(name)) for name in names]
