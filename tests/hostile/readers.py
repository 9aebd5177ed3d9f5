"""Every function of the project that reads a file of a user, with a good file for each."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import torch
from soma_backend_garment import _point_pca as garment
from soma_backend_smpl._model_file import read_model
from soma_backend_smpl.family import SMPL

from assets.make.twist_template import procedural_document
from soma_core.backends.native import component_count
from soma_core.correctives.weights import read_weights
from soma_core.errors import InputError
from soma_core.io import open_vertex_sequence, read_amass, read_motion, read_smpl
from soma_core.io.data_files import read_torch_arrays
from soma_core.io.json_frames import read_pose_frames
from soma_core.io.mesh_vertices import read_mesh_vertices, read_ply_triangles
from soma_core.io.pickled_arrays import read_pickled_arrays
from soma_core.io.point_files import read_points
from soma_core.io.sam3d import read_sam3d
from soma_core.io.skeleton_files import read_skeleton
from soma_core.io.smpl_camera import in_world
from soma_core.obj import read_obj
from soma_core.parquet_file import look_through
from soma_core.rig.manifest import MANIFEST_NAME, read_manifest
from soma_core.rig.neutral import load_shape_space, read_topology
from soma_core.rig.procedural_json import read_procedural
from soma_core.rig.usd import read_usd_rig
from soma_core.tasks.wrap import read_landmarks
from tests.fbx_files import write_fbx
from tests.io.smpl_layouts import TURNS as SMPLX_TURNS
from tests.io.smpl_layouts import easymocap, save_joblib, save_npy, save_npz, save_pt, smplx_names, wham
from tests.skeletons import glb_bytes, moved
from tests.standins.pickles import ch, csc, select, write_pickle

__all__ = ["READERS", "Reader"]

FRAMES, COUNT = 3, 5


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A reader, the suffix of its files, and how to write one that it reads; None: too large to mutate.

    `accepts` names the files that are sound for this reader, which does not read what is wrong with them.
    `apart` readers start a process for every file. NaN marks a vertex that is missing in a sequence.
    """

    name: str
    suffix: str
    read: Callable[[Path], Any]
    good: Callable[[Path], Any] | None = None
    accepts: tuple[str, ...] = ()
    apart: bool = False


def _frames(path: Path) -> np.ndarray:
    with open_vertex_sequence(path) as sequence:
        return sequence.read(0, 1)


def _folder(path: Path) -> np.ndarray:
    """Read a folder that holds the file alone."""
    folder = path.with_suffix(".d")
    folder.mkdir(exist_ok=True)
    inside = folder / path.name
    inside.unlink(missing_ok=True)
    inside.symlink_to(path)
    return _frames(folder)


def _beside(path: Path, name: str) -> Path:
    """A folder that holds the file alone, under a name."""
    folder = path.with_suffix(".d")
    folder.mkdir(exist_ok=True)
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(path)
    return folder


def _pose_frames(path: Path) -> object:
    people = read_pose_frames(_beside(path, path.name))
    if not people:
        raise InputError(str(path), got="nobody", expected="people", fix="Look.")
    return people


def _pose_frame(path: Path) -> None:
    path.write_text(json.dumps(easymocap(72)[0]))


def _camera(path: Path) -> object:
    return in_world(path, np.zeros((2, 24, 3)), np.zeros((2, 3)), np.arange(2))


def _camera_path(path: Path) -> None:
    save_npy(path, {"pred_cam_R": np.tile(np.eye(3), (2, 1, 1)), "pred_cam_T": np.zeros((2, 3))})


def _manifest(path: Path) -> object:
    named = path.with_name(MANIFEST_NAME)
    named.unlink(missing_ok=True)
    named.symlink_to(path)
    return read_manifest(path.parent)


def _vertices() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(FRAMES, COUNT, 3)).astype(np.float32)


def _write_npz(path: Path, **arrays: object) -> None:
    with open(path, "wb") as stream:
        np.savez_compressed(stream, **arrays)


def _motion(path: Path) -> None:
    turns = np.zeros((FRAMES, 77, 3), np.float32)
    _write_npz(path, poses=turns, transl=turns[:, 0], fps=30.0, unit="meters", convention="t_pose_relative")


