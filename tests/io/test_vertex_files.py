"""Vertices over time: every format gives the same frames, in any chunks, and damage is named."""

import json
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from soma_core.errors import AssetError, InputError
from soma_core.io import open_vertex_sequence
from soma_core.io.gltf import write_gltf
from soma_core.io.mesh_vertices import read_mesh_vertices, read_ply_triangles
from soma_core.obj import read_obj

FILE_TOLERANCE_MM = 0.01
"""Float32 positions within four metres of the origin, skinned in float32."""

MEMORY_BYTES = 2**20
"""Ten chunks of four frames of 2,000 vertices: what the reader may hold while it goes through a hundred."""

FRAMES, COUNT = 7, 5


@pytest.fixture
def vertices():
    return np.random.default_rng(0).normal(size=(FRAMES, COUNT, 3)).astype(np.float32)


def chunks_of(path, size=3, **options):
    """The whole sequence, read in chunks."""
    with open_vertex_sequence(path, **options) as sequence:
        starts = range(0, sequence.frame_count, size)
        parts = [sequence.read(s, min(s + size, sequence.frame_count)) for s in starts]
        return np.concatenate(parts)


def write_obj(path, vertices):
    lines = ["# a comment", "mtllib x.mtl"] + [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    path.write_text("\n".join([*lines, "vt 0 0", "f 1/1 2/1 3/1", ""]))


@pytest.mark.parametrize("kind", ["npy", "npz", "npz compressed"])
def test_arrays_are_read_in_chunks_and_in_any_order(tmp_path, vertices, kind):
    path = tmp_path / f"body.{kind[:3]}"
    if kind == "npy":
        np.save(path, vertices)
    else:
        save = np.savez_compressed if "compressed" in kind else np.savez
        save(path, other=np.zeros((2, 2)), vertices=vertices, fps=24.0, unit="centimeters", up_axis="Z")
    np.testing.assert_array_equal(chunks_of(path), vertices)
    with open_vertex_sequence(path) as sequence:
        assert (sequence.frame_count, sequence.vertex_count) == (FRAMES, COUNT)
        told = (sequence.fps, sequence.metres, sequence.up)
        assert told == ((None, None, None) if kind == "npy" else (24.0, 0.01, "+z"))
        np.testing.assert_array_equal(sequence.read(5, 7), vertices[5:])
        np.testing.assert_array_equal(sequence.read(0, 1), vertices[:1])


@pytest.mark.parametrize(
    ("stored", "read"),
    [(np.float16, np.float32), (np.int32, np.float32), (">f4", np.float32), (np.float64, np.float64)],
)
def test_numbers_of_any_kind_become_floats(tmp_path, vertices, stored, read):
    np.save(tmp_path / "body.npy", (10 * vertices).astype(stored))
    found = chunks_of(tmp_path / "body.npy")
    assert found.dtype == read
    np.testing.assert_array_equal(found, (10 * vertices).astype(stored).astype(read))


def test_the_only_array_of_that_layout_counts(tmp_path, vertices):
    np.savez(tmp_path / "a.npz", poses=np.zeros((FRAMES, 4, 3, 3)), anything=vertices)
    np.testing.assert_array_equal(chunks_of(tmp_path / "a.npz"), vertices)
    np.savez(tmp_path / "b.npz", one=vertices, two=vertices)
    with pytest.raises(InputError, match=r"b\.npz: vertices: got one \(7, 5, 3\), two .*: 2 of them"):
        open_vertex_sequence(tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", poses=np.zeros((2, 4)))
    with pytest.raises(InputError, match=r"c\.npz: vertices: got poses \(2, 4\): 0 of them"):
        open_vertex_sequence(tmp_path / "c.npz")


def test_what_the_caller_says_overrides_the_file(tmp_path, vertices):
    np.savez(tmp_path / "a.npz", vertices=vertices, fps=24, unit="m")
    with open_vertex_sequence(tmp_path / "a.npz", fps=60, unit="mm", up="+z") as sequence:
        assert (sequence.fps, sequence.metres, sequence.up) == (60, 0.001, "+z")
    for rate in (0, float("nan")):
        with pytest.raises(InputError, match=rf"fps: got {rate:g}, expected a positive number"):
            open_vertex_sequence(tmp_path / "a.npz", fps=rate)


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.zeros((4, 3)), r"got shape \(4, 3\)"),
        (np.zeros((2, 4, 2)), r"got shape \(2, 4, 2\)"),
        (np.zeros((0, 4, 3)), r"got shape \(0, 4, 3\)"),
        (np.asfortranarray(np.zeros((2, 4, 3))), "Fortran order"),
        (np.full((2, 4, 3), "x"), "dtype <U1"),
    ],
)
def test_another_layout_is_refused(tmp_path, array, said):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InputError, match=rf"a\.npy: the array: .*{said}"):
        open_vertex_sequence(tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", vertices=array)
    with pytest.raises(InputError, match=rf"a\.npz: vertices: .*{said}"):
        open_vertex_sequence(tmp_path / "a.npz")


@pytest.mark.parametrize(("key", "value"), [("unit", "inches"), ("up_axis", "X")])
def test_unknown_units_and_axes_are_refused(tmp_path, vertices, key, value):
    np.savez(tmp_path / "a.npz", vertices=vertices, **{key: value})
    with pytest.raises(InputError, match=rf"a\.npz: {key}: got '{value}'"):
        open_vertex_sequence(tmp_path / "a.npz")


def test_a_range_outside_the_sequence_is_refused(tmp_path, vertices):
    np.save(tmp_path / "a.npy", vertices)
    with open_vertex_sequence(tmp_path / "a.npy") as sequence:
        for start, stop in ((5, 8), (-1, 2), (3, 3)):
            with pytest.raises(InputError, match=f"frames: got {start} to {stop}, expected .* 7 frames"):
                sequence.read(start, stop)


def test_objects_are_never_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    trap = np.empty((1, 1, 3), object)
    trap[:] = Trap()
    np.save(tmp_path / "a.npy", trap, allow_pickle=True)
    np.savez(tmp_path / "a.npz", vertices=trap, allow_pickle=True)
    for name in ("a.npy", "a.npz"):
        with pytest.raises((AssetError, InputError), match=rf"{name}.*(Python objects|no arrays)"):
            open_vertex_sequence(tmp_path / name)
    assert not (tmp_path / "sprung").exists()


def test_truncated_arrays_are_named(tmp_path, vertices):
    np.save(tmp_path / "a.npy", vertices)
    (tmp_path / "cut.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:-10])
    with pytest.raises(AssetError, match=r"cut\.npy: damaged \(10 bytes are missing\)"):
        open_vertex_sequence(tmp_path / "cut.npy")
    (tmp_path / "not.npy").write_bytes(b"hello")
    with pytest.raises(AssetError, match=r"not\.npy: damaged \(.*magic"):
        open_vertex_sequence(tmp_path / "not.npy")
    np.savez_compressed(tmp_path / "a.npz", vertices=vertices)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:-40])
    with pytest.raises(AssetError, match=r"cut\.npz: (damaged|not an NPZ)"):
        open_vertex_sequence(tmp_path / "cut.npz")


