"""Read kimodo motions: 77 joints, or the reduced skeleton of 30 joints; one sample of a batch."""

from __future__ import annotations

import logging

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.io.joint_order import (
    CONTACT_JOINTS,
    KIMODO_30_JOINTS,
    PARENT_NAMES,
    USER_JOINTS,
    nearest_ancestors,
)
from soma_core.io.motion import Motion
from soma_core.io.npz_fields import NpzFields, check_rotations
from soma_core.io.soma_npz import LIKELY_CONTACT
from soma_core.topology.frames import ANY_UNIT

__all__ = ["KIMODO_FPS", "read_kimodo_npz"]

_log = logging.getLogger(__name__)

KIMODO_FPS = 30.0
"""Frame rate of the format: it is not stored in the files."""

_ORDERS = {77: USER_JOINTS, 30: KIMODO_30_JOINTS}
_OTHERS = {22: "SMPL-X", 27: "the older core skeleton", 34: "the Unitree G1 robot"}

_MEASURED = 64
"""Frames, spread over the motion, that the skeleton is measured in: bones are rigid."""

_RIGID = 0.02
"""Largest median change of a bone over these frames, in its length."""

_THUMB = {"1": 1 / 3, "2": 1 / 3, "3": 1 / 3}
_FINGER = {"2": 3 / 8, "3": 3 / 8, "4": 2 / 8}
"""Shares of the turn from hand to finger end. The palm (joint 1 of a finger) is stiff, and the last joint of
a finger bends two thirds as far as the one before it, since one tendon pulls both."""

_SPREAD = {
    "ThumbEnd": {f"Thumb{part}": share for part, share in _THUMB.items()},
    "MiddleEnd": {
        finger + part: share
        for finger in ("Index", "Middle", "Ring", "Pinky")
        for part, share in _FINGER.items()
    },
}
"""Joints of a hand that the turn of each end joint of the reduced skeleton goes to, and their shares."""


def read_kimodo_npz(
    fields: NpzFields, *, fps: float | None, unit: str | None = None, person: str | None = None,
    columns: bool = False,
) -> Motion:  # fmt: skip
    """Read a kimodo motion (metres, +Y up, +Z forward; rotations relative to the T-pose).

    The local rotation of a joint is the transposed world rotation of its nearest stored ancestor times
    its own. Joints that the file does not hold stay at rest, but for the fingers of the reduced skeleton:
    its four finger ends hang directly on the hand, and their turn is spread over the joints between.

    Args:
        fields: the file.
        fps: frame rate, where it is not the usual one.
        unit: of lengths, where it is not the metre.
        person: which sample of a batch, from 0; needed where there are several.
        columns: whether matrices are stored column by column.

    Raises:
        InputError: neither local nor world rotations are there, or a key has another layout.
    """
    key = "local_rot_mats" if "local_rot_mats" in fields else "global_rot_mats"
    sample = _Sample(fields, person)
    stored = sample.numbers(key, ("frames", "30 or 77", 3, 3))
    frames, count = stored.shape[:2]
    if count not in _ORDERS:
        name = f", those of {_OTHERS[count]}" if count in _OTHERS else ""
        raise fields.refuse(
            key, got=f"{count} joints{name}", expected="the 30 or 77 joints of the SOMA skeleton",
            fix="Generate it with a SOMA model; of SMPL-X, kimodo_convert makes AMASS files.",
        )  # fmt: skip
    check_rotations(f"{fields.path}: {key}", stored)
    stored = np.swapaxes(stored, -1, -2) if columns else stored
    names = _ORDERS[count]
    local = stored if key == "local_rot_mats" else _local_rotations(stored, names)
    metres = ANY_UNIT[unit or "m"]
    return Motion(
        rotations=_all_joints(local, names),
        translation=metres * _hips(sample, frames, count),
        fps=KIMODO_FPS if fps is None else float(fps),
        joint_names=USER_JOINTS,
        source=f"kimodo motion {fields.path.name}",
        contacts=_contacts(sample, frames),
        skeleton=_skeleton(sample, local, names, metres),
    )


class _Sample:
    """One sample of a file, whose arrays may have a leading axis of samples."""

    def __init__(self, fields: NpzFields, person: str | None) -> None:
        self.fields, self._person = fields, person

    def __contains__(self, key: str) -> bool:
        return key in self.fields

    def numbers(self, key: str, shape: tuple[int | str, ...]) -> np.ndarray:
        """Finite numbers of the sample under `key`, checked as :meth:`NpzFields.numbers` does."""
        if self.fields.raw(key).ndim <= len(shape):
            _chosen(self.fields, key, 1, self._person)
            return self.fields.numbers(key, shape)
        values = self.fields.numbers(key, ("samples", *shape))
        return values[_chosen(self.fields, key, len(values), self._person)]


