"""Angles of pose inversion: plain skinning comes back, wrong fits are caught, measures know the truth."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from soma_core.evaluation import (
    anny_rig,
    joint_turns,
    pose_angle_fits,
    pose_angle_foreign,
    pose_angle_noise,
    pose_angles,
)
from soma_core.evaluation.joint_turns import angles_between
from soma_core.evaluation.pose_angle_fits import Fit, finger_joints, own_fit
from soma_core.evaluation.pose_angle_meshes import (
    BODIES,
    LIMITS,
    named_poses,
    rotation_matrices,
    strong_poses,
)
from soma_core.evaluation.random_poses import joint_spread
from soma_core.evaluation.shipped_layers import LAYERS, default_layer, layer_label, plain_layer
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import PoseInversion
from soma_core.inversion.priors import HINGES
from soma_core.layer import SomaLayer
from soma_core.paths import assets_dir

FRAMES = 2
GRADIENT = 1e-4
"""Relative: what the tolerance of a fit leaves of a gradient in float64."""


@pytest.fixture(scope="module")
def layer():
    return plain_layer("soma", lod="low")


@pytest.fixture(autouse=True)
def native_only(monkeypatch):
    """One native body in place of four, so that a piece takes seconds and needs no plugin."""
    monkeypatch.setattr(pose_angle_noise, "_FEW", BODIES[:1])
    monkeypatch.setattr(pose_angle_fits, "BODIES", BODIES[:1])


def values(piece):
    return {figure.name.partition(", ")[2]: figure for figure in piece.figures}


def test_the_layers_are_the_shipped_one_and_plain_skinning():
    made = {name: make("soma", lod="low") for name, make in LAYERS.items()}
    shipped = SomaLayer("soma", lod="low")
    assert list(made) == ["default", "plain"]
    assert {name: layer_label(layer) for name, layer in made.items()} == {n: n for n in made}
    assert repr(made["default"]) == repr(shipped)
    assert made["plain"].plain


def test_poses_are_what_their_names_say(layer):
    names = list(layer.joint_names)
    poses = named_poses(layer, 5, np.random.default_rng(0))
    assert not poses["T-pose"].any()
    turned = poses["left hand turned by 180 degrees"][0]
    assert np.flatnonzero(turned.any(axis=1)).tolist() == [names.index("LeftHand")]
    assert np.degrees(np.linalg.norm(turned, axis=1).max()) == pytest.approx(180)

    def joint(name, pose):
        rotations = rotation_matrices(poses[pose], layer)
        return layer.pose(layer.identity(), rotations).joints[:, names.index(name)].numpy()

    down = joint("LeftHand", "arms straight down") - joint("LeftArm", "arms straight down")
    assert down[0, 1] / np.linalg.norm(down) < -0.99
    hinged = "elbows and knees as hinges"
    for name in ("LeftHand", "RightHand"):
        reach = joint(name, hinged)[:, 2]
        assert reach[2] > reach[0] + 0.1, "elbows bend forward"
    for name in ("LeftFoot", "RightFoot"):
        back = joint(name, hinged)[:, 2]
        assert back[2] < back[0] - 0.2, "knees bend backward"
    assert joint("Head", "upside down")[0, 1] < joint("Hips", "upside down")[0, 1]
    fist = joint("LeftHandMiddleEnd", "curled fists") - joint("LeftHand", "curled fists")
    flat = joint("LeftHandMiddleEnd", "T-pose") - joint("LeftHand", "T-pose")
    assert np.linalg.norm(fist) < 0.6 * np.linalg.norm(flat)


@pytest.mark.parametrize("limit", LIMITS)
def test_strong_poses_are_cut_and_fingers_keep_their_spread(layer, limit):
    vectors = strong_poses(layer, 50, limit, np.random.default_rng(0))
    length = np.linalg.norm(vectors, axis=-1)
    assert length.max() <= limit + 1e-12
    assert np.median(length.max(axis=1)) > limit - 1e-9
    spread = joint_spread(layer.joint_names)
    finger = list(layer.joint_names).index("LeftHandIndex2")
    assert 2 * spread[finger] < vectors[:, finger].std() < 3 * spread[finger]
    assert not vectors[:, spread == 0].any()


def test_exact_targets_come_back_through_plain_skinning():
    piece = pose_angles.exact_poses(plain_layer, FRAMES, 0, "low")
    assert piece.layer == "plain"
    assert all(figure.passed for figure in piece.figures), pose_angles.show(piece)
    assert [row[0] for row in piece.table.rows][:3] == ["all", BODIES[0].name, "T-pose"]
    assert all(figure.bound is None for figure in piece.without_bounds().figures)


def test_a_fit_that_says_converged_and_is_not_there_is_counted():
    def early(layer, **options):
        return PoseInversion(layer, iterations=1, tolerance=1e9, **options)

    piece = pose_angles.strong_random_poses(plain_layer, FRAMES, 0, "low", invert=early)
    wrong, missed = values(piece)["strong random poses, converged but wrong"], piece.figures[0]
    assert wrong.value == FRAMES * len(LIMITS)
    assert missed.value == 100
    assert not wrong.passed
    assert not missed.passed


def test_the_default_is_measured_through_the_full_model():
    piece = pose_angles.strong_random_poses(default_layer, 1, 0, "low")
    assert piece.layer == "default"
    assert piece.table.rows[0][1:3] == ("default", len(LIMITS))


def test_a_wrong_frame_needs_both_the_flag_and_the_angle():
    angles = np.array([[0.1, 3.0], [0.1, 3.0], [0.1, 0.2]])
    fit = Fit(
        mean_mm=np.zeros(3), max_mm=np.zeros(3), angles=angles, joints=("LeftHand", "LeftHandIndex2"),
        converged=np.array([True, False, True]), plain=np.zeros(3, bool), seconds=1.0,
    )  # fmt: skip
    assert fit.wrong == 1
    assert fit.of(finger_joints).tolist() == [[3.0], [3.0], [0.2]]
    assert fit.row("x", "plain")[8] == "LeftHandIndex2"
    assert Fit.joined([fit, fit.part(slice(0, 1))]).wrong == 2


def test_noise_of_recorded_motions(monkeypatch, tmp_path):
    (tmp_path / "motions").mkdir()
    shutil.copy(assets_dir() / "motions/range_of_motion.npz", tmp_path / "motions/one.npz")
    monkeypatch.setenv("SOMA_TEST_DATA", str(tmp_path))
    piece = pose_angle_noise.noisy_targets(plain_layer, FRAMES, 0, "low")
    rows = {row[0]: row[2] for row in piece.table.rows}
    assert rows["recorded motions, noise of 5 mm"] == FRAMES
    found = values(piece)
    noisy = [found[f"recorded motions, noise of {mm} mm, body joints, mean angle"] for mm in (5, 20)]
    assert [one.bound for one in noisy] == [2, 6]
    assert 0.3 < noisy[0].value < noisy[1].value


def test_noise_outliers_and_gaps(monkeypatch):
    monkeypatch.delenv("SOMA_TEST_DATA", raising=False)
    piece = pose_angle_noise.noisy_targets(plain_layer, FRAMES, 0, "low")
    assert [row[0] for row in piece.table.rows] == [
        "noise of 5 mm", "noise of 20 mm", "outliers, robust", "30 % missing",
    ]  # fmt: skip
    found = values(piece)
    assert 0.3 < found["noise of 5 mm, body joints, mean angle"].value < 2
    assert found["30 % missing, max angle"].passed
    assert found["30 % missing, not converged"].passed


def test_the_claimed_spread_is_held_against_draws(monkeypatch):
    class Claiming:
        """A result that claims one degree of every joint."""

        def __init__(self, result):
            self.result, self.angle_std = result, torch.ones(result.rotations.shape[:2])

    real = pose_angle_fits.fit_frames

    def claiming(*args, **options):
        fit = real(*args, **options)
        return replace(fit, result=Claiming(fit.result))

    monkeypatch.setattr(pose_angle_noise, "fit_frames", claiming)
    piece = pose_angle_noise.claimed_spread(plain_layer, FRAMES, 0, "low")
    for _, _, found, claimed, ratio in piece.table.rows:
        assert claimed == 1
        assert ratio == found
    assert piece.figures[0].value == pytest.approx(np.median([row[2] for row in piece.table.rows]))


def test_gradients_of_plain_skinning_are_those_of_the_inverse():
    piece = pose_angle_noise.gradients(plain_layer, 1, 0, "low")
    assert piece.figures[0].value < GRADIENT


def test_world_turns_are_those_of_the_posed_joints(layer):
    rotations = rotation_matrices(strong_poses(layer, 3, 3.1, np.random.default_rng(1)), layer)
    posed = layer.pose(layer.identity(), rotations).transforms[:, 1:, :3, :3].double()
    t_pose = torch.tensor(layer.rig.t_pose_world[1:, :3, :3])
    turns = joint_turns.world_turns(layer, rotations)
    assert angles_between(turns, posed @ t_pose.mT).max() < 0.1  # degrees; float32 down a chain


def test_a_turn_that_no_bone_made_is_found(layer):
    names = tuple(sorted({bone for bones in anny_rig.BONES_OF.values() for bone in bones}))
    clip = anny_rig.AnnyClip(
        vertices=torch.zeros(2, 1, 3), bones=torch.eye(3).repeat(2, len(names), 1, 1), names=names,
        bent=np.empty(0),
    )  # fmt: skip
    fit = own_fit(PoseInversion(layer), BODIES[0], np.zeros((2, 77, 3)), np.random.default_rng(0))
    rotations = fit.result.rotations.clone()
    joint = layer.joint_names.index("RightForeArm")
    rotations[1, joint] @= axis_angle_to_matrix(torch.tensor([np.radians(40.0), 0, 0]).float())
    excess = joint_turns.turn_excess(layer, rotations, joint_turns.bone_turns(clip))
    assert excess.joint in ("RightForeArm", "RightHand")
    assert excess.excess == pytest.approx(40, abs=0.1)
    assert excess.true == 0


@pytest.mark.slow
def test_annys_own_rig_through_plain_skinning(monkeypatch):
    pytest.importorskip("anny")
    pytest.importorskip("soma_backend_anny")
    one = {"tall woman": pose_angle_foreign.ANNY_BODIES["tall woman"]}
    monkeypatch.setattr(pose_angle_foreign, "ANNY_BODIES", one)
    monkeypatch.setattr(pose_angle_foreign, "_CLIP", 8)
    motions = pose_angle_foreign.anny_rig_motions(plain_layer, 4, 0, "low")
    assert values(motions)["Anny's own rig, mean over that of plain skinning, worst body"].value == 0
    assert values(motions)["Anny's own rig, not converged"].value == 0
    hinges = pose_angle_foreign.anny_rig_hinges(plain_layer, 6, 0, "low")
    assert hinges.figures[0].passed, pose_angles.show(hinges)
    assert len(hinges.table.rows) == len(HINGES)


@pytest.mark.slow
def test_the_report_lays_both_layers_side_by_side(monkeypatch):
    monkeypatch.setattr(pose_angles, "PIECES", {"gradients": pose_angle_noise.gradients})
    monkeypatch.setattr(pose_angle_noise, "_GRADIENT_FRAMES", 1)
    report = pose_angles.run(
        OmegaConf.create({"experiment": {"name": "pose_angles", "count": 1}, "seed": 0, "device": "cpu"})
    )
    assert [row[1] for row in report.tables[0].rows] == ["default", "plain"]
    assert [figure.bound is None for figure in report.figures] == [False, True]
