"""Point sets in `configs/point_sets`, placed on the mesh by anatomy: ``python -m assets.make.points``.

Joint centres are joints of the rig. Points of the skin are vertices found by rule on the left side and
mirrored: the tip of the nose is the foremost vertex of the head, eyelids and inner lips are the edges of the
eye and mouth bags, a heel is the rearmost vertex of its foot, and so on. Nothing is taken from data of other
models; only the names and the order of the points are those of the data sets.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from soma_core.cache import atomic_text
from soma_core.paths import configs_dir
from soma_core.rig import load_canonical

__all__ = ["make_point_sets"]

_SOURCE = "joint centres of the canonical rig"
_SKIN = _SOURCE + "; vertices of its mesh by anatomical rules (assets/make/points.py)"
_FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")

Place = str | dict
"""A place as the files have it."""


class Landmarks:
    """Vertices of the low mesh by name; those of the right side mirror the left."""

    def __init__(self) -> None:
        self.mesh, self.rig = load_canonical("low")
        self.places = self.rig.bind_shape
        self.joint = dict(zip(self.rig.joint_names, self.rig.bind_world[:, :3, 3], strict=True))
        weights = self.rig.skin.toarray()
        owner = np.array(self.rig.joint_names)[weights.argmax(1)]
        inside = np.isin(np.arange(len(owner)), self.mesh.face_interior)
        self.head = np.flatnonzero(
            np.isin(owner, ("Head", "Jaw", "LeftEye", "RightEye", "HeadEnd")) & ~inside
        )
        self.foot = np.flatnonzero(np.isin(owner, ("LeftFoot", "LeftToeBase", "LeftToeEnd")))
        bags = {name: self.mesh.segments[name] for name in ("eye_bags", "mouth_bag")}
        self.edges = {name: self._edge(ids) for name, ids in bags.items()}

    def _edge(self, bag: np.ndarray) -> np.ndarray:
        """Vertices outside a bag that share an edge with it."""
        edges = self.mesh.edges()
        within = np.isin(edges, bag)
        return np.unique(edges[within[:, ::-1] & ~within])

    def near(self, place: Sequence[float], among: np.ndarray | None = None) -> int:
        """The vertex nearest to a place."""
        ids = self.head if among is None else among
        return int(ids[np.linalg.norm(self.places[ids] - place, axis=1).argmin()])

    def front(self, x: float, y: float) -> int:
        """The vertex of the face at a place seen from the front."""
        ids = self.head[self.places[self.head, 2] > 0]
        return int(ids[np.linalg.norm(self.places[ids, :2] - (x, y), axis=1).argmin()])

    def most(self, ids: np.ndarray, *direction: float) -> int:
        """The vertex farthest in a direction."""
        return int(ids[(self.places[ids] @ np.array(direction)).argmax()])

    def right(self, vertex: int) -> int:
        """The partner of a vertex."""
        return int(self.mesh.mirror[vertex])


def _vertex(vertex: int) -> Place:
    return {"vertices": {str(vertex): 1}}


def _loop(marks: Landmarks, ids: np.ndarray, shares: Sequence[tuple[float, int]]) -> list[int]:
    """Vertices of a loop at shares of its width, on its upper (1) or lower (-1) half."""
    places = marks.places[ids]
    low, high = places[:, 0].min(), places[:, 0].max()
    middle = places[:, 1].mean()
    found = []
    for share, side in shares:
        half = ids[(places[:, 1] - middle) * side >= 0] if 0 < share < 1 else ids
        x = low + share * (high - low)
        found.append(int(half[np.abs(marks.places[half, 0] - x).argmin()]))
    return found


def _face(marks: Landmarks) -> list[int]:
    """The 68 points of a face, in the usual order: jaw, brows, nose, eyes, lips; right side first."""
    eye, lips = marks.joint["LeftEye"], marks.edges["mouth_bag"]
    lids = marks.edges["eye_bags"]
    lids = lids[marks.places[lids, 0] > 0]
    nose = marks.most(marks.head, 0, 0, 1)
    tip, mouth = marks.places[nose], marks.places[lips].mean(0)
    jaw = _jaw(marks, mouth)
    brows = [marks.front(eye[0] * share, eye[1] + rise) for share, rise in
             ((0.4, 0.022), (0.75, 0.028), (1.1, 0.031), (1.45, 0.029), (1.75, 0.021))]  # fmt: skip
    bridge = [marks.front(0, y) for y in np.linspace(eye[1], tip[1], 4)]
    wing = 0.45 * eye[0]
    low = tip[1] - 0.35 * (tip[1] - mouth[1])
    base = [marks.front(x, low) for x in (-wing, -0.5 * wing, 0, 0.5 * wing, wing)]
    base[:2] = [marks.right(base[4]), marks.right(base[3])]
    # Of the left eye from the nose outwards; the right one begins outside.
    left = _loop(marks, lids, ((0, 1), (0.33, 1), (0.67, 1), (1, 1), (0.67, -1), (0.33, -1)))
    right = [marks.right(left[place]) for place in (3, 2, 1, 0, 5, 4)]
    inner = _loop(
        marks, lips, ((0, 1), (0.25, 1), (0.5, 1), (0.75, 1), (1, 1), (0.75, -1), (0.5, -1), (0.25, -1))
    )
    outer = _outer_lips(marks, lips, mouth)
    brows = [*(marks.right(v) for v in brows[::-1]), *brows]
    return [*jaw, *brows, *bridge, *base, *right, *left, *outer, *inner]


def _jaw(marks: Landmarks, mouth: np.ndarray) -> list[int]:
    """17 points from ear to ear along the outline of the face seen from the front, the chin in the middle."""
    ids = marks.head[(marks.places[marks.head, 2] > -0.02) & (marks.places[marks.head, 1] > 1.5)]
    centre = np.array([0.0, mouth[1] + 0.035])
    away = marks.places[ids, :2] - centre
    found = []
    for angle in np.linspace(0.5 * np.pi, -0.02 * np.pi, 9):  # from below to the ear, on the left
        direction = np.array([np.cos(angle), -np.sin(angle)])
        along = away @ direction
        across = np.abs(away @ np.array([-direction[1], direction[0]]))
        found.append(int(ids[(along - 3 * across).argmax()]))
    return [marks.right(v) for v in found[:0:-1]] + found


def _outer_lips(marks: Landmarks, lips: np.ndarray, mouth: np.ndarray) -> list[int]:
    """12 points around the lips: corners, five above, five below."""
    half = np.ptp(marks.places[lips, 0]) / 2
    shares = (-1, -0.62, -0.25, 0, 0.25, 0.62, 1, 0.62, 0.25, 0, -0.25, -0.62)
    rises = (0, 0.008, 0.011, 0.010, 0.011, 0.008, 0, -0.009, -0.012, -0.013, -0.012, -0.009)
    left = {
        (s, r): marks.front(abs(s) * (half + 0.004), mouth[1] + r) for s, r in zip(shares, rises, strict=True)
    }
    return [v if s >= 0 else marks.right(v) for (s, _), v in zip(left, left.values(), strict=True)]


def _hand(side: str) -> dict[str, Place]:
    """21 points of a hand: wrist, then four of each finger from its root to its tip."""
    points: dict[str, Place] = {"wrist": f"{side}Hand"}
    for finger in _FINGERS:
        chain = ("1", "2", "3", "End") if finger == "Thumb" else ("2", "3", "4", "End")
        points |= {f"{finger.lower()}{k + 1}": f"{side}Hand{finger}{part}" for k, part in enumerate(chain)}
    return points


def _hand_bones(prefix: str = "") -> list[list[str]]:
    bones = []
    for finger in _FINGERS:
        chain = ["wrist", *(f"{finger.lower()}{k}" for k in range(1, 5))]
        bones += [[prefix + a, prefix + b] for a, b in itertools.pairwise(chain)]
    return bones


def _both(names: Mapping[str, str], order: Sequence[str] = ("left", "right")) -> dict[str, Place]:
    """Joints of both sides: ``{side}_name``, one side after the other within each name."""
    return {f"{side}_{name}": side.capitalize() + joint for name, joint in names.items() for side in order}


_LIMBS = {
    "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand", "hip": "Leg", "knee": "Shin", "ankle": "Foot",
}  # fmt: skip
_LIMB_BONES = [
    [f"{side}_{a}", f"{side}_{b}"] for side in ("left", "right")
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
]  # fmt: skip
_TRUNK_BONES = [["left_shoulder", "right_shoulder"], ["left_hip", "right_hip"], ["left_shoulder", "left_hip"],
                ["right_shoulder", "right_hip"]]  # fmt: skip
_HEAD_BONES = [
    ["nose", "left_eye"], ["nose", "right_eye"], ["left_eye", "left_ear"], ["right_eye", "right_ear"],
]  # fmt: skip


def _skin_points(marks: Landmarks) -> dict[str, Place]:
    """Nose, eyes, ears, toes and heels by name."""
    ears = marks.head[np.abs(marks.places[marks.head, 1] - marks.joint["LeftEye"][1]) < 0.03]
    left = {
        "ear": marks.most(ears, 1, 0, 0), "heel": marks.most(marks.foot, 0, -0.3, -1),
        "big_toe": marks.most(marks.foot, -0.25, 0, 1), "small_toe": marks.most(marks.foot, 1, 0, 0.8),
    }  # fmt: skip
    found: dict[str, Place] = {"nose": _vertex(marks.most(marks.head, 0, 0, 1))}
    for name, vertex in left.items():
        found |= {f"left_{name}": _vertex(vertex), f"right_{name}": _vertex(marks.right(vertex))}
    for side in ("left", "right"):
        found[f"{side}_eye"] = f"{side.capitalize()}Eye"
    found["head_top"] = _vertex(marks.most(marks.head, 0, 1, 0))
    found["chin"] = _vertex(_face(marks)[8])
    return found


_FEET = ("big_toe", "small_toe", "heel")


def _coco(skin: Mapping[str, Place]) -> dict[str, Place]:
    head = ("nose", "left_eye", "right_eye", "left_ear", "right_ear")
    return {name: skin[name] for name in head} | _both(_LIMBS)


def _openpose(skin: Mapping[str, Place]) -> dict[str, Place]:
    """The 25 points of OpenPose's body."""
    arms, legs = (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))
    points: dict[str, Place] = {"nose": skin["nose"], "neck": {"joints": {"LeftArm": 0.5, "RightArm": 0.5}}}
    for side in ("right", "left"):
        points |= {f"{side}_{part}": side.capitalize() + _LIMBS[part] for part in arms}
    points["mid_hip"] = {"joints": {"LeftLeg": 0.5, "RightLeg": 0.5}}
    for side in ("right", "left"):
        points |= {f"{side}_{part}": side.capitalize() + _LIMBS[part] for part in legs}
    for part in ("eye", "ear"):
        points |= {f"{side}_{part}": skin[f"{side}_{part}"] for side in ("right", "left")}
    for side in ("left", "right"):
        points |= {f"{side}_{part}": skin[f"{side}_{part}"] for part in _FEET}
    return points