def test_an_archive_whose_member_is_short_or_spoilt_is_named(tmp_path, vertices):
    np.save(tmp_path / "a.npy", vertices)
    content = (tmp_path / "a.npy").read_bytes()
    with zipfile.ZipFile(tmp_path / "short.npz", "w") as archive:
        archive.writestr("vertices.npy", content[: -COUNT * 12 - 4])
    with pytest.raises(AssetError, match=r"short\.npz: damaged \(frame 5 is cut off\)"):
        chunks_of(tmp_path / "short.npz")
    with zipfile.ZipFile(tmp_path / "junk.npz", "w") as archive:
        archive.writestr("vertices.npy", b"junk")
    with pytest.raises(AssetError, match=r"junk\.npz: damaged \(.*magic"):
        open_vertex_sequence(tmp_path / "junk.npz")
    noise = np.random.default_rng(1).normal(size=(200, 50, 3))
    np.savez_compressed(tmp_path / "big.npz", vertices=noise)
    spoilt = bytearray((tmp_path / "big.npz").read_bytes())
    spoilt[len(spoilt) // 2 : len(spoilt) // 2 + 64] = bytes(64)
    (tmp_path / "big.npz").write_bytes(spoilt)
    with pytest.raises(AssetError, match=r"big\.npz: damaged"):
        chunks_of(tmp_path / "big.npz")


def test_missing_files_pointers_and_other_suffixes_are_named(tmp_path):
    with pytest.raises(AssetError, match=r"nothing\.npz: file is missing"):
        open_vertex_sequence(tmp_path / "nothing.npz")
    (tmp_path / "a.glb").write_bytes(b"version https://git-lfs.github.com/spec/v1")
    with pytest.raises(AssetError, match=r"a\.glb: is a git-LFS pointer"):
        open_vertex_sequence(tmp_path / "a.glb")
    (tmp_path / "a.fbx").write_bytes(b"x")
    with pytest.raises(InputError, match=r"a\.fbx: got the suffix '\.fbx', expected \.npz"):
        open_vertex_sequence(tmp_path / "a.fbx")


def test_memory_does_not_grow_with_the_length(tmp_path):
    frames = np.random.default_rng(0).normal(size=(400, 2000, 3)).astype(np.float32)  # 9.6 MB
    np.savez_compressed(tmp_path / "long.npz", vertices=frames)
    np.save(tmp_path / "long.npy", frames)
    for name in ("long.npz", "long.npy"):
        tracemalloc.start()
        with open_vertex_sequence(tmp_path / name) as sequence:
            for start in range(0, 400, 4):
                sequence.read(start, start + 4)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < MEMORY_BYTES, name


def test_a_folder_is_read_in_natural_order(tmp_path, vertices):
    for frame, points in enumerate(vertices):
        write_obj(tmp_path / f"f{frame + 5}.obj", points)  # f5 ... f11
    (tmp_path / "notes.txt").write_text("not a mesh")
    found = chunks_of(tmp_path)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, vertices.astype(np.float64))


