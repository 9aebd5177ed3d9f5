"""A backend's posed meshes as a teacher: what skinning leaves over comes back as offsets."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from soma_core.correctives.bind_body import BindBody
from soma_core.correctives.poses import random_rotations
from soma_core.correctives.teacher import Clip
from soma_core.errors import InputError
from soma_core.plugin.hookspecs import hookimpl
from soma_core.plugin.registry import Registry
from soma_core.tasks.posed_teacher import PosedTeacher
from tests.bodies import (
    TO_NATIVE,
    LinearBody,
    TinyPlugin,
    native_body,
    tiny_canonical,
    tiny_registry,
    tiny_spec,
    write_pair,
)
from tests.plugin.fakes import FakeEntryPoint

BULGE_CM = 3.0


class PosedBody(LinearBody):
    """The small body, skinned by the canonical rig; its left forearm bulges, whatever the pose."""

    def __init__(self, **kind):
        super().__init__(**kind)
        _, rig = tiny_canonical()
        vertices, _ = native_body()
        nearest = cKDTree(rig.bind_shape).query(vertices @ TO_NATIVE / 1e4)[1]
        self.skin = BindBody(rig)
        self.weights = torch.as_tensor(self.skin.weights.toarray()[nearest])
        joint = rig.joint_names.index("LeftForeArm")
        self.bulge = BULGE_CM * (self.weights[:, joint] > 0.5)

    def random_poses(self, count, seed):
        names = tiny_canonical()[1].user_joint_names
        return torch.as_tensor(random_rotations(names, count, np.random.default_rng(seed)))

    def posed(self, params, pose):
        to_metres = torch.as_tensor(TO_NATIVE / 1e4)
        rest = self.rest(params)[0].double() @ to_metres
        away = torch.nn.functional.normalize(rest, dim=1) * self.bulge[:, None] / 100
        moved = torch.cat((rest + away, torch.ones_like(rest[:, :1])), 1)
        blended = torch.einsum("vj,bjrc->bvrc", self.weights, self.skin.transforms(pose))
        return ((blended @ moved[..., None]).squeeze(-1) @ torch.as_tensor(TO_NATIVE.T)).to(self.template)


class PosedPlugin(TinyPlugin):
    @hookimpl
    def soma_generator(self, device, dtype):
        return PosedBody(device=device, dtype=dtype)


@pytest.fixture(scope="module")
def lesson(tmp_path_factory):
    spec = tiny_spec(write_pair(tmp_path_factory.mktemp("posed")))
    registry = Registry([FakeEntryPoint("tiny", PosedPlugin(spec))])
    teacher = PosedTeacher("tiny", canonical=tiny_canonical(), registry=registry)
    clip = Clip(name="clip", rotations=np.tile(np.eye(3), (3, 77, 1, 1)), seed=5)
    return teacher, teacher.teach(clip)


def test_the_models_own_poses_are_used(lesson):
    teacher, found = lesson
    assert teacher.name == "tiny"
    assert teacher.provenance["teacher"] == "tiny"
    assert found.rotations.shape == (3, 77, 3, 3)
    assert found.offsets.shape[0] == 3
    assert np.abs(found.rotations - np.eye(3)).max() > 0.1


def test_what_skinning_cannot_explain_is_taught(lesson):
    """The bulge shows on the forearm; the legs, which skin like ours, hardly move."""
    _, found = lesson
    mesh, rig = tiny_canonical()
    length = 100 * np.linalg.norm(found.offsets, axis=-1)
    weights = rig.weights.toarray()
    forearm, leg = (weights[:, rig.joint_names.index(name)] > 0.55 for name in ("LeftForeArm", "RightShin"))
    assert length[:, forearm].mean() > 0.5 * BULGE_CM
    assert length[:, leg].mean() < 0.2 * BULGE_CM
    assert mesh.vertex_count == found.offsets.shape[1]


def test_a_backend_without_posed_meshes_is_named(tmp_path):
    with pytest.raises(InputError, match="teacher: got tiny, whose generator offers no posed meshes"):
        PosedTeacher("tiny", canonical=tiny_canonical(), registry=tiny_registry(tmp_path))