def _kimodo(path: Path) -> None:
    turns = np.tile(np.eye(3, dtype=np.float32), (FRAMES, 30, 1, 1))
    _write_npz(path, local_rot_mats=turns, root_positions=turns[:, 0, 0])


def _amass(path: Path) -> None:
    _write_npz(
        path, poses=np.zeros((FRAMES, 156)), trans=np.zeros((FRAMES, 3)), betas=np.zeros(16),
        gender=np.array("male"), mocap_framerate=120.0,
    )  # fmt: skip


def _estimated(save: Callable[[Path, Any], None]) -> Callable[[Path], None]:
    """A result of a video estimator, in a container."""
    return lambda path: save(path, {"smpl_params_global": smplx_names(SMPLX_TURNS)})


def _shape_space(path: Path) -> None:
    _write_npz(
        path, mean=_vertices()[0], shapedirs=_vertices()[:2].reshape(2, -1),
        eigenvalues=np.ones(2, np.float32), metadata=np.array(json.dumps({"units": "cm"})),
    )  # fmt: skip


def _obj(path: Path) -> None:
    path.write_text("v 0 0 0\nv 1 0 0 # a\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1/1/1 3//2 -1\n")


def _ply(path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
    path.write_bytes((head + "property float z\nend_header\n").encode() + _vertices()[0].tobytes())


def _ply_faces(path: Path) -> None:
    _ply(path)
    head, _, body = path.read_bytes().partition(b"end_header")
    faces = struct.pack("<B3iB4i", 3, 0, 1, 2, 4, 0, 2, 3, 4)
    head += b"element face 2\nproperty list uchar int vertex_indices\nend_header"
    path.write_bytes(head + body + faces)


def _torch(path: Path) -> None:
    numbers = torch.arange(24.0).reshape(2, 3, 4)
    content = {"poses": numbers, "half": numbers.half(), "list": [1, "text", numbers[0].T], 3: (None, True)}
    torch.save({**content, "weights": torch.nn.Linear(2, 3).state_dict()}, path)


def _landmarks(path: Path) -> None:
    path.write_text(json.dumps({"12": 7, "400": 31}))


def _glb(path: Path) -> None:
    points, shift = _vertices()[0], _vertices()[1]
    times, weights = np.array([0, 0.5], np.float32), np.array([0, 1], np.float32)
    data, views, accessors = b"", [], []
    for array, kind in ((points, "VEC3"), (shift, "VEC3"), (times, "SCALAR"), (weights, "SCALAR")):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": 5126, "count": len(array), "type": kind}
        )
        data += array.tobytes()
    channel = {"sampler": 0, "target": {"node": 1, "path": "weights"}}
    document = {
        "asset": {"version": "2.0"}, "nodes": [{"children": [1]}, {"mesh": 0}], "accessors": accessors,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "targets": [{"POSITION": 1}]}]}],
        "animations": [{"channels": [channel], "samplers": [{"input": 2, "output": 3}]}],
        "bufferViews": views, "buffers": [{"byteLength": len(data)}],
    }  # fmt: skip
    path.write_bytes(glb_bytes(document, data))


def _joints_glb(path: Path) -> None:
    nodes = [{"name": "Hips", "children": [1]}, {"name": "LeftLeg", "translation": [0, -1, 0]}]
    path.write_bytes(glb_bytes({"asset": {"version": "2.0"}, "nodes": nodes, "skins": [{"joints": [0, 1]}]}))


def _pickle(path: Path) -> None:
    numbers = _vertices()[0].astype(float)
    write_pickle(path, {"a": numbers, "ch": ch(numbers), "select": select(numbers), "csc": csc(numbers)})


_USD = """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Y"
)

def SkelRoot "Body"
{
    def Skeleton "Skeleton"
    {
        uniform matrix4d[] bindTransforms = [%s, %s]
        uniform token[] joints = ["Root", "Root/Hips"]
        uniform matrix4d[] restTransforms = [%s, %s]
    }

    def Mesh "c_skin_mid" (
        prepend apiSchemas = ["SkelBindingAPI"]
    )
    {
        int[] faceVertexCounts = [3, 3]
        int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
        int[] primvars:skel:jointIndices = [0, 1, 1, 0] (
            elementSize = 1
            interpolation = "vertex"
        )
        float[] primvars:skel:jointWeights = [1, 1, 1, 1] (
            elementSize = 1
            interpolation = "vertex"
        )
        rel skel:skeleton = </Body/Skeleton>
    }
}
"""
_EYE = "((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))"
USD = _USD % ((_EYE,) * 4)
"""A rig of two joints, on which four vertices hang."""


