"""Local rotations of all joints of SMPL, SMPL-H or SMPL-X from the parts that a file has of them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soma_core.io.amass import SmplName
from soma_core.io.rotation_shapes import WIDTHS, RotationLayout, axis_angles, split_shape
from soma_core.io.smpl_bodies import BODY_JOINTS, POSE_JOINTS
from soma_core.io.smpl_parts import BodyParts

__all__ = ["SmplPose", "read_pose"]

_log = logging.getLogger(__name__)

_BODY, _PALMS, _FACE, _HANDS = "body", "palms", "face", "hands"
_BLOCKS = {_BODY: 22, _PALMS: 2, _FACE: 3, _HANDS: 30}
"""Groups of joints: pelvis to wrists; SMPL's hands; jaw and eyes; fingers."""

_MODELS: dict[SmplName, tuple[str, ...]] = {
    "smpl": (_BODY, _PALMS), "smplh": (_BODY, _HANDS), "smplx": (_BODY, _FACE, _HANDS)
}  # fmt: skip
"""Groups of each model, in the order of its joints."""

_SIDED = {"left_hand": (_HANDS, 0, 15), "right_hand": (_HANDS, 15, 15), "hands": (_HANDS, 0, 30)}
_FACES = {"jaw": (_FACE, 0, 1), "eyes": (_FACE, 1, 2), "left_eye": (_FACE, 1, 1), "right_eye": (_FACE, 2, 1)}
_STILL = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class SmplPose:
    """Rotations (frames, J, 3) [rad] of the joints of a model; NaN where the file has none.

    Attributes:
        model: whose joints.
        rotations: local axis-angle vectors.
        leading: the part that tells the number of frames.
        hands: (frames, 2 n) coefficients of the model's hand components, left first; n = 0 without any.
    """

    model: SmplName
    rotations: np.ndarray
    leading: str
    hands: np.ndarray

    @property
    def frames(self) -> int:
        """Number of rows, seen or not."""
        return len(self.rotations)


def read_pose(parts: BodyParts, *, model: SmplName | None, layout: RotationLayout | None) -> SmplPose:
    """Put the pose of a body together, joint for joint.

    Args:
        parts: of the body.
        model: whose joints; None: as the file tells.
        layout: of quaternions and 6D rotations; None: as the numbers tell.

    Raises:
        InputError: shapes or values that are no rotations, or another model than those of SMPL.
    """
    reader = _Reader(parts, layout)
    groups, leading = reader.groups()
    told = model or _told_model(parts, groups)
    rows = groups[_BODY]
    blocks = [groups.get(name, np.zeros((len(rows), _BLOCKS[name], 3))) for name in _MODELS[told]]
    _say_differences(parts, told, groups)
    rotations = np.concatenate(blocks, axis=1)
    return SmplPose(model=told, rotations=rotations, leading=leading, hands=reader.hands(len(rows)))


