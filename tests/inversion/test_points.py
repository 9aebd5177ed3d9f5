"""Pose from points: exact ones come back, noise is told, what they leave open is as expected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from soma_core import SomaLayer
from soma_core.errors import InputError
from soma_core.evaluation.random_poses import random_axis_angles
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import point_fit, point_rows
from soma_core.inversion.point_priors import JointPrior, JointRange
from soma_core.inversion.points import PointInversion
from soma_core.io.camera import Camera
from soma_core.motion import load_clip
from soma_core.points.point_set import Point, PointSet
from tests.bodies import randn

EXACT = 1e-4
"""Largest distance of an exact point after the fit [m]: the acceptance bound of joints."""

LAYER = SomaLayer("soma", lod="low")
IDENTITY = LAYER.identity()
NAMES = list(LAYER.joint_names)


def _poses(count: int, seed: int = 0) -> Tensor:
    return torch.as_tensor(random_axis_angles(NAMES, count, np.random.default_rng(seed))).float()


def _angle(first: Tensor, second: Tensor) -> Tensor:
    turn = first.mT @ second
    return torch.rad2deg(torch.acos(((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)))


def _axes(posed, identity=IDENTITY) -> tuple[Tensor, Tensor]:
    """Places of all joints, and unit axes of all bones."""
    places = posed.transforms[:, 1:, :3, 3]
    bones = places[:, 1:] - places[:, LAYER.rig.parents[2:] - 1]
    return places, torch.nn.functional.normalize(bones, dim=-1)


@pytest.mark.parametrize("kernels", ["auto", "torch"])
def test_all_joints_come_back(kernels: str) -> None:
    count = 64 if kernels == "auto" else 4
    posed = LAYER.joints(IDENTITY, _poses(count), randn(count, 3).float())
    result = PointInversion(LAYER, "soma77", kernels=kernels)(posed.joints, IDENTITY)
    again = LAYER.joints(IDENTITY, result.rotations, result.translation)
    (places, bones), (found, turned) = _axes(posed), _axes(again)
    assert (places - found).norm(dim=-1).max() < EXACT
    assert torch.rad2deg((bones - turned).norm(dim=-1)).max() < 0.1
    # Joints whose turn two or more children determine, that do not lie on one line.
    joints = [NAMES.index(name) for name in ("Hips", "Chest", "Head", "LeftHand", "RightHand")]
    off = _angle(posed.transforms[:, 1:, :3, :3], again.transforms[:, 1:, :3, :3])[:, joints]
    assert off.max() < 0.5
    assert result.noise < 1e-4
    assert bool(result.valid.all())
    assert bool(result.converged.all())


def test_noise_is_told_and_its_angles_claimed() -> None:
    count, noise = 128, 0.01
    rest, pull = (torch.as_tensor(one[1:]) for one in JointPrior().of(LAYER.rig.joint_names))
    stiffness = pull.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * torch.eye(3) - pull
    spread = torch.linalg.cholesky(torch.linalg.inv(stiffness + 1e-6 * torch.eye(3)))
    vectors = (spread @ randn(count, 77, 3)[..., None]).squeeze(-1)
    vectors[:, stiffness.diagonal(dim1=-2, dim2=-1).sum(-1) < 1e-3] = 0  # nothing is expected of the Hips
    hinges = [row - 1 for row in JointPrior().hinges(LAYER.rig.joint_names)]
    vectors[:, hinges] *= 0.5  # no limb bends backwards
    truth = (rest @ axis_angle_to_matrix(vectors)).float()
    posed = LAYER.joints(IDENTITY, truth)
    seen = posed.joints + noise * randn(*posed.joints.shape, seed=1, dtype=torch.float32)
    result = PointInversion(LAYER, "soma77")(seen, IDENTITY)
    assert result.noise == pytest.approx(noise, rel=0.1)
    body = [NAMES.index(name) for name in ("Hips", "LeftArm", "LeftLeg", "Neck1", "Chest", "RightHand")]
    off, claimed = _angle(result.rotations, truth)[:, body], result.angle_std[:, body]
    ratio = off.square().mean(0).sqrt() / claimed.square().mean(0).sqrt()
    assert bool(((ratio > 0.7) & (ratio < 1.4)).all())


def test_gaps_weights_and_single_frames_change_no_other() -> None:
    posed = LAYER.joints(IDENTITY, 0.5 * _poses(6, 2))
    inversion = PointInversion(LAYER, "humanml3d22", noise=1e-3)
    points = LAYER.points(posed, "humanml3d22")
    whole = inversion(points, IDENTITY)
    gaps = points.clone()
    gaps[1, 4], gaps[2, 5:] = torch.nan, torch.nan
    gaps[3, 2:] = torch.nan
    result = inversion(gaps, IDENTITY)
    assert result.valid.tolist() == [True, True, True, False, True, True]
    assert torch.isnan(result.point_error[1, 4])
    assert torch.isnan(result.residual[3])
    same = [0, 4, 5]
    assert _angle(result.rotations[same], whole.rotations[same]).max() < 0.2
    # A point of no weight may be anywhere.
    wild, weights = points.clone(), torch.ones(22)
    wild[:, 7], weights[7] = 30.0, 0.0
    assert (inversion(wild, IDENTITY, weights=weights).point_error[:, :7]).max() < 1e-3


def test_two_threads_find_what_one_finds() -> None:
    """To the bit, where frames are shared out between them."""
    inversion, many = PointInversion(LAYER, "smpl22"), 2 * point_fit.SEVERAL + 19
    points = LAYER.points(LAYER.joints(IDENTITY, _poses(many)), "smpl22")
    points = points + 0.01 * randn(*points.shape, seed=3).float()
    before, found = torch.get_num_threads(), []
    for count in (1, 2):
        torch.set_num_threads(count)
        found.append(inversion(points, IDENTITY))
    torch.set_num_threads(before)
    for name, value in vars(found[0]).items():
        theirs = getattr(found[1], name)
        assert torch.equal(value, theirs) if isinstance(value, Tensor) else value == theirs, name


def test_what_points_leave_open_is_as_expected() -> None:
    expected = JointRange(rest=(20.0, 0.0, 0.0), spread=(5.0, 5.0))
    prior = JointPrior(ranges={**JointPrior().ranges, "LeftHand": expected})
    posed = LAYER.joints(IDENTITY, 0.5 * _poses(3, 3))
    result = PointInversion(LAYER, "humanml3d22", prior=prior)(LAYER.points(posed, "humanml3d22"), IDENTITY)
    hand = NAMES.index("LeftHand")
    angle = _angle(result.rotations[:, hand], torch.eye(3).expand(3, 3, 3))
    torch.testing.assert_close(angle, torch.full((3,), 20.0), atol=0.1, rtol=0)
    assert not bool(result.determined[:, hand].any())
    torch.testing.assert_close(result.angle_std[:, hand], torch.full((3,), 5.0 * 3**0.5), atol=0.1, rtol=0)


def test_points_of_the_skin_are_those_of_the_whole_model() -> None:
    ids = np.linspace(0, 4504, 150).astype(int)
    points = PointSet(name="skin", points={str(i): Point(vertices={int(i): 1.0}) for i in ids})
    posed = LAYER.pose(IDENTITY, 0.3 * _poses(8, 4))
    result = PointInversion(LAYER, points)(LAYER.points(posed, points), IDENTITY)
    again = LAYER.pose(IDENTITY, result.rotations, result.translation)
    assert (LAYER.points(again, points) - LAYER.points(posed, points)).norm(dim=-1).mean() < 5e-4


def test_other_bodies_and_bone_lengths() -> None:
    count = 3
    scale = 1 + 0.2 * torch.tanh(randn(1, 77, dtype=torch.float32))
    posed = LAYER.joints(IDENTITY, 0.5 * _poses(count, 5), bone_scale=scale)
    result = PointInversion(LAYER, "soma77")(posed.joints, IDENTITY, bone_scale=scale)
    assert result.point_error.max() < EXACT
    without = PointInversion(LAYER, "soma77")(posed.joints, IDENTITY)
    assert without.noise > 1e-3


def test_freedom_that_points_take_up_is_told_in_single_precision() -> None:
    clip, taken = load_clip(), []
    turns = torch.as_tensor(clip.rotations[::97])
    for dtype in (torch.float32, torch.float64):
        layer = SomaLayer("soma", lod="low", dtype=dtype)
        model = PointInversion(layer, "soma77", kernels="torch").model
        points = layer.joints(layer.identity(), turns.to(dtype)).joints
        rows = point_rows.rows_of(points, points.new_ones(1, 77), 3e-4)
        fit = point_rows.PointRows(model, model.rest(layer.identity()), rows, smooth=None)
        taken.append(fit.taken(model.pose(turns.to(dtype), points.new_zeros(len(points), 3))).double())
    torch.testing.assert_close(*taken, atol=0.1, rtol=0)


def test_no_frames_are_none() -> None:
    for name in ("smpl22", "coco17"):
        inversion = PointInversion(LAYER, name)
        result = inversion(torch.zeros(0, len(inversion.points), 3), IDENTITY)
        assert result.rotations.shape == (0, 77, 3, 3)
        assert result.point_error.shape == (0, len(inversion.points))


def test_joints_without_points_keep_the_turns_they_began_with() -> None:
    turns = axis_angle_to_matrix(0.5 * _poses(4, 6))
    points, inversion = LAYER.points(LAYER.joints(IDENTITY, turns), "smpl22"), PointInversion(LAYER, "smpl22")
    first = inversion(points, IDENTITY)
    hands = [row for row, name in enumerate(NAMES) if "HandIndex" in name]
    begun = replace(first, rotations=first.rotations.index_copy(1, torch.tensor(hands), turns[:, hands]))
    for fps in (None, 30.0):
        again = inversion(points, IDENTITY, initial=begun, fps=fps)
        assert torch.equal(again.rotations[:, hands], turns[:, hands])


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (torch.zeros(2, 21, 3), r"\(2, 21, 3\)"),
        (torch.zeros(2, 22, 3, dtype=torch.int64), "int64"),
        (np.zeros((2, 22, 3)), "ndarray"),
    ],
)
def test_what_is_no_points_is_refused(points: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        PointInversion(LAYER, "humanml3d22")(points, IDENTITY)


def test_another_unit_is_refused_with_its_factor() -> None:
    points = LAYER.points(LAYER.joints(IDENTITY, _poses(2)), "humanml3d22")
    with pytest.raises(InputError, match=r"Multiply the points by 0\.01"):
        PointInversion(LAYER, "humanml3d22")(100 * points, IDENTITY)


def _camera(yaw: float, away: float = 4.0) -> Camera:
    """A camera that stands at a height of 1.3 m and looks at the body."""
    eye = np.array([away * np.sin(yaw), 1.3, away * np.cos(yaw)])
    view = (np.array([0.0, 0.9, 0.0]) - eye) / away
    view /= np.linalg.norm(view)
    right = np.cross(view, [0, 1, 0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(view, right), view])
    extrinsics = np.eye(4)
    extrinsics[:3, :3], extrinsics[:3, 3] = turn, -turn @ eye
    lens = np.array([[1200.0, 0, 640], [0, 1200, 640], [0, 0, 1]])
    return Camera(intrinsics=lens, extrinsics=extrinsics[None])


def _seen(points: Tensor, *cameras: Camera) -> Tensor:
    return torch.stack([torch.as_tensor(camera.project(points.numpy())[0]) for camera in cameras])


def _walk() -> tuple[Tensor, float]:
    """Points of a person who moves, (F, 17, 3) [m]."""
    clip = load_clip().cut(slice(300, 324))
    posed = LAYER.pose(IDENTITY, torch.as_tensor(clip.rotations), torch.as_tensor(clip.translation))
    return LAYER.points(posed, "coco17"), clip.fps


@pytest.mark.parametrize("yaw", [0.4, 2.6])
def test_one_view_is_met(yaw: float) -> None:
    points, fps = _walk()
    camera = _camera(yaw)
    seen = _seen(points, camera)
    result = PointInversion(LAYER, "coco17")(seen[0], IDENTITY, cameras=camera, fps=fps)
    again = LAYER.points(LAYER.pose(IDENTITY, result.rotations, result.translation), "coco17")
    missed = (_seen(again, camera) - seen).norm(dim=-1)
    assert missed.mean() < 1  # px: the acceptance bound
    torch.testing.assert_close(result.point_error.nanmean(), missed.mean(), atol=0.2, rtol=0)
    assert (again - points).norm(dim=-1).mean() < 0.08  # one view leaves the depth to what is expected [m]
    assert bool(result.valid.all())


def test_two_views_are_met_with_noise_and_gaps() -> None:
    points, fps = _walk()
    cameras = _camera(0.0), _camera(1.5)
    seen = _seen(points, *cameras)
    seen = seen + randn(*seen.shape, dtype=torch.float32)
    seen[0, 5, 3:9], seen[:, 20] = torch.nan, torch.nan
    inversion = PointInversion(LAYER, "coco17")
    result = inversion(seen, IDENTITY, cameras=cameras, fps=fps)
    again = LAYER.points(LAYER.pose(IDENTITY, result.rotations, result.translation), "coco17")
    assert (again - points).norm(dim=-1).mean() < 0.005  # m: the acceptance bound
    assert result.noise == pytest.approx(1, rel=0.3)
    assert result.valid.tolist() == [frame != 20 for frame in range(len(points))]
    scale = inversion.bone_scale(seen, IDENTITY, cameras=cameras)
    assert scale[0, NAMES.index("LeftShin")] == pytest.approx(1, abs=0.02)


def test_frames_of_a_view_that_are_apart() -> None:
    points, _ = _walk()
    seen = _seen(points[::8], _camera(0.4))[0]
    result = PointInversion(LAYER, "coco17", noise=0.5)(seen, IDENTITY, cameras=_camera(0.4))
    assert result.point_error.mean() < 1
    alone = PointInversion(LAYER, "coco17", noise=0.5)(seen[2:3], IDENTITY, cameras=_camera(0.4))
    torch.testing.assert_close(alone.rotations[0], result.rotations[2], atol=1e-2, rtol=0)


@pytest.mark.parametrize(
    ("shape", "cameras", "said"),
    [
        ((1, 4, 17, 2), 2, r"\(1, 4, 17, 2\).*2, frames, 17, 2"),
        ((4, 17, 3), 1, r"\(1, 4, 17, 3\)"),
        ((2, 4, 17, 2), 3, "as many cameras as views"),
    ],
)
def test_views_that_do_not_fit_the_cameras_are_refused(shape, cameras: int, said: str) -> None:
    given = [_camera(0.3 * number) for number in range(cameras)]
    with pytest.raises(InputError, match=said):
        PointInversion(LAYER, "coco17")(torch.zeros(shape), IDENTITY, cameras=given)


def test_cameras_in_millimetres_are_told() -> None:
    points, fps = _walk()
    cameras = _camera(0.0), _camera(1.5)
    far = [replace(c, extrinsics=c.extrinsics * [1, 1, 1, 1000]) for c in cameras]
    with pytest.raises(InputError, match=r"translations of the cameras by 0\.001"):
        PointInversion(LAYER, "coco17")(_seen(points, *cameras), IDENTITY, cameras=far, fps=fps)


def test_points_that_are_none_of_the_body_are_left_out() -> None:
    points, fps = _walk()
    seen, random = points.clone(), torch.Generator().manual_seed(3)
    wrong = torch.rand(seen.shape[:2], generator=random) < 0.04
    seen[wrong] += 0.4 * torch.randn(int(wrong.sum()), 3, generator=random)
    inversion = PointInversion(LAYER, "coco17")
    result = inversion(seen, IDENTITY, fps=fps)
    again = LAYER.points(LAYER.pose(IDENTITY, result.rotations, result.translation), "coco17")
    missed = (again - points).norm(dim=-1)
    assert missed.mean() < 0.005
    assert missed[wrong].mean() < 0.03  # between frames before and after [m]
    cameras = _camera(0.0), _camera(1.5)
    pixels = _seen(points, *cameras)
    pixels[0, 7, 9], pixels[1, 12, 3] = pixels[0, 7, 9] + 200, pixels[1, 12, 3] - 150
    result = inversion(pixels, IDENTITY, cameras=cameras, fps=fps)
    again = LAYER.points(LAYER.pose(IDENTITY, result.rotations, result.translation), "coco17")
    assert (again - points).norm(dim=-1).max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("fps", "views"), [(None, 0), (30.0, 0), (30.0, 2)])
def test_gradients_are_those_of_the_fit(
    monkeypatch: pytest.MonkeyPatch, fps: float | None, views: int
) -> None:
    for module, name, value in ((point_fit, "_STILL", 1e-9), (point_rows, "_RESTING", 1e-14)):
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(point_rows, "_STEPS", 200)  # differences of fits need them at rest
    layer = SomaLayer("soma", lod="low", dtype=torch.float64)
    body, clip = layer.identity(), load_clip().cut(slice(300, 306))
    turns, path = (torch.as_tensor(one).double() for one in (clip.rotations, clip.translation))
    points = layer.points(layer.joints(body, turns, path), "smpl22")
    points = points + 0.01 * randn(*points.shape)
    cameras = [_camera(0.0), _camera(1.5)] if views else None
    if cameras is not None:
        points = _seen(points, *cameras).double()
    inversion = PointInversion(layer, "smpl22", noise=3.0 if views else 0.01, iterations=100)
    by = randn(6, 77, 3, 3, seed=1)

    def told(given: Tensor) -> Tensor:
        found = inversion(given, body, fps=fps, cameras=cameras)
        return (found.rotations * by).sum() + found.translation.sum()

    leaf, way = points.clone().requires_grad_(), randn(*points.shape, seed=2)
    (slope,) = torch.autograd.grad(told(leaf), leaf)
    step = 1e-1 if views else 1e-4  # px, m
    measured = (told(points + step * way) - told(points - step * way)) / (2 * step)
    torch.testing.assert_close((slope * way).sum(), measured, rtol=2e-3, atol=1e-3)


def test_turns_that_points_leave_open_arrive_where_they_are_cheapest():
    points = LAYER.points(LAYER.joints(IDENTITY, _poses(64)), "smpl22")
    inversion = PointInversion(LAYER, "smpl22", noise=3e-4)
    found = inversion(points, IDENTITY)
    again = inversion(points, IDENTITY, initial=found)
    assert _angle(found.rotations, again.rotations).amax(1).quantile(0.9) < 1


def test_collar_bones_rest_as_the_trunk_of_the_motion_does():
    clip = load_clip().cut(slice(300, 360))  # whose trunk and collar bones rest near the T-pose
    turns, path = (torch.as_tensor(one).float() for one in (clip.rotations, clip.translation))
    points = LAYER.points(LAYER.joints(IDENTITY, turns, path), "smpl22")
    found = PointInversion(LAYER, "smpl22")(points + 0.01 * randn(*points.shape).float(), IDENTITY, fps=30)
    collars = [NAMES.index("LeftShoulder"), NAMES.index("RightShoulder")]
    assert _angle(found.rotations, turns)[:, collars].mean() < 6
