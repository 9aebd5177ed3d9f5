"""Read a model file, whatever layout it has, and refuse one that is not what it should be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soma_backend_smpl.family import FAMILIES, Family
from soma_core import AssetError
from soma_core.plugin import open_npz_file

__all__ = ["KEYS", "ModelFile", "read_model", "shape_width"]

KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
HAND_KEYS = ("hands_meanl", "hands_meanr")
COMPONENT_KEYS = ("hands_componentsl", "hands_componentsr")
"""Mean poses of the hands, which only files of SMPL-H and SMPL-X have."""
_HEAD, _LEFT_HIP, _RIGHT_HIP = 15, 1, 2
_SUM_TOLERANCE = 1e-4  # float32 weights of some influences
_REGRESSOR_TOLERANCE = 1e-2  # sums of regressors fitted by least squares
_UPRIGHT = 0.9  # cosine between pelvis-to-head and the up axis
_STATURES = (0.5, 2.5)


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelFile:
    """One model, checked; metres, +Y up, facing +Z.

    Attributes:
        family: which model it is.
        path: where it was read.
        template: (v, 3) float64.
        shapes: (v, 3, s) directions of the body's shape.
        expressions: (v, 3, e) directions of the face; SMPL-X only, else e = 0.
        pose_directions: (v, 3, 9 (J - 1)) pose blend shapes.
        regressor: (J, v) joints from vertices, rows sum to 1.
        weights: (v, J) skinning weights.
        faces: (t, 3) int64.
        mean_hands: (90,) axis-angle values of the fingers' mean pose, left hand first; None where there are
            none.
        hand_components: (2, n, 45) directions of the fingers of both hands [rad], left first, n at most 45;
            None where there are none.
    """

    family: Family
    path: Path
    template: np.ndarray
    shapes: np.ndarray
    expressions: np.ndarray
    pose_directions: np.ndarray
    regressor: np.ndarray
    weights: np.ndarray
    faces: np.ndarray
    mean_hands: np.ndarray | None = None
    hand_components: np.ndarray | None = None

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays under the keys of the official files, in single precision."""
        kintree = np.array([self.family.parents, range(self.family.joint_count)], np.int64)
        found = {
            "v_template": self.template,
            "shapedirs": np.concatenate([self.shapes, self.expressions], axis=2),
            "posedirs": self.pose_directions,
            "J_regressor": self.regressor,
            "weights": self.weights,
        }
        if self.mean_hands is not None:
            found |= dict(zip(HAND_KEYS, np.split(self.mean_hands, 2), strict=True))
        if self.hand_components is not None:
            found |= dict(zip(COMPONENT_KEYS, self.hand_components, strict=True))
        single = {key: value.astype(np.float32) for key, value in found.items()}
        return single | {"kintree_table": kintree, "f": self.faces.astype(np.int32)}


def shape_width(path: Path, family: Family) -> int | None:
    """Number of shape parameters of a model file, for its declaration; None where it cannot be told."""
    try:
        if path.suffix.lower() == ".npz":
            with open_npz_file(path) as file:
                width = file.header("shapedirs").shape[-1]
        else:
            width = _read(path, ("shapedirs",))["shapedirs"].shape[-1]
    except (AssetError, KeyError, ValueError, IndexError):
        return None  # said when the model is built
    split = family.split(int(width))
    return split[0] if split else None


def read_model(path: Path, family: Family) -> ModelFile:
    """Read an official ``.npz`` or ``.pkl``, or what ``soma backends convert`` writes.

    Raises:
        AssetError: missing, damaged, code in a pickle, another model, or arrays that cannot be a body; the
            text names the key, what it holds and what was expected.
    """
    arrays = _read(path, (*KEYS, *HAND_KEYS, *COMPONENT_KEYS))
    components = [arrays.pop(key, np.zeros(0)).astype(np.float64) for key in COMPONENT_KEYS]
    hands = [arrays.pop(key, np.zeros(0)).astype(np.float64).ravel() for key in HAND_KEYS]
    sound = all(hand.size == 45 and np.isfinite(hand).all() for hand in hands)
    _check_layouts(path, family, arrays)
    values = {
        key: value.astype(np.float64) for key, value in arrays.items() if key not in ("f", "kintree_table")
    }
    for key, value in values.items():
        if not np.isfinite(value).all():
            index = tuple(map(int, np.argwhere(~np.isfinite(value))[0]))
            raise _refused(path, family, f"{key} is {value[index]} at {index}, expected finite numbers")
    faces = arrays["f"].astype(np.int64)
    if faces.min() < 0 or faces.max() >= family.vertex_count:
        strange = faces.min() if faces.min() < 0 else faces.max()
        raise _refused(path, family, f"f refers to vertex {strange} of {family.vertex_count}")
    split = family.split(values["shapedirs"].shape[2])
    assert split is not None
    model = ModelFile(
        family=family,
        path=path,
        template=values["v_template"],
        shapes=values["shapedirs"][:, :, : split[0]],
        expressions=values["shapedirs"][:, :, split[0] :],
        pose_directions=values["posedirs"],
        regressor=values["J_regressor"],
        weights=values["weights"],
        faces=faces,
        mean_hands=np.concatenate(hands) if sound else None,
        hand_components=np.stack(components) if _are_directions(components) else None,
    )
    _check_body(model, arrays["kintree_table"])
    return model


