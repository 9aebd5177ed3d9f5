"""Clips and lessons: reproducible, split by clip, cached, mirrored, streamed."""

import numpy as np
import pytest
import torch

from soma_core.correctives.data import SPLITS, ClipPlan, LessonStore, Taught, split_clips
from soma_core.correctives.poses import mirror_rotations, random_rotations
from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix, orthonormality_error

HALF = 1e-3  # relative rounding of offsets in half precision


def _plan(**changes):
    return ClipPlan(**{"random_clips": 5, "hanging_clips": 0, "poses": 4, "seed": 3, **changes})


def planned(names, **changes):
    plan = _plan(**changes)
    return [plan.clip(number, names) for number in range(len(plan))]


@pytest.fixture
def store(body, teacher, tmp_path):
    return LessonStore(tmp_path, teacher, body.mesh, body.rig)


@pytest.fixture
def clips(body):
    return planned(body.rig.user_joint_names)


def test_random_poses_are_rotations_within_human_limits(body):
    names = body.rig.user_joint_names
    found = random_rotations(names, 200, np.random.default_rng(0))
    assert orthonormality_error(torch.as_tensor(found)).max() < 1e-12
    bend = np.degrees(np.arccos(np.clip((np.trace(found, axis1=2, axis2=3) - 1) / 2, -1, 1)))
    largest = dict(zip(names, bend.max(0), strict=True))
    assert largest["HeadEnd"] == 0
    assert 100 < largest["LeftShin"] < 160
    assert largest["Chest"] < 45
    knee = found[:, names.index("LeftShin")]
    assert np.arctan2(knee[:, 2, 1], knee[:, 1, 1]).min() > np.radians(-10)  # knees do not bend forward


def test_mirror_images(body):
    names = body.rig.user_joint_names
    rotations = random_rotations(names, 3, np.random.default_rng(1))
    mirrored = mirror_rotations(rotations, names)
    np.testing.assert_allclose(mirror_rotations(mirrored, names), rotations)
    raised = axis_angle_to_matrix(torch.tensor([0.0, 0.0, 1.0])).double().numpy()
    pose = np.tile(np.eye(3), (len(names), 1, 1))
    pose[names.index("LeftArm")] = raised
    image = mirror_rotations(pose, names)
    np.testing.assert_allclose(image[names.index("RightArm")], raised.T, atol=1e-12)
    np.testing.assert_allclose(image[names.index("LeftArm")], np.eye(3), atol=1e-12)


def test_hanging_arms_hang(body):
    names = body.rig.user_joint_names
    arm = random_rotations(names, 50, np.random.default_rng(0), hanging=True)[:, names.index("LeftArm")]
    assert (arm[:, 1, 0] < -0.3).all()  # what points to the left in the T-pose points downwards
    clips = planned(names, random_clips=2, hanging_clips=3)
    assert [clip.name.split()[0] for clip in clips] == ["random"] * 2 + ["hanging"] * 3
    assert len({clip.seed for clip in clips}) == 5


def test_a_clip_depends_on_its_number_alone(body, clips):
    more = planned(body.rig.user_joint_names, random_clips=8)
    for clip, again in zip(clips, more, strict=False):
        assert clip.name == again.name
        np.testing.assert_array_equal(clip.rotations, again.rotations)
    other = planned(body.rig.user_joint_names, seed=4)
    assert np.abs(other[0].rotations - clips[0].rotations).max() > 0.1


def taught(name, part_of=""):
    return Taught(name=name, part_of=part_of or name, key=name, poses=4)


def test_splits_share_no_clip_nor_pieces_of_one():
    pieces = [taught(f"walk/{start}", "walk") for start in range(5)]
    clips = [*map(taught, "abcdefghijklmnopqrst"), *pieces]
    split = split_clips(clips, held_out=0.1, seed=0)
    whole = {name: {clip.part_of for clip in split[name]} for name in SPLITS}
    assert [len(whole[name]) for name in SPLITS] == [17, 2, 2]
    assert sorted(clip.name for part in split.values() for clip in part) == sorted(
        clip.name for clip in clips
    )
    assert sum(set(pieces) <= set(part) for part in split.values()) == 1
    assert split == split_clips(clips, held_out=0.1, seed=0)


def test_too_few_clips_are_named():
    with pytest.raises(InputError, match=r"data: got 2 clips, expected at least 3"):
        split_clips([taught("a"), taught("b", "c"), taught("d", "c")], held_out=0.1, seed=0)


def test_lessons_are_taught_once(store, teacher, clips):
    kept = store.teach(clips[0])
    assert store.teach(clips[0]) == kept
    assert teacher.taught == [kept.name] == [clips[0].name]
    assert (kept.part_of, kept.poses) == (clips[0].name, 4)
    ids = np.array([4, 2, 9])
    wanted = teacher.teach(clips[0])
    batch = store.read(kept, ids)
    np.testing.assert_allclose(batch.offsets, wanted.offsets[:, ids], rtol=HALF, atol=1e-6)
    features = teacher.features(torch.as_tensor(clips[0].rotations).float())
    torch.testing.assert_close(batch.features, features)
    np.testing.assert_allclose(store.rotations(kept), clips[0].rotations, atol=1e-6)  # float32


def test_mirrored_lessons_are_those_of_the_partners(store, body, clips):
    kept = store.teach(clips[0])
    everywhere = np.arange(body.mesh.vertex_count)
    plain, both = store.read(kept, everywhere), store.read(kept, everywhere, mirrored=True)
    count = len(clips[0].rotations)
    torch.testing.assert_close(both.offsets[:count], plain.offsets)
    image = plain.offsets[:, body.mesh.mirror] * torch.tensor([-1.0, 1, 1])
    torch.testing.assert_close(both.offsets[count:], image)


def test_every_pose_is_streamed_at_most_once(store, clips):
    clips = [store.teach(clip) for clip in clips]
    ids = np.arange(3)
    batches = list(store.batches(clips, 3, np.random.default_rng(0), ids, pool=2))
    assert len(batches) == 20 // 3
    assert {len(batch.features) for batch in batches} == {3}
    seen = torch.cat([batch.features.flatten(1) for batch in batches])
    assert len(torch.unique(seen, dim=0)) == len(seen)
    again = list(store.batches(clips, 3, np.random.default_rng(0), ids, pool=2))
    torch.testing.assert_close(again[0].features, batches[0].features)
