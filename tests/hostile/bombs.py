"""Hostile files that walk memory, unfold to more than they hold, or keep a reader busy."""

from __future__ import annotations

import base64
import functools
import io
import json
import pickle
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator

import numpy as np

from tests.hostile.readers import USD, glb_bytes
from tests.standins.pickles import Instance, ch, csc

__all__ = ["instances", "made"]

_COLLIDING = 2**61 - 1
"""Python hashes its multiples to zero."""


def _number(value: int) -> bytes:
    data = value.to_bytes(16, "little", signed=True)
    return b"\x8a" + bytes([len(data)]) + data


def instances() -> Iterator[tuple[str, object]]:
    """Values that are pickled under the keys of the readers."""
    for name, starts in (
        ("that jump back", [0, 10**6, 0, 3]), ("that leave the values", [0, 1, 2, 10**9]),
        ("below zero", [-(10**6), 1, 2, 3]), ("that are too few", [0, 3]),
    ):  # fmt: skip
        for kind in ("csr", "csc"):
            bad = csc(np.eye(3))
            state = bad.state | {"indptr": np.array(starts, np.int32), "format": kind}
            yield f"pickle of {kind} starts {name}", Instance(f"scipy.sparse.{kind}", f"{kind}_matrix", state)
    for name, ids in (("far away", [0, 1, 2**30]), ("below zero", [0, 1, -(2**30)])):
        places = {"row": np.array(ids, np.int32), "col": np.arange(3, dtype=np.int32)}
        state = {"_shape": (3, 3), "data": np.ones(3), "format": "coo", **places}
        yield f"pickle of coo rows {name}", Instance("scipy.sparse.coo", "coo_matrix", state)
    nested: object = np.arange(3)
    for _ in range(7):
        nested = Instance("chumpy.reordering", "Select", {"a": nested, "idxs": nested})
    yield "pickle of selections of themselves", ch(nested)


def _pickles() -> Iterator[tuple[str, bytes | Callable[[], bytes]]]:
    def colliding() -> bytes:
        items = b"".join(_number(key * _COLLIDING) + b"N" for key in range(300_000))
        return b"\x80\x02}(" + items + b"u."

    yield "pickle of keys that collide", colliding
    many = b"".join(b"J" + struct.pack("<i", key << 14) + b"N" for key in range(70_000))
    yield "pickle of many integers as keys", b"\x80\x02}(" + many + b"u."
    memory = b"".join(b"p%d\n" % (key * _COLLIDING) for key in range(100_000))
    yield "pickle of memory that collides", b"\x80\x02N" + memory + b"."
    yield "pickle of doubled lists", b"\x80\x02]" + b"q\x00" + b"](h\x00h\x00eq\x00" * 60 + b"."
    record = b"cnumpy\ndtype\n(" * 100_000 + b"tR" * 100_000
    yield "pickle of deep records", b"\x80\x02" + record + b"."
    yield (
        "pickle of a wide text",
        lambda: (
            b"\x80\x02X" + struct.pack("<I", 80_000_004) + b"a" * 80_000_000 + "\U0001f600".encode() + b"."
        ),
    )
    sets = b"c__builtin__\nset\n(]tR" + b"q\x00c__builtin__\nset\n(](h\x00h\x00etRq\x00" * 60
    yield "pickle of doubled sets", b"\x80\x02" + sets + b"."


def _name(module: str, name: str) -> bytes:
    return f"c{module}\n{name}\n".encode()


def _text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def _sizes(values: tuple[int, ...]) -> bytes:
    return b"(" + b"".join(_number(value) for value in values) + b"t"


def _tensor(
    size: tuple[int, ...], stride: tuple[int, ...], *, kind: str = "Float", key: str = "0", count: int = 8,
    offset: int = 0,
) -> bytes:  # fmt: skip
    storage = b"(" + _text("storage") + _name("torch", f"{kind}Storage") + _text(key) + _text("cpu")
    storage += _number(count) + b"tQ"
    rest = b"\x89" + _name("collections", "OrderedDict") + b")RtR"
    head = _name("torch._utils", "_rebuild_tensor_v2") + b"("
    return head + storage + _number(offset) + _sizes(size) + _sizes(stride) + rest


