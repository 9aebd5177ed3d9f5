"""Poses in a folder with a JSON file a frame, several people by their id, as EasyMocap writes them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.errors import InputError, SomaError
from soma_core.io.vertex_folder import natural
from soma_core.json_file import read_json

__all__ = ["frame_files", "holds_pose_frames", "read_pose_frames"]

_KEYS = ("Rh", "Th", "poses", "shapes", "expression", "handl", "handr")
_POSE = {"Rh", "Th", "poses"}
_LOOKED_AT = 20
"""Files that may be empty, of nobody, before a folder is none of poses."""

_WIDEST = 1000
"""Numbers of one key in a frame."""

_MOST = 50_000_000
"""Numbers in a folder: 400 MB."""

_PARTS = {"left_hand_pose": 6, "right_hand_pose": 6, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3}
_PACKED = {78: "smplh", 87: "smplx"}
"""Widths of whole poses with six components a hand behind the body's 66 numbers, and whose they are."""

_FIX = "Write it again, or leave it out of the folder."


def frame_files(folder: Path) -> list[Path]:
    """JSON files of a folder, in the order of the numbers in their names."""
    return sorted(folder.glob("*.json"), key=natural)


def holds_pose_frames(path: Path) -> bool:
    """Whether a path is a folder of such files, by the first that shows somebody."""
    if not path.is_dir():
        return False
    for file in itertools.islice(frame_files(path), _LOOKED_AT):
        try:
            people = list(_people(file))
        except SomaError:
            continue  # it is named where the folder is read
        if people:
            return any(set(person) >= _POSE for _, person in people)
    return False


def read_pose_frames(folder: Path) -> dict[str, dict[str, Any]]:
    """Arrays of every person in a folder: a row of each key a frame, and ``frames``, the numbers of them.

    Raises:
        AssetError: a file is missing, too long or no JSON.
        InputError: what is no numbers, or another number of them than in the frames before.
    """
    files, left = frame_files(folder), _MOST
    names = [file.stem for file in files]
    told = all(re.fullmatch(r"[0-9]{1,9}", name) for name in names)
    rows: dict[str, dict[str, list[Any]]] = {}
    for number, file in enumerate(files):
        for person, values in _people(file):
            known = {key: _numbers(file, key, values[key]) for key in _KEYS if key in values}
            if not set(known) >= _POSE:
                continue
            track = rows.setdefault(person, {"frames": [], **{key: [] for key in known}})
            if any(len(track[key]) and len(track[key][0]) != len(row) for key, row in known.items()) or (
                set(track) != {"frames", *known}
            ):
                raise InputError(
                    f"{file}: person {person}", got=_told(known),
                    expected=_told({key: track[key][0] for key in track if key != "frames"}) + ", as before",
                    fix="Put the frames of one fit into a folder of their own.",
                )  # fmt: skip
            left -= sum(len(row) for row in known.values())
            if left < 0:
                raise InputError(
                    str(folder), got=f"more than {_MOST} numbers", expected="fewer",
                    fix="Convert a part of the frames at a time.",
                )  # fmt: skip
            track["frames"].append(int(names[number]) if told else number)
            for key, row in known.items():
                track[key].append(row)
    return {person: _unpacked(track) for person, track in rows.items()}


def _told(rows: Mapping[str, np.ndarray]) -> str:
    return ", ".join(f"{len(row)} {key}" for key, row in rows.items()) or "nothing"


def _unpacked(track: Mapping[str, list[Any]]) -> dict[str, Any]:
    """Arrays of one person; poses with components of the hands in their parts."""
    found: dict[str, Any] = {key: np.stack(rows) for key, rows in track.items()}
    model = _PACKED.get(found["poses"].shape[1])
    if model is not None:
        poses, begin = found["poses"], 66
        found |= {"poses": poses[:, :begin], "model_type": model}
        for name, width in _PARTS.items():
            part = poses[:, begin : begin + width]
            found |= {name: part} if part.shape[1] == width else {}
            begin += width
    return found


def _people(file: Path) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Whose values a frame has: a list of people, or an object that has it under ``annots``."""
    content = read_json(file, fix=_FIX)
    listed = content.get("annots", [content]) if isinstance(content, Mapping) else content
    for number, person in enumerate(listed if isinstance(listed, list) else []):
        if isinstance(person, Mapping) and person:
            yield str(person.get("id", person.get("personID", number)))[:32], person


def _numbers(file: Path, key: str, value: Any) -> np.ndarray:
    try:
        found = np.asarray(value, np.float64).reshape(-1)
        if not 0 < found.size <= _WIDEST:
            raise ValueError(f"{found.size} numbers")
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{file}: {key}", got=str(error)[:80], expected="numbers, one row", fix=_FIX
        ) from error
    return found
