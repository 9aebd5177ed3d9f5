"""Skeletons of other tools, made here: their own names, lengths, rest poses and numbers of spine joints."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.io.skeleton_motion import SkeletonMotion

__all__ = ["along_axes", "biped", "glb_bytes", "in_another_pose", "moved", "write_vrm"]

FPS = 60.0


def biped(
    names: Mapping[str, str], *, spine: int = 3, scale: float = 1.0, hands: bool = True
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names, parents and places [m] of a person in T-pose; `names` gives what its tool calls a part.

    Parts are ``hips spine neck head`` and, with ``L`` or ``R`` before them, ``collar arm elbow wrist finger
    thigh knee ankle toe``; ``spine`` is a format of the number.
    """
    rows: list[tuple[str, str | None, tuple[float, float, float]]] = [("hips", None, (0, 0.97, 0))]
    above = "hips"
    for number in range(spine):
        rows.append((f"spine{number}", above, (0, 0.45 / spine, -0.01 * (number == 0))))
        above = f"spine{number}"
    rows += [("neck", above, (0, 0.1, 0.01)), ("head", "neck", (0, 0.1, 0.02))]
    for side, x in (("L", 1), ("R", -1)):
        chain = [
            ("collar", above, (0.05 * x, 0.06, 0.0)),
            ("arm", "collar", (0.13 * x, -0.01, -0.01)),
            ("elbow", "arm", (0.28 * x, 0.0, -0.01)),
            ("wrist", "elbow", (0.25 * x, 0.01, 0.01)),
        ]
        if hands:
            chain += [
                ("finger1", "wrist", (0.09 * x, 0.0, 0.01)),
                ("finger2", "finger1", (0.04 * x, -0.005, 0.0)),
            ]
        chain += [
            ("thigh", "hips", (0.09 * x, -0.05, 0.0)),
            ("knee", "thigh", (0.01 * x, -0.41, 0.01)),
            ("ankle", "knee", (0.0, -0.42, -0.02)),
            ("toe", "ankle", (0.01 * x, -0.07, 0.13)),
        ]
        parts = {part for part, *_ in chain}
        rows += [
            (side + part, side + parent if parent in parts else parent, place)
            for part, parent, place in chain
        ]
    keys = [key for key, *_ in rows]
    parents = np.array([keys.index(parent) if parent else -1 for _, parent, _ in rows])
    rest = np.zeros((len(rows), 3))
    for joint, (_, _, place) in enumerate(rows):
        rest[joint] = scale * np.array(place) + (rest[parents[joint]] if joint else 0)
    return tuple(_called(key, names) for key in keys), parents, rest


def _called(key: str, names: Mapping[str, str]) -> str:
    if key.startswith("spine"):
        return names["spine"].split()[int(key[5:])]
    side = {"L": "Left", "R": "Right"}.get(key[0], "")
    part = key[1:] if side else key
    return names[part].replace("*", side)


def moved(
    names: tuple[str, ...], parents: np.ndarray, rest: np.ndarray, *, frames: int = 40, seed: int = 0
) -> SkeletonMotion:
    """A motion of any turns, and of knees and elbows that bend one way, on a walk across the floor."""
    rng, time = np.random.default_rng(seed), np.linspace(0, 6, frames)[:, None, None]
    shape = (1, len(names), 3)
    vectors = (
        0.4 * rng.normal(size=shape) * np.sin(rng.uniform(1, 2, shape) * time + rng.uniform(0, 6, shape))
    )
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, len(names), 3, 3)
    for joint, name in enumerate(names):
        x = np.sign(rest[joint, 0])
        axis = {"knee": (1, 0, 0), "elbow": (0, -x, 0)}.get(_bends(name))
        if axis is not None:
            bend = (0.7 + 0.6 * np.sin(3 * time[:, 0, 0] + joint))[:, None] * np.array(axis)
            rotations[:, joint] = Rotation.from_rotvec(bend).as_matrix()
    root = rest[0] + np.linspace(0, 1, frames)[:, None] * [0.3, 0.02, 1.2]
    return SkeletonMotion(names=names, parents=parents, rest=rest, rotations=rotations, root=root, fps=FPS)


def _bends(name: str) -> str:
    bare = name.split(":")[-1].lower().removeprefix("left").removeprefix("right")
    return {"leg": "knee", "knee": "knee", "lowerleg": "knee", "elbow": "elbow", "forearm": "elbow"}.get(
        bare, ""
    )