def _chosen(fields: NpzFields, key: str, count: int, person: str | None) -> int:
    """Number of the sample that is asked for; refuses one that is not there, and to choose among several."""
    known = [str(number) for number in range(count)]
    if person in known or (person is None and count == 1):
        return int(person or 0)
    raise fields.refuse(
        key,
        got=f"{count} samples" if person is None else f"person={person} of {count} samples",
        expected=f"one of 0 to {count - 1}" if count > 1 else "person=0" if count else "at least one",
        fix="Pass person=0, or another of these numbers." if count else "Generate it again.",
    )


def _all_joints(local: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Rotations (frames, 77, 3, 3) of all joints; the turn of finger ends goes to the fingers."""
    rotations = np.tile(np.eye(3), (len(local), len(USER_JOINTS), 1, 1))
    reduced = len(names) < len(USER_JOINTS)
    for index, name in enumerate(names):
        side, hand, end = name.partition("Hand")
        if not (reduced and hand and end):
            rotations[:, USER_JOINTS.index(name)] = local[:, index]
            continue
        turn = Rotation.from_matrix(local[:, index]).as_rotvec()  # one axis: shares of it add up
        for part, share in _SPREAD[end].items():
            joint = USER_JOINTS.index(side + hand + part)
            rotations[:, joint] = Rotation.from_rotvec(share * turn).as_matrix()
    return rotations


def _local_rotations(world: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Pose-relative local rotations, put back on SO(3) in float64."""
    local = world.copy()
    for index, ancestor in enumerate(nearest_ancestors(names)):
        if ancestor >= 0:
            local[:, index] = np.swapaxes(world[:, ancestor], -1, -2) @ world[:, index]
    return Rotation.from_matrix(local.reshape(-1, 3, 3)).as_matrix().reshape(local.shape)


def _hips(sample: _Sample, frames: int, count: int) -> np.ndarray:
    """World position of Hips in the unit of the file, (frames, 3)."""
    if "root_positions" in sample:
        return sample.numbers("root_positions", (frames, 3))
    return sample.numbers("posed_joints", (frames, count, 3))[:, 0]


def _extra(sample: _Sample, key: str, shape: tuple[int | str, ...]) -> np.ndarray | None:
    """Numbers that a motion can do without: where they are not as they should be, that is said."""
    if key not in sample:
        return None
    try:
        return sample.numbers(key, shape)
    except InputError as error:
        _log.warning("%s is not used: %s", key, error)
        return None


def _contacts(sample: _Sample, frames: int) -> np.ndarray | None:
    """Heels and toes on the ground, (frames, 4) bool."""
    likely = _extra(sample, "foot_contacts", (frames, len(CONTACT_JOINTS)))
    return None if likely is None else likely > LIKELY_CONTACT


def _skeleton(sample: _Sample, local: np.ndarray, names: tuple[str, ...], metres: float) -> np.ndarray | None:
    """Offset of each joint from its parent in the T-pose (77, 3) [m], from where the joints are.

    A joint whose parent the file does not hold has NaN.
    """
    joints = _extra(sample, "posed_joints", (len(local), len(names), 3))
    if joints is None:
        return None
    few = np.unique(np.linspace(0, len(local) - 1, _MEASURED).astype(int))
    joints, world, most = joints[few], _world(local[few], names), len(names) // 10
    offsets, loose = _bones(joints, world, names)
    if loose <= most:
        return metres * offsets
    transposed = np.swapaxes(world, -1, -2), _world(np.swapaxes(local[few], -1, -2), names)
    columns = any(_bones(joints, turned, names)[1] <= most for turned in transposed)
    _log.warning(
        "%s: posed_joints do not fit the rotations: %d bones change length or direction, %s",
        sample.fields.path.name, loose,
        "but do not if its matrices are stored column by column; pass rotation_layout=columns to soma convert"
        if columns
        else "as with axes of another hand, or another upward axis; write both with +y up",
    )  # fmt: skip
    return None


def _world(local: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """World rotations (frames, J, 3, 3) of local ones."""
    world = local.copy()
    for index, ancestor in enumerate(nearest_ancestors(names)):
        if ancestor >= 0:
            world[:, index] = world[:, ancestor] @ world[:, index]
    return world


def _bones(joints: np.ndarray, world: np.ndarray, names: tuple[str, ...]) -> tuple[np.ndarray, int]:
    """Bones (77, 3) of joints (frames, J, 3) turned by world rotations, and how many are not rigid."""
    offsets, loose = np.full((len(USER_JOINTS), 3), np.nan), 0
    offsets[0] = 0
    for index, ancestor in enumerate(nearest_ancestors(names)):
        if ancestor < 0 or PARENT_NAMES[names[index]] != names[ancestor]:
            continue
        turned = np.swapaxes(world[:, ancestor], -1, -2)
        bone = (turned @ (joints[:, index] - joints[:, ancestor])[..., None])[..., 0]
        middle = np.median(bone, axis=0)
        offsets[USER_JOINTS.index(names[index])] = middle
        change = np.median(np.linalg.norm(bone - middle, axis=1))
        loose += int(change > _RIGID * np.linalg.norm(middle))
    return offsets, loose
