"""Pose from points: what comes back of exact, noisy, wrong and missing ones, in space and in pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from soma_core.evaluation.ground_contact import motion_files
from soma_core.evaluation.random_poses import random_axis_angles
from soma_core.evaluation.report import Figure, Report, Table
from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from soma_core.inversion.point_identity import fit_point_identity
from soma_core.inversion.point_priors import JointPrior
from soma_core.inversion.points import PointInversion
from soma_core.io.camera import Camera
from soma_core.layer import SomaLayer
from soma_core.motion.conversion import load_clip
from soma_core.skeleton.identity import Identity

__all__ = ["run"]

_MM = 1e3
_SECONDS, _WORST = 4, 0.04
"""Length of a clip; share of points that are wrong where some are."""

_NOISE, _PIXEL, _WRONG = 0.01, 1.0, 0.3
"""Standard deviations of noise [m], in pictures [px], and of points that are wrong [m]."""

_TURNED = ("Hips", "Chest", "Head", "LeftHand", "RightHand")
"""Joints that two or more children turn, which do not lie on one line with them."""

_LEAVES = ("Head", "LeftHand", "RightHand", "LeftToeBase", "RightToeBase")
"""Joints of smpl22 that carry none of its points."""

_PEOPLE = {
    "child": {"age": 0.3, "weight": 0.4},
    "woman": {"gender": 1.0, "age": 0.67, "weight": 0.6, "height": 0.4, "proportions": 0.6},
    "tall man": {"gender": 0.0, "age": 0.7, "muscle": 0.7, "height": 0.75, "proportions": 0.4},
}
"""Parameters of the people whose bodies are found; a backend without them has its default body alone."""

_LIMBS = (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("Leg", "Shin"), ("Shin", "Foot"))
_BONES = (
    *((f"{side}{first}", f"{side}{second}") for side in ("Left", "Right") for first, second in _LIMBS),
    ("Hips", "Chest"), ("Chest", "Head"),
)  # fmt: skip
"""Joints whose distances are the lengths of a person's bones."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Clip:
    """A motion near the origin: turns (F, J - 1, 3, 3), path (F, 3) [m], and its body posed so."""

    name: str
    turns: Tensor
    path: Tensor
    fps: float


def _clips(config: DictConfig) -> Iterator[_Clip]:
    """The first seconds of each motion, and of the clip that ships a part without standing still."""
    files = motion_files(config.experiment.data)
    for file in [*files, None]:
        motion = load_clip(file)
        first = 0 if file else 10 * round(motion.fps)
        motion = motion.cut(slice(first, first + _SECONDS * round(motion.fps)))
        path = torch.as_tensor(motion.translation, dtype=torch.float32)
        level = path.mean(0) * torch.tensor([1.0, 0.0, 1.0])
        yield _Clip(
            name=file.stem if file else "range of motion", path=path - level, fps=motion.fps,
            turns=torch.as_tensor(motion.rotations, dtype=torch.float32),
        )  # fmt: skip


def _angles(first: Tensor, second: Tensor) -> Tensor:
    """Angles [degrees] between rotations."""
    trace = (first.mT @ second).diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.acos(((trace - 1) / 2).clamp(-1, 1)).rad2deg()


def _random(like: Tensor, seed: int) -> Tensor:
    return torch.randn(like.shape, generator=torch.Generator().manual_seed(seed)).to(like)


def _exact(layer: SomaLayer, count: int, seed: int) -> list[Figure]:
    """All joints of strong poses."""
    names, body = list(layer.joint_names), layer.identity()
    vectors = random_axis_angles(names, count, np.random.default_rng(seed))
    posed = layer.joints(body, torch.as_tensor(vectors).to(layer.dtype))
    result = PointInversion(layer, "soma77")(posed.joints, body)
    again = layer.joints(body, result.rotations, result.translation)
    parents = layer.rig.parents[2:] - 1
    axes = [
        torch.nn.functional.normalize(one.joints[:, 1:] - one.joints[:, parents], dim=-1)
        for one in (posed, again)
    ]
    bent = 2 * torch.asin(((axes[0] - axes[1]).norm(dim=-1) / 2).clamp_max(1)).rad2deg()
    rows = [names.index(name) for name in _TURNED]
    turned = _angles(posed.transforms[:, 1:, :3, :3], again.transforms[:, 1:, :3, :3])[:, rows]
    off = (posed.joints - again.joints).norm(dim=-1)
    return [
        Figure(name=f"{count} strong poses, all joints, max", value=_MM * float(off.max()), unit="mm",
               bound=0.1),
        Figure(name="their bones, max", value=float(bent.max()), unit="degrees", bound=0.1),
        Figure(name="turns of joints with several children, max", value=float(turned.max()), unit="degrees",
               bound=0.5),
    ]  # fmt: skip


