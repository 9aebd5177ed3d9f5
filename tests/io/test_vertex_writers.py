"""Vertices over time, read again by parsers of their own: nothing of the writers is used to check them."""

from __future__ import annotations

import struct
import tracemalloc

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.io import open_vertex_sequence
from soma_core.io.usd import write_usd_points
from soma_core.io.vertex_writers import (
    MeshFrames,
    write_mdd,
    write_obj_folder,
    write_pc2,
    write_ply_folder,
    write_vertex_npz,
)

FRAMES, FPS = 5, 24.0
COUNTS = np.array([4, 3], np.int32)
INDICES = np.array([0, 1, 2, 3, 0, 3, 4], np.int32)
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.25, 0.125]], np.float32)
POINTS = np.random.default_rng(0).standard_normal((FRAMES, 5, 3)).astype(np.float32)


def frames(**changes):
    shown = {
        "pieces": lambda: iter((POINTS[:2], POINTS[2:])), "frame_count": FRAMES, "vertex_count": 5,
        "fps": FPS,
        "triangles": np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]]), "counts": COUNTS, "indices": INDICES,
        "uv": UV, "uv_indices": INDICES[::-1], "up": "+z", "source": "a\nwalk",
    }  # fmt: skip
    return MeshFrames(**shown | changes)


def parsed_obj(path):
    """Points, texture coordinates, and each face as pairs of ids."""
    rows = [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]
    points = np.array([row[1:] for row in rows if row[0] == "v"], np.float32)
    uv = np.array([row[1:] for row in rows if row[0] == "vt"], np.float32)
    faces = [[tuple(map(int, corner.split("/"))) for corner in row[1:]] for row in rows if row[0] == "f"]
    return points, uv, faces


def test_an_obj_a_frame(tmp_path):
    write_obj_folder(tmp_path / "obj", frames())
    files = sorted((tmp_path / "obj").iterdir())
    assert [file.name for file in files] == [f"frame_{number:06d}.obj" for number in range(FRAMES)]
    for file, shown in zip(files, POINTS, strict=True):
        points, uv, faces = parsed_obj(file)
        np.testing.assert_array_equal(points, shown)
        np.testing.assert_array_equal(uv, UV)
        assert faces == [[(1, 5), (2, 4), (3, 1), (4, 4)], [(1, 3), (4, 2), (5, 1)]]
        assert "# fps 24\n# unit meters\n# up +z\n" in file.read_text()
    with open_vertex_sequence(tmp_path / "obj") as sequence:
        np.testing.assert_array_equal(sequence.read(0, FRAMES).astype(np.float32), POINTS)