def _sparse(layout: str, indices: tuple[bytes, ...], values: bytes, size: tuple[int, int]) -> bytes:
    kind = _name("torch.serialization", "_get_layout") + b"(" + _text(f"torch.sparse_{layout}") + b"tR"
    parts = b"(" + b"".join(indices) + values + _sizes(size) + b"t"
    return _name("torch._utils", "_rebuild_sparse_tensor") + b"(" + kind + parts + b"tR"


def _archive(
    program: bytes, storages: dict[str, bytes] | None = None, method: int = zipfile.ZIP_STORED
) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr("a/data.pkl", b"\x80\x02}(" + _text("W1") + program + b"u.")
        for key, data in (storages or {"0": bytes(32)}).items():
            archive.writestr(f"a/data/{key}", data)
        archive.writestr("a/version", b"3\n")
    return stream.getvalue()


def _tensors() -> Iterator[tuple[str, bytes | Callable[[], bytes]]]:
    starts = np.array([0, 10**6, 0, 2], "<i8").tobytes()
    ids, numbers = np.array([0, 1], "<i8").tobytes(), np.ones(8, "<f4").tobytes()
    kept = {"0": numbers, "1": starts, "2": ids}
    first = _tensor((4,), (1,), kind="Long", key="1", count=4)
    second, values = _tensor((2,), (1,), kind="Long", key="2", count=2), _tensor((2,), (1,))
    for layout in ("csr", "csc"):
        yield (
            f"pt of {layout} starts that jump back",
            _archive(_sparse(layout, (first, second), values, (3, 3)), kept),
        )
    far = {"0": numbers, "1": np.array([0, 2**40, 1, 1], "<i8").tobytes()}
    places = _tensor((2, 2), (2, 1), kind="Long", key="1", count=4)
    yield "pt of coo rows far away", _archive(_sparse("coo", (places,), values, (3, 3)), far)
    huge = {"0": numbers, "1": bytes(32)}
    yield "pt of a huge sparse matrix", _archive(_sparse("coo", (places,), values, (2**40, 2**40)), huge)
    yield "pt of a stride of zero", _archive(_tensor((3 * 2**30,), (0,)))
    yield "pt of many strides of zero", _archive(b"(" + _tensor((2**24,), (0,)) * 200 + b"l")
    yield "pt of a tensor that leaves its storage", _archive(_tensor((9,), (1,)))
    yield "pt of an offset that leaves it", _archive(_tensor((2,), (1,), offset=2**40))
    yield "pt of an offset below zero", _archive(_tensor((2,), (1,), offset=-8))
    yield "pt of strides below zero", _archive(_tensor((2,), (-4,)))
    yield "pt of a storage of another length", _archive(_tensor((2,), (1,), count=10**12))
    yield "pt of no storage", _archive(_tensor((2,), (1,), key="../../etc/passwd"))
    yield (
        "pt compressed",
        lambda: _archive(_tensor((2**26,), (1,), count=2**26), {"0": bytes(2**28)}, zipfile.ZIP_DEFLATED),
    )
    yield "pt of code", _archive(_name("os", "system") + b"(" + _text("touch owned") + b"tR")
    yield "pt of code by a name of torch", _archive(_name("torch.hub", "load") + b"(" + _text("a") + b"tR")
    yield "pt of doubled lists", _archive(b"]q\x00" + b"](h\x00h\x00eq\x00" * 60)
    yield "pt of deep lists", _archive(b"]" * 50_000 + b"a" * 49_999)
    yield (
        "pt of keys that collide",
        _archive(b"}(" + b"".join(_number(key * _COLLIDING) + b"N" for key in range(1000)) + b"u"),
    )
    array = _name("numpy.core.multiarray", "_reconstruct") + b")R(K\x01" + _sizes((2**20,))
    kind = _name("numpy", "dtype") + b"(" + _text("f8") + b"tRq\x01"
    data = b"B" + struct.pack("<I", 2**23) + bytes(2**23) + b"q\x02"
    again = (array + b"h\x01\x89h\x02tb") * 500
    yield (
        "pt of many arrays of one text",
        lambda: _archive(b"(" + array + kind + b"\x89" + data + b"tb" + again + b"l"),
    )
    whole = _archive(_tensor((2,), (1,)))
    yield "pt cut off", whole[: len(whole) // 2]
    stream = io.BytesIO(whole)
    with zipfile.ZipFile(stream, "a") as archive:
        archive.writestr("a/constants.pkl", b"\x80\x02).")
    yield "pt of a program", stream.getvalue()
    yield "pt of before 1.6", pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1001, 2)
    yield "pt of a long directory", _long_directory


