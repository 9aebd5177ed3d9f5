"""Hostile files: bytes that call code, bombs, lies about sizes, and values that cannot be."""

from __future__ import annotations

import functools
import io
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tests.hostile.bombs import instances, made
from tests.hostile.readers import USD
from tests.skeletons import glb_bytes
from tests.standins.pickles import Instance, ch, csc, write_pickle

__all__ = ["BOMB_BYTES", "FILES", "LINKS", "SENTINEL"]

SENTINEL = "owned"
"""What the code in these files would make in the current folder."""

BOMB_BYTES = 288 * 2**20
"""What a bomb unfolds to: more than any reader may take."""

KEYS = (
    "vertices", "poses", "transl", "local_rot_mats", "mean", "shapedirs", "eigenvalues", "triangles",
    "joint_names", "v_template", "f", "weights", "pca_matrix", "pca_mean",
)  # fmt: skip
"""Keys that the readers of NPZ files ask for."""


class _Call:
    def __init__(self, function: Callable, *arguments: object) -> None:
        self.called = function, arguments

    def __reduce__(self) -> tuple:
        return self.called


def _touches() -> _Call:
    import os

    return _Call(os.system, f"touch {SENTINEL}")


def _pickles() -> Iterator[tuple[str, bytes]]:
    touch = _touches()
    for protocol in (0, 1, 2, 4, 5):
        yield f"pickle of os.system, protocol {protocol}", pickle.dumps({"shapedirs": touch}, protocol)
    yield "pickle of eval", pickle.dumps(_Call(eval, f"open('{SENTINEL}', 'w')"))
    yield "pickle of getattr", pickle.dumps(_Call(getattr, "text", "format"))
    yield "pickle of object array", pickle.dumps({"v_template": np.array([touch], object)})
    yield "pickle of numpy.fromfile", pickle.dumps(_Call(np.fromfile, SENTINEL))
    yield "pickle of a method by attribute", b"cnumpy\nndarray.tofile\n(tR."
    yield "pickle of another allowed module", b"cnumpy\n_distributor_init\n."
    yield "pickle of INST", b"(S'touch owned'\nios\nsystem\n."
    yield "pickle of OBJ", b"(cos\nsystem\nS'touch owned'\no."
    yield "pickle of a persistent id", b"Pname\n."
    yield "pickle of an extension", b"\x80\x02\x82\x01."
    yield "pickle of a stack global that is no text", b"\x80\x04K\x01K\x02\x93."
    yield "pickle with a call of a list", b"](tR."
    yield "pickle that builds a dict", b"}}b."
    yield "pickle of a call to an allowed name", b"cnumpy\ndtype\n(S'O'\ntR."
    yield "pickle of far memory", b"\x80\x02Nr\xff\xff\xff\x7f."
    yield "pickle of a long string", b"\x80\x04\x8e" + struct.pack("<Q", 1 << 40) + b"x."
    yield "pickle of a long array", b"\x80\x05\x96" + struct.pack("<Q", 1 << 62) + b"x."
    yield "pickle of a negative length", b"\x80\x02T" + struct.pack("<i", -5) + b"x."
    yield "pickle of a long number", b"\x80\x02I" + b"9" * 100_000 + b"\n."
    yield "pickle of nested keys", b"\x80\x02}" + b")" + b"2\x86" * 60 + b"Ns."
    yield "pickle of a nested set", b"\x80\x04\x8f(" + b")" + b"2\x86" * 60 + b"\x90."
    yield "pickle of deep lists", b"\x80\x02" + b"]" * 50_000 + b"a" * 49_999 + b"."
    yield "pickle without an end", b"\x80\x02" + b"N" * 1000
    yield "pickle of endless instructions", b"\x80\x02" + b"N0" * 500_001
    yield "pickle with an empty stack", b"\x80\x020."
    yield "pickle of nothing", b"."
    yield "pickle of a forgotten memory", b"\x80\x02h\x05."