def _usd(path: Path) -> None:
    path.write_text(USD)


def _bvh(path: Path) -> None:
    head = "HIERARCHY\nROOT Hips\n{\n OFFSET 0 0 0\n CHANNELS 6 Xposition Yposition Zposition "
    leg = "Zrotation Yrotation Xrotation\n JOINT LeftLeg\n {\n  OFFSET 0 -40 0\n  CHANNELS 1 Xrotation\n"
    leg += "  End Site\n  {\n   OFFSET 0 -40 0\n  }"
    path.write_text(f"{head}{leg}\n }}\n}}\nMOTION\nFrames: 2\nFrame Time: 0.04\n" + "0 90 0 1 2 3 4\n" * 2)


def _parquet(path: Path) -> None:
    rows = pa.table({"name": ["a", "b"], "poses": [_vertices().tolist()] * 2, "bytes": [b"a", None]})
    pa.parquet.write_table(rows, path, compression="zstd")


def _points(path: Path) -> np.ndarray:
    return read_points(path, ("Hips", "Head")).positions


def _keypoints(path: Path) -> None:
    path.write_text(json.dumps({"fps": 30, "frames": [{"keypoints": [[0, 0.9, 0, 1], [0, 1.6, 0, 1]]}] * 2}))


def _table(path: Path) -> None:
    path.write_text("Hips_x,Hips_y,Hips_z,Head_x,Head_y,Head_z\n" + "0,0.9,0,0,1.6,0.05\n" * 2)


def _fbx(path: Path) -> None:
    parents, rest = np.array([-1, 0]), np.array([[0, 1.0, 0], [0, 0.5, 0]])
    motion = moved(("Hips", "LeftLeg"), parents, rest, frames=2)
    write_fbx(motion, path)


def _json(path: Path) -> None:
    path.write_text(json.dumps({"schema": 1, "rig_hash": "a", "rig_revision": "b", "files": {}}))


def _procedural(path: Path) -> None:
    sides = [f"{side}{name}" for side in ("Left", "Right") for name in ("Shoulder", *_LIMBS)]
    path.write_text(json.dumps(procedural_document(["Root", "Hips", *sides])))


_LIMBS = ("Arm", "ForeArm", "Hand", "Leg", "Shin", "Foot")

