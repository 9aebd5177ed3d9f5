"""Pose inversion as users call it: exact where it can be, flagged where it cannot, each frame on its own."""

import threading
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from soma_core.errors import InputError
from soma_core.evaluation.random_poses import joint_spread, smooth_axis_angles
from soma_core.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, orthonormality_error
from soma_core.inversion import PoseInversion, fit
from soma_core.io import read_motion
from soma_core.layer import SomaLayer
from soma_core.paths import assets_dir
from tests.bodies import LinearBody, randn, tiny_canonical, tiny_registry

MEAN_MM, MAX_MM, ANGLE_DEG = 0.01, 0.2, 0.1
"""Promised where an exact solution exists."""
MOVED = 50
"""A joint whose angle is promised moves at least so many vertices."""
NOISE_M, NOISE_RATIO = 0.005, 1.05
"""Under noise the residual stays within 5 % of the least possible."""
SEPARATE_M = 1e-5
"""Promised between a whole sequence and its chunks, and between the two kinds of kernels."""
PI = np.pi


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low", procedural=False)


@pytest.fixture(scope="module")
def identity(layer):
    return layer.identity({"shape": randn(1, 16, seed=1, dtype=torch.float32)})


@pytest.fixture(scope="module")
def inversion(layer):
    return PoseInversion(layer)


@pytest.fixture(scope="module")
def fitted(inversion):
    """Vertices that take part by default."""
    return inversion.default_weights > 0


def smooth_motion(layer, frames, seed):
    """Rotations (frames, J - 1, 3, 3) and Hips positions of a random motion that drifts."""
    random = np.random.default_rng(seed)
    turns = smooth_axis_angles(joint_spread(layer.joint_names), frames, random)
    drift = np.cumsum(0.01 * random.standard_normal((frames, 3)), 0) + np.array([0.1, 0.95, 0.0])
    return axis_angle_to_matrix(torch.as_tensor(turns)).float(), torch.as_tensor(drift).float()


def shipped_motion(layer, frames):
    """Frames spread over the shipped clip."""
    motion = read_motion(assets_dir() / "motions/range_of_motion.npz")
    kept = np.linspace(0, motion.frame_count - 1, frames).astype(int)
    return torch.as_tensor(motion.rotations[kept]), torch.as_tensor(motion.translation[kept])


@torch.no_grad()
def posed(layer, identity, rotations, hips):
    return layer.pose(identity, rotations, hips).vertices


@pytest.fixture(scope="module")
def targets(layer, identity):
    """Twelve frames of our own."""
    return posed(layer, identity, *smooth_motion(layer, 12, 3))


@pytest.fixture(scope="module")
def result(inversion, targets, identity):
    return inversion(targets, identity)


def reconstructed(layer, identity, result):
    return posed(layer, identity, result.rotations.detach(), result.translation.detach())


def from_pose(result, rotations, hips):
    """A warm start at one pose for all frames."""
    count = len(result.rotations)
    return replace(
        result, rotations=rotations.expand(count, -1, 3, 3), translation=hips.expand(count, 3).contiguous()
    )


def assert_exact(layer, identity, targets, result, fitted):
    """Every frame, by the forward model and by what the result says of itself."""
    error = (reconstructed(layer, identity, result) - targets).norm(dim=-1)[:, fitted] * 1e3
    assert error.mean() < MEAN_MM
    assert error.max() < MAX_MM
    assert error.mean(1).max() < 2 * MEAN_MM
    torch.testing.assert_close(result.vertex_error[:, fitted] * 1e3, error, atol=5e-3, rtol=0)
    assert result.valid.all()
    assert result.converged.all()
    assert orthonormality_error(result.rotations).max() < 5e-6


# --- where an exact solution exists ---------------------------------------------------------------------