def _off_hinge(layer: SomaLayer, rotations: Tensor) -> Tensor:
    """Angles [degrees] that elbows and knees leave the axis of their hinge by."""
    off = []
    for joint, axis in JointPrior().hinges(layer.rig.joint_names).items():
        own = torch.as_tensor(axis).to(rotations)
        off.append(torch.acos((rotations[:, joint - 1] @ own @ own).clamp(-1, 1)).rad2deg())
    return torch.stack(off)


def _given(layer: SomaLayer, name: str) -> list[int]:
    """Rows of the joints that are points of a set."""
    points = layer.places(name)
    return [row - 1 for row in torch.nonzero(points.joint_weight.sum(0))[:, 0].tolist()]


def _unseen(names: Sequence[str], given: Sequence[int], parents: np.ndarray) -> dict[str, list[int]]:
    """Rows of the joints that are no points, by what tells of them."""
    groups: dict[str, list[int]] = {"between": [], "toes": [], "head": [], "hands": []}
    for row, name in enumerate(names):
        if row in given:
            continue
        below = [child for child in given if parents[child] == row]
        key = "between" if below else "hands" if "Hand" in name else "toes" if "Toe" in name else "head"
        groups[key].append(row)
    return groups


def _joints(layer: SomaLayer, clip: _Clip, seed: int) -> tuple[list[str | float], list[Figure], Tensor]:
    """The 22 joints of smpl22, exact, with noise and with wrong ones; the turns that exact ones tell."""
    body, inversion = layer.identity(), PointInversion(layer, "smpl22")
    posed = layer.joints(body, clip.turns, clip.path)
    points, given = layer.points(posed, "smpl22"), _given(layer, "smpl22")
    names = list(layer.joint_names)
    unseen = _unseen(names, given, layer.rig.parents[1:] - 1)
    others = [row for row in range(len(names)) if row not in given]

    def missed(rotations: Tensor, path: Tensor) -> Tensor:
        return _MM * (layer.joints(body, rotations, path).joints - posed.joints).norm(dim=-1)

    result = inversion(points, body, fps=clip.fps)
    off = missed(result.rotations, result.translation)
    told = [row for row in given if names[row] not in _LEAVES]
    noisy = points + _NOISE * _random(points, seed)
    angles = _angles(inversion(noisy, body, fps=clip.fps).rotations, clip.turns)[:, told]
    wrong = torch.rand(points.shape[:2], generator=torch.Generator().manual_seed(seed)) < _WORST
    wild = torch.where(wrong[..., None], points + _WRONG * _random(points, seed + 1), points)
    mended = inversion(wild, body, fps=clip.fps)
    lost = missed(mended.rotations, mended.translation)[:, given]
    row: list[str | float] = [
        clip.name, float(off[:, given].max()), *(float(off[:, rows].mean()) for rows in unseen.values()),
        float(off[:, others].mean()), float(angles.mean()), float(lost.mean()),
    ]  # fmt: skip
    hinges = float(_off_hinge(layer, result.rotations).max())
    return row, [
        Figure(name=f"{clip.name}: given joints, max", value=float(row[1]), unit="mm", bound=1.0),
        Figure(name=f"{clip.name}: joints between given ones, mean", value=float(row[2]), unit="mm",
               bound=5.0),
        Figure(name=f"{clip.name}: ends of toes, mean", value=float(row[3]), unit="mm", bound=5.0),
        Figure(name=f"{clip.name}: elbows and knees off their hinge, max", value=hinges, unit="degrees",
               bound=10.0),
        Figure(name=f"{clip.name}: {_MM * _NOISE:g} mm of noise, turns of joints that points tell, mean",
               value=float(row[7]), unit="degrees", bound=5.0),
        Figure(name=f"{clip.name}: {100 * _WORST:g} % of points wrong, given joints, mean",
               value=float(row[8]), unit="mm", bound=5.0),
    ], result.rotations  # fmt: skip


def _world(layer: SomaLayer, rotations: Tensor) -> Tensor:
    """Turns (F, J - 1, 3, 3) from the T-pose in the axes of the world."""
    zero = torch.tensor(layer.rig.t_pose_world[1:, :3, :3]).to(rotations)
    return layer.joints(layer.identity(), rotations).transforms[:, 1:, :3, :3] @ zero.mT