def test_a_folder_of_another_kind_is_refused(tmp_path, vertices):
    with pytest.raises(InputError, match=r"a folder with neither \.obj nor \.ply files"):
        open_vertex_sequence(tmp_path)
    write_obj(tmp_path / "a.obj", vertices[0])
    write_obj(tmp_path / "b.obj", vertices[0, :4])
    with pytest.raises(InputError, match=r"b\.obj: got 4 vertices, expected 5, as in a\.obj"):
        chunks_of(tmp_path)
    (tmp_path / "b.ply").write_bytes(b"ply")
    with pytest.raises(InputError, match=r"a folder with \.obj and \.ply files"):
        open_vertex_sequence(tmp_path)


@pytest.mark.parametrize("content", ["v 1 2\nf 1 1 1", "v a b c", "o empty", "v 1 2 3\nv 4 5"])
def test_a_broken_obj_is_named(tmp_path, content):
    (tmp_path / "a.obj").write_text(content)
    with pytest.raises(AssetError, match=r"a\.obj: (no readable mesh|holds no vertices)"):
        open_vertex_sequence(tmp_path)


def ply(vertices, kind):
    """A PLY with another element in front, and properties around the position."""
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    head = (
        f"ply\nformat {kind} 1.0\ncomment made by hand\nelement marker 2\nproperty int id\n"
        f"element vertex {len(vertices)}\nproperty uchar shade\nproperty double x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    if not order:
        rows = ["7", "8"] + [f"255 {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()] + ["3 0 1 2"]
        return (head + "\n".join(rows) + "\n").encode()
    body = struct.pack(f"{order}2i", 7, 8)
    body += b"".join(struct.pack(f"{order}Bdff", 255, *row) for row in vertices.tolist())
    return head.encode() + body + struct.pack(f"{order}B3i", 3, 0, 1, 2)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_of_every_kind(tmp_path, vertices, kind):
    for frame, points in enumerate(vertices):
        (tmp_path / f"{frame}.ply").write_bytes(ply(points, kind))
    np.testing.assert_array_equal(chunks_of(tmp_path), vertices.astype(np.float64))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n", "1|2 of 3|'y'"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nend_header\n1",
            "buffer",
        ),
        (b"ply\nformat morse 1.0\nelement vertex 3\nend_header\n", "no known PLY format"),
        (b"ply\nformat ascii 1.0\nelement face 3\nend_header\n1\n1\n1\n", "no element 'vertex'"),
        (
            b"ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int v\nend_header\n",
            "'face' with lists",
        ),
        (
            b"ply\nformat binary_big_endian 1.0\nelement vertex 1\nproperty list uchar int v\nend_header\n1",
            "vertices with lists",
        ),
        (b"solid", "no PLY header"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
            b"end_header\n1 2 3\n4 5 6",
            "2 of 3 vertices",
        ),
    ],
)
def test_a_broken_ply_is_named(tmp_path, content, said):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(AssetError, match=rf"a\.ply: no readable mesh \(.*({said})"):
        open_vertex_sequence(tmp_path)