@pytest.mark.parametrize("motion", ["smooth", "another", "shipped"])
def test_our_own_bodies_are_met(layer, identity, inversion, fitted, motion):
    rotations, hips = {
        "smooth": lambda: smooth_motion(layer, 40, 5),
        "another": lambda: smooth_motion(layer, 40, 6),
        "shipped": lambda: shipped_motion(layer, 40),
    }[motion]()
    vertices = posed(layer, identity, rotations, hips)
    result = inversion(vertices, identity)
    assert_exact(layer, identity, vertices, result, fitted)
    moved = torch.tensor(layer.rig.weights.tocsc()[:, 1:].astype(bool).sum(0)) >= MOVED
    assert moved.sum() > 50
    off = matrix_to_axis_angle(result.rotations.transpose(-1, -2) @ rotations).norm(dim=-1).rad2deg()
    assert off[:, moved].mean(0).max() < ANGLE_DEG
    torch.testing.assert_close(result.translation, hips, atol=1e-4, rtol=0)


def test_under_noise_the_residual_is_the_least_possible(layer, identity, inversion, targets):
    """Against a solve in float64 that has converged to rounding."""
    noisy = targets + NOISE_M * randn(*targets.shape, seed=4, dtype=torch.float32)
    exact = SomaLayer("soma", lod="low", dtype=torch.float64, procedural=False)
    who = exact.identity({"shape": identity.params["shape"].double()})
    best = PoseInversion(exact, iterations=60, tolerance=1e-9)(noisy.double(), who)
    assert best.converged.all()
    found = inversion(noisy, identity)
    assert (found.residual < NOISE_RATIO * best.residual).all()
    assert 0.9 * NOISE_M * 3**0.5 < best.residual.mean() < NOISE_M * 3**0.5


HARD = {
    "T-pose": {},
    "handstand": {"Hips": (PI, 0, 0), "LeftArm": (0, 0, 1.5), "RightArm": (0, 0, -1.5)},
    "turned round": {"Hips": (0, PI, 0)},
    "upside down, sideways": {"Hips": (0, 0, PI), "Spine1": (0.6, 0.3, 0)},
    "lying": {"Hips": (PI / 2, 0, 0)},
    "legs crossed, sitting": {
        "LeftLeg": (-1.5, 0, -0.6), "RightLeg": (-1.5, 0, 0.6), "LeftShin": (1.8, 0, 0),
        "RightShin": (1.8, 0, 0),
    },
    "legs crossed, standing": {"LeftLeg": (0, 0, -0.5), "RightLeg": (0, 0, 0.5)},
    "arms twisted by a quarter": {"LeftArm": (PI / 2, 0, 0), "RightForeArm": (PI / 2, 0, 0)},
    "arms twisted by a half": {"LeftArm": (PI, 0, 0), "RightForeArm": (PI, 0, 0), "LeftHand": (PI, 0, 0)},
    "an arm twisted by a whole turn": {"LeftArm": (PI, 0, 0), "LeftForeArm": (PI, 0, 0)},
    "fists": {
        f"{side}Hand{finger}{joint}": (0, 0, 1.4 if side == "Right" else -1.4)
        for side in ("Left", "Right")
        for finger in ("Index", "Middle", "Ring", "Pinky")
        for joint in (2, 3)
    },
    "head over the shoulder": {"Neck1": (0, 0.7, 0), "Neck2": (0, 0.6, 0), "Head": (0.3, 0.6, 0)},
}  # fmt: skip


def hard_poses(layer):
    turns = torch.zeros(len(HARD), len(layer.joint_names), 3)
    for frame, turned in enumerate(HARD.values()):
        for name, turn in turned.items():
            turns[frame, layer.joint_names.index(name)] = torch.tensor(turn)
    return axis_angle_to_matrix(turns), torch.tensor([0.0, 1.0, 0.0]).expand(len(HARD), 3)


def test_hard_poses_are_met(layer, identity, inversion, fitted):
    vertices = posed(layer, identity, *hard_poses(layer))
    assert_exact(layer, identity, vertices, inversion(vertices, identity), fitted)