def _learned(layer: SomaLayer, clips: Sequence[_Clip], told: Sequence[Tensor]) -> list[list[str | float]]:
    """What is left of head and hands when the other motions teach how they turn, in mm.

    Ridge regression of their turns from those of all joints that points tell, and from where up is; of the
    strengths tried that which is best afterwards, with the fingers as they are: no predictor of this kind
    does better.
    """
    names, body, given = list(layer.joint_names), layer.identity(), _given(layer, "smpl22")
    parents = layer.rig.parents[1:] - 1
    groups = _unseen(names, given, parents)
    leaves = [names.index(name) for name in _LEAVES[:3]]
    seen = [row for row in given if names[row] not in _LEAVES]
    inputs, turns = [], []
    for clip, found in zip(clips, told, strict=True):
        world = _world(layer, found)
        above = world[:, parents[leaves]]
        turns.append(matrix_to_axis_angle(above.mT @ _world(layer, clip.turns)[:, leaves]).flatten(1))
        own = matrix_to_axis_angle(found[:, seen]).flatten(1)
        inputs.append(torch.cat((own, above[..., 1, :].flatten(1), torch.ones_like(own[:, :1])), 1))
    rows: list[list[str | float]] = []
    for place, clip in enumerate(clips):
        others = [k for k in range(len(clips)) if k != place]
        known, taught = (torch.cat([part[k] for k in others]).double() for part in (inputs, turns))
        where = layer.joints(body, clip.turns).joints
        left = []
        for strength in (0.1, 1.0, 10.0, 100.0):
            ridge = torch.diag(torch.tensor([strength] * (known.shape[1] - 1) + [1e-6]).to(known))
            weights = torch.linalg.solve(known.mT @ known + ridge, known.mT @ taught)
            held = told[place].clone()
            held[:, groups["hands"]] = clip.turns[:, groups["hands"]]
            turned = (inputs[place].double() @ weights).to(held).unflatten(1, (-1, 3))
            held[:, leaves] = axis_angle_to_matrix(turned)
            gone = _MM * (layer.joints(body, held).joints - where).norm(dim=-1)
            left.append([float(gone[:, groups[key]].mean()) for key in ("head", "hands")])
        rows.append([clip.name, *np.min(left, axis=0).tolist()])
    return rows


