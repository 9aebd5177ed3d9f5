"""Files of points over time: arrays, tables, and what keypoint tools write."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.errors import InputError, SomaError
from soma_core.files import refuse_far
from soma_core.io.data_files import open_data
from soma_core.io.humanml3d import joints_of_humanml3d
from soma_core.io.json_frames import frame_files
from soma_core.io.text_numbers import table_rows
from soma_core.json_file import read_json

__all__ = ["PointFrames", "is_one", "read_points"]

_KEYS = (
    "points", "joints", "joints3d", "joints_3d", "keypoints", "keypoints3d", "keypoints_3d", "kpts3d",
    "positions", "pred_keypoints_3d", "posed_joints", "poses3d", "xyz", "motion",
)  # fmt: skip
"""Names of an array of points in an NPZ or a pickle, the first that is there."""

_SCORES = ("confidence", "confidences", "scores", "visibility", "weights", "conf")
_RATES = ("fps", "framerate", "frame_rate", "mocap_framerate")
_LISTS = ("frames", "data", "annotations", "instance_info")
_PEOPLE = ("people", "persons", "instances")
_IDS = ("id", "track_id", "idx", "person_id")
"""Names of what a JSON lists: frames or people; people of a frame; what a person is known by."""

_SKIPPED = 4
"""Images have numbers this much further apart than they are many: those of a data set, which skip none."""

_LONGER = {33: (75, 543, 553)}
"""Points that begin with a set: MediaPipe's body, before its hands and faces, as FreeMoCap keeps them."""

_FLAT = 263
"""Numbers a frame of HumanML3D's vectors."""

