import numpy as np
import pytest
import scipy.sparse

from soma_core.errors import AssetError
from soma_core.rig import load_canonical
from soma_core.rig.legacy import read_legacy_rig

SAME_M = 1e-12


@pytest.fixture(scope="module")
def fat() -> dict[str, np.ndarray]:
    mesh, rig = load_canonical("low")
    weights = scipy.sparse.csc_array(rig.weights)
    centimetres = np.eye(4) + np.pad(np.full((3, 1), 99.0), ((0, 1), (3, 0)))
    return {
        "joint_names": np.array(rig.joint_names),
        "joint_parent_ids": np.where(rig.parents < 0, 0, rig.parents),
        "bind_pose_world": rig.bind_world * np.where(centimetres == 99, 100, 1),
        "t_pose_world": rig.t_pose_world * np.where(centimetres == 99, 100, 1),
        "bind_shape": rig.bind_shape * 100,
        "skinning_weights_data": weights.data,
        "skinning_weights_indices": weights.indices,
        "skinning_weights_indptr": weights.indptr,
        "skinning_weights_shape": np.array(weights.shape),
        "triangles": mesh.triangles,
    }


@pytest.mark.parametrize("root", [0, -1, 2**32 - 1])
def test_fat_file_gives_the_same_rig(tmp_path, fat, root):
    path = tmp_path / "fat.npz"
    parents = fat["joint_parent_ids"].astype(np.int64)
    parents[0] = root
    np.savez(path, **{**fat, "joint_parent_ids": parents})
    rig, expected = read_legacy_rig(path), load_canonical("low")[1]
    assert rig.joint_names == expected.joint_names
    np.testing.assert_array_equal(rig.parents, expected.parents)
    for name in ("bind_world", "t_pose_world", "bind_shape"):
        np.testing.assert_allclose(getattr(rig, name), getattr(expected, name), atol=SAME_M)
    assert abs(rig.weights - expected.weights).max() < SAME_M


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"joint_parent_ids": np.arange(78) + 1}, "parents before children"),
        ({"bind_pose_world": np.zeros((77, 4, 4))}, r"\(77, 4, 4\)"),
        ({"skinning_weights_data": 0.5}, "expected 1"),
    ],
)
def test_broken_fat_files_are_refused(tmp_path, fat, change, text):
    if "skinning_weights_data" in change:
        change = {"skinning_weights_data": fat["skinning_weights_data"] * 0.5}
    path = tmp_path / "fat.npz"
    np.savez(path, **{**fat, **change})
    with pytest.raises(AssetError, match=text):
        read_legacy_rig(path)


def test_slim_file_has_no_rig(tmp_path):
    np.savez(tmp_path / "slim.npz", mean=np.zeros(3))
    with pytest.raises(AssetError, match="joint_names"):
        read_legacy_rig(tmp_path / "slim.npz")