_OPENPOSE_BONES = [
    ["nose", "neck"], ["neck", "mid_hip"], ["neck", "left_shoulder"], ["neck", "right_shoulder"],
    ["mid_hip", "left_hip"], ["mid_hip", "right_hip"], *_LIMB_BONES, *_HEAD_BONES,
    *([f"{side}_ankle", f"{side}_{part}"] for side in ("left", "right") for part in ("big_toe", "heel")),
]  # fmt: skip

_SMPL = {
    "pelvis": "Hips", "left_hip": "LeftLeg", "right_hip": "RightLeg", "spine1": "Spine1",
    "left_knee": "LeftShin", "right_knee": "RightShin", "spine2": "Spine2", "left_ankle": "LeftFoot",
    "right_ankle": "RightFoot", "spine3": "Chest", "left_foot": "LeftToeBase", "right_foot": "RightToeBase",
    "neck": "Neck1", "left_collar": "LeftShoulder", "right_collar": "RightShoulder", "head": "Head",
    "left_shoulder": "LeftArm", "right_shoulder": "RightArm", "left_elbow": "LeftForeArm",
    "right_elbow": "RightForeArm", "left_wrist": "LeftHand", "right_wrist": "RightHand",
}  # fmt: skip
_SMPL_BONES = [
    ["pelvis", "left_hip"], ["pelvis", "right_hip"], ["pelvis", "spine1"], ["spine1", "spine2"],
    ["spine2", "spine3"], ["spine3", "neck"], ["neck", "head"],
    *(pair for side in ("left", "right") for pair in (
        ["spine3", f"{side}_collar"], [f"{side}_collar", f"{side}_shoulder"],
        [f"{side}_ankle", f"{side}_foot"])),
    *_LIMB_BONES,
]  # fmt: skip