def test_our_own_glb_gives_the_posed_body(tmp_path, clip, posed):
    write_gltf(tmp_path / "body.glb", clip)
    found = chunks_of(tmp_path / "body.glb", size=4)
    assert found.shape == posed.shape
    assert 1000 * np.abs(found - posed).max() < FILE_TOLERANCE_MM
    with open_vertex_sequence(tmp_path / "body.glb") as sequence:
        assert (sequence.fps, sequence.metres, sequence.up) == (30.0, 1.0, "+y")


class Glb:
    """A GLB made by hand, part by part."""

    def __init__(self):
        self.data, self.views, self.accessors = b"", [], []

    def add(self, array, **changes):
        kinds = {1: "SCALAR", 2: "VEC3"}
        codes = {"float32": 5126, "uint8": 5121, "uint16": 5123}
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        entry = {"bufferView": len(self.views) - 1, "componentType": codes[array.dtype.name]}
        kind = "VEC4" if array.ndim == 2 and array.shape[1] == 4 else kinds[array.ndim]
        self.accessors.append(entry | {"count": len(array), "type": kind} | changes)
        self.data += array.tobytes() + bytes(-array.nbytes % 4)
        return len(self.accessors) - 1

    def write(self, path, **document):
        base = {"asset": {"version": "2.0"}, "accessors": self.accessors, "bufferViews": self.views}
        text = json.dumps(base | {"buffers": [{"byteLength": len(self.data)}]} | document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self.data), b"BIN\0") + self.data
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def morphed(path, vertices, **changes):
    """Each frame a morph target, switched on in turn, on a node that is moved and turned about +Y."""
    glb = Glb()
    targets = [{"POSITION": glb.add(points - vertices[0])} for points in vertices[1:]]
    weights = np.eye(len(vertices), dtype=np.float32)[:, 1:].ravel()
    times = (np.arange(len(vertices)) / 25).astype(np.float32)
    document = {
        "nodes": [
            {"children": [1], "translation": [1, 2, 3]},
            {"mesh": 0, "rotation": [0, 2**-0.5, 0, 2**-0.5]},
            {"name": "lamp"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": glb.add(vertices[0])}, "targets": targets}]}],
        "animations": [
            {
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "weights"}}],
                "samplers": [{"input": glb.add(times), "output": glb.add(weights)}],
            }
        ],
    }
    return glb.write(path, **(document | changes))


def test_morph_targets_and_node_transforms(tmp_path, vertices):
    found = chunks_of(morphed(tmp_path / "a.glb", vertices))
    turned = vertices @ np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]) + [1, 2, 3]
    assert 1000 * np.abs(found - turned).max() < FILE_TOLERANCE_MM
    with open_vertex_sequence(tmp_path / "a.glb") as sequence:
        assert sequence.fps == 25