@pytest.mark.parametrize("where", ["T-pose", "bind pose"])
@pytest.mark.parametrize("motion", ["smooth", "shipped", "hard"])
def test_every_frame_is_met_from_one_pose_for_all(layer, identity, fitted, motion, where):
    """Without a start of its own: the Hips where the rest shape has them, metres and half a turn away."""
    inversion = PoseInversion(layer, iterations=60)
    rotations, hips = {
        "smooth": lambda: smooth_motion(layer, 16, 7),
        "shipped": lambda: shipped_motion(layer, 16),
        "hard": lambda: hard_poses(layer),
    }[motion]()
    vertices = posed(layer, identity, rotations, hips + torch.tensor([2.0, 0.0, -1.0]))
    kinematics = layer.animation.kinematics
    begin = kinematics.bind_relative if where == "bind pose" else torch.eye(3).expand_as(rotations[0])
    initial = from_pose(inversion(vertices, identity), begin, identity.bind_world[0, 1, :3, 3])
    assert_exact(layer, identity, vertices, inversion(vertices, identity, initial=initial), fitted)


def test_a_warm_start_at_the_answer_takes_no_further_steps_worth_the_name(
    layer, identity, inversion, targets, result
):
    again = inversion(targets, identity, initial=result)
    assert (again.iterations <= 1).all()
    assert again.converged.all()
    torch.testing.assert_close(again.rotations, result.rotations, atol=1e-3, rtol=0)


def test_known_bone_scales_are_respected(layer, identity, inversion, fitted):
    scale = 1 + 0.1 * randn(1, len(layer.joint_names), seed=2, dtype=torch.float32).clamp(-1, 1)
    rotations, hips = smooth_motion(layer, 5, 3)
    with torch.no_grad():
        vertices = layer.pose(identity, rotations, hips, bone_scale=scale).vertices
    result = inversion(vertices, identity, bone_scale=scale)
    assert result.vertex_error[:, fitted].max() < MAX_MM * 1e-3
    assert inversion(vertices, identity).residual.min() > 1e-3


# --- what a frame may depend on -------------------------------------------------------------------------


def assert_same(one, other):
    """Bit for bit, all of the result."""
    for field in fields(one):
        mine, theirs = getattr(one, field.name), getattr(other, field.name)
        assert torch.equal(mine.nan_to_num(-1), theirs.nan_to_num(-1)), field.name


def test_the_same_object_gives_the_same_twice(inversion, targets, identity, result, layer):
    """Also after it has served another body."""
    other = layer.identity({"shape": randn(1, 16, seed=9, dtype=torch.float32)})
    inversion(targets[:3], other)
    assert_same(inversion(targets, identity), result)


def test_frames_are_fitted_on_their_own(inversion, targets, identity, result):
    order = torch.tensor([4, 11, 0, 7, 2, 9])
    assert_same(inversion(targets[order], identity), result.part(order))
    assert_same(inversion(targets[5:6], identity), result.part(slice(5, 6)))


@pytest.mark.parametrize("kernels", ["warp", "torch"])
@pytest.mark.parametrize("each", ["one identity", "identity a frame", "weights a frame"])
def test_chunks_give_what_the_whole_gives(layer, targets, identity, monkeypatch, kernels, each):
    inversion = PoseInversion(layer, kernels=kernels)
    options, targets = {}, targets[:5]
    if each == "identity a frame":
        identity = layer.identity({"shape": randn(5, 16, seed=2, dtype=torch.float32)})
        targets = posed(layer, identity, *smooth_motion(layer, 5, 3))
    elif each == "weights a frame":
        random = torch.Generator().manual_seed(1)
        options["weights"] = torch.rand(5, targets.shape[1], generator=random) * inversion.default_weights
    whole = inversion(targets, identity, **options)
    monkeypatch.setattr(fit, "_CHUNK", 2)
    parts = inversion(targets, identity, **options)
    gap = reconstructed(layer, identity, parts) - reconstructed(layer, identity, whole)
    assert gap.abs().max() < SEPARATE_M
    assert torch.equal(parts.valid, whole.valid)
    assert parts.vertex_error.shape == whole.vertex_error.shape