def _smpl_family() -> dict[str, tuple[str, dict[str, Place], list]]:
    hands = {f"{side}_hand": f"{side.capitalize()}HandMiddle2" for side in ("left", "right")}
    fingers = {
        f"{side}_{finger.lower()}{k + 1}": f"{side.capitalize()}Hand{finger}{part}"
        for side in ("left", "right") for finger in ("Index", "Middle", "Pinky", "Ring", "Thumb")
        for k, part in enumerate(("1", "2", "3") if finger == "Thumb" else ("2", "3", "4"))
    }  # fmt: skip
    face = {"jaw": "Jaw", "left_eye_smplhf": "LeftEye", "right_eye_smplhf": "RightEye"}
    return {
        "smpl22": ("The first 22 joints of SMPL, SMPL-H and SMPL-X.", dict(_SMPL), _SMPL_BONES),
        "smpl24": (
            "The 24 joints of SMPL, whose hands are points of the palm.",
            {**_SMPL, **hands},
            _SMPL_BONES,
        ),
        "smplx55": ("The 55 joints of SMPL-X.", {**_SMPL, **face, **fingers}, _SMPL_BONES),
        "humanml3d22": ("The 22 joints of HumanML3D, which are those of SMPL.", dict(_SMPL), _SMPL_BONES),
    }