def test_a_still_glb_is_one_frame(tmp_path, vertices):
    found = chunks_of(morphed(tmp_path / "a.glb", vertices, animations=[]))
    assert found.shape == (1, COUNT, 3)
    with open_vertex_sequence(tmp_path / "a.glb") as sequence:
        assert sequence.fps is None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "needs the extension KHR_draco"),
        ({"animations": [{}, {}]}, "2 animations"),
        ({"nodes": [{"mesh": 0}, {"mesh": 0}]}, "2 meshes, expected one"),
        ({"nodes": [{"children": [1]}, {"mesh": 0, "children": [0]}]}, "circle"),
        (
            {"nodes": [{"children": [2]}, {"mesh": 0, "children": [2]}, {}, {"children": [0, 1, 2]}]},
            "two parents",
        ),
        ({"nodes": "x"}, "TypeError|AttributeError|ValueError"),
        ({"meshes": []}, "IndexError"),
        ({"accessors": []}, "IndexError"),
        ({"buffers": [{"uri": "elsewhere.bin"}]}, "in other files"),
    ],
)
def test_a_glb_of_another_kind_says_why(tmp_path, vertices, changes, said):
    morphed(tmp_path / "a.glb", vertices, **changes)
    with pytest.raises(AssetError, match=rf"a\.glb: no usable GLB \(.*({said})"):
        open_vertex_sequence(tmp_path / "a.glb")


@pytest.mark.parametrize(
    ("accessor", "said"),
    [
        ({"count": 10**12}, "leaves its part of the file"),
        ({"sparse": {}}, "KeyError"),
        ({"bufferView": None, "count": 10**12}, "NoneType"),
        ({"bufferView": 9}, "IndexError"),
        ({"componentType": 1}, "KeyError"),
    ],
)
def test_a_hostile_accessor_is_refused(tmp_path, vertices, accessor, said):
    glb = Glb()
    place = glb.add(vertices[0], **accessor)
    meshes = [{"primitives": [{"attributes": {"POSITION": place}}]}]
    glb.write(tmp_path / "a.glb", nodes=[{"mesh": 0}], meshes=meshes)
    with pytest.raises(AssetError, match=rf"a\.glb: no usable GLB \(.*({said})"):
        open_vertex_sequence(tmp_path / "a.glb")


def test_overlapping_values_and_parts_are_refused(tmp_path, vertices):
    glb = Glb()
    place, other = glb.add(vertices[0]), glb.add(vertices[1])
    glb.views[0]["byteStride"] = 4
    meshes = [{"primitives": [{"attributes": {"POSITION": place}}]}]
    glb.write(tmp_path / "a.glb", nodes=[{"mesh": 0}], meshes=meshes)
    with pytest.raises(AssetError, match="accessor 0 has overlapping values"):
        open_vertex_sequence(tmp_path / "a.glb")
    meshes[0]["primitives"].append({"attributes": {"POSITION": other}})
    glb.write(tmp_path / "a.glb", nodes=[{"mesh": 0}], meshes=meshes)
    with pytest.raises(AssetError, match="cut into 2 parts"):
        open_vertex_sequence(tmp_path / "a.glb")


@pytest.mark.parametrize(
    ("sampler", "said"),
    [
        ({"interpolation": "CUBICSPLINE"}, "interpolates by CUBICSPLINE"),
        ({"input": "reversed"}, "keys of node 1 are out of order"),
    ],
)
def test_animations_that_are_not_read_say_why(tmp_path, vertices, sampler, said):
    glb = Glb()
    place = glb.add(vertices[0])
    times, weights = glb.add(np.array([1, 0], np.float32)), glb.add(np.zeros(2, np.float32))
    samplers = [{"input": times, "output": weights} | {k: v for k, v in sampler.items() if k != "input"}]
    channels = [{"sampler": 0, "target": {"node": 1, "path": "weights"}}]
    glb.write(
        tmp_path / "a.glb",
        nodes=[{}, {"mesh": 0}],
        meshes=[{"primitives": [{"attributes": {"POSITION": place}, "targets": [{"POSITION": place}]}]}],
        animations=[{"channels": channels, "samplers": samplers}],
    )
    with pytest.raises(AssetError, match=said):
        open_vertex_sequence(tmp_path / "a.glb")