_AXIS = re.compile(r"^(.*?)[ _.:-]*([xyz])(?:[ _]*\(?(?:m|mm|cm)\)?)?$", re.IGNORECASE)
"""A column of a table: name and axis, with the unit behind it or not."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointFrames:
    """Points as a file has them.

    Attributes:
        positions: (frames, P, 3) in the file's unit and axes; NaN where a point is not known.
        confidence: (frames, P) from 0; None where the file has none.
        fps: frames per second; None where the file does not say.
        names: of the points, in order; None where the file does not say.
        layout: what was read, in words.
    """

    positions: np.ndarray
    confidence: np.ndarray | None = None
    fps: float | None = None
    names: tuple[str, ...] | None = None
    layout: str = "an array"


def is_one(folder: Path, *, views: bool) -> bool:
    """Whether a folder holds one recording, a ``.json`` a frame or its `views`, and not files of several."""
    return views or any(folder.glob("*.json"))


def read_points(
    path: Path, names: Sequence[str], *, person: str | None = None, views: int = 0
) -> PointFrames:
    """Read a file, or a folder with a file a frame, whose points are `names` in this order.

    A table with names in its head may have them in any order, and lack some.

    Args:
        path: the file or folder; of several views an array that begins with them, or a folder with a file or
            folder for each, in the order of their names.
        names: of the points.
        person: number or identity of one of several.
        views: of pictures that the points are in, x and y [px]; 0 for points in space.

    Raises:
        AssetError: missing, damaged, or not what its suffix says.
        InputError: no array of so many points; points in a picture, which need their camera; views that are
            not as many, or not as long.
    """
    size = 2 if views else 3
    lists = path.is_dir() or path.suffix.lower() == ".json"
    try:
        if views > 1:
            return _of_views(path, names, person, views)
        if path.suffix.lower() == ".csv":
            found = _of_table(path, size)
        else:
            found = (_of_folder if path.is_dir() else _of_json if lists else _of_data)(path, person, size)
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
        if isinstance(error, SomaError):
            raise
        told = ("lists and names", "JSON") if lists else ("values", f"another kind ({error})")
        raise _no_points(path, *told, size) from error
    return _ordered(path, found, names)


def _of_views(path: Path, names: Sequence[str], person: str | None, views: int) -> PointFrames:
    """Points (V, F, P, 2) of several views, and their confidence (V, F, P)."""
    if path.is_dir():
        places = sorted(each for each in path.iterdir() if each.name[0] != ".")
        parts = [read_points(each, names, person=person, views=1) for each in places]
    else:
        with open_data(path) as file:
            content = file.content
            values = _named(path, file, _KEYS) if isinstance(content, Mapping) else file.array(content)
        if values.ndim != 4:
            raise _no_points(path, values.shape, values.dtype, 2, views)
        parts = [_ordered(path, _shaped(path, one, None, None, 2), names) for one in values]
    lengths = sorted({len(part.positions) for part in parts})
    if len(parts) != views or len(lengths) != 1:
        raise InputError(
            str(path), got=f"{len(parts)} views of {', '.join(map(str, lengths))} frames",
            expected=f"{views} views of the same frames, one for each camera",
            fix="List the cameras in the order of the views, and cut these to the same frames.",
        )  # fmt: skip
    plain = np.ones(parts[0].positions.shape[:2])
    scores = [plain if part.confidence is None else part.confidence for part in parts]
    positions = np.stack([part.positions for part in parts])
    return replace(parts[0], positions=positions, confidence=np.stack(scores))


def _named(path: Path, file: Any, keys: Sequence[str]) -> np.ndarray:
    """The first array under one of some keys."""
    known = {str(key).lower(): value for key, value in file.content.items()}
    key = next((name for name in keys if name in known), None)
    if key is None and len(known) == 1:  # an NPY has one array without a name
        key = next(iter(known))
    if key is None:
        raise InputError(
            str(path), got="the keys " + ", ".join(map(str, file.content)),
            expected="points under " + ", ".join(keys),
            fix="Rename the array of points to 'points'.",
        )  # fmt: skip
    return file.array(known[key])


def _of_data(path: Path, _person: str | None, size: int) -> PointFrames:
    """Points of an NPZ, NPY, pickle or file of tensors."""
    with open_data(path) as file:
        content = file.content
        if not isinstance(content, Mapping):
            return _shaped(path, file.array(content), None, None, size)
        known = {str(key).lower(): value for key, value in content.items()}
        score = next((known[name] for name in _SCORES if name in known), None)
        rate = next((known[name] for name in _RATES if name in known), None)
        fps = None if rate is None else float(np.asarray(file.array(rate)).reshape(-1)[0])
        values = _named(path, file, _KEYS)
        scores = None if score is None else file.array(score)
    return _shaped(path, values, scores, fps, size)


def _shaped(
    path: Path, values: np.ndarray, scores: np.ndarray | None, fps: float | None, size: int
) -> PointFrames:
    """An array as frames of points: (F, P, size or one more), (F, size P), one frame, or HumanML3D's."""
    values = np.squeeze(values) if values.ndim > 3 else values
    if values.dtype.kind not in "fiu" or values.ndim not in (2, 3):
        raise _no_points(path, values.shape, values.dtype, size)
    values = values.astype(np.float64)
    if values.ndim == 2 and values.shape[1] == _FLAT and size == 3:
        return PointFrames(
            positions=joints_of_humanml3d(path, values), fps=fps or 20.0, layout="HumanML3D's vectors"
        )
    if values.ndim == 2 and values.shape[1] in (size, size + 1):
        values = values[None]
    elif values.ndim == 2 and values.shape[1] % size == 0:
        values = values.reshape(len(values), -1, size)
    if values.ndim != 3 or values.shape[2] not in (size, size + 1):
        raise _no_points(path, values.shape, values.dtype, size)
    if values.shape[2] > size:
        scores, values = values[..., size], values[..., :size]
    if scores is not None:
        scores = np.broadcast_to(np.squeeze(scores), values.shape[:2]).astype(np.float64)
    return PointFrames(positions=values, confidence=scores, fps=fps)


def _no_points(path: Path, shape: object, kind: object, size: int, views: int = 1) -> InputError:
    flat = isinstance(shape, tuple) and len(shape) >= 3 and shape[-1] == 2
    expected = "(frames, points, 3), with a confidence (frames, points, 4), or (frames, 263) of HumanML3D"
    fix, got = "Save them as an array of that shape.", f"{shape} of {kind}"
    if size == 2:
        many = f"{views}, " if views > 1 else ""
        expected = f"({many}frames, points, 2) of pixels, with a confidence ({many}frames, points, 3)"
        fix = "Leave out camera for points in space, and give a list of cameras for several views."
    elif flat:
        fix = "Those of a picture need the camera that took it: camera=FILE.json."
        got = "points in a picture" if kind == "JSON" else got
    return InputError(str(path), got=got, expected=expected, fix=fix)