def _h36m(skin: Mapping[str, Place]) -> dict[str, Place]:
    """The 17 points of Human3.6M."""
    points: dict[str, Place] = {"pelvis": "Hips"}
    for side in ("right", "left"):
        points |= {f"{side}_{part}": side.capitalize() + _LIMBS[part] for part in ("hip", "knee", "ankle")}
    points |= {"spine": "Spine2", "neck": "Neck1", "nose": skin["nose"], "head": skin["head_top"]}
    for side in ("left", "right"):
        points |= {
            f"{side}_{part}": side.capitalize() + _LIMBS[part] for part in ("shoulder", "elbow", "wrist")
        }
    return points


def _mediapipe33(skin: Mapping[str, Place], face: Sequence[int]) -> dict[str, Place]:
    """The 33 landmarks of MediaPipe's body, which FreeMoCap keeps."""
    points: dict[str, Place] = {"nose": skin["nose"]}
    for side, inner, outer in (("left", 42, 45), ("right", 39, 36)):
        points |= {f"{side}_eye_inner": _vertex(face[inner]), f"{side}_eye": skin[f"{side}_eye"],
                   f"{side}_eye_outer": _vertex(face[outer])}  # fmt: skip
    points |= {f"{side}_ear": skin[f"{side}_ear"] for side in ("left", "right")}
    points |= {"mouth_left": _vertex(face[54]), "mouth_right": _vertex(face[48])}
    points |= _both({part: _LIMBS[part] for part in ("shoulder", "elbow", "wrist")})
    points |= _both({finger.lower(): f"Hand{finger}2" for finger in ("Pinky", "Index", "Thumb")})
    points |= _both({part: _LIMBS[part] for part in ("hip", "knee", "ankle")})
    for name, part in (("heel", "heel"), ("foot_index", "big_toe")):
        points |= {f"{side}_{name}": skin[f"{side}_{part}"] for side in ("left", "right")}
    return points


