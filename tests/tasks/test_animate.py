"""The main job on the native backend: files that re-open to the same body, and bodies that stand."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation

from soma_core.config.schema import AnimateConfig
from soma_core.errors import InputError
from soma_core.io import read_motion, write_motion
from soma_core.io.vertex_files import open_vertex_sequence
from soma_core.layer import SomaLayer
from soma_core.motion import Picture, animate, animated, load_clip, stored_identity, write
from soma_core.options import FrameRange
from soma_core.tasks import animate as task

GROUND_TOLERANCE = 1e-5
"""Height of the lowest vertex [m]: float32 rounding at the size of a body."""

UP = np.array([0, 3, 0])

FILE_TOLERANCE_MM = 0.1
"""Largest distance between a re-opened file and the posed body, correctives included."""


def configured(**changes):
    settings = {"backend": {"name": "soma"}, "lod": "low", "frames": {"start": 0, "stop": 60, "step": 20}}
    return OmegaConf.merge(OmegaConf.structured(AnimateConfig), settings | changes)


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low")


@pytest.fixture(scope="module")
def identity(layer):
    return layer.identity({})


@pytest.fixture
def motion():
    return load_clip(frames=FrameRange(start=0, stop=60, step=20))


def lowest(result):
    return min(vertices[:, 1].min() for vertices in result.vertices.values())


@pytest.mark.slow
def test_run_writes_what_is_asked_for(tmp_path):
    task.run(configured(write=["npz", "usd", "glb"]), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["body.glb", "body.usdc", "motion.npz"]
    written = read_motion(tmp_path / "motion.npz")
    assert (written.frame_count, written.fps) == (3, 1.5)
    assert written.identity == {"backend": "soma", "params": {}}
    task.run(configured(write=[]), tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()


def test_written_motion_and_skinned_files_give_the_same_body(tmp_path, identity):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    task.run(configured(write=["npz", "usd", "glb"]), tmp_path)
    written = read_motion(tmp_path / "motion.npz")
    with torch.no_grad():
        rotations, hips = torch.as_tensor(written.rotations), torch.as_tensor(written.translation)
        posed = SomaLayer("soma", lod="low").pose(identity, rotations, hips).vertices.numpy()
    for name in ("body.usdc", "body.glb"):
        with open_vertex_sequence(tmp_path / name) as shown:
            error = np.linalg.norm(shown.read(0, len(posed)) - posed, axis=2).max()
        assert error * 1000 < FILE_TOLERANCE_MM


def test_picture_is_written(tmp_path):
    pytest.importorskip("pyvista", reason="pictures need pyvista")
    task.run(configured(write=["png"], picture={"frames": 2, "width": 200}), tmp_path)
    assert (tmp_path / "contact_sheet.png").stat().st_size > 1000


def test_no_frames_are_no_picture(tmp_path):
    task.run(configured(write=["npz", "png"], picture={"frames": 0}), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["motion.npz"]


@pytest.mark.parametrize(("name", "value"), [("frames", -1), ("width", 0), ("width", 10**6)])
def test_pictures_of_no_size_are_refused(name, value):
    with pytest.raises(InputError, match=rf"picture\.{name}: got {value}, expected a number from \d+ to"):
        Picture(**{name: value})


def test_gallery_of_all_backends(tmp_path, monkeypatch):
    pytest.importorskip("pyvista", reason="pictures need pyvista")
    monkeypatch.setenv("SOMA_BACKENDS", "soma")
    task.run(configured(backends="all", frames={}, picture={"width": 300}), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["gallery.png"]


def test_ground_puts_the_lowest_vertex_on_the_floor(layer, identity, motion):
    lifted = replace(motion, translation=motion.translation + UP)
    for mode in ("ground", "none"):
        result = animate(layer, identity, lifted, translation=mode, ground="lowest", keep=list(range(3)))
        assert abs(lowest(result)) < GROUND_TOLERANCE
        np.testing.assert_array_equal(result.transforms[:, 0], np.tile(np.eye(4), (3, 1, 1)))
        np.testing.assert_allclose(
            result.transforms[:, 1, :3, 3], result.motion.translation, atol=GROUND_TOLERANCE
        )


def test_motion_is_taken_as_recorded(layer, identity, motion):
    lifted = replace(motion, translation=motion.translation + UP)
    result = animate(layer, identity, lifted, translation="motion", keep=[0])
    np.testing.assert_array_equal(result.motion.translation, lifted.translation)
    assert lowest(result) > 2


def test_none_keeps_the_hips_where_they_are(layer, identity, motion):
    result = animate(layer, identity, replace(motion, translation=motion.translation * 7), translation="none")
    assert np.ptp(result.motion.translation, axis=0).max() == 0


def test_a_small_body_takes_small_steps(layer, identity, motion):
    bind = identity.bind_world.clone()
    bind[..., :3, 3] /= 2
    half = replace(identity, rest=identity.rest / 2, bind_world=bind)
    walk = replace(motion, translation=motion.translation + np.arange(3)[:, None] * [0.0, 0.0, 1.0])
    whole = animate(layer, identity, walk).motion.translation
    short = animate(layer, half, walk).motion.translation
    np.testing.assert_allclose(np.diff(short, axis=0), np.diff(whole, axis=0) / 2, atol=1e-5)


def test_chunks_do_not_show(layer, identity, monkeypatch):
    motion = load_clip(frames=FrameRange(step=60))
    whole = animate(layer, identity, motion, keep=[0, 5])
    monkeypatch.setattr(animated, "_CHUNK", 3)
    parts = animate(layer, identity, motion, keep=[0, 5])
    np.testing.assert_allclose(parts.transforms, whole.transforms, atol=GROUND_TOLERANCE)
    np.testing.assert_allclose(parts.vertices[5], whole.vertices[5], atol=GROUND_TOLERANCE)


def test_absolute_rotations_give_the_same_body(layer, identity, motion):
    orient = np.concatenate([np.eye(3)[None], layer.rig.t_pose_world[1:, :3, :3]])
    relative = motion.rotations.astype(float)
    local = np.swapaxes(orient[layer.rig.parents[1:]], -1, -2) @ relative @ orient[1:]
    absolute = replace(motion, rotations=local, convention="absolute_local")
    a = animate(layer, identity, motion, keep=[2]).vertices[2]
    b = animate(layer, identity, absolute, keep=[2]).vertices[2]
    np.testing.assert_allclose(a, b, atol=GROUND_TOLERANCE)


def test_another_rig(layer, identity, motion):
    foreign = replace(motion, rig_revision="f" * 16)
    assert animate(layer, identity, foreign).motion.rig_revision == layer.rig.revision
    with pytest.raises(InputError, match=r"rig_revision: got ffffffffffffffff"):
        animate(layer, identity, replace(foreign, convention="absolute_local"))


def test_frames_outside_the_motion_are_refused():
    with pytest.raises(InputError, match=r"frames: got start=5000.*inside the 421 frames"):
        load_clip(frames=FrameRange(start=5000))
    with pytest.raises(InputError, match=r"frames: got start=0, stop=None, step=0"):
        load_clip(frames=FrameRange(step=0))


def test_unknown_translation_is_refused(layer, identity, motion):
    with pytest.raises(InputError, match=r"translation: got 'sideways'"):
        animate(layer, identity, motion, translation="sideways")


def test_a_motion_is_found_from_the_current_folder(motion, tmp_path, monkeypatch):
    turned = Rotation.from_euler("y", 40, degrees=True).as_matrix()
    rotations = motion.rotations.copy()
    rotations[:, 0] = turned @ rotations[:, 0]
    write_motion(replace(motion, rotations=rotations), tmp_path / "turned.npz")
    monkeypatch.chdir(tmp_path)
    found = load_clip("turned.npz", frames=FrameRange(start=1, stop=2))
    np.testing.assert_array_equal(found.rotations, rotations[1:2])


def test_the_extra_low_mesh_is_written_with_its_own_faces_and_texture(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom

    task.run(configured(lod="xlo", write=["npz", "usd", "glb"]), tmp_path)
    assert (tmp_path / "body.glb").stat().st_size > 0
    stage = Usd.Stage.Open(str(tmp_path / "body.usdc"))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("Mesh"))
    assert len(mesh.GetPointsAttr().Get()) == 612
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == 1220 * [3]
    assert len(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()) == 3660
    assert read_motion(tmp_path / "motion.npz").rig_revision.endswith("-xlo")


@pytest.mark.slow
def test_the_options_of_a_backend_are_kept(smplh_models, tmp_path):
    """The stand-in is female only: without its options the motion would play as a body that is not there."""
    female = {"params": {"betas": [1.0, 0, 0]}, "options": {"gender": "female"}}
    task.run(configured(backend={"name": "smplh", **female}, write=["npz"]), tmp_path)
    assert read_motion(tmp_path / "motion.npz").identity == {"backend": "smplh", **female}
    played = {"motion": str(tmp_path / "motion.npz"), "identity_from": "motion", "frames": {"stop": None}}
    task.run(configured(write=["npz"], **played), tmp_path / "again")
    assert read_motion(tmp_path / "again/motion.npz").identity == {"backend": "smplh", **female}


@pytest.mark.parametrize("measured", [True, False], ids=["of parameters", "of a rest shape"])
def test_the_motion_of_a_body_keeps_that_body(layer, motion, tmp_path, measured):
    """In Python too, whatever body the motion was recorded with."""
    body = layer.identity({"shape": [1.0]})
    given = body if measured else layer.identity_from_rest(body.fitted_rest)
    played = animate(
        layer, given, replace(motion, identity={"backend": "anny", "params": {"age": 0.1}})
    ).motion
    write(played, tmp_path / "m.npz")
    again = stored_identity(layer, read_motion(tmp_path / "m.npz").identity)
    torch.testing.assert_close(again.rest, given.rest, atol=GROUND_TOLERANCE, rtol=0)