def test_uneven_keys_are_refused(tmp_path, vertices):
    glb = Glb()
    place = glb.add(vertices[0])
    times = glb.add(np.array([0, 0.1, 0.2, 0.5], np.float32))
    weights = glb.add(np.zeros(4, np.float32))
    glb.write(
        tmp_path / "a.glb",
        nodes=[{"mesh": 0}],
        meshes=[{"primitives": [{"attributes": {"POSITION": place}, "targets": [{"POSITION": place}]}]}],
        animations=[
            {
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
                "samplers": [{"input": times, "output": weights}],
            }
        ],
    )
    with pytest.raises(
        InputError, match=r"a\.glb: times: got a step of 0\.3 s after sample 2 where others are 0\.1"
    ):
        open_vertex_sequence(tmp_path / "a.glb")


@pytest.mark.parametrize("content", [b"glTF", b"not a glb at all, whatever it is called"])
def test_what_is_no_glb_is_named(tmp_path, content):
    (tmp_path / "a.glb").write_bytes(content)
    with pytest.raises(AssetError, match=r"a\.glb: no usable GLB"):
        open_vertex_sequence(tmp_path / "a.glb")


def test_a_glb_that_is_cut_off_is_named(tmp_path, vertices):
    content = morphed(tmp_path / "a.glb", vertices).read_bytes()
    (tmp_path / "a.glb").write_bytes(content[:-12])
    with pytest.raises(AssetError, match=r"a\.glb: .*12 bytes are missing at the end"):
        open_vertex_sequence(tmp_path / "a.glb")
    (tmp_path / "a.glb").write_bytes(content[:16] + b"SPAM" + content[20:])
    with pytest.raises(AssetError, match=r"a\.glb: .*first chunk is b'SPAM'"):
        open_vertex_sequence(tmp_path / "a.glb")


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_faces_of_a_ply_are_fans_in_order(tmp_path, order):
    faces, head = [(0, 1, 2), (0, 2, 3, 4)], f"ply\nformat {order} 1.0\ncomment TextureFile /dev/zero\n"
    head += "element vertex 5\nproperty float x\nproperty float y\nproperty float z\nelement face 2\n"
    head += "property uchar flags\nproperty list uchar int vertex_indices\nproperty float area\nend_header\n"
    points, sign = np.arange(15, dtype="f4").reshape(5, 3), ">" if "big" in order else "<"
    if order == "ascii":
        rows = [" ".join(map(str, row)) for row in points.tolist()]
        rows += [f"7 {len(face)} {' '.join(map(str, face))} 0.5" for face in faces]
        body = ("\n".join(rows) + "\n").encode()
    else:
        body = points.astype(f"{sign}f4").tobytes()
        body += b"".join(struct.pack(f"{sign}BB{len(face)}if", 7, len(face), *face, 0.5) for face in faces)
    path = tmp_path / "a.ply"
    path.write_bytes(head.encode() + body)
    np.testing.assert_array_equal(read_ply_triangles(path, 5), [[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    np.testing.assert_array_equal(read_mesh_vertices(path), points)
    with pytest.raises(AssetError, match=r"a\.ply: has faces of others than its 4 vertices"):
        read_ply_triangles(path, 4)
    path.write_bytes((head.encode() + body)[:-12])
    with pytest.raises(AssetError, match=r"a\.ply: no readable faces"):
        read_ply_triangles(path, 5)


def test_numbers_of_other_scripts_in_names_are_no_numbers(tmp_path):
    for name in ("²1.obj", "f10.obj", "f2.obj", "٣.obj", "f" + "9" * 200 + ".obj"):
        (tmp_path / name).write_text("v 0 0 0\nv 1 0 0\n")
    with open_vertex_sequence(tmp_path) as sequence:
        names = [file.name for file in sequence._files]
    assert names.index("f2.obj") < names.index("f10.obj")


def test_an_obj_takes_little_more_than_its_numbers(tmp_path):
    path, count = tmp_path / "a.obj", 20_000
    path.write_text("v 0.25 0.5 0.75\n" * count + "f 1 2 3\n" * count)
    tracemalloc.start()
    read_obj(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * 48 * count  # 48 bytes of result a pair of lines, twice while it is copied