@pytest.mark.parametrize("kernels", ["warp", "torch"])
def test_two_identities_in_a_batch_give_what_each_alone_gives(layer, kernels, fitted):
    inversion = PoseInversion(layer, kernels=kernels)
    shapes = randn(2, 16, seed=5, dtype=torch.float32)
    both, alone = layer.identity({"shape": shapes}), [layer.identity({"shape": one[None]}) for one in shapes]
    rotations, hips = smooth_motion(layer, 2, 3)
    vertices = posed(layer, both, rotations, hips)
    vertices = vertices + 0.002 * randn(*vertices.shape, seed=3, dtype=torch.float32)
    together = inversion(vertices, both)
    expected = reconstructed(layer, both, together)
    for frame, who in enumerate(alone):
        found = inversion(vertices[frame : frame + 1], who)
        gap = reconstructed(layer, who, found)[0] - expected[frame]
        assert gap[fitted].abs().max() < SEPARATE_M


def test_the_kinds_of_kernels_agree(layer, targets, identity, result, fitted):
    found = PoseInversion(layer, kernels="torch")(targets, identity)
    gap = reconstructed(layer, identity, found) - reconstructed(layer, identity, result)
    assert gap[:, fitted].abs().max() < SEPARATE_M
    # A step whose gain is near the tolerance may be the last for one order of summing and not for another.
    assert (found.iterations - result.iterations).abs().max() <= 1
    torch.testing.assert_close(found.vertex_error, result.vertex_error, atol=SEPARATE_M, rtol=0)


def test_callers_with_and_without_gradients_get_the_same(inversion, targets, identity, result):
    with torch.no_grad():
        assert_same(inversion(targets, identity), result)
    with torch.inference_mode():
        assert_same(inversion(targets.clone(), identity), result)
    tracked = inversion(targets.clone().requires_grad_(), identity)
    for field in fields(tracked):
        value = getattr(tracked, field.name).detach()
        torch.testing.assert_close(value, getattr(result, field.name), atol=1e-6, rtol=0, equal_nan=True)
    assert not result.rotations.requires_grad


