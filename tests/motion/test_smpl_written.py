"""Poses of SMPL models as they are written, under an evaluator that takes what smplx's code takes."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core import SomaLayer, load_canonical
from soma_core.errors import InputError
from soma_core.io import read_motion, write_motion
from soma_core.motion import ConvertOptions, back, convert_file, load_clip
from soma_core.native import NativeFit, NativeTransfer
from soma_core.options import FrameRange

WIDTHS = {"smplx": 10, "smplh": 16}
BODY = [0.8, -0.5, 0.4] + [0.0] * 7

SAME_SHARE = 0.05
"""Of the mean error that the report has: that one leaves the inside of the face out."""

ROUND_TRIP_MM = 0.6
"""Mean distance of the skin after a motion went to parameters of the model, its mesh, and back."""


@pytest.fixture(scope="module")
def data_folder(tmp_path_factory):
    """Stand-ins of SMPL-X with ten shape directions and of SMPL-H with sixteen, as a user has them."""
    pytest.importorskip("soma_backend_smpl.smplx")
    from soma_backend_smpl import smplh, smplx

    from tests.standins.smpl_files import smpl_arrays, write_npz, write_smpl_wrap

    root = tmp_path_factory.mktemp("models")
    models = {"smplx": (smplx, "SMPLX_NEUTRAL.npz", 20), "smplh": (smplh, "neutral/model.npz", 16)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOMA_DATA_DIR", str(root))
        patch.setenv("SOMA_CACHE_DIR", str(root / "cache"))
        for name, (module, file, width) in models.items():
            arrays = smpl_arrays(name, width=width)
            module.soma_convert(write_npz(root / "official" / name / file, arrays), None)
            write_smpl_wrap(root, name)
        patch.setattr(back, "NativeFit", shared_fit())
        yield root


def shared_fit():
    """Builds a fit of each kind once for all conversions here, as one conversion does for its files."""
    made = {}

    def build(name, **kind):
        key = name, repr(kind)
        if key not in made:
            made[key] = NativeFit(name, **kind)
        return made[key]

    return build


@pytest.fixture(scope="module")
def motion_file(data_folder):
    """Four frames of the shipped motion on a body of SMPL-X."""
    clip = load_clip(frames=FrameRange(start=0, stop=280, step=90))
    write_motion(
        replace(clip, identity={"backend": "smplx", "params": {"betas": BODY}}), data_folder / "m.npz"
    )
    return data_folder / "m.npz"


def shown_vertices(path, lod="low"):
    """Canonical vertices [m] of a motion on that body."""
    layer, clip = SomaLayer("smplx", lod=lod), read_motion(path)
    rotations, hips = torch.as_tensor(clip.rotations), torch.as_tensor(clip.translation)
    return layer.pose(layer.identity({"betas": BODY}), rotations, hips).vertices


def smplx_style(name, file):
    """Vertices (frames, v, 3) as smplx evaluates them: every coefficient of the file meets a direction."""
    from tests.standins.smpl_files import smpl_arrays

    model = smpl_arrays(name, width={"smplx": 20, "smplh": 16}[name])
    if "poses" in file:
        poses, place, betas = file["poses"], file["trans"], file["betas"][None]
    else:
        face = [file[key] for key in ("jaw_pose", "leye_pose", "reye_pose") if key in file]
        hands = file["left_hand_pose"], file["right_hand_pose"]
        assert bool(file["flat_hand_mean"])
        poses = np.concatenate([file["global_orient"], file["body_pose"], *face, *hands], 1)
        place, betas = file["transl"], file["betas"]
    directions = model["shapedirs"][:, :, : WIDTHS[name]]  # as smplx.create(num_betas=...) keeps them
    rest = model["v_template"] + np.einsum("bl,mkl->bmk", betas, directions)
    joints = np.einsum("bik,ji->bjk", rest, model["J_regressor"])
    turns = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(len(poses), -1, 3, 3)
    feature = (turns[:, 1:] - np.eye(3)).reshape(len(poses), -1)
    rest = rest + np.einsum("bl,mkl->bmk", feature, model["posedirs"])
    joints = np.broadcast_to(joints, (len(poses), *joints.shape[1:]))
    world = np.tile(np.eye(4), (*turns.shape[:2], 1, 1))
    for joint, parent in enumerate(model["kintree_table"][0]):
        local = np.tile(np.eye(4), (len(poses), 1, 1))
        local[:, :3, :3] = turns[:, joint]
        local[:, :3, 3] = joints[:, joint] - (joints[:, parent] if parent >= 0 else 0)
        world[:, joint] = local if parent < 0 else world[:, parent] @ local
    world[..., :3, 3] -= np.einsum("bjrc,bjc->bjr", world[..., :3, :3], joints)
    skin = np.einsum("vj,bjrc->bvrc", model["weights"], world[..., :3, :])
    posed = np.einsum("bvrc,bvc->bvr", skin[..., :3], rest) + skin[..., 3]
    return posed + place[:, None]


@pytest.mark.parametrize(
    ("name", "changes", "width"),
    [
        ("smplx", {"layout": "smplx"}, 10), ("smplx", {"num_betas": 16}, 16), ("smplh", {}, 16),
        ("smplh", {"layout": "smplx", "num_betas": 10}, 10),
    ],
)  # fmt: skip
def test_a_body_model_takes_what_is_written(motion_file, tmp_path, monkeypatch, name, changes, width):
    monkeypatch.setitem(WIDTHS, name, min(width, {"smplx": 10, "smplh": 16}[name]))
    options = ConvertOptions(to=name, lod="low", up="y", **changes)
    found = convert_file(motion_file, tmp_path, options=options)
    with np.load(tmp_path / "motion.npz", allow_pickle=False) as file:
        written = dict(file)
    assert written["betas"].shape == ((1, width) if "layout" in changes else (width,))
    if width > 10 and name == "smplx":  # a model file of ten directions: the others must be zero
        assert not written["betas"][10:].any()
        written["betas"] = written["betas"][:10]
    shown = smplx_style(name, written)
    transfer = NativeTransfer(name, lod="low")
    target = transfer(shown_vertices(motion_file)).numpy()
    covered = transfer.covered.numpy()
    error = 1e3 * np.linalg.norm(shown - target, axis=-1)[:, covered].mean()
    with np.load(tmp_path / "frames.npz") as frames:
        told = 1e3 * frames["mean_error"].mean()
    assert abs(error - told) < SAME_SHARE * told
    assert found.report["settings"]["to_layout"] == changes.get("layout", "amass")


def test_there_and_back_as_close_as_the_models_allow(motion_file, tmp_path):
    convert_file(motion_file, tmp_path / "there", options=ConvertOptions(to="smplx"))
    convert_file(tmp_path / "there/motion.npz", tmp_path / "back")
    before, after = (shown_vertices(file, lod="mid") for file in (motion_file, tmp_path / "back/motion.npz"))
    mesh = load_canonical("mid")[0]
    outside = np.setdiff1d(np.arange(mesh.vertex_count), mesh.face_interior)
    distance = (after - before).norm(dim=-1)[:, outside]
    assert 1e3 * float(distance.mean()) <= ROUND_TRIP_MM
    assert len(read_motion(tmp_path / "back/motion.npz").identity["params"]["betas"]) == 10


@pytest.mark.parametrize(("layout", "key"), [("amass", "expressions"), ("smplx", "expression")])
def test_the_face_comes_back_where_the_model_is_the_same(layout, key, motion_file, tmp_path):
    """Coefficients of SMPL-X are kept beside the motion of its body, which moves the jaw alone."""
    options = ConvertOptions(to="smplx", lod="low", layout=layout)
    convert_file(motion_file, tmp_path / "a", options=options)
    with np.load(tmp_path / "a/motion.npz") as file:
        content = dict(file)
    assert not np.any(content.pop(key, 0))
    frames = len(content["trans" if layout == "amass" else "transl"])
    face = np.random.default_rng(1).normal(size=(frames, 50)).astype(np.float32)
    np.savez(tmp_path / "face.npz", **content, **{key: face})
    found = convert_file(tmp_path / "face.npz", tmp_path / "b", options=ConvertOptions(lod="low", chunk=3))
    assert any("50 coefficients, are left out" in text for text in found.report["warnings"])
    np.testing.assert_array_equal(found.motion().expression, face)
    np.testing.assert_array_equal(found.motion().cut(slice(1, 3)).expression, face[1:3])
    convert_file(tmp_path / "b/motion.npz", tmp_path / "c", options=options)
    with np.load(tmp_path / "c/motion.npz") as file:
        np.testing.assert_array_equal(file[key], face)
    options = ConvertOptions(to="smplh", lod="low")
    convert_file(tmp_path / "b/motion.npz", tmp_path / "d", options=options)
    with np.load(tmp_path / "d/motion.npz") as file:
        assert key not in file


def test_fewer_betas_than_the_body_has_are_said(motion_file, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        options = ConvertOptions(to="smplx", lod="low", num_betas=1)
        found = convert_file(motion_file, tmp_path, options=options)
    assert "num_betas=1 leaves out betas of up to 0.5; the body is the nearest without them" in caplog.text
    with np.load(tmp_path / "motion.npz") as file:
        np.testing.assert_array_equal(file["betas"], np.float32(BODY[:1]))
    assert found.report["settings"]["params"] == {"betas": BODY[:1]}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"num_betas": 10}, "num_betas: got 10, expected none with to=soma"),
        ({"layout": "smplx"}, "layout: got smplx, expected none with to=soma"),
        ({"to": "smplx", "num_betas": 0}, "num_betas: got 0, expected at least 1"),
        ({"to": "smplx", "layout": "vibe"}, "layout: got 'vibe', expected one of amass, smplx"),
        (
            {"to": "smplx", "write": ["joints"]},
            "write: got joints, expected with to=smplx, npz for its poses",
        ),
        ({"to": "smplx", "write": ["npz", "obj"]}, "write: got poses and obj, expected with to=smplx"),
        ({"to": "smplx", "write": ["obj"], "write_up": "z"}, "write_up: got z, expected none with to=smplx"),
    ],
)
def test_settings_that_do_not_apply_are_refused(changes, said):
    with pytest.raises(InputError, match=said):
        ConvertOptions(**changes)


def test_poses_have_no_place_among_vertices(motion_file, tmp_path):
    for changes in ({"num_betas": 10}, {"layout": "smplx"}):
        options = ConvertOptions(to="smplx", lod="low", result="vertices", **changes)
        with pytest.raises(
            InputError, match=f"{next(iter(changes))}: got .*, expected none: vertices of smplx"
        ):
            convert_file(motion_file, tmp_path, options=options)


def test_the_mesh_of_a_model_is_written_as_any_product(motion_file, tmp_path):
    options = ConvertOptions(to="smplx", lod="low", write=["ply", "pc2"])
    found = convert_file(motion_file, tmp_path, options=options)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "ply", "report.json", "vertices.obj", "vertices.pc2",
    ]  # fmt: skip
    points = np.fromfile(tmp_path / "vertices.pc2", "<f4", offset=32).reshape(4, 10475, 3)
    target = NativeTransfer("smplx", lod="low")(shown_vertices(motion_file)).numpy()
    np.testing.assert_allclose(points, target, atol=1e-6)
    assert found.written == {"ply": tmp_path / "ply", "pc2": tmp_path / "vertices.pc2"}
    assert convert_file(motion_file, tmp_path, options=options).earlier