def in_another_pose(motion: SkeletonMotion, turns: np.ndarray) -> SkeletonMotion:
    """The same motion with the pose as rest that turns (J, 3, 3) lead to."""
    rest = motion.rest.copy()
    for joint, parent in enumerate(motion.parents):
        if parent >= 0:
            rest[joint] = rest[parent] + turns[parent] @ (motion.rest[joint] - motion.rest[parent])
    return motion.rebased(rest, turns)


def along_axes(motion: SkeletonMotion) -> SkeletonMotion:
    """The same motion with a pose of zeros in which every bone lies along x and hinges turn about z."""
    turns = []
    for joint, _ in enumerate(motion.names):
        children = np.flatnonzero(motion.parents == joint)
        following = children[np.argmin(np.abs(motion.rest[children, 0]))] if len(children) else joint
        origin = joint if len(children) else motion.parents[joint]
        bone = motion.rest[following] - motion.rest[origin]
        bone = np.array([0, 1.0, 0]) if joint == 0 else bone / np.linalg.norm(bone)
        upright = abs(bone[1]) > 0.5
        side = np.array([1.0, 0, 0]) if upright else np.array([0, 1.0, 0])
        side = side - (side @ bone) * bone
        side /= np.linalg.norm(side)
        turns.append(np.stack([bone, np.cross(side, bone), side]))
    return replace(in_another_pose(motion, np.stack(turns)))


def write_vrm(motion: SkeletonMotion, path: Path, bones: Mapping[str, str], *, version: int = 1) -> None:
    """Write a motion as VRM, whose joints have no names: `bones` tells which bone of a human each one is.

    The skin is bound in the rest pose; the nodes themselves stand in another one.
    """
    count, frames = len(motion.names), motion.frame_count
    offsets = motion.rest - np.where(motion.parents[:, None] < 0, 0, motion.rest[motion.parents])
    inverse = np.tile(np.eye(4), (count, 1, 1))
    inverse[:, 3, :3] = -motion.rest  # columns first
    turns = Rotation.from_matrix(motion.rotations.reshape(-1, 3, 3)).as_quat().reshape(frames, count, 4)
    arrays = [(np.arange(frames) / motion.fps, "SCALAR"), (motion.root, "VEC3"), (inverse, "MAT4")]
    arrays += [(turns[:, joint], "VEC4") for joint in range(count)]
    data, views, accessors = b"", [], []
    for values, kind in arrays:
        part = np.ascontiguousarray(values, np.float32)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": part.nbytes})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": 5126, "count": len(part), "type": kind}
        )
        data += part.tobytes()
    samplers = [{"input": 0, "output": output} for output in (1, *range(3, 3 + count))]
    channels = [{"sampler": 0, "target": {"node": 0, "path": "translation"}}]
    channels += [
        {"sampler": joint + 1, "target": {"node": joint, "path": "rotation"}} for joint in range(count)
    ]
    nodes = [
        {"name": f"node{joint}", "translation": offsets[joint].tolist(), "rotation": [0, 0, 0.6, 0.8],
         "children": np.flatnonzero(motion.parents == joint).tolist()}
        for joint in range(count)
    ]  # fmt: skip
    placed = {bones[name]: joint for joint, name in enumerate(motion.names) if name in bones}
    human = {
        "VRMC_vrm": {"humanoid": {"humanBones": {name: {"node": node} for name, node in placed.items()}}}
    }
    if version == 0:
        human = {
            "VRM": {"humanoid": {"humanBones": [{"bone": n, "node": node} for n, node in placed.items()]}}
        }
    document = {
        "asset": {"version": "2.0"}, "nodes": nodes, "accessors": accessors, "bufferViews": views,
        "skins": [{"joints": list(range(count)), "inverseBindMatrices": 2}], "extensions": human,
        "animations": [{"channels": channels, "samplers": samplers}], "buffers": [{"byteLength": len(data)}],
    }  # fmt: skip
    path.write_bytes(glb_bytes(document, data))


def glb_bytes(document: object, data: bytes = b"") -> bytes:
    """A GLB of a JSON document and a binary chunk."""
    text = (document if isinstance(document, str) else json.dumps(document)).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