class _Reader:
    """Groups of joints of one body, while they are read."""

    def __init__(self, parts: BodyParts, layout: RotationLayout | None) -> None:
        self._parts, self._layout, self._frames = parts, layout, 0
        self._components: dict[int, np.ndarray] = {}

    def groups(self) -> tuple[dict[str, np.ndarray], str]:
        """Rotations (frames, joints, 3) of the groups that the file has, and the part that leads."""
        apart = "body" in self._parts and "root" in self._parts
        leading = "body" if apart else "pose"
        values = self._leading(leading, BODY_JOINTS if apart else (*POSE_JOINTS, *BODY_JOINTS))
        if values.shape[1] in BODY_JOINTS:
            values = np.concatenate([self._part("root", 1), values], axis=1)
        elif not apart and "root" in self._parts and np.abs(values[:, 0]).max() < _STILL:
            values = np.concatenate([self._part("root", 1), values[:, 1:]], axis=1)  # as EasyMocap has it
        found = _grouped(values)
        whole = {*found} if leading == "pose" else set()
        for part, (group, start, count) in (_SIDED | _FACES).items():
            if part in self._parts and group not in whole:
                self._add(found, part, group, slice(start, start + count))
        return found, leading

    def _add(self, found: dict[str, np.ndarray], part: str, group: str, place: slice) -> None:
        count = place.stop - place.start
        values = self._parts.numbers(part)
        if group == _HANDS and self._frames and values.size % (self._frames * count * 3):
            _log.info(
                "%s: %d numbers a frame are no rotations of %d joints, but components of the model's hands",
                self._parts.where(part), values.size // self._frames, count,
            )  # fmt: skip
            sides, rows = (0, 1) if count == 30 else (place.start // 15,), values.reshape(self._frames, -1)
            self._components |= dict(zip(sides, np.array_split(rows, len(sides), axis=1), strict=True))
            return
        whole = found.setdefault(group, np.zeros((self._frames, _BLOCKS[group], 3)))
        whole[:, place] = self._part(part, count)

    def hands(self, frames: int) -> np.ndarray:
        """Coefficients (frames, 2 n) of both hands; a hand that the file lacks has zeros."""
        width = max((values.shape[1] for values in self._components.values()), default=0)
        found = np.zeros((frames, 2, width))
        for side, values in self._components.items():
            found[:, side, : values.shape[1]] = values
        return found.reshape(frames, 2 * width)

    def _leading(self, part: str, joints: Sequence[int]) -> np.ndarray:
        """Rotations of the part that tells the number of frames."""
        values = self._parts.numbers(part)
        if self._parts.body.time_last:
            values = np.moveaxis(values, -1, 0)
        split = split_shape(values.shape, joints)
        if split is None:
            raise self._refuse_shape(part, values.shape)
        lead, count, width = split
        self._frames = int(np.prod(lead)) if lead else 1
        if len(lead) == 2 and 1 not in lead:
            raise self._refuse_shape(part, values.shape)
        return self._turned(part, values.reshape(self._frames, count, width))

    def _part(self, part: str, count: int) -> np.ndarray:
        """Rotations (frames, count, 3) of another part; one row counts for all frames."""
        values = self._parts.numbers(part)
        if self._parts.body.time_last and values.shape[-1:] == (self._frames,):
            values = np.moveaxis(values, -1, 0)
        rows = self._frames
        single = values.ndim == 1 or values.shape[0] == 1
        if values.size not in {rows * count * width for width in WIDTHS} and single:
            rows = 1
        width = values.size // (rows * count)
        if width not in WIDTHS or values.size != rows * count * width:
            raise self._refuse_shape(part, values.shape, count)
        turned = self._turned(part, values.reshape(rows, count, width))
        return np.broadcast_to(turned, (self._frames, count, 3))

    def _turned(self, part: str, values: np.ndarray) -> np.ndarray:
        width = values.shape[2]
        try:
            found, told = axis_angles(values, width, self._layout)
        except ValueError as error:
            raise self._parts.refuse(
                part,
                got=str(error),
                expected="rotations",
                fix="Pass rotation_layout=wxyz, xyzw, rows or columns.",
            ) from error
        if width == 6 and self._layout is None:
            _log.warning(
                "%s: %s; rotation_layout=columns or rows for the other", self._parts.where(part), told
            )
        if width == 4 and self._layout is None:
            self._layout = told.rpartition(" ")[2]  # type: ignore[assignment]  # the same in all parts
        if width != 3:
            _log.info("%s: rotations are %s", self._parts.where(part), told)
        return found

    def _refuse_shape(self, part: str, shape: tuple[int, ...], count: int | None = None) -> Exception:
        joints = count or "24 (SMPL), 52 (SMPL-H), 55 (SMPL-X) or 22"
        frames = f"{self._frames} frames of " if self._frames else ""
        return self._parts.refuse(
            part, got=f"shape {shape}",
            expected=f"{frames}{joints} joints with 3, 4, 6 or 9 numbers each",
            fix="Choose another key or person; if frames differ between keys, save the file anew.",
        )  # fmt: skip


def _grouped(values: np.ndarray) -> dict[str, np.ndarray]:
    """Groups of joints of a whole pose."""
    count = values.shape[1]
    found = {_BODY: values[:, :22]}
    if count == 24:
        found[_PALMS] = values[:, 22:]
    if count == 55:
        found[_FACE] = values[:, 22:25]
    if count in (52, 55):
        found[_HANDS] = values[:, -30:]
    return found


def _told_model(parts: BodyParts, groups: dict[str, np.ndarray]) -> SmplName:
    """The model that the file names, or whose joints it has."""
    if "model" in parts:
        name = parts.text("model")
        plain = "".join(letter for letter in name.lower() if letter.isalnum())
        models: tuple[SmplName, ...] = ("smplx", "smplh", "smpl")
        found = next((model for model in models if plain.startswith(model)), None)
        if found is None:
            raise parts.refuse(
                "model",
                got=repr(name),
                expected="smpl, smplh or smplx",
                fix="Pass model=smplx (or the true one).",
            )
        if "locked" in plain:
            _log.warning(
                "%s: betas belong to the model with a locked head (SMPLX_*_2020), not to another SMPL-X",
                parts.file.path.name,
            )
        return found
    if _PALMS in groups:
        return "smpl"
    if _FACE in groups or "expression" in parts or {"left_hand", "right_hand"} & set(parts.body.parts):
        return "smplx"
    return "smplh" if _HANDS in groups else "smplx"


def _say_differences(parts: BodyParts, model: SmplName, groups: dict[str, np.ndarray]) -> None:
    """Say which joints of the model the file lacks, and which of its rotations are dropped."""
    name, wanted = parts.file.path.name, _MODELS[model]
    if _HANDS in wanted and _HANDS not in groups:
        other = "model=smplh or smpl" if model == "smplx" else "model=smplx or smpl"
        _log.info("%s: no fingers in the file: %s with flat hands; %s for another model", name, model, other)
    elif _FACE in wanted and _FACE not in groups:
        _log.info("%s: no jaw and eyes in the file: they stay still", name)
    moved = [group for group in groups if group not in wanted and np.nanmax(np.abs(groups[group])) > _STILL]
    if moved:
        _log.warning(
            "%s: %s has no joints for the %s of the file, which are dropped", name, model, " and ".join(moved)
        )
