"""Products of a motion on its body: the joints and vertices of the layer, in one file or a folder of them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from soma_core import SomaLayer
from soma_core.choices import Product
from soma_core.cli import EXIT_OK, EXIT_USAGE, main
from soma_core.errors import AssetError, InputError
from soma_core.io import open_vertex_sequence, write_motion
from soma_core.motion import (
    BackendChoice,
    ConvertOptions,
    convert_file,
    convert_folder,
    load_clip,
    played,
    write_products,
)
from soma_core.motion.writers import MESH_WRITERS, WRITERS, listed_writers
from soma_core.options import BvhChoice, FrameRange

ROUNDING = 1e-6
"""Metres: float32 at the size of a body."""

BODY = {"backend": "soma", "params": {"shape": [1.0, -0.5]}}
CAMERA = {
    "fx": 800,
    "fy": 800,
    "cx": 320,
    "cy": 240,
    "extrinsics": [[1, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 4]],
}


@pytest.fixture(scope="module")
def clip():
    return replace(load_clip(frames=FrameRange(start=0, stop=330, step=110)), identity=BODY)


@pytest.fixture
def file(clip, tmp_path):
    write_motion(clip, tmp_path / "m.npz")
    return tmp_path / "m.npz"


@pytest.fixture(scope="module")
def posed(clip):
    layer = SomaLayer("soma", lod="low")
    values = torch.as_tensor(clip.rotations), torch.as_tensor(clip.translation)
    return layer.pose(layer.identity(BODY["params"]), *values)


def converted(path, out, **changes):
    return convert_file(path, out, options=ConvertOptions(lod="low", **changes))


def test_every_product_has_a_row_and_a_line_of_help():
    assert list(WRITERS) == [product for product in WRITERS if product in Product]
    assert set(WRITERS) == set(Product)
    assert all(f"  {product} " in listed_writers() for product in Product)
    assert len({writer.file for writer in WRITERS.values()}) == len(WRITERS)


def test_joints_are_those_of_the_layer_and_no_mesh_is_posed(file, posed, tmp_path, monkeypatch):
    monkeypatch.setattr(SomaLayer, "pose", lambda *_, **__: pytest.fail("a mesh was posed"))
    monkeypatch.setattr(played, "_CHUNK", 2)
    found = converted(file, tmp_path / "out", write=["joints"], joints=["LeftHand", "Hips", "LeftForeArm"])
    with np.load(tmp_path / "out/joints.npz") as joints:
        names = SomaLayer("soma", lod="low").joint_names
        places = [names.index(name) for name in joints["joint_names"]]
        assert joints["parents"].tolist() == [2, -1, 1]
        np.testing.assert_allclose(joints["positions"], posed.joints[:, places], atol=ROUNDING)
        x, y, z = (joints["quaternions"][..., axis] for axis in (1, 2, 3))
        w = joints["quaternions"][..., 0]
        turned = np.stack(
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1
        )  # the x axis
        np.testing.assert_allclose(turned, posed.transforms[:, 1:][:, places, :3, 0], atol=ROUNDING)
    assert found.written == {"npz": tmp_path / "out/motion.npz", "joints": tmp_path / "out/joints.npz"}


def test_vertices_are_those_of_the_layer_whatever_the_file(file, posed, tmp_path):
    converted(file, tmp_path, write=["vertices", "obj", "usdpoints"], write_up="z")
    shown = posed.vertices.numpy()
    turned = np.stack([shown[..., 0], -shown[..., 2], shown[..., 1]], -1)
    for name in ("vertices.npz", "obj", "vertices.usdc"):
        with open_vertex_sequence(tmp_path / name) as sequence:
            np.testing.assert_allclose(sequence.read(0, 3), turned, atol=ROUNDING)
            assert sequence.up in ("+z", None)


def test_keypoints_are_seen_from_the_world_of_the_motion(file, posed, tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA))
    converted(file, tmp_path, to="keypoints", camera=str(tmp_path / "camera.json"), joints=["Head"])
    head = posed.joints[:, SomaLayer("soma", lod="low").joint_names.index("Head")].double().numpy()
    expected = np.stack([800 * head[:, 0], 800 * (1 - head[:, 1])], -1) / (4 - head[:, 2:]) + [320, 240]
    with np.load(tmp_path / "keypoints.npz") as keypoints:
        np.testing.assert_allclose(keypoints["keypoints"][:, 0], expected, atol=1e-3)


def test_the_body_can_be_chosen_and_put_on_the_ground(file, tmp_path):
    pytest.importorskip("soma_backend_toy")
    place = {"translation": "ground", "ground": "lowest"}
    choice = {"write": ["vertices"], "backend": BackendChoice(name="toy"), **place}
    converted(file, tmp_path, **choice)
    with open_vertex_sequence(tmp_path / "vertices.npz") as sequence:
        assert abs(sequence.read(0, 3)[..., 1].min()) < 1e-5


def test_products_are_written_once(file, tmp_path, monkeypatch):
    """A second call adds what is missing; other settings make a product anew."""
    made = []
    monkeypatch.setattr(
        "soma_core.motion.products.write_products",
        lambda played, products, *rest, **more: (
            made.append(products) or write_products(played, products, *rest, **more)
        ),
    )
    for write, settings in (
        (["joints"], {}), (["joints", "csv"], {}), (["joints", "csv"], {}), (["csv"], {"joints": ["Hips"]}),
    ):  # fmt: skip
        converted(file, tmp_path / "out", write=write, **settings)
    assert made == [["joints"], ["csv"], ["csv"]]
    header = (tmp_path / "out/joints.csv").read_text().split("\n")[0]
    assert header.endswith("up,Hips_x_m,Hips_y_m,Hips_z_m,Hips_qw,Hips_qx,Hips_qy,Hips_qz")


def test_a_folder_has_a_folder_for_each_product(clip, tmp_path):
    (tmp_path / "in/a").mkdir(parents=True)
    for name in ("a/walk.npz", "run.npz"):
        write_motion(clip, tmp_path / "in" / name)
    options = ConvertOptions(lod="low", write=["csv", "ply"])
    found = convert_folder(tmp_path / "in", tmp_path / "out", options=options)
    assert not found.errors
    files = {path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.*")}
    frames = {f"ply/{name}/frame_{number:06d}.ply" for name in ("a/walk", "run") for number in range(3)}
    assert files == frames | {
        "report.json", "csv/a/walk.csv", "csv/run.csv", "motions/a/walk.npz", "motions/run.npz",
        "reports/a/walk.json", "reports/run.json",
    }  # fmt: skip


def test_the_command_says_what_was_written_where(file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["input=m.npz", "out=made", "lod=low", "write=[csv]", "joints=[Hips,LeftHand]"]
    assert main(["convert", *command]) == EXIT_OK
    streams = capsys.readouterr()
    assert "wrote motion.npz, joints.csv\n" in streams.err
    assert streams.out.splitlines()[-1] == "made"
    assert main(["animate", "lod=low", "frames.stop=2", "write=[csv]", "camera=c.json"]) == EXIT_USAGE
    said = "camera: got c.json, expected none with write=[csv]. Leave camera out, or write one of keypoints."
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"joints": ["Hips"]},
            r"joints: got \['Hips'\], expected none with write=\[npz\].*or write one of joints, csv",
        ),
        ({"write": ["obj"], "camera": "c"}, r"camera: got c, expected none with write=\[obj\]"),
        ({"write": ["glb"], "write_up": "z"}, r"write_up: got z, expected none with write=\[glb\]"),
        ({"write": ["keypoints"]}, r"camera: got none, expected the camera.*camera=FILE\.json"),
        (
            {"write": ["obj"], "bvh": BvhChoice(order="XYZ")},
            r"bvh: got order=XYZ, expected none with write=.obj.",
        ),
        ({"write": ["abc"]}, "write: got 'abc', expected one of npz, usd, glb"),
        ({"write": [1]}, "write: got 1, expected one of npz"),
    ],
)
def test_what_does_not_apply_is_refused(changes, said):
    with pytest.raises(InputError, match=said):
        ConvertOptions(**changes)


def test_what_is_asked_for_can_be_wrong(file, tmp_path, clip):
    with pytest.raises(AssetError, match=r"nix\.json: file is missing"):
        converted(file, tmp_path / "c", to="keypoints", camera="nix.json")
    assert not (tmp_path / "c").exists()
    with pytest.raises(InputError, match="to: got fbx.*to=glb; docs/to_fbx.py"):
        ConvertOptions(to="fbx")
    with pytest.raises(
        InputError, match="joints: got 'Hip', expected names among Hips, Spine1.*mean \"Hips\""
    ):
        converted(file, tmp_path / "a", write=["joints"], joints=["Hip"])
    write_motion(replace(clip, identity={}), tmp_path / "none.npz")
    with pytest.raises(InputError, match=r"backend: got none, and no body in none\.npz"):
        converted(tmp_path / "none.npz", tmp_path / "b", write=["obj"])


def test_a_file_that_tells_its_body_shows_that_one(smplh_models, amass_file, tmp_path):
    with pytest.raises(InputError, match=r"backend: got soma, expected none: walk_poses\.npz tells whose"):
        converted(amass_file, tmp_path, write=["obj"], backend=BackendChoice(name="soma"))


def test_a_fitted_body_is_written_without_another_fit(smplh_models, amass_file, tmp_path):
    converted(amass_file, tmp_path)
    found = converted(amass_file, tmp_path, write=["pc2"])
    assert found.earlier
    assert found.report["products"]["files"] == {"pc2": "vertices.pc2"}
    assert json.loads((tmp_path / "report.json").read_text()) == found.report
    assert set(MESH_WRITERS) == {"vertices", "obj", "ply", "pc2", "mdd", "usdpoints"}


@pytest.mark.parametrize("choice", [{}, {"order": "XYZ", "rest": "bind", "unit": "m", "joints": 78}])
def test_a_bvh_has_the_joints_of_the_layer(file, posed, tmp_path, choice):
    """Parsed here, line by line: offsets, channels, and the walk down the tree."""
    converted(file, tmp_path, to="bvh", bvh=BvhChoice(**choice))
    places, names = joints_of_bvh(tmp_path / "motion.bvh")
    metres = 1.0 if choice else 0.01
    known = SomaLayer("soma", lod="low").joint_names
    assert set(known) <= set(names)
    ours = np.stack([places[:, names.index(name)] for name in known], 1) * metres
    assert np.abs(ours - posed.joints.numpy()).max() < BVH_ROUNDING


BVH_ROUNDING = 2e-6
"""Metres: the layer is float32."""


def joints_of_bvh(path):
    """World places (frames, J, 3) and names of the joints."""
    head, _, tail = path.read_text().partition("MOTION")
    names, parents, offsets, channels, stack = [], [], [], [], []
    for line in head.splitlines():
        words = line.split()
        if words[:1] in (["ROOT"], ["JOINT"]):
            names.append(words[1])
            parents.append(stack[-1] if stack else -1)
        elif words[:1] == ["End"]:
            names.append("end")
            parents.append(stack[-1])
        elif words == ["{"]:
            stack.append(len(names) - 1)
        elif words == ["}"]:
            stack.pop()
        elif words[:1] == ["OFFSET"]:
            offsets.append([float(word) for word in words[1:]])
        elif words[:1] == ["CHANNELS"]:
            channels += [(len(names) - 1, word) for word in words[2:]]
    rows = [line.split() for line in tail.strip().splitlines()[2:]]
    values = np.array(rows, float)
    turn = np.tile(np.eye(3), (len(values), len(names), 1, 1))
    place = np.tile(np.array(offsets), (len(values), 1, 1))
    moved = set()
    for column, (joint, channel) in zip(values.T, channels, strict=True):
        axis = "XYZ".index(channel[0])
        if channel.endswith("position"):
            if joint not in moved:
                place[:, joint] = 0
            moved.add(joint)
            place[:, joint, axis] = column
        else:
            turn[:, joint] = (
                turn[:, joint] @ Rotation.from_euler("xyz"[axis], column[:, None], degrees=True).as_matrix()
            )
    for joint, parent in enumerate(parents):
        if parent >= 0:
            place[:, joint] = place[:, parent] + np.einsum("fab,fb->fa", turn[:, parent], place[:, joint])
            turn[:, joint] = turn[:, parent] @ turn[:, joint]
    return place, names
