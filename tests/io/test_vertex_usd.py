"""USD meshes over time: skinned as we write them, or points at each time code."""

import numpy as np
import pytest

from soma_core.errors import AssetError, InputError
from soma_core.io import open_vertex_sequence
from soma_core.io.usd import write_usd

pytest.importorskip("pxr", reason="usd-core is not installed")

FILE_TOLERANCE_MM = 0.01
"""Float32 positions within four metres of the origin, skinned in float32."""


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
def test_our_own_usd_gives_the_posed_body(tmp_path, clip, posed, suffix):
    write_usd(tmp_path / f"body{suffix}", clip)
    with open_vertex_sequence(tmp_path / f"body{suffix}") as sequence:
        assert (sequence.fps, sequence.metres, sequence.up) == (30.0, 1.0, "+y")
        found = np.concatenate([sequence.read(0, 5), sequence.read(5, sequence.frame_count)])
    assert 1000 * np.abs(found - posed).max() < FILE_TOLERANCE_MM


def write_points(path, vertices, *, times=None, up="Z", rate=24.0):
    """Meshes whose points are stored at each time, under a group that moves and turns about +Z."""
    from pxr import Gf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetTimeCodesPerSecond(rate)
    group = UsdGeom.Xform.Define(stage, "/group")
    group.AddTransformOp().Set(Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(0, 0, 1), 90)))
    mesh = UsdGeom.Mesh.Define(stage, "/group/body")
    for time, points in zip(times or range(len(vertices)), vertices, strict=True):
        mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), time)
    still = UsdGeom.Mesh.Define(stage, "/floor")
    still.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(vertices[0]))
    stage.GetRootLayer().Save()
    return stage


@pytest.fixture
def vertices():
    return np.random.default_rng(0).normal(size=(4, 6, 3)).astype(np.float32)


def test_points_at_each_time_are_placed_in_the_world(tmp_path, vertices):
    write_points(tmp_path / "a.usda", vertices)
    with open_vertex_sequence(tmp_path / "a.usda") as sequence:
        assert (sequence.fps, sequence.metres, sequence.up) == (24.0, 0.01, "+z")
        found = sequence.read(0, 4)
    turned = vertices @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(found, turned, atol=1e-6)


def test_samples_two_codes_apart_halve_the_rate(tmp_path, vertices):
    write_points(tmp_path / "a.usda", vertices, times=[10, 12, 14, 16])
    with open_vertex_sequence(tmp_path / "a.usda") as sequence:
        assert (sequence.fps, sequence.frame_count) == (12.0, 4)


def test_uneven_times_are_refused(tmp_path, vertices):
    write_points(tmp_path / "a.usda", vertices, times=[0, 1, 2, 7])
    with pytest.raises(InputError, match=r"a\.usda: times: got a step of 0\.208\S* s after sample 2"):
        open_vertex_sequence(tmp_path / "a.usda")


def test_several_moving_meshes_are_named(tmp_path, vertices):
    from pxr import UsdGeom, Vt

    stage = write_points(tmp_path / "a.usda", vertices)
    hat = UsdGeom.Mesh.Define(stage, "/hat")
    for time in range(2):
        hat.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(vertices[time]), time)
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match=r"got 2 meshes /group/body, /hat, expected one"):
        open_vertex_sequence(tmp_path / "a.usda")


def test_a_vertex_count_that_changes_is_refused(tmp_path, vertices):
    from pxr import UsdGeom, Vt

    stage = write_points(tmp_path / "a.usda", vertices)
    mesh = UsdGeom.Mesh.Get(stage, "/group/body")
    mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(vertices[0, :3]), 2)
    stage.GetRootLayer().Save()
    with (
        open_vertex_sequence(tmp_path / "a.usda") as sequence,
        pytest.raises(InputError, match=r"points at time 2: got 3 vertices, expected 6"),
    ):
        sequence.read(0, 4)


def test_inbetweens_of_blend_shapes_are_refused(tmp_path, clip):
    from pxr import Usd, UsdSkel

    write_usd(tmp_path / "a.usda", clip)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    UsdSkel.BlendShape.Get(stage, "/Toy_body/Mesh/Corrective001").CreateInbetween("half")
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match=r"/Toy_body/Mesh/Corrective001: got inbetweens"):
        open_vertex_sequence(tmp_path / "a.usda")


def test_what_is_no_usd_is_named(tmp_path):
    (tmp_path / "a.usdc").write_bytes(b"not a stage")
    with pytest.raises(AssetError, match=r"a\.usdc: USD cannot read it"):
        open_vertex_sequence(tmp_path / "a.usdc")


def test_a_stage_without_a_mesh_is_refused(tmp_path):
    from pxr import Usd

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match="got 0 meshes, expected one"):
        open_vertex_sequence(tmp_path / "a.usda")
