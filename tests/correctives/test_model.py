"""Inference: the dense formula, zero at bind, masks, sizes of bodies, and the layer."""

import dataclasses

import numpy as np
import pytest
import torch

from soma_core.cache import file_sha256
from soma_core.correctives.model import Correctives, find_correctives, load_correctives
from soma_core.correctives.weights import write_weights
from soma_core.deploy.correctives import BatchedCorrectives
from soma_core.errors import AssetError
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.layer import SomaLayer
from soma_core.rig.manifest import Manifest, write_manifest
from soma_core.topology.lod_transfer import offset_rows
from tests.bodies import CPU, randn, tiny_registry
from tests.correctives.test_weights import made_weights

ROUNDING = 1e-12  # metres, float64
SINGLE = 1e-6  # metres, float32


@pytest.fixture(scope="module")
def weights(body):
    return made_weights(body)


@pytest.fixture(scope="module")
def model(body, weights):
    return Correctives(weights, body.rig, offset_rows(body.mesh), dtype=torch.float64, device="cpu")


@pytest.fixture(scope="module")
def poses(body):
    return axis_angle_to_matrix(0.5 * randn(4, body.rig.joint_count - 1, 3))


@pytest.fixture(scope="module")
def bind(body):
    return torch.as_tensor(body.rig.bind_world.copy())[None]


def test_equals_the_dense_formula(model, weights, poses):
    features = model.features(poses)
    active = torch.tanh(torch.relu(features.flatten(1) @ torch.as_tensor(weights.first.toarray())))
    dense = (active @ torch.as_tensor(weights.second.toarray())).view(len(poses), -1, 3)
    torch.testing.assert_close(model.offsets(features), dense, atol=ROUNDING, rtol=0)


def test_batched_products_give_the_same(model, bind_pose, poses, bind):
    batched = BatchedCorrectives(model, dtype=torch.float64, device=CPU)
    torch.testing.assert_close(batched(poses, bind), model(poses, bind), atol=ROUNDING, rtol=0)
    assert batched(bind_pose, bind).abs().max() < ROUNDING


def test_zero_at_the_bind_pose(model, bind_pose, bind):
    assert model(bind_pose, bind).abs().max() < ROUNDING


def test_nothing_moves_outside_the_masks(model, body, poses, bind):
    moved = model(poses, bind).abs().amax((0, 2)) > 0
    assert not moved[np.setdiff1d(np.arange(body.mesh.vertex_count), body.masks.vertices.indices)].any()
    assert moved.any()


def test_offsets_grow_with_the_body(model, poses, bind):
    larger = bind.clone()
    larger[..., :3, 3] *= 1.5
    torch.testing.assert_close(model(poses, larger), 1.5 * model(poses, bind))


def test_poses_do_not_mix(model, poses, bind):
    alone = torch.cat([model(pose[None], bind) for pose in poses])
    torch.testing.assert_close(model(poses, bind), alone, atol=ROUNDING, rtol=0)


def test_gradients_reach_the_pose(model, body, bind):
    pose = 0.3 * randn(1, body.rig.joint_count - 1, 3)
    shin = body.rig.user_joint_names.index("LeftShin")
    chosen = torch.as_tensor(body.creases.vertices[shin + 1][:3])

    def offsets(vector):
        vectors = pose.index_copy(1, torch.tensor([shin]), vector)
        return model(axis_angle_to_matrix(vectors), bind)[:, chosen]

    assert torch.autograd.gradcheck(offsets, pose[:, shin : shin + 1].clone().requires_grad_())


@pytest.fixture(scope="module")
def checkpoint(weights, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "correctives_model.pt"
    write_weights(path, weights)
    return path


@pytest.fixture(scope="module")
def layers(body, checkpoint, tmp_path_factory):
    registry = tiny_registry(tmp_path_factory.mktemp("tiny"))
    given = {"canonical": (body.mesh, body.rig), "registry": registry, "dtype": torch.float64}
    return [SomaLayer("tiny", correctives=path, **given) for path in (checkpoint, None)]


def test_the_layer_applies_them_before_skinning(layers, body, bind_pose, poses):
    with_them, without = layers
    assert "correctives_model.pt" in repr(with_them)
    assert "correctives=None" in repr(without)
    identity = without.identity()
    moved = with_them.correctives(poses, identity.bind_world)
    posed = with_them.pose(identity, poses)
    expected = without.animation.pose(
        identity, poses, torch.zeros(4, 3, dtype=torch.float64), absolute=False, offsets=moved
    )
    torch.testing.assert_close(posed.vertices, expected.vertices)
    assert (posed.vertices - without.pose(identity, poses).vertices).abs().max() > SINGLE
    bound = [layer.pose(identity, bind_pose).vertices for layer in layers]
    torch.testing.assert_close(*bound, atol=ROUNDING, rtol=0)


def test_every_way_through_the_layer_is_the_same(layers, poses):
    layer, kinematics = layers[0], layers[0].animation.kinematics
    identity = layer.identity()
    posed = layer.pose(identity, poses).vertices
    absolute = kinematics.parent_orient[1:].mT @ poses @ kinematics.orient[1:]
    torch.testing.assert_close(layer.pose(identity, absolute, absolute=True).vertices, posed)
    torch.testing.assert_close(layer(None, poses).vertices, posed)
    many = poses.repeat(10, 1, 1, 1)  # more than one chunk
    with torch.no_grad():
        torch.testing.assert_close(layer(None, many).vertices[-4:], posed)
    plain = layers[1].pose(identity, poses).vertices
    torch.testing.assert_close(layer.pose_plain(identity, poses).vertices, plain)


def test_auto_is_for_the_shipped_rig_alone(body, tmp_path, monkeypatch, checkpoint):
    monkeypatch.setenv("SOMA_ASSETS", str(checkpoint.parent))
    assert find_correctives("auto", shipped=True) == checkpoint
    assert find_correctives("auto", shipped=False) is None
    monkeypatch.setenv("SOMA_ASSETS", str(tmp_path))
    assert find_correctives("auto", shipped=True) is None


def test_the_shipped_file_is_compared_with_its_hash(body, tmp_path, monkeypatch, checkpoint):
    shipped, entry = tmp_path / "correctives_model.pt", {"size": checkpoint.stat().st_size}
    shipped.write_bytes(checkpoint.read_bytes())
    entry["sha256"] = file_sha256(shipped)
    files = {shipped.name: entry}
    write_manifest(tmp_path, Manifest(rig_hash="a", rig_revision="b", files=files))
    monkeypatch.setenv("SOMA_ASSETS", str(tmp_path))
    assert find_correctives("auto", shipped=True) == shipped
    changed = bytearray(shipped.read_bytes())
    changed[len(changed) // 2] ^= 1
    shipped.write_bytes(changed)
    with pytest.raises(AssetError, match=r"correctives_model\.pt: SHA-256 is .*correctives=FILE"):
        find_correctives("auto", shipped=True)
    assert find_correctives(shipped, shipped=True) == shipped  # named by the user, who may have made it


def test_a_named_file_must_be_there_and_fit(body, weights, tmp_path, checkpoint):
    with pytest.raises(AssetError, match=r"none\.pt: file is missing"):
        find_correctives(tmp_path / "none.pt", shipped=False)
    assert load_correctives(None, body.mesh, body.rig, dtype=torch.float32, device=CPU) is None
    mesh = dataclasses.replace(body.mesh, mid_ids=body.mesh.mid_ids + 5)
    with pytest.raises(AssetError, match=f"moves {body.mesh.vertex_count} vertices"):
        load_correctives(checkpoint, mesh, body.rig, dtype=torch.float32, device=CPU)