def _are_directions(hands: list[np.ndarray]) -> bool:
    left, right = hands
    shaped = left.ndim == 2 and left.shape == right.shape and 0 < len(left) <= left.shape[1] == 45
    return shaped and all(bool(np.isfinite(hand).all()) for hand in hands)


def _refused(path: Path, family: Family, cause: str) -> AssetError:
    return AssetError(path, cause=cause, fix=f"Get the {family.title} file from {family.url}")


def _read(path: Path, keys: tuple[str, ...]) -> dict[str, np.ndarray]:
    if path.suffix.lower() == ".pkl":
        from soma_core.plugin import read_pickled_arrays

        return read_pickled_arrays(path, keys)
    with open_npz_file(path, fix="Convert the official file with `soma backends convert`.") as file:
        found = {}
        for key in keys:
            if key not in file.names:
                continue
            try:
                found[key] = file.read(key)
            except ValueError as error:
                fix = "Convert the official .pkl with `soma backends convert` instead of this copy."
                raise AssetError(path, cause=f"{key} cannot be read: {error}", fix=fix) from error
        return found


def _check_layouts(path: Path, family: Family, arrays: Mapping[str, np.ndarray]) -> None:
    missing = [key for key in KEYS if key not in arrays]
    if missing:
        raise _refused(path, family, f"has no {', '.join(missing)}, so it is no {family.title} model")
    shape = arrays["v_template"].shape
    if shape != (family.vertex_count, 3):
        cause = f"v_template has the shape {shape}, expected ({family.vertex_count}, 3)"
        raise _refused(path, family, cause + _other(shape[:1], arrays["weights"].shape))
    width = arrays["shapedirs"].shape[-1]
    if arrays["shapedirs"].ndim == 3 and family.split(width) is None:
        widths = " or ".join(map(str, family.expressions or {})) or "1 to 300"
        raise _refused(path, family, f"shapedirs has {width} directions, expected {widths}")
    v, joints = family.vertex_count, family.joint_count
    expected = {
        "shapedirs": (v, 3, width), "posedirs": (v, 3, 9 * (joints - 1)), "J_regressor": (joints, v),
        "weights": (v, joints), "kintree_table": (2, joints), "f": (family.face_count, 3),
    }  # fmt: skip
    for key in ("weights", *expected):
        array = arrays[key]
        if array.shape != expected[key]:
            cause = f"{key} has the shape {array.shape}, expected {expected[key]}"
            raise _refused(path, family, cause + _other(shape[:1], arrays["weights"].shape))
    for key in KEYS:
        kinds = "iu" if key in ("f", "kintree_table") else "f"
        if arrays[key].dtype.kind not in kinds:
            wanted = "whole numbers" if kinds == "iu" else "floating-point numbers"
            raise _refused(path, family, f"{key} holds {arrays[key].dtype}, expected {wanted}")


def _other(vertices: tuple[int, ...], weights: tuple[int, ...]) -> str:
    """Which other model a file of these sizes is."""
    if vertices == (778,):
        return "; it is a MANO hand"
    for family in FAMILIES:
        if (family.vertex_count, family.joint_count) == weights == (*vertices, *weights[1:]):
            return f"; it is {family.title}: use the backend {family.name}"
    return ""


def _check_body(model: ModelFile, kintree: np.ndarray) -> None:
    """Refuse another tree, weights that do not sum to 1, another unit and other axes."""
    path, family = model.path, model.family
    parents = kintree[0].astype(np.int64)[1:]  # the root's is -1, as unsigned 32 bits in some files
    wrong = np.flatnonzero(parents != np.array(family.parents)[1:])
    if len(wrong):
        joint = int(wrong[0]) + 1
        cause = f"kintree_table gives joint {joint} the parent {parents[joint - 1]}"
        raise _refused(path, family, f"{cause}, expected {family.parents[joint]}")
    for key, sums, tolerance in (
        ("weights", model.weights.sum(1), _SUM_TOLERANCE),
        ("J_regressor", model.regressor.sum(1), _REGRESSOR_TOLERANCE),
    ):
        worst = int(np.abs(sums - 1).argmax())
        if abs(sums[worst] - 1) > tolerance:
            raise _refused(path, family, f"row {worst} of {key} sums to {sums[worst]:.6g}, expected 1")
    low, high = _STATURES
    stature = float(np.ptp(model.template[:, 1]))
    if not low <= stature <= high:
        cause = f"v_template is {stature:.4g} tall, expected metres, {low} to {high}, along y"
        raise _refused(path, family, cause)
    joints = model.regressor @ model.template
    up, left = joints[_HEAD] - joints[0], joints[_LEFT_HIP] - joints[_RIGHT_HIP]
    if up[1] < _UPRIGHT * np.linalg.norm(up) or left[0] < _UPRIGHT * np.linalg.norm(left):
        raise _refused(path, family, "v_template does not stand along +y and face +z")