def test_threads_share_one_object(inversion, targets, identity, result):
    found = {}

    def run(name):
        found[name] = inversion(targets, identity)

    threads = [threading.Thread(target=run, args=(name,)) for name in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for name in range(3):
        assert_same(found[name], result)


def test_what_is_given_is_not_changed(inversion, targets, identity):
    vertices = targets.clone()
    vertices[3, 100] = torch.nan
    before = vertices.clone(), identity.rest.clone()
    inversion(vertices, identity)
    assert torch.equal(vertices.nan_to_num(9), before[0].nan_to_num(9))
    assert torch.equal(identity.rest, before[1])


@pytest.mark.parametrize("kernels", ["warp", "torch"])
def test_no_frames_give_no_frames(layer, targets, identity, kernels):
    result = PoseInversion(layer, kernels=kernels)(targets[:0], identity)
    assert result.rotations.shape == (0, len(layer.joint_names), 3, 3)
    assert result.vertex_error.shape == (0, targets.shape[1])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_targets_of_any_precision(layer, inversion, targets, identity, dtype, fitted):
    result = inversion(targets.to(dtype), identity)
    assert result.rotations.dtype == torch.float32
    assert result.vertex_error[:, fitted].mean() < (1e-5 if dtype == torch.float64 else 1e-3)


def test_views_and_strides_do_not_matter(inversion, targets, identity, result):
    planes = targets.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    assert_same(inversion(planes, identity), result)


def test_far_from_the_origin_only_the_input_is_rounded(layer, inversion, targets, identity, fitted):
    """A kilometre away float32 vertices are rounded to 0.06 mm; the fit adds nothing to it."""
    result = inversion(targets + torch.tensor([1000.0, 0.0, -500.0]), identity)
    assert result.valid.all()
    assert result.vertex_error[:, fitted].mean() < 1.5e-4


# --- input that cannot be fitted ------------------------------------------------------------------------


def spoil(vertices, how):
    """One unusable frame."""
    return {
        "all vertices equal": lambda: vertices[:1].expand_as(vertices),
        "a NaN": lambda: vertices.index_fill(0, torch.tensor([17]), torch.nan),
        "an infinity": lambda: vertices.index_fill(0, torch.tensor([17]), torch.inf),
        "all NaN": lambda: torch.full_like(vertices, torch.nan),
        "mirrored": lambda: vertices * torch.tensor([-1.0, 1.0, 1.0]),
        "turned inside out": lambda: -vertices,
        "a hundred times too large": lambda: 100 * vertices,
        "a hundred times too small": lambda: 0.01 * vertices,
        "beyond all bounds": lambda: 1e30 * vertices,
        "a flat sheet": lambda: vertices * torch.tensor([1.0, 1.0, 0.0]),
        "noise": lambda: randn(*vertices.shape, seed=1, dtype=torch.float32),
    }[how]()


SPOILT = (
    "all vertices equal", "a NaN", "an infinity", "all NaN", "mirrored", "turned inside out",
    "a hundred times too large", "a hundred times too small", "beyond all bounds", "a flat sheet",
)  # fmt: skip


@pytest.mark.parametrize("kernels", ["warp", "torch"])
def test_unusable_frames_are_flagged_and_harm_no_other(layer, targets, identity, kernels):
    """One of each kind between the good ones."""
    inversion = PoseInversion(layer, kernels=kernels)
    good = inversion(targets, identity)
    bad = torch.stack([spoil(targets[2], how) for how in SPOILT])
    found = inversion(torch.cat((targets[:5], bad, targets[5:])), identity)
    spoilt, others = slice(5, 5 + len(bad)), torch.tensor([*range(5), *range(5 + len(bad), 12 + len(bad))])
    assert dict(zip(SPOILT, found.valid[spoilt].tolist(), strict=True)) == dict.fromkeys(SPOILT, False)
    assert found.valid[others].all()
    if kernels == "warp":
        assert_same(found.part(others), good)
    gap = reconstructed(layer, identity, found)[others] - reconstructed(layer, identity, good)
    assert gap.abs().max() < SEPARATE_M
    eye = torch.eye(3).expand_as(found.rotations[spoilt])
    assert torch.equal(found.rotations[spoilt], eye)
    assert torch.equal(found.translation[spoilt], torch.zeros(len(bad), 3))
    assert found.vertex_error[spoilt].isnan().all()
    assert found.residual[spoilt].isnan().all()
    assert not found.converged[spoilt].any()
    assert not found.determined[spoilt].any()


def test_nonsense_is_no_silent_pose(inversion, targets, identity):
    """Noise has the size of a body, so that only its error tells."""
    vertices = targets[:3].clone()
    vertices[1] = spoil(vertices[1], "noise")
    found = inversion(vertices, identity)
    assert not found.valid[1] or found.residual[1] > 0.1


def test_a_collapsed_hand_leaves_its_fingers_undetermined(layer, inversion, targets, identity, result):
    joints = [j for j, name in enumerate(layer.rig.joint_names) if name.startswith("LeftHand")]
    hand = torch.tensor(layer.rig.weights.toarray()[:, joints].sum(1) > 0.5)
    vertices = targets.clone()
    vertices[4, hand] = vertices[4, hand].mean(0)
    found = inversion(vertices, identity)
    assert found.valid.all()
    lost = result.determined[4] & ~found.determined[4]
    names = {layer.joint_names[joint] for joint in lost.nonzero().flatten()}
    assert {"LeftHandIndex2", "LeftHandThumb2", "LeftHandPinky3"} <= names
    assert all(name.startswith("LeftHand") for name in names)
    others = torch.arange(12) != 4
    assert torch.equal(found.determined[others], result.determined[others])
    assert torch.equal(found.rotations[others], result.rotations[others])
    away = found.vertex_error[4][~hand & (inversion.default_weights > 0)]
    assert away.mean() < 5e-3


def test_joints_without_skin_are_undetermined_and_stay_at_rest(layer, result):
    without = [layer.joint_names[j] for j in (~result.determined[0]).nonzero().flatten()]
    assert without
    assert all(name.endswith(("End", "Eye")) for name in without)
    still = result.rotations[:, ~result.determined[0]]
    torch.testing.assert_close(still, torch.eye(3).expand_as(still), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("factor", "size", "fix"),
    [(1000, r"\d{3,4}(\.\d)?", "0.001"), (100, r"\d{2,3}(\.\d+)?", "0.01"), (0.01, r"0\.0[01]\d*", "100")],
)
def test_a_sequence_in_another_unit_is_refused_with_the_factor(
    inversion, targets, identity, factor, size, fix
):
    text = rf"vertices: got bodies {size} times the size .* Multiply the vertices by {fix}\."
    with pytest.raises(InputError, match=text):
        inversion(factor * targets, identity)


@pytest.mark.parametrize("how", ["all vertices equal", "all NaN", "mirrored", "beyond all bounds"])
def test_a_sequence_without_a_usable_frame_is_flagged_throughout(inversion, targets, identity, how):
    found = inversion(torch.stack([spoil(frame, how) for frame in targets[:3]]), identity)
    assert not found.valid.any()
    assert found.vertex_error.isnan().all()


# --- vertex weights -------------------------------------------------------------------------------------


def test_vertices_left_out_may_be_anything(layer, inversion, targets, identity, fitted):
    """A bag on the back: no value, an infinite one, a wild one."""
    weights = inversion.default_weights.clone()
    weights[500:900] = 0
    vertices = targets.clone()
    expected = inversion(vertices, identity, weights=weights)
    vertices[:, 500:600] += 3.0
    moved = inversion(vertices, identity, weights=weights)
    assert torch.equal(moved.rotations, expected.rotations)
    vertices[:, 600:700], vertices[:, 700:750] = torch.nan, torch.inf
    gone = inversion(vertices, identity, weights=weights)
    assert torch.equal(gone.rotations, expected.rotations)
    assert gone.valid.all()
    assert gone.vertex_error[:, 600:750].isnan().all()
    assert torch.equal(gone.vertex_error[:, 900:], expected.vertex_error[:, 900:])
    assert torch.equal(gone.residual, expected.residual)
    assert (expected.vertex_error[:, weights > 0] < MAX_MM * 1e-3).all()


@pytest.mark.parametrize("part", ["upper body", "left hand", "legs"])
def test_a_part_of_the_body_is_fitted_alone(layer, targets, identity, part):
    """A cut spine is badly determined: it takes more than the default number of steps."""
    inversion = PoseInversion(layer, iterations=60, tolerance=1e-6)
    pattern = {
        "upper body": ("Spine", "Chest", "Neck", "Head", "Jaw", "Left", "Right"),
        "left hand": ("LeftHand",),
        "legs": ("LeftLeg", "LeftShin", "LeftFoot", "RightLeg", "RightShin", "RightFoot"),
    }[part]
    joints = [j for j, name in enumerate(layer.rig.joint_names) if name.startswith(pattern)]
    if part == "upper body":
        joints = [j for j in joints if not layer.rig.joint_names[j].endswith(("Leg", "Shin", "Foot", "Base"))]
    own = torch.tensor(layer.rig.weights.toarray()[:, joints].sum(1) > 0.999)
    weights = inversion.default_weights * own
    assert 20 < weights.sum() < 4000
    found = inversion(targets, identity, weights=weights)
    assert found.valid.all()
    assert found.vertex_error[:, weights > 0].max() < MAX_MM * 1e-3
    kept = {layer.joint_names[j] for j in found.determined.all(0).nonzero().flatten()}
    assert kept
    assert ("RightHandIndex2" in kept) == (part == "upper body")


def test_weights_of_a_frame_are_its_own(layer, inversion, targets, identity, fitted):
    noisy = targets + 0.003 * randn(*targets.shape, seed=4, dtype=torch.float32)
    random = torch.Generator().manual_seed(1)
    weights = torch.rand(12, targets.shape[1], generator=random) * inversion.default_weights
    whole = inversion(noisy, identity, weights=weights)
    for frame in (0, 7):
        alone = inversion(noisy[frame : frame + 1], identity, weights=weights[frame])
        gap = reconstructed(layer, identity, alone)[0] - reconstructed(layer, identity, whole)[frame]
        assert gap[fitted].abs().max() < 5 * SEPARATE_M


def test_a_frame_without_any_weight_is_flagged(inversion, targets, identity):
    weights = inversion.default_weights.repeat(3, 1)
    weights[1] = 0
    found = inversion(targets[:3], identity, weights=weights)
    assert found.valid.tolist() == [True, False, True]


def test_only_ratios_of_weights_matter(layer, inversion, targets, identity):
    noisy = targets + 0.003 * randn(*targets.shape, seed=4, dtype=torch.float32)
    expected = inversion(noisy, identity)
    for factor in (1e-3, 4e4):
        found = inversion(noisy, identity, weights=factor * inversion.default_weights)
        gap = reconstructed(layer, identity, found) - reconstructed(layer, identity, expected)
        assert gap.abs().max() < 5 * SEPARATE_M
        torch.testing.assert_close(found.residual, expected.residual, rtol=1e-5, atol=0)


# --- native vertices ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A layer whose backend has its own topology, in centimetres, +Z up."""
    registry = tiny_registry(tmp_path_factory.mktemp("pair"))
    return SomaLayer("tiny", dtype=torch.float64, canonical=tiny_canonical(), registry=registry)


def test_native_vertices_are_transferred_turned_and_scaled(tiny):
    params = {"shape": [[0.4, -0.3, 0.2, 0.5]], "size": [1.1]}
    identity, inversion = tiny.identity(params), PoseInversion(tiny)
    native = LinearBody().rest({name: torch.tensor(value).double() for name, value in params.items()})
    expected = inversion(identity.fitted_rest, identity)
    found = inversion(native, identity, topology="native")
    torch.testing.assert_close(found.rotations, expected.rotations, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.translation, expected.translation, atol=SEPARATE_M, rtol=0)
    turn = axis_angle_to_matrix(torch.tensor([0.0, 0.0, PI / 2], dtype=torch.float64))
    turned = inversion(native @ turn.T + 100, identity, topology="native")
    about_y = axis_angle_to_matrix(torch.tensor([0.0, PI / 2, 0.0], dtype=torch.float64))
    torch.testing.assert_close(turned.rotations[:, 0], about_y @ found.rotations[:, 0], atol=1e-3, rtol=0)
    torch.testing.assert_close(turned.residual, found.residual, atol=1e-6, rtol=0)


def test_native_vertices_of_the_canonical_backend_are_the_mid_mesh_in_centimetres(layer, inversion, identity):
    mid = SomaLayer("soma", lod="mid")
    vertices = posed(mid, mid.identity(dict(identity.params)), *smooth_motion(layer, 3, 3))
    found = inversion(100 * vertices, identity, topology="native")
    expected = inversion(vertices[:, layer.mesh.mid_ids.tolist()], identity)
    torch.testing.assert_close(found.vertex_error, expected.vertex_error, atol=SEPARATE_M, rtol=0)
    torch.testing.assert_close(found.translation, expected.translation, atol=SEPARATE_M, rtol=0)


def test_native_vertices_in_metres_instead_of_centimetres_are_refused(tiny):
    identity = tiny.identity()
    native = LinearBody().template[None] / 100
    with pytest.raises(InputError, match=r"got bodies 0\.0\d+ times .* the backend's own unit"):
        PoseInversion(tiny)(native, identity, topology="native")


# --- steps and their report -----------------------------------------------------------------------------


def test_more_steps_lower_the_residual_until_it_has_converged(layer, targets, identity):
    residuals = []
    for iterations in (0, 1, 2, 4, 8):
        found = PoseInversion(layer, iterations=iterations, tolerance=1e-6)(targets, identity)
        assert (found.iterations <= iterations).all()
        residuals.append(found.residual.mean())
        if iterations < 2:
            assert not found.converged.any()
    assert torch.stack(residuals).diff().max() <= 0


def test_the_start_alone_is_near(layer, targets, identity):
    found = PoseInversion(layer, stages=["procrustes"])(targets, identity)
    assert 1e-3 < found.residual.mean() < 0.05
    assert not found.converged.any()


# --- refusals -------------------------------------------------------------------------------------------


REFUSED_OPTIONS = [
    ({"stages": ["gauss"]}, r"stages: got 'gauss', expected among procrustes, .*gauss_newton"),
    ({"stages": []}, r"stages: got none, expected at least one"),
    ({"iterations": -1}, r"iterations: got -1, expected at least 0"),
    ({"tolerance": -1e-3}, r"tolerance: got -0.001, expected a length"),
    ({"robust": 0.0}, r"robust: got 0.0, expected a length"),
    ({"kernels": "wrap"}, r"kernels: got 'wrap', expected one of 'auto', 'torch', 'warp'"),
]


@pytest.mark.parametrize(("options", "text"), REFUSED_OPTIONS, ids=lambda value: str(value)[:20])
def test_options_out_of_range_are_refused(layer, options, text):
    with pytest.raises(InputError, match=text):
        PoseInversion(layer, **options)


V = 4505
REFUSED = {
    "numpy": (lambda t: {"vertices": t.numpy()}, r"vertices: got ndarray, expected a floating torch.Tensor"),
    "integers": (lambda t: {"vertices": t.int()}, r"vertices: got torch.int32, .*floating"),
    "one frame without its axis": (
        lambda t: {"vertices": t[0]}, r"vertices: got \(4505, 3\), expected \(frames, 4505, 3\)",
    ),
    "another mesh": (
        lambda t: {"vertices": t[:, :100]},
        r"got \(3, 100, 3\), expected \(frames, 4505, 3\).*topology='native'.* LOD is low",
    ),
    "planar": (lambda t: {"vertices": t[..., :2]}, r"got \(3, 4505, 2\)"),
    "native without its axis": (
        lambda t: {"vertices": t[0], "topology": "native"}, r"vertices: got \(4505, 3\), .*backend's own",
    ),
    "topology": (
        lambda t: {"topology": "low"}, r"topology: got 'low', expected one of 'canonical', 'native'",
    ),
    "few weights": (
        lambda t: {"weights": torch.ones(7)}, r"weights: got \(7,\), expected \(4505,\) or \(3, 4505\)",
    ),
    "weights of other frames": (lambda t: {"weights": torch.ones(2, V)}, r"weights: got \(2, 4505\)"),
    "negative weight": (lambda t: {"weights": torch.full((V,), -0.5)}, r"weights: got -0.5, .*at least zero"),
    "NaN weight": (lambda t: {"weights": torch.full((V,), torch.nan)}, r"weights: got nan, .*at least zero"),
    "infinite weight": (lambda t: {"weights": torch.full((V,), torch.inf)}, r"weights: got inf, .*finite"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_bad_input_is_refused_by_name(inversion, targets, identity, what):
    change, text = REFUSED[what]
    given = {"vertices": targets[:3], "identity": identity} | change(targets[:3])
    with pytest.raises(InputError, match=text):
        inversion(**given)


def test_identities_that_do_not_fit_are_refused(layer, inversion, targets, identity, result):
    two = layer.identity({"shape": randn(2, 16, dtype=torch.float32)})
    with pytest.raises(InputError, match=r"identity: got a batch of 2 for 3 frames, expected a batch of 1"):
        inversion(targets[:3], two)
    mid = SomaLayer("soma", lod="mid").identity()
    with pytest.raises(InputError, match=r"identity: got 18056 vertices on rig \w+, expected 4505"):
        inversion(targets[:3], mid)
    double = SomaLayer("soma", lod="low", dtype=torch.float64, procedural=False).identity()
    with pytest.raises(InputError, match=r"identity: got torch.float64, expected torch.float32"):
        inversion(targets[:3], double)
    with pytest.raises(InputError, match=r"initial: got 12 frames, expected 3 frames"):
        inversion(targets[:3], identity, initial=result)
