import importlib.util
from pathlib import Path

import numpy as np
import pytest

from soma_core.errors import AssetError
from soma_core.rig import load_canonical
from soma_core.rig.usd import read_usd_rig

FLOAT32_M = 1e-6  # points are stored in float32
EXACT_M = 1e-12  # matrices are stored in float64


def quarter_turn() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    return matrix


def moved(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def test_reads_joints_weights_and_metres(tiny_usd):
    found = read_usd_rig(tiny_usd())
    rig = found.rig
    assert rig.joint_names == ("Root", "Hips", "Spine1")
    assert rig.parents.tolist() == [-1, 0, 1]
    np.testing.assert_allclose(rig.bind_world[:, 1, 3], [0, 0.01, 0.02], atol=EXACT_M)
    np.testing.assert_allclose(rig.t_pose_world[:, 1, 3], [0, 0.01, 0.02], atol=EXACT_M)
    np.testing.assert_allclose(rig.weights.toarray(), np.tile([0, 0.75, 0.25], (8, 1)))
    assert found.face_vert_counts.tolist() == [4] * 6
    assert rig.revision == found.rig_hash[:16]
    assert found.uv.shape == (0, 2)


@pytest.mark.parametrize("unit", [0.001, 0.01, 1.0])
def test_unit_scales_points_and_joints_alike(tiny_usd, unit):
    rig = read_usd_rig(tiny_usd(unit=unit)).rig
    np.testing.assert_allclose(rig.bind_world[2, :3, 3], [0, 2 * unit, 0], atol=EXACT_M)
    assert np.ptp(rig.bind_shape[:, 1]) == pytest.approx(2 * unit)


def test_z_up_file_gives_the_same_rig_as_its_y_up_twin(tiny_usd):
    y_up = read_usd_rig(tiny_usd()).rig
    to_z = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    turn = [to_z @ matrix @ to_z.T for matrix in (np.eye(4), moved(0, 1, 0), moved(0, 2, 0))]
    rest = [to_z @ matrix @ to_z.T for matrix in (np.eye(4), moved(0, 1, 0), moved(0, 1, 0))]
    points = y_up.bind_shape * 100 @ to_z[:3, :3].T
    z_up = read_usd_rig(tiny_usd(up="Z", bind=tuple(turn), rest=tuple(rest), points=points)).rig
    np.testing.assert_allclose(z_up.bind_shape, y_up.bind_shape, atol=FLOAT32_M)
    np.testing.assert_allclose(z_up.bind_world, y_up.bind_world, atol=EXACT_M)
    np.testing.assert_allclose(z_up.t_pose_world, y_up.t_pose_world, atol=EXACT_M)


def test_geom_bind_transform_moves_the_points(tiny_usd):
    plain = read_usd_rig(tiny_usd()).rig
    placed = read_usd_rig(tiny_usd(geom_bind=moved(3, 0, 0) @ quarter_turn())).rig
    expected = plain.bind_shape @ quarter_turn()[:3, :3].T + [0.03, 0, 0]
    np.testing.assert_allclose(placed.bind_shape, expected, atol=FLOAT32_M)


def test_mesh_transform_counts_only_without_geom_bind(tiny_usd):
    plain = read_usd_rig(tiny_usd()).rig
    own = read_usd_rig(tiny_usd(mesh_transform=moved(5, 0, 0))).rig
    both = read_usd_rig(tiny_usd(mesh_transform=moved(5, 0, 0), geom_bind=np.eye(4))).rig
    np.testing.assert_allclose(own.bind_shape, plain.bind_shape + np.array([0.05, 0, 0]), atol=FLOAT32_M)
    np.testing.assert_array_equal(both.bind_shape, plain.bind_shape)


def test_skeleton_transform_places_the_rest_pose_in_the_world(tiny_usd):
    rig = read_usd_rig(tiny_usd(skeleton_transform=moved(0, 0, 7))).rig
    np.testing.assert_allclose(rig.t_pose_world[:, 2, 3], 0.07, atol=EXACT_M)
    np.testing.assert_allclose(rig.bind_world[:, 2, 3], 0, atol=EXACT_M)


def test_mesh_joint_subset_is_scattered_by_name(tiny_usd):
    path = tiny_usd(mesh_joints=("Root/Hips/Spine1", "Root/Hips"), influences=((0, 1),) * 8)
    weights = read_usd_rig(path).rig.weights.toarray()
    np.testing.assert_allclose(weights, np.tile([0, 0.25, 0.75], (8, 1)))


def test_unknown_joint_in_the_subset_is_refused(tiny_usd):
    path = tiny_usd(mesh_joints=("Root/Hips", "Root/Tail"), influences=((0, 1),) * 8)
    with pytest.raises(AssetError, match="Root/Tail"):
        read_usd_rig(path)


def test_children_listed_before_parents_are_put_in_order(tiny_usd):
    path = tiny_usd(
        joints=("Root/Hips/Spine1", "Root", "Root/Hips"),
        bind=(moved(0, 2, 0), np.eye(4), moved(0, 1, 0)),
        rest=(moved(0, 1, 0), np.eye(4), moved(0, 1, 0)),
        influences=((2, 0),) * 8,
    )
    shuffled, ordered = read_usd_rig(path).rig, read_usd_rig(tiny_usd()).rig
    assert shuffled.joint_names == ordered.joint_names
    np.testing.assert_array_equal(shuffled.parents, ordered.parents)
    np.testing.assert_allclose(shuffled.t_pose_world, ordered.t_pose_world, atol=EXACT_M)
    np.testing.assert_allclose(shuffled.weights.toarray(), ordered.weights.toarray())


def test_rotations_are_projected_but_hashed_as_stored(tiny_usd):
    loose = quarter_turn()
    loose[:3, :3] *= 1 + 1e-5
    found = read_usd_rig(tiny_usd(bind=(np.eye(4), loose, moved(0, 2, 0))))
    rotations = found.rig.bind_world[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (3, 1, 1)), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1)