READERS = [
    Reader(name="wrap pair", suffix=".obj", read=read_obj, good=_obj),
    Reader(
        name="mesh obj", suffix=".obj", read=read_mesh_vertices, good=_obj,
        accepts=(
            "obj of an index of zero", "obj of an index out of range", "obj of a negative index",
            "obj of a huge index", "obj of an index of many digits", "obj of no index", "obj of two corners",
            "obj of no faces", "obj of NaN", "obj of infinity",
        ),
    ),
    Reader(
        name="faces ply", suffix=".ply", read=lambda path: read_ply_triangles(path, FRAMES + 2),
        good=_ply_faces,
        accepts=("ply with a texture elsewhere", "ply of far away", "ply of very far away"),
    ),
    Reader(name="torch file", suffix=".pt", read=read_torch_arrays, good=_torch),
    Reader(name="correctives", suffix=".pt", read=read_weights),
    Reader(name="landmarks", suffix=".json", read=read_landmarks, good=_landmarks),
    Reader(
        name="mesh ply", suffix=".ply", read=read_mesh_vertices, good=_ply,
        accepts=("ply with a texture elsewhere",),
    ),
    Reader(
        name="vertex folder", suffix=".ply", read=_folder, good=_ply,
        accepts=("ply with a texture elsewhere",),
    ),
    Reader(
        name="vertices npz", suffix=".npz", read=_frames,
        good=lambda path: _write_npz(path, vertices=_vertices()), accepts=("npz of NaN",),
    ),
    Reader(name="vertices npy", suffix=".npy", read=_frames, good=lambda path: np.save(path, _vertices())),
    Reader(name="vertices glb", suffix=".glb", read=_frames, good=_glb),
    Reader(
        name="vertices usd", suffix=".usda", read=_frames, good=_usd, apart=True,
        accepts=(
            "usda of a repeated joint", "usda of faces out of range", "usda of negative faces",
            "usda of negative face counts", "usda of weights of NaN", "usda of points of NaN",
        ),
    ),
    Reader(name="vertices usdc", suffix=".usdc", read=_frames),
    Reader(name="vertices usdz", suffix=".usdz", read=_frames),
    Reader(
        name="bvh", suffix=".bvh", read=read_skeleton, good=_bvh,
        accepts=("bvh of a billion frames", "bvh of a joint without a root"),
    ),
    Reader(
        name="fbx", suffix=".fbx", read=read_skeleton, good=_fbx, accepts=("fbx of a missing bracket",),
        apart=True,
    ),
    Reader(name="joints of a vrm", suffix=".vrm", read=read_skeleton, good=_joints_glb),
    Reader(name="joints of a glb", suffix=".glb", read=read_skeleton, good=_joints_glb),
    Reader(
        name="joints of a usd", suffix=".usda", read=read_skeleton, good=_usd, apart=True,
        accepts=(
            "usda of joint indices out of range", "usda of negative joint indices",
            "usda of faces out of range", "usda of negative faces", "usda of negative face counts",
            "usda of weights of NaN", "usda of points of NaN", "usda of a huge element size",
            "usda of an element size of zero",
        ),
    ),
    Reader(name="motion", suffix=".npz", read=read_motion, good=_motion),
    Reader(name="kimodo motion", suffix=".npz", read=read_motion, good=_kimodo),
    Reader(name="amass motion", suffix=".npz", read=read_amass, good=_amass),
    Reader(name="smpl npz of objects", suffix=".npz", read=read_smpl, good=_estimated(save_npz)),
    Reader(name="smpl npy", suffix=".npy", read=read_smpl, good=_estimated(save_npy)),
    Reader(name="smpl torch", suffix=".pt", read=read_smpl, good=_estimated(save_pt)),
    Reader(
        name="smpl joblib", suffix=".pkl", read=read_smpl,
        good=lambda path: save_joblib(path, {0: wham()[0]}),
    ),
    Reader(name="pose frames", suffix=".json", read=_pose_frames, good=_pose_frame),
    Reader(name="points of a table", suffix=".csv", read=_points, good=_table),
    Reader(name="points of frames", suffix=".json", read=_points, good=_keypoints),
    Reader(
        name="points npy", suffix=".npy", read=_points,
        good=lambda path: np.save(path, np.random.default_rng(0).random((2, 2, 3))),
    ),
    Reader(name="camera of tracks", suffix=".npy", read=_camera, good=_camera_path),
    Reader(name="sam 3d body", suffix=".npz", read=read_sam3d),
    Reader(name="parquet", suffix=".parquet", read=look_through, good=_parquet, apart=True),
    Reader(name="sam 3d body in rows", suffix=".parquet", read=read_sam3d),
    Reader(name="shape space", suffix=".npz", read=load_shape_space, good=_shape_space),
    Reader(
        name="shape space header", suffix=".npz", read=component_count, good=_shape_space,
        accepts=("npz of invalid text",),
    ),
    Reader(name="topology", suffix=".npz", read=read_topology),
    Reader(name="usd rig", suffix=".usda", read=read_usd_rig, good=_usd, apart=True),
    Reader(name="procedural definition", suffix=".json", read=read_procedural, good=_procedural),
    Reader(name="manifest", suffix=".json", read=_manifest, good=_json),
    Reader(
        name="pickle", suffix=".pkl",
        read=lambda path: read_pickled_arrays(path, ["a", "ch", "select", "csc", "v_template", "shapedirs"]),
        good=_pickle,
        accepts=(
            "pickle of NaN", "pickle of lists in lists", "pickle of one array many times",
            "pickle of tracks in tracks", "pickle of itself", "pickle of a tree without end",
        ),
    ),
    Reader(name="smpl npz", suffix=".npz", read=lambda path: read_model(path, SMPL)),
    Reader(name="smpl pkl", suffix=".pkl", read=lambda path: read_model(path, SMPL)),
    Reader(name="point.pca", suffix=".pca", read=garment.read_pca),
    Reader(name="point.npz", suffix=".npz", read=garment.read_npz),
]  # fmt: skip
