import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from soma_core.errors import AssetError, InputError
from soma_core.paths import assets_dir
from soma_core.rig import load_canonical
from soma_core.rig.manifest import NEUTRAL_NAME, PROCEDURAL_NAME, RIG_NAME, read_manifest

MIRROR_M = 1e-6  # the source's two sides differ by 2e-7 m
ROTATION = 1e-12  # projected in float64


@pytest.fixture(scope="module")
def mid():
    return load_canonical()


@pytest.fixture(scope="module")
def low():
    return load_canonical("low")


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    root = tmp_path / "assets"
    root.mkdir()
    for name in (RIG_NAME, NEUTRAL_NAME, PROCEDURAL_NAME, "MANIFEST.json"):
        shutil.copy(assets_dir() / name, root / name)
    return root


def edges(triangles: np.ndarray) -> Counter:
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return Counter(map(tuple, pairs.tolist()))


@pytest.mark.parametrize(
    ("lod", "counts"),
    [("mid", (18056, 36108, 18054)), ("low", (4505, 9006, 4524)), ("xlo", (612, 1220, 1220))],
)
def test_counts(lod, counts):
    mesh, rig = load_canonical(lod)
    assert (mesh.vertex_count, len(mesh.triangles), len(mesh.face_vert_counts)) == counts
    assert mesh.face_vert_counts.sum() == len(mesh.face_vert_indices) == len(mesh.uv_indices)
    assert rig.joint_count == 78
    assert rig.weights.shape == (counts[0], 78)
    assert mesh.uv_indices.max() == len(mesh.uv) - 1


@pytest.mark.parametrize("lod", ["mid", "low", "xlo"])
def test_mesh_is_closed_oriented_and_of_genus_zero(lod):
    mesh, _ = load_canonical(lod)
    half = edges(mesh.triangles)
    assert set(half.values()) == {1}
    assert all((second, first) in half for first, second in half)
    assert mesh.vertex_count - len(half) // 2 + len(mesh.triangles) == 2


def test_low_mesh_has_the_edges_that_were_split(low):
    mesh, _ = low
    starts = np.cumsum(mesh.face_vert_counts) - mesh.face_vert_counts
    following = np.arange(len(mesh.face_vert_indices)) + 1
    following[starts + mesh.face_vert_counts - 1] = starts
    pairs = np.sort(np.stack([mesh.face_vert_indices, mesh.face_vert_indices[following]], axis=1), axis=1)
    assert len(np.unique(pairs, axis=0)) == 9027
    assert Counter(mesh.face_vert_counts.tolist()) == {4: 4482, 3: 42}


@pytest.mark.parametrize("lod", ["mid", "low", "xlo"])
def test_triangles_tile_the_polygons(lod):
    mesh, _ = load_canonical(lod)
    starts = np.cumsum(mesh.face_vert_counts) - mesh.face_vert_counts
    first = 0
    for start, count in zip(starts.tolist(), mesh.face_vert_counts.tolist(), strict=True):
        polygon = mesh.face_vert_indices[start : start + count].tolist()
        tiles = mesh.triangles[first : first + count - 2]
        first += count - 2
        outline = edges(tiles)
        outline = {edge for edge in outline if edge[::-1] not in outline}
        assert outline == set(zip(polygon, polygon[1:] + polygon[:1], strict=True))
    assert first == len(mesh.triangles)


def test_low_is_the_start_of_mid(mid, low):
    (mid_mesh, mid_rig), (low_mesh, low_rig) = mid, low
    np.testing.assert_array_equal(low_mesh.mid_ids, np.arange(4505))
    np.testing.assert_array_equal(low_mesh.vertices, mid_mesh.vertices[:4505])
    np.testing.assert_array_equal(low_rig.bind_world, mid_rig.bind_world)
    assert abs(low_rig.weights - mid_rig.weights[:4505]).max() == 0
    assert low_mesh.revision == mid_mesh.revision + "-low" == low_rig.revision


