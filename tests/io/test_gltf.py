"""The GLB is valid in structure, and skinning it by hand gives the same body."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError
from soma_core.io.gltf import write_gltf

VERTEX_TOLERANCE_MM = 0.1
"""Largest distance between a re-opened file and the body; float32 storage needs about 0.002."""

REST_TOLERANCE = 1e-6
"""Positions of about two metres in float32 [m]."""

WEIGHT_SUM_TOLERANCE = 1e-6
"""Sum of up to sixteen float32 weights; the glTF validator accepts 2e-7 per weight."""

_TYPES = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    """An independent reader of what glTF 2.0 says."""

    def __init__(self, content):
        magic, version, length = struct.unpack_from("<4sII", content)
        assert (magic, version, length) == (b"glTF", 2, len(content))
        size, kind = struct.unpack_from("<I4s", content, 12)
        assert kind == b"JSON"
        assert size % 4 == 0
        self.json = json.loads(content[20 : 20 + size])
        data_size, kind = struct.unpack_from("<I4s", content, 20 + size)
        assert kind == b"BIN\0"
        self.data = content[28 + size :]
        assert len(self.data) == data_size == self.json["buffers"][0]["byteLength"]

    def accessor(self, index):
        accessor = self.json["accessors"][index]
        if "sparse" not in accessor:
            return self.values(accessor, accessor, accessor["count"])
        sparse = accessor["sparse"]
        found = np.zeros((accessor["count"], _WIDTHS[accessor["type"]]), np.float32)
        places = self.values(sparse["indices"], {"type": "SCALAR", **sparse["indices"]}, sparse["count"])
        assert (np.diff(places.astype(int)) > 0).all()
        found[places] = self.values(sparse["values"], accessor, sparse["count"])
        return found

    def values(self, place, of, count):
        view = self.json["bufferViews"][place["bufferView"]]
        kind, width = np.dtype(_TYPES[of["componentType"]]), _WIDTHS[of["type"]]
        values = np.frombuffer(self.data, kind, count * width, view["byteOffset"])
        return values.reshape(count, width) if width > 1 else values

    def attribute(self, name):
        return self.accessor(self.json["meshes"][0]["primitives"][0]["attributes"][name])

    def node_worlds(self, frame):
        """World transforms of all nodes at a key frame."""
        nodes = self.json["nodes"]
        track = {
            (n, p): np.array(node[p])
            for n, node in enumerate(nodes)
            for p in ("translation", "rotation")
            if p in node
        }
        animation = self.json["animations"][0]
        for channel in animation["channels"] if frame is not None else ():
            values = self.accessor(animation["samplers"][channel["sampler"]]["output"])
            track[channel["target"]["node"], channel["target"]["path"]] = values[frame]
        worlds = {}

        def visit(node, parent):
            local = np.eye(4)
            local[:3, 3] = track.get((node, "translation"), np.zeros(3))
            local[:3, :3] = Rotation.from_quat(track.get((node, "rotation"), [0, 0, 0, 1])).as_matrix()
            worlds[node] = parent @ local
            for child in nodes[node].get("children", ()):
                visit(child, worlds[node])

        for root in self.json["scenes"][0]["nodes"]:
            visit(root, np.eye(4))
        return worlds

    def skinned(self, frame):
        skin = self.json["skins"][0]
        inverse = self.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(-1, -2)
        worlds = self.node_worlds(frame)
        matrices = np.stack([worlds[node] for node in skin["joints"]]) @ inverse
        names = sorted(
            n for n in self.json["meshes"][0]["primitives"][0]["attributes"] if n.startswith("JOINTS")
        )
        primitive, animation = self.json["meshes"][0]["primitives"][0], self.json["animations"][0]
        (weights,) = (
            animation["samplers"][channel["sampler"]]["output"]
            for channel in animation["channels"]
            if channel["target"] == {"node": 0, "path": "weights"}
        )
        targets = np.stack([self.accessor(target["POSITION"]) for target in primitive["targets"]])
        moved = np.tensordot(self.accessor(weights).reshape(-1, len(targets))[frame], targets, 1)
        rest = np.c_[self.attribute("POSITION") + moved, np.ones(len(moved))]
        total = np.zeros((len(rest), 3))
        for name in names:
            joints, weights = self.attribute(name), self.attribute(name.replace("JOINTS", "WEIGHTS"))
            total += np.einsum("vk,vkab,vb->va", weights, matrices[joints][:, :, :3], rest)
        return total


@pytest.fixture(scope="module")
def path(clip, tmp_path_factory):
    path = tmp_path_factory.mktemp("gltf") / "body.glb"
    write_gltf(path, clip)
    return path


@pytest.fixture(scope="module")
def glb(path):
    return Glb(path.read_bytes())


def test_skinning_by_hand_gives_the_same_vertices(glb, clip, posed):
    for frame in range(clip.frame_count):
        vertices = glb.skinned(frame)[: clip.mesh.vertex_count]
        assert np.linalg.norm(vertices - posed[frame], axis=1).max() * 1000 < VERTEX_TOLERANCE_MM


def test_seam_copies_follow_their_canonical_vertex(glb, clip):
    count = clip.mesh.vertex_count
    assert glb.json["asset"]["extras"]["canonical_vertex_count"] == count
    positions = glb.attribute("POSITION")
    assert len(positions) > count  # the tube has a seam
    np.testing.assert_allclose(positions[:count], clip.rest, atol=REST_TOLERANCE)
    indices = glb.accessor(glb.json["meshes"][0]["primitives"][0]["indices"]).reshape(-1, 3)
    np.testing.assert_allclose(positions[indices], clip.rest[clip.mesh.triangles], atol=REST_TOLERANCE)


def test_uv_of_every_triangle_corner(glb, clip):
    mesh = clip.mesh
    want = {}
    for face in range(len(mesh.face_vert_counts)):
        for corner in range(4 * face, 4 * face + 4):
            want[face, int(mesh.face_vert_indices[corner])] = mesh.uv[mesh.uv_indices[corner]]
    indices = glb.accessor(glb.json["meshes"][0]["primitives"][0]["indices"]).reshape(-1, 3)
    uv = glb.attribute("TEXCOORD_0")[indices]
    expected = np.array(
        [[want[row // 2, v] for v in triangle] for row, triangle in enumerate(mesh.triangles.tolist())]
    )
    np.testing.assert_allclose(uv, expected * [1, -1] + [0, 1], atol=REST_TOLERANCE)


def test_rest_nodes_are_the_t_pose(glb, clip):
    worlds = glb.node_worlds(None)
    rest = np.stack([worlds[joint + 1] for joint in range(clip.rig.joint_count)])
    np.testing.assert_allclose(rest, clip.t_pose_world, atol=REST_TOLERANCE)
    assert [node["name"] for node in glb.json["nodes"][1:]] == list(clip.rig.joint_names)


def test_weights_sum_to_one_and_come_heaviest_first(glb):
    weights = np.concatenate([glb.attribute("WEIGHTS_0"), glb.attribute("WEIGHTS_1")], axis=1)
    assert np.abs(weights.sum(axis=1) - 1).max() < WEIGHT_SUM_TOLERANCE
    assert (np.diff(weights, axis=1) <= 0).all()


def test_structure_follows_the_specification(glb, clip):
    attributes = glb.json["meshes"][0]["primitives"][0]["attributes"].values()
    for view in glb.json["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= len(glb.data)
    for index, accessor in enumerate(glb.json["accessors"]):
        if "sparse" in accessor:
            values = glb.accessor(index)
            np.testing.assert_array_equal(accessor["min"], values.min(axis=0))
            np.testing.assert_array_equal(accessor["max"], values.max(axis=0))
            continue
        view = glb.json["bufferViews"][accessor["bufferView"]]
        assert view.get("target") == (
            34962
            if index in attributes
            else 34963
            if accessor["type"] == "SCALAR" and accessor["componentType"] != 5126
            else None
        )
    positions = glb.json["accessors"][glb.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    np.testing.assert_array_equal(positions["min"], glb.attribute("POSITION").min(axis=0))
    np.testing.assert_array_equal(positions["max"], glb.attribute("POSITION").max(axis=0))
    times = glb.json["accessors"][glb.json["animations"][0]["samplers"][0]["input"]]
    assert times["min"] == [0.0]
    assert times["max"] == pytest.approx([(clip.frame_count - 1) / clip.fps])
    assert glb.json["asset"]["copyright"] == "CC0-1.0"


def test_trimesh_reads_the_rest_mesh(path, clip):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    scene = trimesh.load(path, process=False)
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(mesh.vertices[: clip.mesh.vertex_count], clip.rest, atol=REST_TOLERANCE)
    assert mesh.faces.shape == clip.mesh.triangles.shape


def test_mesh_without_uv_keeps_its_vertices(clip, tmp_path):
    bare = replace(clip.mesh, uv=np.empty((0, 2), np.float32), uv_indices=np.empty(0, np.int32))
    write_gltf(tmp_path / "bare.glb", replace(clip, mesh=bare))
    glb = Glb((tmp_path / "bare.glb").read_bytes())
    assert len(glb.attribute("POSITION")) == bare.vertex_count
    assert "TEXCOORD_0" not in glb.json["meshes"][0]["primitives"][0]["attributes"]


def test_a_body_at_rest_has_one_channel(clip, tmp_path):
    local = clip.t_pose_local()
    quaternions = Rotation.from_matrix(local[:, :3, :3]).as_quat(canonical=True)[None]
    write_gltf(
        tmp_path / "still.glb",
        replace(clip, translations=local[None, :, :3, 3], quaternions=quaternions, shapes=None),
    )
    glb = Glb((tmp_path / "still.glb").read_bytes())
    assert len(glb.json["animations"][0]["channels"]) == 1


def test_a_foreign_triangle_is_refused(clip, tmp_path):
    triangles = clip.mesh.triangles.copy()
    triangles[5] = (0, 40, 80)
    with pytest.raises(InputError, match=r"triangle 5 \(0, 40, 80\)"):
        write_gltf(tmp_path / "body.glb", replace(clip, mesh=replace(clip.mesh, triangles=triangles)))


def test_another_suffix_is_refused(clip, tmp_path):
    with pytest.raises(InputError, match=r"body\.gltf"):
        write_gltf(tmp_path / "body.gltf", clip)