def camera_at(yaw: float, away: float, focal: float) -> Camera:
    """A camera [px] that looks at a person at the origin from a height of 1.3 m."""
    eye = np.array([away * np.sin(yaw), 1.3, away * np.cos(yaw)])
    view = np.array([0.0, 0.9, 0.0]) - eye
    view /= np.linalg.norm(view)
    right = np.cross(view, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    extrinsics = np.eye(4)
    extrinsics[:3, :3] = np.stack([right, np.cross(view, right), view])
    extrinsics[:3, 3] = -extrinsics[:3, :3] @ eye
    lens = np.array([[focal, 0.0, 640.0], [0.0, focal, 640.0], [0.0, 0.0, 1.0]])
    return Camera(intrinsics=lens, extrinsics=extrinsics[None])


def _pictures(layer: SomaLayer, clip: _Clip, seed: int) -> tuple[list[str | float], list[Figure]]:
    """Keypoints of coco17 in one view from in front and one from behind, and in two."""
    body, inversion = layer.identity(), PointInversion(layer, "coco17")
    places = layer.points(layer.pose(body, clip.turns, clip.path), "coco17")
    away = 3.0 + float(clip.path[:, [0, 2]].norm(dim=1).max())

    def seen(points: Tensor, cameras: list[Camera]) -> Tensor:
        pixels = [torch.as_tensor(camera.project(points.cpu().numpy())[0]) for camera in cameras]
        return torch.stack(pixels).to(points)

    def fitted(cameras: list[Camera], noise: float) -> Tensor:
        pixels = seen(places, cameras)
        pixels = pixels + noise * _random(pixels, seed)
        result = inversion(pixels, body, cameras=cameras, fps=clip.fps)
        return layer.points(layer.pose(body, result.rotations, result.translation), "coco17")

    row: list[str | float] = [clip.name]
    for yaw in (0.4, 2.6):
        camera = [camera_at(yaw, away, 320 * away)]
        again = fitted(camera, 0.0)
        row.append(float((seen(again, camera) - seen(places, camera)).norm(dim=-1).mean()))
        row.append(_MM * float((again - places).norm(dim=-1).mean()))
    both = [camera_at(yaw, away, 320 * away) for yaw in (0.0, 1.5)]
    row.append(_MM * float((fitted(both, _PIXEL) - places).norm(dim=-1).mean()))
    return row, [
        Figure(name=f"{clip.name}: one view, exact, reprojection, mean", unit="px", bound=1.0,
               value=max(float(row[1]), float(row[3]))),
        Figure(name=f"{clip.name}: two views, {_PIXEL:g} px of noise, keypoints, mean", value=float(row[5]),
               unit="mm", bound=5.0),
    ]  # fmt: skip


def _people(layer: SomaLayer, seed: int) -> tuple[list[list[str | float]], list[Figure]]:
    """Bodies of people from 17 noisy joints in 60 frames."""
    motion = load_clip()
    some = np.linspace(0, motion.frame_count - 1, 60).astype(int)
    turns, path = torch.as_tensor(motion.rotations[some]), torch.as_tensor(motion.translation[some])
    known = {parameter.name for parameter in layer.spec.params}
    still = turns.new_zeros(1, len(layer.joint_names), 3)
    rows: list[list[str | float]] = []
    for name, params in _PEOPLE.items():
        body = layer.identity({key: value for key, value in params.items() if key in known})
        for points in ("coco17", "h36m17"):
            places = layer.points(layer.pose(body, turns, path), points)
            noisy = places + _NOISE * _random(places, seed)
            found = fit_point_identity(PointInversion(layer, points), noisy).identity
            lengths, heights = zip(*(_lengths(layer, one, still) for one in (body, found)), strict=True)
            off = (lengths[0] - lengths[1]).abs()
            stature = _MM * abs(heights[0] - heights[1])
            rows.append([f"{name}, {points}", _MM * heights[0], _MM * float(off.max()), stature])
    return rows, [
        Figure(name="unknown bodies: lengths of bones, max", value=max(float(row[2]) for row in rows),
               unit="mm", bound=10.0),
        Figure(name="unknown bodies: stature, max", value=max(float(row[3]) for row in rows), unit="mm",
               bound=15.0),
    ]  # fmt: skip


def _lengths(layer: SomaLayer, body: Identity, still: Tensor) -> tuple[Tensor, float]:
    """Lengths of bones, and the stature [m], at the T-pose."""
    posed = layer.pose(body, still)
    row = {name: place for place, name in enumerate(layer.joint_names)}
    bones = [posed.joints[0, row[first]] - posed.joints[0, row[second]] for first, second in _BONES]
    height = posed.vertices[0, :, 1]
    return torch.stack(bones).norm(dim=-1), float(height.max() - height.min())


@torch.no_grad()
def run(config: DictConfig) -> Report:
    """Fit points of random poses, of motions, of pictures, and of people whose bodies are not known.

    Raises:
        SomaError: a motion or the backend cannot be used.
    """
    layer = SomaLayer("soma", lod="low", device=config.device)
    figures = _exact(layer, config.experiment.count, config.seed)
    joints: list[list[str | float]] = []
    pictures: list[list[str | float]] = []
    clips, told = list(_clips(config)), []
    for clip in clips:
        row, found, turns = _joints(layer, clip, config.seed)
        joints.append(row)
        figures += found
        told.append(turns)
        row, found = _pictures(layer, clip, config.seed)
        pictures.append(row)
        figures += found
    taught = _learned(layer, clips, told) if len(clips) > 1 else []
    other = SomaLayer(config.experiment.backend, lod="low", device=config.device)
    people, found = _people(other, config.seed)
    tables = [
        Table(title="22 joints of smpl22, mm", rows=joints, columns=(
            "motion", "given, max", "between given ones, mean", "ends of toes", "head", "hands", "all unseen",
            "degrees, 10 mm of noise", "given, 4 % wrong")),
        Table(title="Head and hands as the other motions teach, fingers as they are, mm", rows=taught,
              columns=("motion", "head", "hands")),
        Table(title="17 keypoints of coco17 in pictures", rows=pictures, columns=(
            "motion", "px, from in front", "mm", "px, from behind", "mm", "two views, 1 px of noise: mm")),
        Table(title="Bodies from 60 frames with 10 mm of noise, mm", rows=people, columns=(
            "person, points", "stature", "bones, max", "stature, off by")),
    ]  # fmt: skip
    notes = [
        "Nothing in 22 joints tells how head and wrists turn: the second table is what the best linear "
        "predictor of these turns leaves. A single view leaves depth to what is expected of a person. A "
        "wrong point is off by 0.3 m along each axis, in the standard deviation. What is expected at rest "
        "was rounded from these motions."
    ]
    return Report(title="Pose from points", figures=[*figures, *found], tables=tables, notes=notes)