def test_a_ply_a_frame_is_what_trimesh_reads(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    write_ply_folder(tmp_path / "ply", frames())
    for number, shown in enumerate(POINTS):
        mesh = trimesh.load(tmp_path / f"ply/frame_{number:06d}.ply", process=False, maintain_order=True)
        np.testing.assert_array_equal(mesh.vertices, shown)
        np.testing.assert_array_equal(mesh.faces, frames().triangles)
    with open_vertex_sequence(tmp_path / "ply") as sequence:
        np.testing.assert_array_equal(sequence.read(0, FRAMES), POINTS)


def test_pc2(tmp_path):
    write_pc2(tmp_path / "v.pc2", frames())
    data = (tmp_path / "v.pc2").read_bytes()
    assert struct.unpack("<12siiffi", data[:32]) == (b"POINTCACHE2\0", 1, 5, 0.0, 1.0, FRAMES)
    np.testing.assert_array_equal(np.frombuffer(data[32:], "<f4").reshape(FRAMES, 5, 3), POINTS)
    np.testing.assert_array_equal(parsed_obj(tmp_path / "v.obj")[0], POINTS[0])


def test_mdd(tmp_path):
    write_mdd(tmp_path / "v.mdd", frames())
    data = (tmp_path / "v.mdd").read_bytes()
    assert struct.unpack(">ii", data[:8]) == (FRAMES, 5)
    times = np.frombuffer(data[8 : 8 + 4 * FRAMES], ">f4")
    np.testing.assert_allclose(times, np.arange(FRAMES) / FPS, rtol=1e-6)
    np.testing.assert_array_equal(np.frombuffer(data[8 + 4 * FRAMES :], ">f4").reshape(FRAMES, 5, 3), POINTS)
    assert len(parsed_obj(tmp_path / "v.obj")[2]) == 2


def test_usd_points(tmp_path, monkeypatch):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom

    monkeypatch.setattr("soma_core.io.usd._SAVED_FRAMES", 2)  # a frame that was saved is there as well
    for _ in range(2):  # and a file that is there is replaced
        write_usd_points(tmp_path / "v.usdc", frames(metres=0.01))
    stage = Usd.Stage.Open(str(tmp_path / "v.usdc"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 0.01)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 4, FPS)
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    assert mesh.GetPointsAttr().GetTimeSamples() == list(range(FRAMES))
    for number, shown in enumerate(POINTS):
        np.testing.assert_array_equal(mesh.GetPointsAttr().Get(number), shown)
        np.testing.assert_array_equal(mesh.GetExtentAttr().Get(number), [shown.min(0), shown.max(0)])
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == COUNTS.tolist()
    assert list(mesh.GetFaceVertexIndicesAttr().Get()) == INDICES.tolist()
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
    np.testing.assert_array_equal(st, UV[INDICES[::-1]])
    with open_vertex_sequence(tmp_path / "v.usdc") as sequence:
        assert (sequence.fps, sequence.metres, sequence.up) == (FPS, 0.01, "+z")
        np.testing.assert_allclose(sequence.read(0, FRAMES), POINTS, atol=1e-6)


def test_npz_says_what_it_holds(tmp_path):
    write_vertex_npz(tmp_path / "v.npz", frames(metres=0.01))
    with np.load(tmp_path / "v.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["vertices"], POINTS)
        np.testing.assert_array_equal(file["triangles"], frames().triangles)
        assert (file["fps"], file["unit"], file["up_axis"]) == (FPS, "centimeters", "Z")


_WRITERS = [
    (write_vertex_npz, "v.npz"), (write_obj_folder, "v"), (write_ply_folder, "v"), (write_pc2, "v.pc2"),
    (write_mdd, "v.mdd"), (write_usd_points, "v.usdc"),
]  # fmt: skip


@pytest.mark.parametrize(("writer", "name"), _WRITERS, ids=[name.__name__ for name, _ in _WRITERS])
def test_pieces_that_are_missing_leave_no_file(tmp_path, writer, name):
    if writer is write_usd_points:
        pytest.importorskip("pxr", reason="usd-core is not installed")
    with pytest.raises(InputError, match="got 2 frames, expected 5"):
        writer(tmp_path / name, frames(pieces=lambda: iter((POINTS[:2],))))
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".obj"]


@pytest.mark.parametrize(("writer", "name"), _WRITERS[:5], ids=[name.__name__ for name, _ in _WRITERS[:5]])
def test_memory_does_not_grow_with_the_frames(tmp_path, writer, name):
    """A piece is 0.1 MB, the sequence 3.6 MB; USD's memory is not Python's, and not counted here."""
    piece = np.zeros((5, 2000, 3), np.float32)
    many = frames(pieces=lambda: (piece for _ in range(30)), frame_count=150, vertex_count=2000)
    tracemalloc.start()
    writer(tmp_path / name, many)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.2e6


def test_a_folder_of_other_files_is_not_replaced(tmp_path):
    (tmp_path / "obj").mkdir()
    (tmp_path / "obj/mine.txt").write_text("x")
    with pytest.raises(InputError, match=r"obj: got a folder that holds mine\.txt"):
        write_obj_folder(tmp_path / "obj", frames())
    assert (tmp_path / "obj/mine.txt").read_text() == "x"


def test_frames_of_an_earlier_run_are_replaced(tmp_path):
    write_obj_folder(tmp_path / "obj", frames())
    write_obj_folder(tmp_path / "obj", frames(pieces=lambda: iter((POINTS[:1],)), frame_count=1))
    assert [file.name for file in (tmp_path / "obj").iterdir()] == ["frame_000000.obj"]


def test_usd_has_no_name_for_other_axes(tmp_path):
    with pytest.raises(InputError, match=r"up: got -x, expected \+y or \+z"):
        write_usd_points(tmp_path / "v.usdc", frames(up="-x"))