def _mhr70(skin: Mapping[str, Place]) -> dict[str, Place]:
    """The 70 keypoints of MHR and SAM 3D Body: body, feet, fingers from tip to root, arms, neck."""
    body = _coco(skin)
    points = {name: body[name] for name in ("nose", "left_eye", "right_eye", "left_ear", "right_ear",
              "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_hip", "right_hip",
              "left_knee",
              "right_knee", "left_ankle", "right_ankle")}  # fmt: skip
    for side in ("left", "right"):
        points |= {f"{side}_{part}": skin[f"{side}_{part}"] for part in _FEET}
    for side in ("right", "left"):
        hand = _hand(side.capitalize())
        for finger in _FINGERS:
            points |= {f"{side}_{finger.lower()}{k}": hand[f"{finger.lower()}{k}"] for k in (4, 3, 2, 1)}
        points[f"{side}_wrist"] = hand["wrist"]
    for part, joint in (("olecranon", "ForeArm"), ("cubital_fossa", "ForeArm"), ("acromion", "Arm")):
        for side in ("left", "right"):
            away = {"olecranon": (0, 0, -0.035), "cubital_fossa": (0, 0, 0.035), "acromion": (0, 0.03, 0)}[
                part
            ]
            points[f"{side}_{part}"] = {"joint": side.capitalize() + joint, "offset": list(away)}
    points["neck"] = "Neck1"
    return points


def _markers(marks: Landmarks, skin: Mapping[str, Place]) -> dict[str, Place]:
    """An example of a marker set: 38 places of the skin that optical systems use."""
    trunk = {
        "C7": ("Neck1", (0, 0.02, -0.08)), "T10": ("Chest", (0, 0.04, -0.15)),
        "CLAV": ("Chest", (0, 0.2, 0.15)), "STRN": ("Chest", (0, 0.07, 0.15)),
    }  # fmt: skip
    sides = {
        "SHO": ("Arm", (-0.01, 0.08, 0)), "ELBL": ("ForeArm", (0.02, 0, -0.06)),
        "ELBM": ("ForeArm", (-0.03, -0.03, 0.05)), "WRA": ("Hand", (0.01, 0.02, 0.04)),
        "WRB": ("Hand", (0.01, 0.02, -0.04)), "FIN": ("HandMiddle2", (0.02, 0.02, 0)),
        "ASI": ("Leg", (0.01, 0.09, 0.09)), "PSI": ("Leg", (-0.05, 0.1, -0.12)),
        "THI": ("Leg", (0.1, -0.2, 0)),
        "KNE": ("Shin", (0.07, 0, 0)), "KNEM": ("Shin", (-0.07, 0, 0)), "TIB": ("Shin", (0.07, -0.2, 0)),
        "ANK": ("Foot", (0.06, 0, 0)),
    }  # fmt: skip
    weights = marks.rig.skin.toarray()
    points: dict[str, Place] = {"HEADTOP": skin["head_top"], "NOSE": skin["nose"]}

    def placed(joint: str, away: Sequence[float]) -> int:
        row = marks.rig.joint_names.index(joint)
        middle = np.abs(marks.places[:, 0]) < 1e-3
        near = (
            middle if joint in ("Neck1", "Chest") else weights[:, [row, marks.rig.parents[row]]].sum(1) > 0.3
        )
        owner = np.flatnonzero(near)
        return marks.near(marks.joint[joint] + np.array(away), owner)

    for name, (joint, away) in trunk.items():
        points[name] = _vertex(placed(joint, away))
    for name, (joint, away) in sides.items():
        vertex = placed("Left" + joint, away)
        points |= {f"L{name}": _vertex(vertex), f"R{name}": _vertex(marks.right(vertex))}
    for name, part in (("HEE", "heel"), ("TOE", "big_toe"), ("MT5", "small_toe")):
        points |= {"L" + name: skin[f"left_{part}"], "R" + name: skin[f"right_{part}"]}
    return points