def _graphs() -> Iterator[tuple[str, bytes]]:
    """Pickles of a few bytes whose values lie in each other many times, or for ever."""
    many = 300
    wide: object = np.arange(3.0)
    for _ in range(6):
        wide = [wide] * many
    body: dict[object, object] = {"pose": wide, "trans": wide, "betas": wide, "global_orient": wide}
    yield "pickle of lists in lists", pickle.dumps(body)
    yield "pickle of one array many times", pickle.dumps({"pose": [np.zeros((2000, 72))] * 4000, "trans": 1})
    frame = {"smpl": [{"global_orient": wide, "body_pose": wide}] * 3000, "tid": list(range(3000))}
    yield "pickle of tracks in tracks", pickle.dumps(dict.fromkeys(range(3000), frame))
    yield "pickle of frames in frames", pickle.dumps([dict.fromkeys(map(str, range(3000)), wide)] * 3000)
    body["people"] = body
    yield "pickle of itself", pickle.dumps(body)
    tree: dict[object, object] = {"pose": np.zeros((2, 71))}
    for _ in range(12):
        tree = dict.fromkeys(range(200), tree)
    yield "pickle of a tree without end", pickle.dumps(tree)
    layout = {"dtype": np.dtype("f8"), "order": "C", "subclass": np.ndarray, "allow_mmap": True}
    wrapper = b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n)\x81"
    for name, shape in (("huge", (2**40,)), ("negative", (-1,)), ("text", "abc"), ("no", None)):
        state = pickle.dumps(layout | {"shape": shape}, 2)[2:-1]
        yield f"pickle of joblib with {name} shape", b"\x80\x02" + wrapper + state + b"b."
    state = pickle.dumps(layout | {"shape": (1,), "dtype": np.dtype("O")}, 2)[2:-1]
    yield "pickle of joblib with code", b"\x80\x02" + wrapper + state + b"b" + pickle.dumps(_touches()) + b"."
    yield "pickle of joblib in itself", b"\x80\x02" + (wrapper + state + b"b\x80\x02") * 3000
    storage = b"ctorch._utils\n_rebuild_tensor_v2\n(ctorch.storage\n_load_from_bytes\n"
    inner = pickle.dumps(_touches(), 2)
    loaded = (
        storage + b"B" + struct.pack("<I", len(inner)) + inner + b"\x85RK\x00(K\x02K\x48t(K\x48K\x01t\x89Nt"
    )
    yield "pickle of a tensor with code", b"\x80\x02}U\x04pose" + loaded + b"Rs."
    yield "pickle compressed with zlib, cut off", zlib.compress(bytes(10_000))[:-6]
    yield "pickle compressed with gzip, damaged", b"\x1f\x8b" + bytes(30)
    yield "pickle compressed with lz4", b"\x04\x22\x4d\x18" + bytes(30)


@functools.cache
def _zlib_bomb() -> bytes:
    """Zeros in a thousandth of their size."""
    packer = zlib.compressobj(1)
    return b"".join(packer.compress(bytes(1 << 22)) for _ in range(BOMB_BYTES >> 22)) + packer.flush()


def _structured_pickles() -> Iterator[tuple[str, bytes]]:
    folder = Path(__file__).parent
    numbers = np.arange(6.0)
    bad = csc(np.eye(3))
    bad.state["indices"] = np.array([0, 1, 77], np.int32)
    deep = numbers
    for _ in range(50):
        deep = ch(deep)
    for name, value in (
        ("pickle of sparse indices out of range", bad),
        ("pickle of chumpy without end", deep),
        ("pickle of chumpy with code", Instance("chumpy.ch", "Ch", {"x": _touches()})),
        ("pickle of other chumpy", Instance("chumpy.ch", "MatVecMult", {})),
        ("pickle of NaN", np.array([np.nan])),
        *instances(),
    ):
        path = folder / f".{name}"
        try:
            yield (
                name,
                write_pickle(path, {"a": value, "v_template": value, "csc": value}, protocol=2).read_bytes(),
            )
        finally:
            path.unlink(missing_ok=True)


def _header(shape: str, dtype: str = "<f4", order: str = "False") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': {order}, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) & 0xFFFF) + text


