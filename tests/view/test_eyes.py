"""Eyeballs of pictures and files: they lie in their sockets and turn with their joints."""

import numpy as np
import pytest
import torch

from soma_core import USER_JOINTS, Motion, SomaLayer
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.io import open_vertex_sequence
from soma_core.io.eyeballs import eyeball
from soma_core.io.glb_animation import NodeTracks
from soma_core.io.glb_file import GlbFile
from soma_core.motion.products import write_body
from soma_core.view.picture import with_eyes
from soma_core.view.stage import Body

EYE_TOLERANCE_MM = 0.01
"""Of float32, down a chain of joints."""

VERTEX_TOLERANCE_MM = 0.1


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low", correctives=None, procedural=False)


@pytest.fixture(scope="module")
def rotations():
    rotations = torch.zeros(2, 77, 3)
    rotations[1, USER_JOINTS.index("LeftEye"), 1] = 0.5
    rotations[1, USER_JOINTS.index("Head"), 0] = 0.3
    return rotations


@pytest.fixture(scope="module")
def shown(layer, rotations):
    """The body of each frame as it is drawn."""
    posed = layer.pose(layer.identity(), rotations)
    skins = (
        Body(vertices=skin, triangles=layer.mesh.triangles, colour=(1.0, 0.5, 0.0))
        for skin in posed.vertices.numpy()
    )
    return [with_eyes(*given, layer.rig) for given in zip(skins, posed.transforms.numpy(), strict=True)]


@pytest.fixture(scope="module", params=["body.glb", "body.usdc"])
def file(request, layer, rotations, tmp_path_factory):
    path = tmp_path_factory.mktemp("eyes") / request.param
    turns = axis_angle_to_matrix(rotations).numpy()
    motion = Motion(rotations=turns, joint_names=USER_JOINTS, translation=np.zeros((2, 3)), fps=30.0)
    write_body(path, layer, layer.identity(), motion)
    return path


@pytest.mark.parametrize(("frame", "turned"), [(0, 0.0), (1, 0.5)])
def test_eyes_lie_in_their_sockets_and_look_where_their_joints_do(layer, shown, frame, turned):
    ball, count = eyeball()[0], layer.mesh.vertex_count
    front, drawn = ball[:, 2].argmax(), shown[frame]
    skin = drawn.vertices[:count]
    np.testing.assert_array_equal(drawn.shades[:count], np.tile([1.0, 0.5, 0.0], (count, 1)))
    assert len(drawn.vertices) == len(drawn.shades) == count + 2 * len(ball)
    assert drawn.triangles.max() == len(drawn.vertices) - 1
    left, right = (drawn.vertices[count + k * len(ball) :][: len(ball)] for k in (0, 1))
    radius = np.ptp(left[:, 0]) / 2
    for eye in (left, right):
        apart = np.linalg.norm(skin - eye.mean(0), axis=1).min()
        assert 0.8 < apart / radius < 1.1  # lids touch the ball, and none cuts deep into it
    looks = [eye[front] - eye.mean(0) for eye in (left, right)]
    cosine = looks[0] @ looks[1] / np.prod([np.linalg.norm(look) for look in looks])
    np.testing.assert_allclose(cosine, np.cos(turned), atol=2e-3)


def eyes_of_glb(path):
    """Vertices of both eyeballs, frame by frame."""
    file = GlbFile(path)
    nodes = [index for index, node in enumerate(file.document["nodes"]) if "Eyeball" in node["name"]]
    (mesh,) = {file.document["nodes"][node]["mesh"] for node in nodes}
    ball = file.accessor(file.document["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"])
    tracks = NodeTracks(file)
    for worlds in tracks.worlds(tracks.times, nodes):
        yield np.concatenate([ball @ world[:3, :3].T + world[:3, 3] for world in worlds])


def eyes_of_usd(path):
    pxr = pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom, UsdSkel  # noqa: F401 - pxr loads them

    stage = pxr.Usd.Stage.Open(pxr.Usd.Stage.Open(str(path)).Flatten())
    root = stage.GetDefaultPrim()
    assert UsdSkel.BakeSkinning(UsdSkel.Root(root), Gf.Interval(0, 1))
    for frame in (0, 1):
        cache, found = UsdGeom.XformCache(frame), []
        for name in ("LeftEyeball", "RightEyeball"):
            prim = root.GetChild(name)
            world = np.array(cache.GetLocalToWorldTransform(prim))
            points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(frame))
            found.append(points @ world[:3, :3] + world[3, :3])
        yield np.concatenate(found)


def test_files_have_the_eyes_of_the_pictures(layer, shown, file):
    found = list((eyes_of_glb if file.suffix == ".glb" else eyes_of_usd)(file))
    assert len(found) == len(shown)
    for eyes, drawn in zip(found, shown, strict=True):
        wanted = drawn.vertices[layer.mesh.vertex_count :]
        assert 1e3 * np.linalg.norm(eyes - wanted, axis=1).max() < EYE_TOLERANCE_MM


def test_the_body_is_still_what_is_read(layer, shown, file):
    with open_vertex_sequence(file) as sequence:
        found = sequence.read(0, 2)
    wanted = np.stack([drawn.vertices[: layer.mesh.vertex_count] for drawn in shown])
    assert 1e3 * np.linalg.norm(found - wanted, axis=-1).max() < VERTEX_TOLERANCE_MM