def test_low_uvs_are_those_of_mid_at_the_same_vertex(mid, low):
    (mid_mesh, _), (low_mesh, _) = mid, low
    seen = {}
    for vertex, uv in zip(mid_mesh.face_vert_indices.tolist(), mid_mesh.uv[mid_mesh.uv_indices], strict=True):
        seen.setdefault(vertex, set()).add(tuple(uv.tolist()))
    corners = zip(low_mesh.face_vert_indices.tolist(), low_mesh.uv[low_mesh.uv_indices].tolist(), strict=True)
    assert all(tuple(uv) in seen[vertex] for vertex, uv in corners)


@pytest.mark.parametrize("lod", ["mid", "low", "xlo"])
def test_mirror_is_an_involution_that_maps_faces_to_faces(lod):
    mesh, _ = load_canonical(lod)
    np.testing.assert_array_equal(mesh.mirror[mesh.mirror], np.arange(mesh.vertex_count))
    starts = np.cumsum(mesh.face_vert_counts) - mesh.face_vert_counts
    split = np.split(mesh.face_vert_indices, starts[1:])
    faces = {tuple(sorted(face.tolist())) for face in split}
    assert faces == {tuple(sorted(mesh.mirror[face].tolist())) for face in split}
    np.testing.assert_allclose(mesh.vertices[mesh.mirror], mesh.vertices * [-1, 1, 1], atol=MIRROR_M)


def test_mirror_swaps_the_weights_of_left_and_right(mid):
    mesh, rig = mid
    swapped = [
        name.replace("Left", "\0").replace("Right", "Left").replace("\0", "Right") for name in rig.joint_names
    ]
    order = [rig.joint_names.index(name) for name in swapped]
    difference = abs(rig.weights[mesh.mirror][:, order] - rig.weights)
    assert difference.mean() < 1e-4  # the painted weights are symmetric but for a few vertices


def test_no_vertex_follows_other_joints_than_the_skin_around_it(mid):
    """The source binds three vertices inside the upper lip to the jaw: spikes across an open mouth."""
    mesh, rig = mid
    weights = rig.skin.toarray()
    ends = np.concatenate([mesh.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])  # both ways
    around = np.zeros_like(weights)
    np.add.at(around, ends[:, 0], weights[ends[:, 1]])
    around /= np.bincount(ends[:, 0], minlength=len(weights))[:, None]

    assert np.abs(weights - around).max() < 0.3


def test_face_interior_is_one_mouth_bag_and_two_eye_bags(mid, low):
    mesh, _ = mid
    assert len(mesh.face_interior) == 691
    assert len(mesh.segments["mouth_bag"]) == 465
    eyes = mesh.segments["eye_bags"]
    assert Counter(np.sign(mesh.vertices[eyes, 0]).tolist()) == {1.0: 113, -1.0: 113}
    assert len(low[0].face_interior) == 175


@pytest.mark.parametrize("lod", ["mid", "low", "xlo"])
def test_segments_are_sorted_and_mirror_closed(lod):
    mesh, _ = load_canonical(lod)
    for name, ids in mesh.segments.items():
        assert ids.dtype == np.int32
        np.testing.assert_array_equal(ids, np.unique(ids), err_msg=name)
        np.testing.assert_array_equal(np.unique(mesh.mirror[ids]), ids, err_msg=name)
        empty = ("hair", "haircap", "mouth_bag", "eye_bags") if lod == "xlo" else ("hair", "haircap")
        assert (len(ids) == 0) == (name in empty), name