def _of_table(path: Path, size: int) -> PointFrames:
    """A table with commas, semicolons or tabs: a row a frame, a column for each axis of a point."""
    rows = table_rows(path)
    first = next(rows, [])
    head = None if _numbers(first) is not None else [cell.strip() for cell in first]
    if head is None:
        rows = chain([first] if first else [], rows)
    values = np.array([_cells(path, number, row, len(first)) for number, row in enumerate(rows)])
    if not len(values):
        raise InputError(str(path), got="an empty table", expected="a row a frame", fix="Write it again.")
    if head is None:
        return _shaped(path, values, None, None, size)
    columns: dict[str, dict[str, int]] = {}
    for place, title in enumerate(head):
        match = _AXIS.match(title)
        if match and match.group(1):
            columns.setdefault(match.group(1), {})[match.group(2).lower()] = place
    axes = "xyz"[:size]
    names = [name for name, places in columns.items() if all(axis in places for axis in axes)]
    if not names:
        raise InputError(
            str(path), got="the columns " + ", ".join(head[:6]),
            expected=" and ".join(f"NAME_{axis}" for axis in axes) + " of each point",
            fix="Name the columns so, or leave out the head.",
        )  # fmt: skip
    taken = np.array([[columns[name][axis] for axis in axes] for name in names])
    rate = values[0, head.index("fps")] if "fps" in head else None
    return PointFrames(positions=values[:, taken], names=tuple(names), fps=rate, layout="a table with names")


def _numbers(cells: Sequence[str]) -> list[float] | None:
    try:
        return [float(cell) if cell.strip() else np.nan for cell in cells]
    except ValueError:
        return None


def _cells(path: Path, number: int, row: Sequence[str], count: int) -> np.ndarray:
    found = [(_numbers([cell]) or [np.nan])[0] for cell in row]
    if len(found) != count:
        raise InputError(
            f"{path}: row {number}", got=f"{len(found)} cells", expected=f"{count}, as in the first",
            fix="Write the table again.",
        )  # fmt: skip
    return np.array(found)


def _of_folder(path: Path, person: str | None, size: int) -> PointFrames:
    """A folder of OpenPose or EasyMocap: a JSON file a frame, by the order of their names."""
    if not (files := frame_files(path)):
        raise InputError(str(path), got="no .json in it", expected="a file a frame", fix="Name their folder.")
    frames = [
        None if file is None else _person(file, read_json(file, fix="Write it again."), person, size)
        for file in _with_gaps(files)
    ]
    return _stacked(path, frames, "a folder with a file a frame", size)


def _with_gaps(files: Sequence[Path]) -> list[Path | None]:
    """Files by the one number that differs in their names; None where a number is skipped now and then."""
    groups = [re.findall(r"\d+", file.stem) for file in files]
    if len({len(group) for group in groups}) > 1:
        return list(files)
    differ = [column for column in zip(*groups, strict=True) if len(set(column)) > 1]
    if len(differ) != 1:
        return list(files)
    found = {int(number): file for number, file in zip(differ[0], files, strict=True)}
    first, last, step = min(found), max(found), int(np.gcd.reduce(np.diff(sorted(found))))
    if len(found) < len(files) or last - first >= _SKIPPED * step * len(files):
        return list(files)
    return [found.get(number) for number in range(first, last + 1, step)]


def _of_json(path: Path, person: str | None, size: int) -> PointFrames:
    """One JSON: a list of frames, or an object that has it under a known key."""
    content = read_json(path, fix="Write it again, or as an NPZ.")
    if isinstance(content, Mapping):
        known = {str(key).lower(): value for key, value in content.items()}
        rate = next((float(known[name]) for name in _RATES if name in known), None)
        key = next((name for name in (*_LISTS, *_KEYS) if name in known), None)
        if "people" not in known and key is not None:
            found = _of_frames(path, known[key], person, size)
            return replace(found, fps=rate or found.fps)
        content = [content]
    return _of_frames(path, content, person, size)


def _of_frames(path: Path, frames: Any, person: str | None, size: int) -> PointFrames:
    if isinstance(frames, list) and frames and isinstance(frames[0], (Mapping, list)):
        inner = frames[0]
        if isinstance(inner, Mapping) and "image_id" in inner:
            frames = _by_image(frames)
        if isinstance(inner, Mapping) or (inner and isinstance(inner[0], Mapping)):
            people = [_person(path, frame, person, size) for frame in frames]
            return _stacked(path, people, "frames of people", size)
    return _shaped(path, np.array(frames, np.float64), None, None, size)


