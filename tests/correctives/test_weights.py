"""The checkpoint: what is written comes back, and what is not one is refused."""

import dataclasses
import pickle

import numpy as np
import pytest
import scipy.sparse
import torch

from soma_core.correctives.features import local_bind_rotations
from soma_core.correctives.weights import CorrectiveWeights, check_bind_pose, read_weights, write_weights
from soma_core.errors import AssetError
from tests.correctives.conftest import CHANNELS

HALF = 2**-10  # relative rounding of the half precision that W2 is stored in
SINGLE = 1e-6


@pytest.fixture(scope="module")
def weights(body):
    return made_weights(body)


def made_weights(body) -> CorrectiveWeights:
    random = np.random.default_rng(0)
    first = scipy.sparse.kron(body.masks.joints.astype(float), np.ones((6, CHANNELS)), format="csr")
    second = scipy.sparse.kron(body.masks.vertices > 0, np.ones((CHANNELS, 3)), format="csr").astype(float)
    first.data = random.standard_normal(first.nnz)
    second.data = 0.01 * random.standard_normal(second.nnz)
    return CorrectiveWeights(
        channels=CHANNELS,
        use_tanh=True,
        bind_pose=local_bind_rotations(body.rig),
        first=scipy.sparse.csr_array(first),
        second=scipy.sparse.csr_array(second),
        joint_mask=scipy.sparse.csr_array(body.masks.joints.astype(float)),
        vertex_mask=scipy.sparse.csr_array((body.masks.vertices > 0).astype(float)),
        meta={"teacher": "known", "clips": {"train": 3}},
    )


@pytest.fixture
def content(weights, tmp_path):
    write_weights(tmp_path / "stored.pt", weights)
    return torch.load(tmp_path / "stored.pt", weights_only=True)


def test_round_trip(weights, tmp_path, body):
    write_weights(tmp_path / "model.pt", weights)
    found = read_weights(tmp_path / "model.pt")
    assert (found.channels, found.use_tanh, found.meta) == (CHANNELS, True, weights.meta)
    assert found.vertex_count == body.mesh.vertex_count
    np.testing.assert_allclose(found.second.data, weights.second.data, rtol=HALF, atol=1e-6)
    np.testing.assert_allclose(found.first.data, weights.first.data, rtol=SINGLE)
    check_bind_pose(tmp_path / "model.pt", found, body.rig)


def test_the_file_has_the_documented_keys_and_shapes(content, body):
    joints, vertices = body.rig.joint_count, body.mesh.vertex_count
    shapes = {key: tuple(content[key].shape) for key in ("bindpose", "W1", "W2", "M1_mask", "M2_mask")}
    assert shapes == {
        "bindpose": (joints, 3, 3),
        "W1": (6 * joints, joints * CHANNELS),
        "W2": (joints * CHANNELS, 3 * vertices),
        "M1_mask": (joints, joints),
        "M2_mask": (joints, vertices),
    }
    assert (content["C_max"], content["use_tanh"], content["unit"]) == (CHANNELS, True, "centimeters")


@pytest.mark.parametrize("layout", ["coo", "dense", "4x4"])
def test_other_layouts_read_the_same(weights, content, tmp_path, layout):
    if layout == "4x4":
        whole = torch.eye(4).repeat(len(content["bindpose"]), 1, 1)
        whole[:, :3, :3] = content["bindpose"]
        content["bindpose"] = whole
    else:
        for key in ("W1", "W2", "M1_mask", "M2_mask"):
            dense = content[key].to_dense().float()
            content[key] = dense.to_sparse_coo() if layout == "coo" else dense
    torch.save(content, tmp_path / "other.pt")
    found = read_weights(tmp_path / "other.pt")
    np.testing.assert_allclose(found.second.toarray(), weights.second.toarray(), rtol=HALF, atol=1e-6)


def test_masks_are_multiplied_in(content, tmp_path):
    content["M2_mask"] = 0.5 * content["M2_mask"].to_dense().float()
    content["M2_mask"][:, 0] = 0
    content["W2"] = torch.ones_like(content["W2"].to_dense(), dtype=torch.float32)
    content["unit"] = "meters"
    torch.save(content, tmp_path / "masked.pt")
    found = read_weights(tmp_path / "masked.pt").second
    assert found[:, :3].nnz == 0
    np.testing.assert_array_equal(found.data, 0.5)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"W2": None}, "without the keys W2"),
        ({"unit": "feet"}, "in the unit 'feet'"),
        ({"W1": torch.zeros(5, 7)}, r"W1 of shape \(5, 7\)"),
        ({"bindpose": torch.zeros(78, 2, 2)}, r"bindpose of shape \(78, 2, 2\)"),
        ({"W2": torch.full((156, 3 * 8), float("nan"))}, "W2 holds numbers that are not finite"),
        ({"C_max": "many"}, "many"),
    ],
)
def test_what_does_not_fit_is_named(content, tmp_path, change, text):
    content = {key: value for key, value in {**content, **change}.items() if value is not None}
    torch.save(content, tmp_path / "bad.pt")
    with pytest.raises(AssetError, match=text):
        read_weights(tmp_path / "bad.pt")


class _Harm:
    def __reduce__(self):
        return (print, ("executed",))


def test_code_in_a_file_is_not_run(tmp_path, capsys):
    torch.save({"C_max": _Harm()}, tmp_path / "harm.pt")
    (tmp_path / "raw.pt").write_bytes(pickle.dumps(_Harm(), protocol=2))
    for name in ("harm.pt", "raw.pt"):
        with pytest.raises(AssetError, match="asks for __builtin__.print|not a file of tensors"):
            read_weights(tmp_path / name)
    assert "executed" not in capsys.readouterr().out


def test_a_list_is_no_checkpoint(tmp_path):
    torch.save([1, 2], tmp_path / "list.pt")
    with pytest.raises(AssetError, match="without the keys C_max, use_tanh"):
        read_weights(tmp_path / "list.pt")


def test_another_bind_pose_is_refused(weights, body):
    turned = weights.bind_pose.copy()
    turned[5, 0, 1] += 0.01
    other = dataclasses.replace(weights, bind_pose=turned)
    with pytest.raises(AssetError, match=rf"bind pose: that of {body.rig.joint_names[5]} differs by 0.01"):
        check_bind_pose("file", other, body.rig)
    with pytest.raises(AssetError, match="for 77 joints, this rig has 78"):
        check_bind_pose("file", dataclasses.replace(weights, bind_pose=turned[1:]), body.rig)
