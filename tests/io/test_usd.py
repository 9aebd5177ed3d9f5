"""The UsdSkel file gives the same body in another implementation of skinning."""

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.io.usd import write_usd

pxr = pytest.importorskip("pxr", reason="usd-core is not installed")

VERTEX_TOLERANCE_MM = 0.1
"""Largest distance between a re-opened file and the body; float32 storage needs about 0.002."""

MATRIX_TOLERANCE = 1e-9
"""Bind and rest transforms are stored as doubles."""


@pytest.fixture(scope="module", params=[".usdc", ".usda"])
def stage(request, clip, tmp_path_factory):
    from pxr import Usd

    path = tmp_path_factory.mktemp("usd") / f"body{request.param}"
    write_usd(path, clip)
    return Usd.Stage.Open(str(path))


def test_skinning_in_usd_gives_the_same_vertices(stage, clip, posed):
    from pxr import Gf, Usd, UsdGeom, UsdSkel

    flat = Usd.Stage.Open(stage.Flatten())
    last = Gf.Interval(0, clip.frame_count - 1)
    assert UsdSkel.BakeSkinning(UsdSkel.Root(flat.GetDefaultPrim()), last)
    mesh = UsdGeom.Mesh.Get(flat, "/Toy_body/Mesh")
    for frame in range(clip.frame_count):
        points = np.array(mesh.GetPointsAttr().Get(frame))
        assert np.linalg.norm(points - posed[frame], axis=1).max() * 1000 < VERTEX_TOLERANCE_MM


def test_rest_is_the_t_pose_and_bind_is_the_identity(stage, clip):
    from pxr import UsdSkel

    skeleton = UsdSkel.Skeleton.Get(stage, "/Toy_body/Skeleton")
    bind = np.array(skeleton.GetBindTransformsAttr().Get()).swapaxes(-1, -2)
    rest = np.array(skeleton.GetRestTransformsAttr().Get()).swapaxes(-1, -2)
    np.testing.assert_allclose(bind, clip.bind_world, atol=MATRIX_TOLERANCE)
    np.testing.assert_allclose(rest, clip.t_pose_local(), atol=MATRIX_TOLERANCE)
    rotations = clip.t_pose_world[:, :3, :3]
    np.testing.assert_allclose(rotations, clip.rig.t_pose_world[:, :3, :3], atol=MATRIX_TOLERANCE)


def test_stage_says_unit_axis_time_and_licence(stage, clip):
    from pxr import UsdGeom

    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert stage.GetTimeCodesPerSecond() == clip.fps
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, clip.frame_count - 1)
    assert stage.GetRootLayer().customLayerData["soma_core"]["licence"] == "CC0-1.0"


def test_uv_and_polygons_are_kept(stage, clip):
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh.Get(stage, "/Toy_body/Mesh")
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    np.testing.assert_array_equal(mesh.GetFaceVertexIndicesAttr().Get(), clip.mesh.face_vert_indices)
    np.testing.assert_array_equal(st.GetIndices(), clip.mesh.uv_indices)
    np.testing.assert_array_equal(np.array(st.Get()), clip.mesh.uv)
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"


def test_another_suffix_is_refused(clip, tmp_path):
    with pytest.raises(InputError, match=r"body\.fbx.*expected .*usdc"):
        write_usd(tmp_path / "body.fbx", clip)
    assert not list(tmp_path.iterdir())
