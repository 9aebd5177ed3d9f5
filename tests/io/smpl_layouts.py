"""Small files in the layouts of video estimators and data sets, all of one motion, and the motion itself."""

from __future__ import annotations

import json
import pickle
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.standins.pickles import write_pickle

FRAMES = 5
_random = np.random.default_rng(7)
TURNS = 0.4 * _random.standard_normal((FRAMES, 55, 3))
"""Local rotations of SMPL-X [rad]; body and hands are those of the others too."""
TURNS[:, 0] = (Rotation.from_euler("y", np.linspace(0, 40, FRAMES)[:, None], degrees=True)).as_rotvec()
PATH = np.linspace([0, 0.9, 0], [0.3, 1.0, 0.2], FRAMES)
BETAS = np.array([0.5, -1.0, 0.25, 0, 0, 0, 0, 0, 0, 0.125])
PALMS = 0.1 * _random.standard_normal((FRAMES, 2, 3))
SMPL = np.concatenate([TURNS[:, :22], PALMS], axis=1)
SMPLH = np.concatenate([TURNS[:, :22], TURNS[:, 25:]], axis=1)
BODY = np.concatenate([TURNS[:, :22], np.zeros((FRAMES, 33, 3))], axis=1)
MANY = np.tile(BETAS, (FRAMES, 1))
CAMERA_TURNS = np.concatenate([TURNS[:, :1] + 0.1, TURNS[:, 1:]], axis=1)


def flat(values: np.ndarray) -> np.ndarray:
    """One row a frame."""
    return values.reshape(len(values), -1)


def matrices(values: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3)."""
    return Rotation.from_rotvec(values.reshape(-1, 3)).as_matrix().reshape(*values.shape, 3)


def tensors(content: Any) -> Any:
    """The same with torch's tensors for arrays."""
    import torch

    if isinstance(content, dict):
        return {key: tensors(value) for key, value in content.items()}
    return torch.as_tensor(content) if isinstance(content, np.ndarray) else content


def save_npz(path: Path, content: dict[str, Any]) -> None:
    """As numpy does, objects included."""
    np.savez(path, **content)


def save_frames(path: Path, content: list[Any]) -> None:
    """As EasyMocap does: a folder with a JSON file a frame."""
    path.mkdir()
    for number, frame in enumerate(content):
        (path / f"{number:06d}.json").write_text(json.dumps(frame))


def save_npy(path: Path, content: Any) -> None:
    """A dictionary as numpy saves one: an array of one Python object."""
    np.save(path, content, allow_pickle=True)


def save_pt(path: Path, content: Any) -> None:
    """As torch does."""
    import torch

    torch.save(tensors(content), path)


def save_joblib(path: Path, content: Any) -> None:
    """As joblib does: a stand-in of each array, and its bytes in the stream."""
    path.write_bytes(joblib_bytes(content))


def save_zlib(path: Path, content: Any) -> None:
    """As joblib does with compress=3."""
    path.write_bytes(zlib.compress(joblib_bytes(content)))


def save_pickle(path: Path, content: Any) -> None:
    """As Python does."""
    path.write_bytes(pickle.dumps(content))


def save_python_2(path: Path, content: Any) -> None:
    """As Python 2 did."""
    write_pickle(path, content, protocol=2)


def joblib_bytes(content: Any) -> bytes:
    """What joblib.dump writes."""
    import io

    joblib = pytest.importorskip("joblib")

    stream = io.BytesIO()
    joblib.dump(content, stream)
    return stream.getvalue()


def smplx_names(turns: np.ndarray, **others: Any) -> dict[str, Any]:
    """Parts under the names of the smplx library."""
    return {
        "global_orient": turns[:, 0],
        "body_pose": flat(turns[:, 1:22]),
        "transl": PATH,
        "betas": MANY,
    } | others


def rows(values: np.ndarray) -> np.ndarray:
    """The same, each row an object of its own."""
    found = np.empty(len(values), object)
    found[:] = list(values)
    return found


