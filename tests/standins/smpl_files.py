"""Files in the official layouts of SMPL, SMPL-H and SMPL-X, holding a body of this project."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from soma_backend_smpl.family import SMPL, SMPLH, SMPLX, Family

from tests.standins.body import Body, make_body, write_wrap
from tests.standins.pickles import Instance, ch, csc, select, write_pickle

__all__ = [
    "FAMILIES",
    "body_of",
    "smpl_arrays",
    "smpl_model",
    "write_npz",
    "write_smpl_pickle",
    "write_smpl_wrap",
]

FAMILIES = {family.name: family for family in (SMPL, SMPLH, SMPLX)}

_CANONICAL = {
    "pelvis": "Hips", "hip": "Leg", "knee": "Shin", "ankle": "Foot", "foot": "ToeBase", "spine1": "Spine1",
    "spine2": "Spine2", "spine3": "Chest", "neck": "Neck1", "head": "Head", "collar": "Shoulder",
    "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand", "jaw": "Jaw", "eye_smplhf": "Eye",
    "hand": "HandMiddle1",
}  # fmt: skip
_REGRESSOR_VERTICES = 24
_FAR_REACH = 0.05
"""How much a joint's pose blend shapes move distant parts, relative to its own: little, but not nothing."""
_ADULTS = 0.4
"""Part of the spread of the shape space, which goes from newborn to old age."""


def body_of(family: Family) -> Body:
    """The body with the mesh size of `family`."""
    return make_body(family.vertex_count, family.face_count)


def _canonical_name(joint: str) -> str:
    """Name of the canonical joint at the place of a joint of SMPL."""
    side, _, rest = joint.partition("_") if joint.startswith(("left_", "right_")) else ("", "", joint)
    if rest in _CANONICAL:
        return side.capitalize() + _CANONICAL[rest]
    finger, knuckle = rest[:-1].capitalize(), int(rest[-1])
    return f"{side.capitalize()}Hand{finger}{knuckle if finger == 'Thumb' else knuckle + 1}"


@functools.cache
def _skeleton(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Joint regressor (J, v) and skinning weights (v, J): weights of other joints go to the next above."""
    family = FAMILIES[name]
    body = body_of(family)
    places = [body.joint_names.index(_canonical_name(joint)) for joint in family.joint_names]
    regressor = np.zeros((family.joint_count, family.vertex_count))
    for row, place in zip(regressor, places, strict=True):
        distance = np.linalg.norm(body.vertices - body.joints[place], axis=1)
        near = np.argsort(distance)[:_REGRESSOR_VERTICES]
        points = np.concatenate((np.ones((1, len(near))), (body.vertices[near] - body.joints[place]).T))
        row[near] = np.linalg.pinv(points)[:, 0]  # the smallest weights whose mean is the joint itself
    from soma_core.io.joint_order import PARENT_NAMES

    weights = np.zeros((family.vertex_count, family.joint_count))
    column = {body.joint_names[place]: index for index, place in reversed(list(enumerate(places)))}
    for index, joint in enumerate(body.joint_names):
        above = joint
        while above not in column and above in PARENT_NAMES:
            above = PARENT_NAMES[above]
        weights[:, column.get(above, 0)] += body.weights[:, index]
    return regressor, weights / weights.sum(1, keepdims=True)


def smpl_arrays(name: str, *, width: int) -> dict[str, np.ndarray]:
    """The arrays of a model with `width` shape directions, in the dtypes of the official files."""
    family = FAMILIES[name]
    body = body_of(family)
    regressor, weights = _skeleton(name)
    random = np.random.default_rng(0)
    own = len(body.directions)
    mix = random.standard_normal((width, own)) / np.sqrt(own) * (1 / (1 + np.arange(width)))[:, None]
    mix[:own] = np.eye(own)[:width]  # the leading directions are those of the shape space
    directions = _ADULTS * np.einsum("wk,knc->ncw", mix, body.directions)
    poses = 9 * (family.joint_count - 1)
    near = np.full((family.joint_count, family.joint_count - 1), _FAR_REACH)
    for joint, parent in enumerate(family.parents[1:]):
        near[[joint + 1, parent], joint] = 1
    amplitude = 1e-3 * near.repeat(9, 1) * random.standard_normal((family.joint_count, poses))
    correctives = (weights @ amplitude)[:, None] * random.standard_normal((3, poses))
    return {
        "v_template": body.vertices,
        "shapedirs": directions,
        "posedirs": correctives,
        "J_regressor": regressor,
        "weights": weights,
        "kintree_table": np.array([family.parents, range(family.joint_count)], np.int64),
        "f": body.faces.astype(np.uint32),
    }


def smpl_model(arrays: dict[str, np.ndarray], *, chumpy: bool) -> dict[str, object]:
    """What an official pickle holds: sparse regressor, unsigned tree, and chumpy objects in some files."""
    tree = arrays["kintree_table"].astype(np.uint32)  # the root's -1 becomes 2^32 - 1
    wrap = {"v_template": ch, "shapedirs": select, "posedirs": ch} if chumpy else {}
    found: dict[str, object] = {
        key: wrap.get(key, lambda value: value)(value) for key, value in arrays.items()
    }
    return found | {
        "J_regressor": csc(arrays["J_regressor"]), "J_regressor_prior": csc(arrays["J_regressor"]),
        "weights_prior": arrays["weights"], "kintree_table": tree, "bs_style": "lbs", "bs_type": "lrotmin",
        "J": arrays["J_regressor"] @ arrays["v_template"], "vert_sym_idxs": np.arange(10),
        "pose_training_info": {"gender": "x", "extra": Instance("chumpy.ch", "Ch", {"x": np.zeros(2)})},
    }  # fmt: skip


def write_smpl_pickle(
    path: Path, arrays: dict[str, np.ndarray], *, chumpy: bool = True, protocol: int = 2
) -> Path:
    """Write the model as a pickle of Python 2: chumpy as in v1.0.0 and SMPL-H, plain as in v1.1.0."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_pickle(path, smpl_model(arrays, chumpy=chumpy), protocol=protocol)


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """Write the model as an ``.npz`` of SMPL-H or SMPL-X, with the objects that those files hold beside."""
    path.parent.mkdir(parents=True, exist_ok=True)
    extra = {"joint2num": np.array({"Pelvis": 0}, object), "hands_meanl": np.zeros(45)}
    np.savez(path, **arrays, **extra)
    return path


def write_smpl_wrap(root: Path, name: str) -> None:
    """Write the wrap pair of a model, except for its native mesh, which ``soma backends convert`` writes."""
    family = FAMILIES[name]
    write_wrap(root / family.wrap_folder, body_of(family))