def _by_image(people: Sequence[Mapping[str, Any]]) -> list[list[Mapping[str, Any]]]:
    """The people of each frame from the list that COCO has, the surest first; no one in frames it skips."""
    found: dict[Any, list[Mapping[str, Any]]] = {}
    for one in sorted(people, key=lambda one: -float(one.get("score", 0))):
        found.setdefault(one["image_id"], []).append(one)
    numbers = sorted(
        found, key=lambda image: (0, image) if isinstance(image, int) else (1, *_numbered(image))
    )
    if all(isinstance(number, int) for number in numbers):
        first, last = numbers[0], numbers[-1]
        if last - first < _SKIPPED * len(numbers):  # numbers of frames, and not of a data set's pictures
            numbers = list(range(first, last + 1))
    return [found.get(number, []) for number in numbers]


def _numbered(name: object) -> list[tuple[int, int, str]]:
    """A key that sorts names by the numbers in them."""
    parts = re.split(r"(\d+)", str(name))
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]


def _person(path: Path, frame: Any, person: str | None, size: int) -> np.ndarray | None:
    """Points (P, size or one more) of one person in a frame; None where there is none."""
    people = frame
    if isinstance(frame, Mapping):
        people = next((frame[key] for key in _PEOPLE if key in frame), [frame])
    number = int(person) if person and person.isdigit() else 0
    by_id = [
        one for one in people
        if isinstance(one, Mapping) and person in [str(one[key]) for key in _IDS if key in one]
    ]  # fmt: skip
    chosen = by_id[0] if by_id else (people[number] if number < len(people) else None)
    if chosen is None:
        return None
    parts = []
    for keys in (
        (f"keypoints{size}d", f"pose_keypoints_{size}d", *_KEYS),
        (f"hand_left_keypoints_{size}d",),
        (f"hand_right_keypoints_{size}d",),
    ):
        key = next((name for name in keys if len(chosen.get(name, ())) > 0), None)
        if key is not None:
            values = np.array(chosen[key], np.float64)
            parts.append(values.reshape(-1, size + 1) if values.ndim == 1 else values)
    if not parts:
        flat = any(str(key).endswith("_2d") and len(value) for key, value in chosen.items())
        raise _no_points(path, (1, 0, 2) if flat and size == 3 else tuple(chosen), "JSON", size)
    wide = min(part.shape[1] for part in parts)
    points = np.concatenate([part[:, :wide] for part in parts])
    score = next((chosen[name] for name in (*_SCORES, "keypoint_scores") if name in chosen), None)
    if wide == size and score is not None and np.shape(score) == (len(points),):
        points = np.concatenate((points, np.array(score, np.float64)[:, None]), 1)
    return points


def _stacked(path: Path, frames: Sequence[np.ndarray | None], layout: str, size: int) -> PointFrames:
    shapes = {frame.shape for frame in frames if frame is not None}
    if len(shapes) != 1:
        got = f"frames of {', '.join(map(str, sorted(shapes)))} numbers" if shapes else "nobody in any frame"
        expected = "the same points in every frame"
        raise InputError(str(path), got=got, expected=expected, fix="Write them again.")
    empty = np.full(next(iter(shapes)), np.nan)
    values = np.stack([empty if frame is None else frame for frame in frames])
    return replace(_shaped(path, values, None, None, size), layout=layout)


def _ordered(path: Path, found: PointFrames, names: Sequence[str]) -> PointFrames:
    """Points in the order of `names`; those of no confidence are not known."""
    positions, confidence = found.positions, found.confidence
    refuse_far(path, positions, "point")
    if confidence is not None:
        gone = ~(confidence > 0)
        positions = np.where(gone[..., None], np.nan, positions)
        confidence = np.where(gone, 0.0, confidence)
    if found.names is None and positions.shape[1] in _LONGER.get(len(names), ()):
        positions = positions[:, : len(names)]
        confidence = confidence if confidence is None else confidence[:, : len(names)]
    if found.names is None and positions.shape[1] == len(names):
        return replace(found, positions=positions, confidence=confidence)
    row = {_plain(name): place for place, name in enumerate(found.names or ())}
    order = [row.get(_plain(name), -1) for name in names]
    if max(order, default=-1) < 0:
        few = ", ".join((found.names or ())[:5])
        raise InputError(
            str(path), got=f"{positions.shape[1]} points" + (f" called {few}, ..." if few else ""),
            expected=f"{len(names)}: {', '.join(names[:5])}, ...",
            fix="Choose the set that the file has: soma points list, points=NAME.",
        )  # fmt: skip
    unknown = np.array(order) < 0
    positions = np.where(unknown[:, None], np.nan, positions[:, order])
    return replace(found, positions=positions, confidence=None, names=tuple(names))


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