def make_point_sets(folder: Path) -> list[Path]:
    """Write every point set that the core ships."""
    marks = Landmarks()
    skin, face, rig = _skin_points(marks), _face(marks), marks.rig
    coco = _coco(skin)
    coco_bones = [*_HEAD_BONES, *_TRUNK_BONES, *_LIMB_BONES]
    hands = {f"{side}_hand_{name}": place for side in ("left", "right")
             for name, place in _hand(side.capitalize()).items()}  # fmt: skip
    hand_bones = [bone for side in ("left", "right") for bone in _hand_bones(f"{side}_hand_")]
    feet = {f"{side}_{part}": skin[f"{side}_{part}"] for side in ("left", "right") for part in _FEET}
    dots = {f"face_{k}": _vertex(vertex) for k, vertex in enumerate(face)}
    every = {name: name for name in rig.joint_names[1:]}
    above = zip(rig.parents[2:], rig.joint_names[2:], strict=True)
    sets: dict[str, tuple[str, Mapping[str, Place], list]] = {
        "soma77": ("All joints that a pose controls, in the order of its rotations.", every,
                   [[rig.joint_names[parent], name] for parent, name in above]),
        **_smpl_family(),
        "coco17": ("The 17 keypoints of COCO.", coco, coco_bones),
        "coco-wholebody133": ("The 133 keypoints of COCO-WholeBody: body, feet, face, hands.",
                              coco | feet | dots | hands, coco_bones + hand_bones),
        "openpose25": ("The 25 keypoints of OpenPose's BODY_25.", _openpose(skin), _OPENPOSE_BONES),
        "body25+hands": ("OpenPose's BODY_25 with 21 keypoints of each hand, the left first.",
                         _openpose(skin) | hands, _OPENPOSE_BONES + hand_bones),
        "mhr70": ("The 70 keypoints of MHR and SAM 3D Body.", _mhr70(skin), coco_bones),
        "h36m17": ("The 17 joints of Human3.6M.", _h36m(skin), [["pelvis", "spine"], ["spine", "neck"],
                   ["neck", "nose"], ["nose", "head"], *_LIMB_BONES]),
        "mediapipe33": ("The 33 landmarks of MediaPipe's body, which FreeMoCap keeps.",
                        _mediapipe33(skin, face), coco_bones),
        "mano21-left": ("21 points of the left hand, in MediaPipe's order.", _hand("Left"), _hand_bones()),
        "mano21-right": ("21 points of the right hand, in MediaPipe's order.", _hand("Right"), _hand_bones()),
        "markers38": ("An example of a set of markers on the skin.", _markers(marks, skin), []),
    }  # fmt: skip
    return [_write(folder / f"{name}.json", name, *one) for name, one in sets.items()]


def _write(path: Path, name: str, about: str, points: Mapping[str, Place], bones: list) -> Path:
    skin = any(isinstance(place, dict) and "vertices" in place for place in points.values())
    head = {"name": name, "about": about, "source": _SKIN if skin else _SOURCE}
    lines = [f'"{key}": {json.dumps(value)},' for key, value in head.items()]
    rows = ",\n  ".join(f"{json.dumps(key)}: {json.dumps(place)}" for key, place in points.items())
    pairs = ",\n  ".join(json.dumps(bone) for bone in bones)
    lines += [f'"points": {{\n  {rows}\n}},', f'"bones": [\n  {pairs}\n]']
    atomic_text(path, "{\n" + "\n".join(lines) + "\n}\n")
    return path


if __name__ == "__main__":
    make_point_sets(configs_dir() / "point_sets")