def _arrays() -> Iterator[tuple[str, bytes]]:
    """Contents of one array file."""
    yield "array of a huge shape", _header("(1000000000000, 6890, 3)")
    yield "array of a huge frame", _header("(1, 1000000000000, 3)") + bytes(36)
    yield "array of a shape beyond integers", _header(f"({10**30}, 5, 3)")
    yield "array of a negative shape", _header("(-1, 5, 3)") + bytes(60)
    yield "array of a text shape", _header("'abc'")
    yield "array of a wrong size", _header("(3, 5, 3)") + bytes(10)
    yield "array of objects", _header("(1,)", dtype="|O") + pickle.dumps([_touches()])
    yield "array of an unknown type", _header("(1,)", dtype="<q99")
    yield "array of nested brackets", _header("(" * 3000)
    yield "array of a call", _header("__import__('os').system('touch owned')")
    yield "array of a long header", b"\x93NUMPY\x02\x00" + struct.pack("<I", 1 << 31) + b"{" * 1000
    yield "array of an unknown version", b"\x93NUMPY\x09\x00" + bytes(20)


def _zip(members: dict[str, bytes], **options: int) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", **options) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


def _npz(**arrays: object) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _archives() -> Iterator[tuple[str, bytes]]:
    for name, content in _arrays():
        yield f"npz with {name}", _zip({f"{key}.npy": content for key in KEYS})
    objects = np.array([_touches()], object)
    yield "npz of object arrays", _npz(**dict.fromkeys(KEYS, objects))
    yield "npz of NaN", _npz(**dict.fromkeys(KEYS, np.full((3, 77, 3), np.nan)))
    yield "npz of scalars", _npz(**dict.fromkeys(KEYS, np.float32(1)))
    yield "npz of text", _npz(**dict.fromkeys(KEYS, np.array("text")))
    yield "npz of invalid text", _npz(**dict.fromkeys(KEYS, np.array([b"\xff\xfe"])))
    yield "npz of nothing", _zip({})
    yield "npz of no arrays", _zip({"../../owned": b"x", "/etc/owned": b"y"})
    good = bytearray(_npz(**dict.fromkeys(KEYS, np.ones((3, 5, 3), np.float32))))
    yield "npz cut off", bytes(good[: len(good) // 2])
    yield "npz without a directory", bytes(good[:-30])
    encrypted = bytearray(good)
    at = encrypted.find(b"PK\x01\x02")
    while at >= 0:
        encrypted[at + 8] |= 1
        at = encrypted.find(b"PK\x01\x02", at + 1)
    yield "npz encrypted", bytes(encrypted)
    method = bytearray(good)
    at = method.find(b"PK\x01\x02")
    while at >= 0:
        method[at + 10] = 99
        at = method.find(b"PK\x01\x02", at + 1)
    yield "npz of an unknown compression", bytes(method)


@functools.cache
def _bomb() -> bytes:
    """Zeros in a thousandth of their size, under the first key of every reader."""
    size = BOMB_BYTES // 4
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for key in ("vertices", "poses", "mean", "v_template", "pca_matrix", "triangles"):
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                member.write(
                    _header(f"({size // 3 + 1}, 3)" if key != "vertices" else f"(1, {size // 3 + 1}, 3)")
                )
                for _ in range(BOMB_BYTES >> 22):
                    member.write(bytes(1 << 22))
    return stream.getvalue()


def _meshes() -> Iterator[tuple[str, bytes]]:
    points = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    for name, faces in (
        ("an index of zero", "f 1 2 0"), ("an index out of range", "f 1 2 4"),
        ("a negative index", "f 1 2 -9"),
        ("a huge index", "f 1 2 " + "9" * 30), ("an index of many digits", "f 1 2 " + "9" * 5000),
        ("no index", "f 1 2 x"), ("two corners", "f 1 2"), ("no faces", ""),
    ):  # fmt: skip
        yield f"obj of {name}", (points + faces + "\n").encode()
    yield "obj of NaN", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    yield "obj of infinity", b"v 1e999 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    yield "obj of two coordinates", b"v 1 0\nf 1 1 1\n"
    yield "obj of NUL", b"v 0 0 0\0\nf 1 1 1\n"
    head = (
        "ply\nformat {}\nelement vertex {}\nproperty {} x\nproperty float y\nproperty float z\nend_header\n"
    )
    little = "binary_little_endian 1.0"
    yield "ply of a negative count", head.format(little, -3, "float").encode() + bytes(36)
    yield "ply of a huge count", head.format(little, 10**15, "float").encode() + bytes(36)
    yield "ply of many digits", head.format(little, "9" * 5000, "float").encode() + bytes(36)
    yield "ply of objects", head.format(little, 1, "O").encode() + bytes(36)
    yield "ply of another format", head.format("text", 1, "float").encode() + b"1 2 3\n"
    yield "ply cut off", head.format(little, 5, "float").encode() + bytes(36)
    yield "ply in text cut off", head.format("ascii 1.0", 5, "float").encode() + b"1 2 3\n"
    yield "ply without properties", b"ply\nformat ascii 1.0\nproperty float x\nend_header\n"
    yield "ply without vertices", b"ply\nformat ascii 1.0\nend_header\n"


def _scenes() -> Iterator[tuple[str, bytes]]:
    mesh = [{"primitives": [{"attributes": {"POSITION": 0}}]}]
    accessor = {"bufferView": 0, "componentType": 5126, "count": 2, "type": "VEC3"}
    document = {
        "asset": {}, "nodes": [{"mesh": 0}], "meshes": mesh, "accessors": [accessor],
        "bufferViews": [{"buffer": 0, "byteLength": 24}], "buffers": [{"byteLength": 24}],
    }  # fmt: skip
    changes: dict[str, dict] = {
        "a huge accessor": {"accessors": [accessor | {"count": 10**12}]},
        "a negative count": {"accessors": [accessor | {"count": -1}]},
        "an offset before the file": {"accessors": [accessor | {"byteOffset": -(10**6)}]},
        "an offset beyond it": {"accessors": [accessor | {"byteOffset": 10**18}]},
        "a text count": {"accessors": [accessor | {"count": "x"}]},
        "no accessors": {"accessors": []},
        "another file": {"buffers": [{"uri": "file:///etc/passwd"}]},
        "nodes in a circle": {"nodes": [{"mesh": 0, "children": [1]}, {"children": [0]}]},
        "a node of its own child": {"nodes": [{"mesh": 0, "children": [0]}]},
        "children out of range": {"nodes": [{"mesh": 0, "children": [7]}]},
        "many nodes": {"nodes": [{"mesh": 0}, *[{}] * 200_000]},
        "nodes that are text": {"nodes": "abc"},
        "a chain of many joints": {
            "nodes": [*({"children": [child]} for child in range(1, 30_000)), {"mesh": 0}],
            "skins": [{"joints": [*range(30_000)]}],
        },
    }
    for name, change in changes.items():
        yield f"glb of {name}", glb_bytes(document | change, bytes(24))
    target = [{"POSITION": 0}] * 100_000
    wide = accessor | {"count": 10_000}
    many = [{"primitives": [{"attributes": {"POSITION": 0}, "targets": target}]}]
    yield "glb of many targets", glb_bytes(document | {"meshes": many, "accessors": [wide]}, bytes(120_000))
    yield "glb of deep JSON", glb_bytes("[" * 200_000)
    yield "glb of no JSON", glb_bytes("{")
    yield "glb of a list", glb_bytes("[]")
    yield "glb cut off", glb_bytes(document, bytes(24))[:-30]
    for name, old, new in (
        ("a repeated joint", '"Root", "Root/Hips"', '"Root", "Root"'),
        ("joint indices out of range", "jointIndices = [0, 1, 1, 0]", "jointIndices = [0, 1, 7, 0]"),
        ("negative joint indices", "jointIndices = [0, 1, 1, 0]", "jointIndices = [0, -1, 1, 0]"),
        ("faces out of range", "[0, 1, 2, 0, 2, 3]", "[0, 1, 2, 0, 2, 9]"),
        ("negative faces", "[0, 1, 2, 0, 2, 3]", "[0, 1, 2, 0, 2, -3]"),
        ("negative face counts", "faceVertexCounts = [3, 3]", "faceVertexCounts = [-3, 9]"),
        ("weights of NaN", "jointWeights = [1,", "jointWeights = [nan,"),
        ("points of NaN", "(1, 0, 0), (0, 1, 0), (0, 0, 1)]", "(nan, 0, 0), (0, 1, 0), (0, 0, 1)]"),
        ("a huge element size", "elementSize = 1", "elementSize = 1000000000"),
        ("an element size of zero", "elementSize = 1", "elementSize = 0"),
        ("no text", "def SkelRoot", "def SkelRoot \x00"),
        ("a unit of NaN", "metersPerUnit = 0.01", "metersPerUnit = nan"),
    ):
        assert old in USD
        yield f"usda of {name}", USD.replace(old, new).encode()
    yield "usda of a layer that is not there", b'#usda 1.0\ndef "A" (references = @/nowhere/a.usda@)\n{\n}\n'
    yield "usda cut off", USD[: len(USD) // 2].encode()
    yield "usda of deep prims", b"#usda 1.0\n" + b'def "A"\n{\n' * 3000 + b"}\n" * 3000
    yield "usdc of nothing", b"PXR-USDC" + bytes(100)


def _skeletons() -> Iterator[tuple[str, bytes]]:
    head, end = (
        b"HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n",
        b"MOTION\nFrames: 1\nFrame Time: 0.04\n",
    )
    joint = b"JOINT a\n{\nOFFSET 0 1 0\nCHANNELS 1 Xrotation\n"
    good = head + b"}\n" + end
    yield "bvh of a million levels", head + joint * 1_000_000 + b"}\n" * 1_000_001 + end + b"0"
    yield "bvh of a million joints", head + (joint + b"}\n") * 1_000_000 + b"}\n" + end + b"0"
    yield "bvh of a million brackets", head + b"{" * 1_000_000 + b"}" * 1_000_001 + end + b"0"
    yield "bvh of a missing bracket", head + joint + b"}\n" + end + b"0 0"
    yield "bvh of a bracket too many", head + b"}\n}\n" + end + b"0"
    yield "bvh of a billion frames", good.replace(b"Frames: 1", b"Frames: 1000000000") + b"0"
    yield "bvh of no frame", good
    yield "bvh of NaN", good + b"nan"
    yield "bvh of infinity", good + b"1e999"
    yield "bvh of text", good + b"0 1,5 abc"
    yield "bvh of one long number", good + b"1" * 2_000_000
    yield "bvh of a hierarchy of zeros", b"HIERARCHY\n" + bytes(40 << 20)
    yield "bvh of a number of zeros", good + bytes(40 << 20)
    yield "bvh of many channels", good.replace(b"1 Xrotation", b"1000000000 Xrotation") + b"0"
    yield "bvh of an unknown channel", good.replace(b"Xrotation", b"Wrotation") + b"0"
    yield "bvh of an offset of NaN", good.replace(b"0 0 0", b"0 nan 0") + b"0"
    yield "bvh of no motion", head + b"}\n"
    yield "bvh of an end alone", b"HIERARCHY\nEnd Site\n{\nOFFSET 0 0 0\n}\n" + end
    yield "bvh of a joint without a root", b"HIERARCHY\n" + joint + b"}\n" + end + b"0"
    yield "bvh of entries before a joint", b"HIERARCHY\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n" + end
    yield "bvh of no frame time", good.replace(b"0.04", b"0") + b"0"


def _fbx() -> Iterator[tuple[str, bytes]]:
    """Text of FBX, and headers of binary files that lie."""
    head = b"; FBX 7.4.0 project file\nFBXHeaderExtension: {\n FBXVersion: 7400\n}\n"
    bone = b'Model: %d, "Model::Hips%d", "LimbNode" {\n}\n'
    binary = b"Kaydara FBX Binary  \x00\x1a\x00" + struct.pack("<I", 7400)
    yield "fbx of no bones", head + b"Objects: {\n}\nConnections: {\n}\n"
    yield "fbx of a million brackets", head + b"A: {\n" * 1_000_000
    yield "fbx of a missing bracket", head + b"Objects: {\n" + bone % (1, 1)
    yield (
        "fbx of a circle",
        head + b"Objects: {\n" + bone % (1, 1) + bone % (2, 2)
        + b'}\nConnections: {\nC: "OO",1,2\nC: "OO",2,1\n}\n',
    )  # fmt: skip
    objects = head + b"Objects: {\n" + b"".join(bone % (number, number) for number in range(1, 120_000))
    yield "fbx of very many bones", objects + b"}\n"
    yield "fbx of a huge array", head + b"Objects: {\nA: *9000000000000 {\n a: 1,2\n}\n}\n"
    yield "fbx binary cut off", binary + struct.pack("<IIIB", 2**31, 3, 12, 4) + b"Objects"[:4]
    yield "fbx binary of a huge property", binary + struct.pack("<IIIB", 100, 1, 50, 1) + b"AS" + b"\xff" * 40
    packed = zlib.compress(bytes(64 * 2**20), 9)
    record = b"d" + struct.pack("<III", 2**29, 1, len(packed)) + packed
    node = struct.pack("<IIIB", 27 + 13 + 1 + len(record), 1, len(record), 1) + b"A" + record
    yield "fbx binary of a bomb", binary + node + bytes(13)
    yield "fbx of a version that is none", head.replace(b"7400", b"99999999999999999999")


def _plain() -> Iterator[tuple[str, bytes]]:
    yield "empty file", b""
    yield (
        "git-LFS pointer",
        b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"a" * 64 + b"\nsize 9\n",
    )
    yield "zeros", bytes(10_000)
    yield "noise", np.random.default_rng(0).bytes(10_000)
    yield "one long line", b"v " + b"1" * 2_000_000
    yield "deep JSON", b"[" * 200_000
    yield "JSON of another kind", b'{"schema": 1, "files": 3}'
    yield "JSON of a list", b"[1, 2]"
    yield "JSON of a key of many digits", b'{"' + b"9" * 5000 + b'": 1}'
    yield "JSON of half a letter", b'{"\\ud800\\u001b[2J": 1}'
    yield "invalid UTF-8", b'{"schema": "\xff\xfe"}'
    yield "csv of one long line", b"1," * 2_000_000
    yield "csv of a long cell", b"a_x,a_y,a_z\n" + b"1" * 200_000
    yield "csv of a head alone", b"a_x,a_y,a_z\n"
    yield "csv of rows of other lengths", b"1,2,3\n4,5\n"
    yield "point.pca of a huge header", struct.pack("<II", 0xFFFFFFFF, 0xFFFFFFFF) + bytes(100)
    yield "point.pca cut off", struct.pack("<II", 71_256, 15) + bytes(100)
    yield "point.pca big-endian", struct.pack(">II", 71_256, 15) + bytes(100)


def _all() -> dict[str, bytes | Callable[[], bytes]]:
    found: dict[str, bytes | Callable[[], bytes]] = {"npz bomb": _bomb, "pickle bomb of zlib": _zlib_bomb}
    parts = (
        _plain, _pickles, _structured_pickles, _graphs, _arrays, _archives, _meshes, _scenes, _skeletons,
        _fbx, made,
    )  # fmt: skip
    for part in parts:
        found.update(part())
    return found


FILES = _all()
"""Name -> content, or what makes it."""


def _folder(path: Path) -> None:
    path.mkdir()


def _pipe(path: Path) -> None:
    import os

    os.mkfifo(path)


LINKS: dict[str, Callable[[Path], None]] = {
    "nothing": lambda path: None,
    "a folder": _folder,
    "a pipe": _pipe,
    "a link to nothing": lambda path: path.symlink_to(path.with_name("gone")),
    "a link to itself": lambda path: path.symlink_to(path),
    "a link to a device": lambda path: path.symlink_to("/dev/zero"),
}
"""Name -> makes what is no file."""