def test_rigidly_bound_mesh_gives_every_vertex_the_constant_weights(tiny_usd):
    from pxr import Usd, UsdGeom

    path = tiny_usd(influences=((1, 2),), weights=((0.5, 0.5),))
    stage = Usd.Stage.Open(str(path))
    for name in ("skel:jointIndices", "skel:jointWeights"):
        UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Body/c_skin_mid")).GetPrimvar(name).SetInterpolation(
            "constant"
        )
    stage.GetRootLayer().Save()
    np.testing.assert_allclose(read_usd_rig(path).rig.weights.toarray(), np.tile([0, 0.5, 0.5], (8, 1)))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"rest": None}, "restTransforms holds 0 matrices for 3 joints"),
        ({"bind": None}, "bindTransforms holds 0 matrices for 3 joints"),
        ({"bind": (np.eye(4), np.eye(4), np.full((4, 4), np.nan))}, "bindTransforms holds NaN"),
        ({"joints": ()}, "no joints"),
        ({"joints": ("Root", "Root/Hips", "Root/Hips/Root")}, r"repeats the joint names \['Root'\]"),
        ({"weights": ((0.75, 0.2),) * 8}, "vertex 0 sum to 0.95"),
        ({"weights": ((1.25, -0.25),) * 8}, "negative skin weight -0.25"),
        ({"weights": ((0.75, float("nan")),) * 8}, "vertex 0 are NaN"),
        ({"influences": ((1, 9),) * 8}, "jointIndices holds 9"),
        ({"influences": ((1, 2),) * 7}, "holds 14 values, expected 8 points"),
        ({"points": np.full((8, 3), np.inf)}, "NaN or infinity"),
        ({"points": np.zeros((0, 3))}, "no points"),
        ({"faces": ((0, 1, 8),)}, "faces that do not fit its 8 points"),
        ({"up": "X"}, "upAxis"),
    ],
)
def test_bad_files_are_refused_by_name(tiny_usd, changes, text):
    if changes.get("up") == "X":
        path = tiny_usd()
        path.write_text(path.read_text().replace('upAxis = "Y"', 'upAxis = "X"'))
    else:
        path = tiny_usd(**changes)
    with pytest.raises(AssetError, match=text):
        read_usd_rig(path)


def test_influences_and_weights_of_other_widths_are_refused(tiny_usd):
    from pxr import Usd, UsdGeom

    path = tiny_usd()
    stage = Usd.Stage.Open(str(path))
    primvar = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Body/c_skin_mid")).GetPrimvar("skel:jointWeights")
    primvar.SetElementSize(1)
    primvar.Set([1.0] * 8)
    stage.GetRootLayer().Save()
    with pytest.raises(AssetError, match="elementSize 2 and 1"):
        read_usd_rig(path)


def test_the_only_skinned_mesh_is_taken_whatever_its_name(tiny_usd):
    assert read_usd_rig(tiny_usd(names=("Odd",))).mesh_name == "Odd"


def test_several_unknown_meshes_are_listed(tiny_usd):
    path = tiny_usd(names=("Odd", "Other"))
    with pytest.raises(AssetError, match="/Body/Odd, /Body/Other"):
        read_usd_rig(path)
    assert read_usd_rig(path, mesh="/Body/Other").mesh_name == "Other"
    with pytest.raises(AssetError, match="no skinned mesh named Wrong"):
        read_usd_rig(path, mesh="Wrong")


def test_unbound_mesh_takes_the_only_skeleton_and_refuses_to_guess(tiny_usd):
    from pxr import Usd, UsdSkel

    path = tiny_usd(bound=False)
    assert read_usd_rig(path).rig.joint_count == 3
    stage = Usd.Stage.Open(str(path))
    UsdSkel.Skeleton.Define(stage, "/Body/Second")
    stage.GetRootLayer().Save()
    with pytest.raises(AssetError, match="bound to no skeleton and the file has 2"):
        read_usd_rig(path)


def test_truncated_layer_is_refused(tiny_usd, tmp_path):
    text = tiny_usd().read_text()
    broken = tmp_path / "broken.usda"
    broken.write_text(text[: len(text) // 2])
    with pytest.raises(AssetError, match="USD cannot read it"):
        read_usd_rig(broken)


def test_reads_the_rig_of_the_retargeter_wheel():
    spec = importlib.util.find_spec("soma_retargeter")
    if spec is None:
        pytest.skip("eden-soma-retargeter is not installed")
    path = Path(spec.submodule_search_locations[0]) / "configs" / "soma" / "soma_base_skel_minimal.usd"
    mesh, rig = load_canonical()
    other = read_usd_rig(path, triangles=mesh.triangles)
    assert other.mesh_name == "Mesh"
    assert other.rig.joint_names == rig.joint_names
    np.testing.assert_array_equal(other.rig.parents, rig.parents)
    np.testing.assert_array_equal(other.face_vert_indices, mesh.face_vert_indices)
    assert other.rig.revision != rig.revision
    distance = np.linalg.norm(other.rig.bind_shape - rig.bind_shape, axis=1)
    assert 0.0028 < distance.mean() < 0.0030  # another sculpt of the same body, in the same unit
    assert other.uv.shape == (19690, 2)