def _long_directory() -> bytes:
    entry = b"PK\x01\x02" + bytes(24) + struct.pack("<H", 4) + bytes(16) + b"name"
    count = 400_000
    end = struct.pack("<4s4H2IH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, count * len(entry), 0, 0)
    return entry * count + end


def _scenes() -> Iterator[tuple[str, bytes | Callable[[], bytes]]]:
    accessor = {"bufferView": 0, "componentType": 5126, "count": 2, "type": "VEC3"}
    document = {
        "asset": {}, "nodes": [{"mesh": 0}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [accessor], "bufferViews": [{"buffer": 0, "byteLength": 24}],
        "buffers": [{"byteLength": 24}],
    }  # fmt: skip
    for name, change in (
        ("JSON as vertices", {"accessors": [accessor | {"byteOffset": -64}]}),
        ("a view before the file", {"bufferViews": [{"buffer": 0, "byteLength": 24, "byteOffset": -64}]}),
        ("a view that is longer", {"bufferViews": [{"buffer": 0, "byteLength": 10**9}]}),
        ("a child below zero", {"nodes": [{"mesh": 0, "children": [-1]}]}),
    ):
        yield f"glb of {name}", glb_bytes(document | change, bytes(24))
    yield "glb of many nodes and frames", _many_nodes


def _many_nodes() -> bytes:
    frames, count = 256, 99_000
    data = bytes(24) + np.arange(frames, dtype="<f4").tobytes() + bytes(12 * frames)
    places = [(0, 24), (24, 4 * frames), (24 + 4 * frames, 12 * frames)]
    kinds = [("VEC3", 2), ("SCALAR", frames), ("VEC3", frames)]
    nodes = [{"mesh": 0, "skin": 0, "children": list(range(1, count))}, *[{}] * (count - 1)]
    document = {
        "asset": {}, "nodes": nodes, "skins": [{"joints": list(range(count))}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [
            {"bufferView": view, "componentType": 5126, "count": count, "type": kind}
            for view, (kind, count) in enumerate(kinds)
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": at, "byteLength": size} for at, size in places],
        "buffers": [{"byteLength": len(data)}],
        "animations": [{
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}],
            "samplers": [{"input": 1, "output": 2}],
        }],
    }  # fmt: skip
    return glb_bytes(json.dumps(document), data)


def _layers() -> Iterator[tuple[str, bytes]]:
    mesh = USD.partition("def SkelRoot")[2]
    for name, arc in (
        ("a reference to a device", 'references = @/dev/zero@'),
        ("a payload of another folder", 'payload = @../../../../../../etc/hosts@'),
        ("a reference to the net", 'references = @https://example.org/a.usd@'),
        ("values in other files", "clips = {dictionary default = {asset[] assetPaths = [@/dev/zero@]}}"),
    ):  # fmt: skip
        yield (
            f"usda of {name}",
            f'#usda 1.0\ndef SkelRoot "A" (\n    {arc}\n)\n{{\n}}\ndef SkelRoot{mesh}'.encode(),
        )
    yield (
        "usda of a layer that is a device",
        f"#usda 1.0\n(\n    subLayers = [@/dev/zero@]\n)\ndef SkelRoot{mesh}".encode(),
    )
    doubled = 'def "P0"\n{\n    def "x"\n    {\n    }\n}\n'
    for level in range(1, 25):
        inside = "".join(
            f'    def "{side}" (references = </P{level - 1}>)\n    {{\n    }}\n' for side in "ab"
        )
        doubled += f'def "P{level}"\n{{\n{inside}}}\n'
    yield "usda of doubled references", ("#usda 1.0\n" + doubled).encode()
    yield "usda of very deep prims", b"#usda 1.0\n" + b'def "A"\n{\n' * 200_000 + b"}\n" * 200_000
    for name, left, right in (("lists", b"[", b"]"), ("dictionaries", b"dictionary a = {\n", b"}\n")):
        deep = left * 200_000 + right * 200_000
        yield f"usda of deep {name}", b"#usda 1.0\n(\n    customLayerData = {\n" + deep + b"}\n)\n"
    # Texts in which brackets close keep a count of brackets from being seen.
    yield (
        "usda of deep prims in disguise",
        b"#usda 1.0\n" + b'def "A" (doc = "}")\n{\n' * 200_000 + b"}\n" * 200_000,
    )


def _far() -> Iterator[tuple[str, bytes]]:
    """Places that a file can hold and no body has: their squares are infinite."""
    for name, number in (("far away", "1e300"), ("very far away", "-1e160")):
        triangle = f"v 0 0 0\nv {number} 0 0\nv 0 {number} 0\nf 1 2 3\n"
        yield f"obj of {name}", triangle.encode()
        head = "ply\nformat ascii 1.0\nelement vertex 3\n"
        head += "".join(f"property double {axis}\n" for axis in "xyz")
        faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        yield f"ply of {name}", f"{head}{faces}0 0 0\n{number} 0 0\n0 {number} 0\n3 0 1 2\n".encode()
        stream = io.BytesIO()
        np.savez(stream, vertices=np.full((1, 5, 3), float(number)), poses=np.full((3, 77, 3), float(number)))
        yield f"npz of {name}", stream.getvalue()
        moved = "CHANNELS 3 Xposition Yposition Zposition\nEnd Site\n{\nOFFSET 0 1 0\n}\n}\nMOTION\n"
        for place, rest, root in (("a joint", number, "0"), ("a root", "1", number)):
            joint = f"JOINT a\n{{\nOFFSET 0 {rest} 0\nCHANNELS 0\n}}\n"
            text = f"HIERARCHY\nROOT Hips\n{{\nOFFSET 0 1 0\n{moved.replace('End', joint + 'End', 1)}"
            yield f"bvh of {place} {name}", f"{text}Frames: 1\nFrame Time: 0.04\n0 {root} 0\n".encode()
        row = ",".join([number] * 6)
        yield f"csv of {name}", f"Hips_x,Hips_y,Hips_z,Head_x,Head_y,Head_z\n{row}\n".encode()
        frames = [{"keypoints": [[0, float(number), 0, 1]] * 2}]
        yield f"JSON of points {name}", json.dumps({"fps": 30, "frames": frames}).encode()
    point = np.array([[3e38, 0, 0], [0, 1, 0]], "<f4").tobytes()
    accessor = {"bufferView": 0, "componentType": 5126, "count": 2, "type": "VEC3"}
    document = {
        "asset": {}, "nodes": [{"mesh": 0}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [accessor], "bufferViews": [{"buffer": 0, "byteLength": 24}],
        "buffers": [{"byteLength": 24}],
    }  # fmt: skip
    yield "glb of vertices far away", glb_bytes(document, point)
    nodes = [{"name": "Hips", "children": [1]}, {"name": "LeftLeg", "translation": [0, -1e300, 0]}]
    yield "glb of a joint far away", glb_bytes({"asset": {}, "nodes": nodes, "skins": [{"joints": [0, 1]}]})
    for digits in (4_000, 1_000_000):
        frames = f'{{"fps": 30, "frames": [{{"keypoints": [[0, {"9" * digits}, 0, 1], [0, 1, 0, 1]]}}]}}'
        yield f"JSON of {digits} digits", frames.encode()
    names = ",".join(f"a{number}_x,a{number}_y,a{number}_z" for number in range(50_000))
    yield "csv of very many columns", (names + "\n" + "0," * 149_999 + "0\n").encode()


def _archives() -> Iterator[tuple[str, bytes | Callable[[], bytes]]]:
    """Members of one name, which readers disagree on; members that unfold together to more than each may."""
    keys = ("poses", "vertices", "mean", "v_template", "pca_matrix", "triangles", "local_rot_mats", "a")
    for name, second in (("twice", "{}.npy"), ("with and without a suffix", "{}")):
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for key in keys:
                for number, place in enumerate(("{}.npy", second)):
                    array = io.BytesIO()
                    np.save(array, np.full((3, 77, 3), 0.1 * number))
                    archive.writestr(place.format(key), array.getvalue())
        yield f"npz of arrays {name}", stream.getvalue()
    yield "npz of several bombs", lambda: _several_bombs(400_000)
    yield "npz of several bombs below the limit", lambda: _several_bombs(200_000)


@functools.cache
def _several_bombs(frames: int) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for key, width in (
            ("poses", 156),
            ("trans", 156),
            ("betas", 156),
            ("dmpls", 156),
            ("pose_hand", 156),
        ):
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(
                    member, {"descr": "<f4", "fortran_order": False, "shape": (frames, width)}
                )
                for _ in range(frames // 4000):
                    member.write(bytes(4 * width * 4000))
    return stream.getvalue()


_LIST_BOMB = (
    b"c-nnZO-sW-5S^?c=AfX$gseoU2SbIbRjG=oF!dW-YzuzWi<B5@v8^$!20i(w{0Cn2m*_=2dQsfnrfM&~!%k-By*E3XEl_C|b"
    b"u@7_hYVo^Ao(!!nb5~U0RfjWm%{t!hc^v}&_Khnby-pCy#>iX+3+yL`mt94QzU&~?@vOh8L})r`ZN^)b)L(BZM3{|zfnO38D"
    b"<X#p?`LI<A?2<=eNXhjNFRQWprDw*II2sLUV%I{eInV_{}z0j62+M!9kN}z!>67y$(v%W#fRQI$MvL^`g0JuKE8UJSDCLWKR"
    b"%tGgz5)*_WJ!Z*^x8QMxhL6pp|hdw@!%{iEg1O!kL1Be6&lMe1OWD57kYwuq{<UR8V9EKy#5tP}03jo&D+`Lo;>gkL1xqJ!A"
    b"1YptltgwisNyvE_h@%%~MYnFoY+~HkJ+Kl-{$`)n6Z6c30ev2Ix^NO_7bM&~$c0GM^Bzu%&eL1dn)vK#uCxS|Nb?vvOydapW"
    b"gyChB5PzjryKE-r7N*nFv)pmS^%)GHAYR}%yu_M%"
)
"""One row of Parquet with a list of 250,000,000 zeros, 646 bytes: deflated, in base 85."""


def _parquet(**columns: object) -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    stream = io.BytesIO()
    parquet.write_table(pa.table(columns), stream, compression="zstd")
    return stream.getvalue()


def _tables() -> Iterator[tuple[str, bytes | Callable[[], bytes]]]:
    yield "parquet of a list without end", zlib.decompress(base64.b85decode(_LIST_BOMB))
    yield "parquet of more rows than bytes", lambda: _parquet(name=[None] * 2_000_000)
    yield "parquet of many columns", lambda: _parquet(**{f"c{n}": [1.0] for n in range(12_000)})
    yield "parquet of a footer before its begin", b"PAR1" + bytes(99) + struct.pack("<I", 2**31 - 1) + b"PAR1"
    yield "parquet of no footer", b"PAR1" + bytes(99) + struct.pack("<I", 0) + b"PAR1"
    deep: object = 1.0
    for _ in range(150):
        deep = [deep]
    yield "parquet of lists in lists", lambda: _parquet(pred_vertices=[deep])


def made() -> Iterator[tuple[str, bytes | Callable[[], bytes]]]:
    """Name -> content, or what makes it."""
    yield from _pickles()
    yield from _tensors()
    yield from _scenes()
    yield from _layers()
    yield from _far()
    yield from _archives()
    yield from _tables()
    yield "JSON of many brackets", lambda: b"[" + b"[]," * 2_700_000 + b"[]]"
    texture = "ply\nformat ascii 1.0\ncomment TextureFile /dev/zero\nelement vertex 3\nproperty float x\n"
    texture += "property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\n"
    yield "ply with a texture elsewhere", (texture + "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n").encode()