def test_segments_lie_where_their_names_say(mid):
    mesh, rig = mid
    height = {
        name: rig.bind_world[rig.joint_names.index(name), 1, 3]
        for name in ("Neck1", "LeftFoot", "LeftArm", "LeftLeg")
    }
    y = {name: mesh.vertices[ids, 1] for name, ids in mesh.segments.items()}
    assert y["head"].min() > height["Neck1"]
    assert y["feet"].max() < height["LeftFoot"] + 0.03
    assert set(mesh.segments["between_toes"]) <= set(mesh.segments["feet"])
    assert height["LeftLeg"] < y["armpits"].min() < y["armpits"].max() < height["LeftArm"] + 0.02
    assert height["LeftLeg"] - 0.15 < y["torso"].min() < y["torso"].max() < height["Neck1"] + 0.05
    assert not set(mesh.face_interior) & set(mesh.segments["head"])


def test_rig_is_in_metres_upright_with_exact_rotations(mid):
    mesh, rig = mid
    assert 1.7 < np.ptp(mesh.vertices[:, 1]) < 1.8
    assert mesh.vertices[mesh.segments["feet"], 2].max() > mesh.vertices[mesh.segments["head"], 2].min()
    assert rig.joint_names[:3] == ("Root", "Hips", "Spine1")
    assert rig.parents[0] == -1
    assert (rig.parents[1:] < np.arange(1, 78)).all()
    for world in (rig.bind_world, rig.t_pose_world):
        rotations = world[:, :3, :3]
        np.testing.assert_allclose(
            rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (78, 1, 1)), atol=ROTATION
        )
        np.testing.assert_array_equal(world[0], np.eye(4))
    np.testing.assert_allclose(rig.weights.sum(axis=1), 1, atol=1e-12)
    assert rig.weights.nnz == 60735


def test_t_pose_stretches_both_arms_level(mid):
    _, rig = mid
    position = dict(zip(rig.joint_names, rig.t_pose_world[:, :3, 3], strict=True))
    for side, sign in (("Left", 1), ("Right", -1)):
        span = position[f"{side}Hand"] - position[f"{side}Arm"]
        assert sign * span[0] > 0.5
        assert np.abs(span[1:]).max() < 0.001


def test_everything_is_read_only(mid):
    mesh, rig = mid
    arrays = [value for value in (*vars(mesh).values(), *vars(rig).values()) if isinstance(value, np.ndarray)]
    arrays += [*mesh.segments.values(), rig.weights.data, rig.weights.indices, rig.weights.indptr]
    assert not any(array.flags.writeable for array in arrays)


def test_second_load_needs_no_usd_library(mid, monkeypatch):
    monkeypatch.setattr("soma_core.rig.canonical._parse", lambda *_: pytest.fail("parsed again"))
    again = load_canonical()
    np.testing.assert_array_equal(again[0].triangles, mid[0].triangles)


def test_revision_is_the_one_of_the_manifest(mid):
    assert mid[1].revision == read_manifest(assets_dir()).rig_revision


def test_unknown_lod_is_refused():
    with pytest.raises(InputError, match="'high'"):
        load_canonical("high")


@pytest.mark.parametrize("name", [RIG_NAME, NEUTRAL_NAME])
def test_damaged_files_are_refused_with_a_fix(copied, name):
    path = copied / name
    whole = path.read_bytes()
    damages = {
        "truncated": whole[:-100],
        "SHA-256": whole[:-100] + bytes(100),
        "git-LFS pointer": b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n",
        "empty": b"",
        "not the shipped one": whole + b"\n",
    }
    for text, damaged in damages.items():
        path.write_bytes(damaged)
        with pytest.raises(AssetError, match=text) as caught:
            load_canonical(root=copied)
        assert str(path) in str(caught.value)
        assert caught.value.fix
    path.unlink()
    with pytest.raises(AssetError, match="missing"):
        load_canonical(root=copied)


def test_a_manifest_of_another_rig_is_refused(copied):
    path = copied / "MANIFEST.json"
    path.write_text(path.read_text().replace(read_manifest(copied).rig_hash, "f" * 64))
    with pytest.raises(AssetError, match="rig revision is"):
        load_canonical(root=copied)