def framed(content: dict[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    """A dictionary a frame."""
    return [{key: value[frame] for key, value in content.items()} for frame in range(FRAMES)]


def phalp() -> dict[str, Any]:
    """Frames with the tracks seen in each; the second person comes and goes, and is once predicted only."""
    found = {}
    for number in range(FRAMES):
        people = [3] if number == 2 else [3, 8]
        body = {
            "global_orient": matrices(SMPL[number, :1]),
            "body_pose": matrices(SMPL[number, 1:]),
            "betas": BETAS,
        }
        found[f"outputs/_DEMO/clip/img/{number:06d}.jpg"] = {
            "time": number,
            "shot": 0,
            "frame_path": f"{number}.jpg",
            "tid": people,
            "tracked_ids": people,
            "bbox": [np.zeros(4)] * len(people),
            "tracked_time": [0] * len(people),
            "smpl": [body] * len(people),
            "camera": [np.array([0.0, 0.1, 30.0])] * len(people),
            "mask": [{"size": [1, 1], "counts": b"0"}],
        }
    return found


def romp() -> dict[str, Any]:
    """Images with the people in each, and the same by their tracks; the second comes and goes."""
    images, tracks = {}, {}
    for number in range(FRAMES):
        people = [3] if number == 2 else [8, 3]
        image = {
            "smpl_thetas": np.stack([flat(SMPL)[number] + (person == 8) for person in people]),
            "smpl_betas": np.tile(np.append(BETAS, 0.5), (len(people), 1)),  # BEV's eleventh tells children
            "cam": np.ones((len(people), 3)),
            "cam_trans": np.tile(PATH[number], (len(people), 1)),
            "track_ids": np.array(people, np.int32),
        }
        images[f"{number:08d}.png"] = image
        for place, person in enumerate(people):
            track = tracks.setdefault(np.int32(person), {"frame_id": []})
            track["frame_id"].append(number)
            for name, values in image.items():
                track.setdefault(name, []).append(values[place])
    return {"results": images, "sequence_results": tracks}


def easymocap(width: int) -> list[list[dict[str, Any]]]:
    """Frames with the people in each; the second is seen in the last alone."""
    poses = flat(np.concatenate([np.zeros((FRAMES, 1, 3)), SMPL[:, 1:]], axis=1))
    hands_and_face = np.concatenate([np.zeros((FRAMES, 12)), flat(TURNS[:, 22:25])], axis=1)
    poses = np.concatenate([poses[:, :66], hands_and_face], axis=1) if width == 87 else poses
    one = [
        {
            "id": 4,
            "Rh": SMPL[number, :1].tolist(),
            "Th": PATH[number : number + 1].tolist(),
            "poses": poses[number : number + 1].tolist(),
            "shapes": [BETAS.tolist()],
        }
        for number in range(FRAMES)
    ]
    return [[person, *([person | {"id": 9}] * (person is one[-1]))] for person in one]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A file: how it is written, what is asked for, and what must come out."""

    name: str
    suffix: str
    save: Callable[[Path, Any], None]
    content: Callable[[], Any]
    choices: dict[str, Any] | None = None
    model: str = "smplx"
    turns: np.ndarray = field(default_factory=lambda: BODY)
    path: np.ndarray = field(default_factory=lambda: PATH)
    up: str = "+y"
    fps: float = 30
    gender: str = "neutral"
    about: str = "pelvis"
    people: int = 1


def wham() -> dict[int, Any]:
    """By people."""
    one = {
        "pose_world": flat(SMPL),
        "trans_world": PATH,
        "pose": flat(SMPL) + 0.1,
        "trans": PATH + np.array([0, 0, 5]),
        "betas": MANY,
        "verts": np.zeros((FRAMES, 4, 3), np.float32),
        "frame_ids": np.arange(FRAMES) + 7,
    }
    return {0: one, 4: one | {"trans_world": PATH + 1}}


def motion_x() -> np.ndarray:
    """322 numbers a frame."""
    face = np.zeros((FRAMES, 150))
    hands = flat(TURNS[:, 25:])
    parts = [flat(TURNS[:, :22]), hands, TURNS[:, 22], face, PATH, MANY]
    return np.concatenate(parts, axis=1).astype(np.float32)


def six(values: np.ndarray) -> np.ndarray:
    """First two rows of the matrices, one after the other (pytorch3d)."""
    return matrices(values)[..., :2, :].reshape(*values.shape[:-1], 6)


NO_EYES = np.concatenate([TURNS[:, :23], np.zeros((FRAMES, 2, 3)), TURNS[:, 25:]], axis=1)
NO_FACE = np.concatenate([TURNS[:, :22], np.zeros((FRAMES, 3, 3)), TURNS[:, 25:]], axis=1)
STILL_PALMS = np.concatenate([TURNS[:, :22], np.zeros((FRAMES, 2, 3))], axis=1)

LAYOUTS = [
    Layout(
        name="GVHMR", suffix=".pt", save=save_pt,
        content=lambda: {
            "smpl_params_global": smplx_names(TURNS), "smpl_params_incam": smplx_names(CAMERA_TURNS),
            "K_fullimg": np.zeros((FRAMES, 3, 3)),
        },
    ),
    Layout(
        name="GVHMR in the camera", suffix=".pt", save=save_pt, choices={"coordinates": "camera"}, up="-y",
        turns=np.concatenate([CAMERA_TURNS[:, :22], np.zeros((FRAMES, 33, 3))], axis=1),
        content=lambda: {
            "smpl_params_global": smplx_names(TURNS), "smpl_params_incam": smplx_names(CAMERA_TURNS),
            "net_outputs": {"pred_smpl_params_incam": smplx_names(TURNS + 1)},
        },
    ),
    Layout(
        name="GENMO", suffix=".pt", save=save_pt,
        content=lambda: {
            "body_params_global": smplx_names(TURNS), "body_params_incam": smplx_names(CAMERA_TURNS),
        },
    ),
    Layout(
        name="GVHMR saved by numpy", suffix=".npz", save=save_npz,
        content=lambda: {
            "smpl_params_global": smplx_names(TURNS), "smpl_params_incam": smplx_names(CAMERA_TURNS),
        },
    ),
    Layout(
        name="WHAM", suffix=".pkl", save=save_joblib, content=wham, model="smpl", turns=SMPL,
        choices={"person": "0"}, people=2,
    ),
    Layout(
        name="PromptHMR", suffix=".pkl", save=save_zlib, turns=TURNS,
        content=lambda: {
            "camera": {"pred_cam_R": np.zeros((FRAMES, 3, 3))}, "n_frames": FRAMES,
            "people": {
                1: {
                    "frames": np.arange(FRAMES), "bboxes": np.zeros((FRAMES, 4)),
                    "smplx_cam": {"pose": flat(CAMERA_TURNS), "shape": MANY, "trans": PATH},
                    "smplx_world": {"pose": flat(TURNS), "shape": MANY, "trans": PATH},
                },
            },
        },
    ),
    Layout(
        name="4D-Humans", suffix=".pkl", save=save_zlib, content=phalp, model="smpl", turns=SMPL, up="-y",
        choices={"person": "3"}, path=np.zeros((FRAMES, 3)), people=2,
    ),
    Layout(
        name="VIBE", suffix=".pkl", save=save_joblib, model="smpl", turns=SMPL, up="-y",
        path=np.zeros((FRAMES, 3)),
        content=lambda: {
            1: {
                "pred_cam": np.ones((FRAMES, 3)), "orig_cam": np.ones((FRAMES, 4)),
                "verts": np.zeros((FRAMES, 2, 3)), "pose": flat(SMPL), "betas": MANY,
                "joints3d": np.zeros((FRAMES, 49, 3)), "joints2d": None, "bboxes": np.zeros((FRAMES, 4)),
                "frame_ids": np.arange(FRAMES),
            },
        },
    ),
    Layout(
        name="TRAM", suffix=".npy", save=save_npy, model="smpl", turns=SMPL, up="-y",
        content=lambda: tensors(
            {
                "pred_cam": np.ones((FRAMES, 3)), "pred_pose": six(SMPL).reshape(FRAMES, -1),
                "pred_shape": MANY, "pred_rotmat": matrices(SMPL), "pred_trans": PATH[:, None],
                "frame": np.arange(FRAMES),
            },
        ),
    ),
    Layout(
        name="3DPW", suffix=".pkl", save=save_python_2, model="smpl", turns=SMPL, choices={"person": "1"},
        gender="female", people=2,
        content=lambda: {
            "sequence": "a", "poses": [flat(SMPL) + 0.1, flat(SMPL)], "trans": [PATH, PATH],
            "genders": ["m", "f"], "betas": [BETAS + 1, BETAS], "cam_poses": np.zeros((FRAMES, 4, 4)),
            "poses2d": [np.zeros(3)] * 2, "img_frame_ids": np.arange(FRAMES),
        },
    ),
    Layout(
        name="EMDB", suffix=".pkl", save=save_pickle, model="smpl", turns=SMPL, gender="female",
        content=lambda: {
            "gender": "female", "name": "P0", "n_frames": FRAMES, "camera": {"intrinsics": np.eye(3)},
            "good_frames_mask": np.ones(FRAMES, bool), "kp2d": np.zeros((FRAMES, 24, 2)),
            "smpl": {
                "poses_root": SMPL[:, 0], "poses_body": flat(SMPL[:, 1:]), "trans": PATH, "betas": BETAS,
            },
        },
    ),
    Layout(
        name="AIST++", suffix=".pkl", save=save_pickle, model="smpl", turns=SMPL, fps=60, gender="male",
        choices={"betas": BETAS},
        content=lambda: {
            "smpl_poses": flat(SMPL), "smpl_trans": 94.0 * PATH, "smpl_scaling": np.array([94.0]),
            "smpl_loss": 0.1,
        },
    ),
    Layout(
        name="MOYO", suffix=".pkl", save=save_pickle, turns=TURNS, up="+z", fps=60,
        content=lambda: {
            "fullpose": flat(TURNS), "trans": PATH, "betas": BETAS, "markers_latent": np.zeros((3, 3)),
            "latent_labels": ["a", "b"], "labels_obs": [["a"]] * FRAMES,
            "stageii_debug_details": {"stageii_errs": {}},
        },
    ),
    Layout(
        name="smplx names, with hands and face", suffix=".npz", save=save_npz, turns=TURNS,
        content=lambda: smplx_names(
            TURNS, left_hand_pose=flat(TURNS[:, 25:40]), right_hand_pose=flat(TURNS[:, 40:]),
            jaw_pose=TURNS[:, 22], leye_pose=TURNS[:, 23], reye_pose=TURNS[:, 24],
            expression=np.zeros((FRAMES, 10)),
        ),
    ),
    Layout(
        name="smplx names, matrices, a batch of one", suffix=".npz", save=save_npz, model="smpl", turns=SMPL,
        content=lambda: {
            "global_orient": matrices(SMPL[:, :1])[None], "body_pose": matrices(SMPL[:, 1:])[None],
            "transl": PATH[None], "betas": MANY[None],
        },
    ),
    Layout(
        name="EasyMocap", suffix=".npy", save=save_npy, model="smpl", turns=SMPL, about="origin",
        content=lambda: {
            "poses": flat(np.concatenate([np.zeros((FRAMES, 1, 3)), SMPL[:, 1:]], axis=1)), "Rh": SMPL[:, 0],
            "Th": PATH, "shapes": BETAS[None],
        },
    ),
    Layout(
        name="EasyMocap's folder", suffix="", save=save_frames, model="smpl", turns=SMPL, about="origin",
        choices={"person": "4"}, people=2, content=lambda: easymocap(72),
    ),
    Layout(
        name="EasyMocap's folder, SMPL-X", suffix="", save=save_frames,
        turns=np.concatenate([TURNS[:, :25], np.zeros((FRAMES, 30, 3))], axis=1), about="origin",
        choices={"person": "4"}, people=2, content=lambda: [{"annots": people} for people in easymocap(87)],
    ),
    Layout(
        name="BEV, a video", suffix=".npz", save=save_npz, model="smpl", turns=SMPL, up="-y",
        choices={"person": "3"}, people=2, content=romp,
    ),
    Layout(
        name="ROMP, an image of two", suffix=".npz", save=save_npz, model="smpl", turns=SMPL[:1],
        path=PATH[:1], up="-y", choices={"person": "1"}, people=2,
        content=lambda: {
            "results": {
                key: value for key, value in romp()["results"]["00000000.png"].items() if key != "track_ids"
            },
        },
    ),
    Layout(
        name="MDM", suffix=".npy", save=save_npy, model="smpl", turns=SMPL, fps=20, choices={"betas": BETAS},
        content=lambda: {
            "thetas": six(SMPL).transpose(1, 2, 0), "root_translation": PATH.T,
            "faces": np.zeros((2, 3), int), "vertices": np.zeros((4, 3, FRAMES)), "text": "walks",
            "length": FRAMES,
        },
    ),
    Layout(name="Motion-X", suffix=".npy", save=save_npy, content=motion_x, turns=NO_EYES),
    Layout(
        name="Inter-X", suffix=".npz", save=save_npz, turns=NO_FACE, fps=120, choices={"fps": 120},
        content=lambda: {
            "pose_body": TURNS[:, 1:22], "pose_lhand": TURNS[:, 25:40], "pose_rhand": TURNS[:, 40:],
            "trans": PATH, "root_orient": TURNS[:, 0], "betas": BETAS[None], "gender": "neutral",
        },
    ),
    Layout(
        name="SLAHMR", suffix=".npz", save=save_npz, choices={"person": "1"}, model="smplx", people=2,
        content=lambda: {
            "root_orient": np.stack([TURNS[:, 0] + 1, TURNS[:, 0]]), "trans": np.stack([PATH + 1, PATH]),
            "pose_body": np.stack([flat(TURNS[:, 1:22]) + 1, flat(TURNS[:, 1:22])]),
            "betas": np.stack([BETAS + 1, BETAS]), "cam_R": np.zeros((2, FRAMES, 3, 3)),
        },
    ),
    Layout(
        name="InterHuman", suffix=".pkl", save=save_pickle, choices={"person": "person2"}, gender="male",
        fps=59, up="+z", people=2,
        content=lambda: {
            "mocap_framerate": 59.0, "frames": FRAMES,
            **{
                f"person{number}": {
                    "trans": PATH,
                    "root_orient": TURNS[:, 0],
                    "pose_body": flat(TURNS[:, 1:22]),
                    "betas": BETAS,
                    "gender": "male",
                }
                for number in (1, 2)
            },
        },
    ),
    Layout(
        name="AMASS names, 52 joints of SMPL-X", suffix=".npz", save=save_npz, turns=NO_FACE, up="+z", fps=60,
        content=lambda: {
            "poses": flat(SMPLH), "trans": PATH, "betas": BETAS, "gender": "neutral", "mocap_framerate": 60.0,
            "surface_model_type": "smplx",
        },
    ),
    Layout(
        name="AMASS names beside transl", suffix=".npz", save=save_npz, model="smplh", turns=SMPLH, up="+z",
        fps=60,
        content=lambda: {
            "poses": flat(SMPLH), "transl": PATH, "betas": BETAS, "gender": np.array("neutral", object),
            "mocap_framerate": 60.0,
        },
    ),
    Layout(
        name="ROMP-like", suffix=".npz", save=save_npz, model="smpl", turns=SMPL, fps=25,
        content=lambda: {
            "smpl_thetas": flat(SMPL), "root_translation": PATH, "smpl_betas": MANY, "gender": "n", "fps": 25,
        },
    ),
    Layout(
        name="arrays of objects", suffix=".npz", save=save_npz, model="smplh", turns=SMPLH, up="+z", fps=60,
        content=lambda: {
            "poses": flat(SMPLH).astype(object), "trans": PATH.astype(object), "betas": BETAS.astype(object),
            "gender": np.array(["neutral"], object), "mocap_framerate": 60.0,
        },
    ),
    Layout(
        name="rows that are objects", suffix=".npy", save=save_npy,
        content=lambda: {"smplx": {key: rows(value) for key, value in smplx_names(TURNS).items()}},
    ),
    Layout(
        name="frames by number", suffix=".pkl", save=save_pickle,
        content=lambda: dict(reversed(list(enumerate(framed(smplx_names(TURNS)), start=3)))),
    ),
    Layout(
        name="frames by picture", suffix=".npy", save=save_npy,
        content=lambda: {
            f"shot_{number:04}.jpg": frame for number, frame in enumerate(framed(smplx_names(TURNS)))
        },
    ),
    Layout(
        name="names with humps", suffix=".npz", save=save_npz, fps=25,
        content=lambda: {
            "globalOrient": TURNS[:, 0], "bodyPose": TURNS[:, 1:22], "transl": PATH, "betas": MANY,
            "gender": "neutral", "fps": 25,
        },
    ),
    Layout(
        name="OSX", suffix=".npz", save=save_npz, fps=25, up="-y",
        content=lambda: {
            "smplx_root_pose": TURNS[:, 0], "smplx_body_pose": TURNS[:, 1:22], "smplx_shape": MANY,
            "cam_trans": PATH, "gender": "neutral", "fps": 25,
        },
    ),
    Layout(
        name="Motion-X in a batch", suffix=".npy", save=save_npy, content=lambda: motion_x()[None],
        turns=NO_EYES,
    ),
]  # fmt: skip
