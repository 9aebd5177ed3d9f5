"""Read BVH: joints in any order of channels, any number of channels a joint, numbers by numpy."""

from __future__ import annotations

import logging
import mmap
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from soma_core.errors import AssetError, InputError
from soma_core.files import FARTHEST, refuse_unreadable
from soma_core.geometry.euler import matrices_from_euler
from soma_core.io.skeleton_motion import SkeletonMotion
from soma_core.io.text_numbers import numbers_of_text

__all__ = ["read_bvh"]

_log = logging.getLogger(__name__)

_MOST_JOINTS = 4096
_CHUNK = 1 << 18
"""Bytes of text that are taken at once: what is made of them stays in the processor's cache."""

_MOST_HIERARCHY = 1 << 24
"""Bytes in which MOTION has to follow: 4,096 joints take a tenth of that."""

_ROWS = 128
_WORD = re.compile(
    rb"(?i:(ROOT|JOINT)[ \t]+([^\r\n{}]+))|(?i:(End)[ \t]*Site[^\r\n{}]*)"
    rb"|(?i:(OFFSET|CHANNELS)\b([^\r\n{}]*))|(?i:(?:^|(?<=\r))[ \t]*(MOTION)\b)|([{}])"
    rb"|(?:\#|//)[^\r\n]*|(\S+)",
    re.MULTILINE,
)
_NOTE = re.compile(rb"(?:^|(?<=\s))(?:#|//)[^\r\n]*")
_MARK = b"\xef\xbb\xbf"
"""With which some programs begin a text in UTF-8."""

_HEAD = re.compile(rb"(?i:Frames[ \t]*:?[ \t]*(\S+))|(?i:Frame[ \t]*Time[ \t]*:?[ \t]*(\S+))")
_RATES = (
    24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 144, 150, 180, 200, 240, 24 / 1.001, 30 / 1.001, 60 / 1.001,
)  # fmt: skip
_LEAST, _CLIP = 0.2, 10
"""Largest angle [degrees] of a clip that moves, which has so many frames; radians end at a turn."""

_MOST_TURNED = 1e6
"""Angle [degrees], thousands of turns, from which on none is meant; at last none is left of its digits."""

_FIX = "Export it again as BVH, with HIERARCHY and MOTION."


@dataclass
class _Tree:
    """What HIERARCHY says; channels are (axis, is rotation) pairs, offsets and ends in the file's unit."""

    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    offsets: list[np.ndarray] = field(default_factory=list)
    ends: list[np.ndarray] = field(default_factory=list)
    channels: list[list[tuple[int, bool]]] = field(default_factory=list)


def read_bvh(
    path: str | Path,
    *,
    fps: float | None = None,
    root: str | None = None,
    angles: Literal["rad", "deg"] | None = None,
) -> SkeletonMotion:
    """Read a BVH file; lengths stay in its unit and axes, which it does not tell.

    Position channels replace the offset of their joint, unless they are all zero. Damage that leaves whole
    frames is warned of: a number of frames that disagrees, a last frame cut off, a frame time that is a rate.

    Args:
        path: the file.
        fps: frame rate; overrides the frame time.
        root: name of the root joint, where the file has several.
        angles: unit of rotation channels; None for degrees.

    Raises:
        AssetError: missing, damaged or no BVH.
        InputError: several roots, no frame time, or numbers that are none.
    """
    path = Path(path).expanduser()
    refuse_unreadable(path)
    with open(path, "rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as text:
        tree, at = _hierarchy(path, text)
        announced, frame_time, at = _motion_head(text, at)
        rate = _frame_rate(path, frame_time, fps)
        width = sum(map(len, tree.channels))
        values = _numbers(path, text, at)
    if not width or len(values) < width:
        raise AssetError(
            path, cause=f"holds {len(values)} numbers for {width} channels: no whole frame", fix=_FIX
        )
    frames = len(values) // width
    if announced != str(frames) or len(values) % width:
        cut = f" and {len(values) % width} of the {width} numbers of another" if len(values) % width else ""
        _log.warning(
            "%s: announces %s frames and holds %d%s; the whole ones are read",
            path.name,
            announced,
            frames,
            cut,
        )
    rows = values[: frames * width].reshape(frames, width)
    turning = np.array([rotates for channels in tree.channels for _, rotates in channels])
    if angles == "rad":
        rows = np.where(turning, np.degrees(rows), rows)
    largest = _largest(rows)
    for kind, size, most in ((turning, "degrees", _MOST_TURNED), (~turning, "units of length", FARTHEST)):
        found = largest[kind].max(initial=0)
        if found > most:
            raise InputError(
                f"{path}: MOTION", got=f"{found:.3g} {size}", expected=f"at most {most:g}",
                fix="Correct or delete the frame.",
            )  # fmt: skip
    if angles != "rad" and frames >= _CLIP and _LEAST < largest[turning].max(initial=0) <= 2 * np.pi:
        _log.warning("%s: no angle is above 6.28; if they are radians, pass angles=rad", path.name)
    return _motion(path, tree, rows, rate, root)


def _largest(rows: np.ndarray) -> np.ndarray:
    """Largest size of each column."""
    return np.asarray(np.maximum(rows.max(axis=0), -rows.min(axis=0)))


def _hierarchy(path: Path, text: mmap.mmap) -> tuple[_Tree, int]:
    """Joints up to MOTION, and where that ends.

    Raises:
        AssetError: what is no hierarchy.
    """
    tree, stack, opened = _Tree(), [-1], 0
    pending: int | None = None  # joint whose brace is awaited; -2 for an End Site
    begin = len(_MARK) if text[: len(_MARK)] == _MARK else 0
    for word in _WORD.finditer(text, begin, _MOST_HIERARCHY):
        kind, name, end, entry, numbers, motion, brace, other = word.groups()
        if motion:
            if opened or not tree.names:
                break
            return tree, word.end()
        if kind:
            pending = len(tree.names)
            _add_joint(
                path,
                tree,
                name.decode("utf-8", "replace").strip(),
                -1 if kind.upper() == b"ROOT" else stack[-1],
            )
        elif end:
            pending = -2
        elif brace == b"{":
            stack.append(pending if pending is not None else -3)
            opened, pending = opened + 1, None
        elif brace == b"}":
            if not opened:
                break
            stack.pop()
            opened -= 1
        elif entry:
            _add_entry(path, tree, stack, entry.upper(), numbers)
        elif other and other.upper() != b"HIERARCHY":
            cause = f"not a BVH file ({other[:20]!r} stands in its hierarchy)"
            raise AssetError(path, cause=cause, fix=_FIX)
    cause = f"its hierarchy has no end: {opened} brackets are open before MOTION, of {len(tree.names)} joints"
    raise AssetError(path, cause=cause, fix=_FIX)


def _add_joint(path: Path, tree: _Tree, name: str, parent: int) -> None:
    if len(tree.names) >= _MOST_JOINTS or parent < -1:
        cause = (
            f"more than {_MOST_JOINTS} joints" if parent >= -1 else f"the joint {name!r} lies below no joint"
        )
        raise AssetError(path, cause=cause, fix="Export the skeleton of one body.")
    tree.names.append(name)
    tree.parents.append(parent)
    tree.offsets.append(np.zeros(3))
    tree.ends.append(np.full(3, np.nan))
    tree.channels.append([])


def _add_entry(path: Path, tree: _Tree, stack: list[int], entry: bytes, text: bytes) -> None:
    """An offset, of which some programs write a rotation behind the place, or channels."""
    words, joint = _with_points(text).split(), stack[-1]
    try:
        if entry == b"OFFSET":
            offset = np.array([float(word) for word in words[:3]])
            if offset.shape != (3,) or not np.isfinite(offset).all():
                raise ValueError(text.decode("utf-8", "replace").strip()[:40])
            if joint == -2:
                tree.ends[stack[-2]] = offset
            else:
                tree.offsets[joint] = offset
            return
        names = [word.decode("ascii", "replace").lower() for word in words[1:]]
        if int(words[0]) != len(names):
            raise ValueError(f"CHANNELS {words[0].decode('ascii', 'replace')[:9]} with {len(names)} names")
        tree.channels[joint] = [
            ("xyz".index(name[0]), {"rotation": True, "position": False}[name[1:]]) for name in names
        ]
    except (ValueError, IndexError, KeyError) as error:
        cause = f"unreadable {entry.decode()} of {tree.names[joint] if joint >= 0 else 'an end'!r} ({error})"
        raise AssetError(
            path, cause=cause, fix="Correct the line: x y z, or a count and Xposition ... Zrotation."
        ) from error


def _motion_head(text: mmap.mmap, at: int) -> tuple[str, str | None, int]:
    """Frames that are announced, the frame time as text, and where the numbers begin."""
    announced, frame_time = "no", None
    for _ in range(2):
        found = _HEAD.search(text, at, at + 200)
        if not found:
            break
        at = found.end()
        if found[1]:
            announced = found[1].decode("ascii", "replace")
        else:
            frame_time = _with_points(found[2]).decode("ascii", "replace")
    return announced, frame_time, at


def _frame_rate(path: Path, frame_time: str | None, fps: float | None) -> float:
    """Frames a second, with the rounding of the frame time undone."""
    if fps is not None:
        return float(fps)
    try:
        seconds = float(frame_time) if frame_time else float("nan")
    except ValueError:
        seconds = float("nan")
    if 5 <= seconds <= 1000:
        _log.warning(
            "%s: a frame time of %g s is read as a rate of %g frames a second; fps= says another",
            path.name,
            seconds,
            seconds,
        )
        return seconds
    if not 5e-4 <= seconds <= 1:
        raise InputError(
            f"{path}: Frame Time",
            got=frame_time or "none",
            expected="seconds from one frame to the next",
            fix="Pass fps=30 (the true rate).",
        )
    digits = len(str(frame_time).partition(".")[2]) if "e" not in str(frame_time).lower() else 9
    near = min(_RATES, key=lambda rate: abs(1 / rate - seconds))
    return float(near) if abs(1 / near - seconds) < 10.0**-digits else 1 / seconds


def _numbers(path: Path, text: mmap.mmap, at: int) -> np.ndarray:
    """All numbers from `at` on; text is taken a piece at a time."""
    found = [_parsed(path, piece) for piece in _pieces(text, at)]
    return np.concatenate(found) if found else np.empty(0)


def _pieces(text: mmap.mmap, at: int) -> Iterator[bytes]:
    """Pieces that end between two numbers, or within a word that is longer than any number."""
    rest = b""
    for start in range(at, len(text), _CHUNK):
        piece = rest + text[start : start + _CHUNK]
        cut = max(piece.rfind(blank) for blank in (b" ", b"\n", b"\t", b"\r"))
        if cut < 0 or start + _CHUNK >= len(text):
            cut = len(piece)
        rest = piece[cut + 1 :]
        yield piece[:cut]


def _parsed(path: Path, piece: bytes) -> np.ndarray:
    if b"#" in piece or b"/" in piece:
        piece = _NOTE.sub(b"", piece)
    if not piece or piece.isspace():
        return np.empty(0)
    try:
        values = numbers_of_text(_with_points(piece))
        if np.isfinite(values).all():
            return values
    except ValueError:
        pass
    wrong = next((word for word in piece.split() if not _is_number(word)), b"?")
    raise InputError(
        f"{path}: MOTION",
        got=repr(wrong[:20].decode("ascii", "replace")),
        expected="finite numbers",
        fix="Correct or delete the frame.",
    )


def _with_points(text: bytes) -> bytes:
    """Numbers with a point, which commas stand for or part from each other in some countries and programs."""
    if b"," not in text and b";" not in text:
        return text
    text = text.replace(b";", b" ")
    decimal = b"." not in text and not re.search(rb",\S*,|,(?:\s|$)", text)
    return text.replace(b",", b"." if decimal else b" ")


def _is_number(word: bytes) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False


def _motion(path: Path, tree: _Tree, rows: np.ndarray, fps: float, root: str | None) -> SkeletonMotion:
    """The joints under one root."""
    first = _root(path, tree, root)
    kept = [first]
    for joint in range(first + 1, len(tree.names)):  # parents stand before their children
        if tree.parents[joint] < 0:
            break
        kept.append(joint)
    columns = np.cumsum([0, *map(len, tree.channels)])
    offsets = np.array([tree.offsets[joint] for joint in kept])
    parents = np.array([tree.parents[joint] for joint in kept]) - first
    parents[0] = -1
    rest = offsets.copy()
    for joint in range(1, len(kept)):
        rest[joint] += rest[parents[joint]]
    orders: dict[str, list[tuple[int, list[int]]]] = {}
    moves: dict[int, np.ndarray] = {}
    for index, joint in enumerate(kept):
        channels = list(enumerate(tree.channels[joint], start=columns[joint]))
        turns = [(place, axis) for place, (axis, rotates) in channels if rotates]
        order = "".join("XYZ"[axis] for _, axis in turns)
        orders.setdefault(order, []).append((index, [place for place, _ in turns]))
        moved = [(place, axis) for place, (axis, rotates) in channels if not rotates]
        places = rows[:, [place for place, _ in moved]]
        if moved and (index == 0 or np.any(places)):
            bone = np.tile(offsets[index], (len(rows), 1))
            bone[:, [axis for _, axis in moved]] = places
            moves[index] = bone
    place = moves.pop(0, np.tile(offsets[0], (len(rows), 1)))
    return SkeletonMotion(
        names=tuple(tree.names[joint] for joint in kept),
        parents=parents,
        rest=rest,
        rotations=_turns(rows, len(kept), orders),
        root=place,
        fps=fps,
        ends=np.array([tree.ends[joint] for joint in kept]),
        moves=_that_move(moves, offsets),
        source=path.name,
    )


def _turns(rows: np.ndarray, count: int, orders: dict[str, list[tuple[int, list[int]]]]) -> np.ndarray:
    """Rotations (frames, joints, 3, 3), for joints of one order of channels at once."""
    rotations = np.empty((len(rows), count, 3, 3))
    for start in range(0, len(rows), _ROWS):
        block, found = rows[start : start + _ROWS].T, rotations[start : start + _ROWS].swapaxes(0, 1)
        for order, joints in orders.items():
            angles = block[np.array([columns for _, columns in joints], np.intp).T]  # (axes, joints, frames)
            angles *= np.pi / 180
            angles = np.moveaxis(angles, 0, -1)
            if len(joints) == count:
                matrices_from_euler(angles, order, found)
            else:
                found[[joint for joint, _ in joints]] = matrices_from_euler(angles, order)
    return rotations


def _that_move(moves: dict[int, np.ndarray], offsets: np.ndarray) -> dict[int, np.ndarray]:
    """Without the channels that repeat the offset in every frame."""
    size = 1e-6 * (np.abs(offsets).max() + 1e-12)
    return {joint: bone for joint, bone in moves.items() if np.abs(bone - offsets[joint]).max() > size}


def _root(path: Path, tree: _Tree, name: str | None) -> int:
    roots = [joint for joint, parent in enumerate(tree.parents) if parent < 0]
    named = [joint for joint in roots if tree.names[joint] == name] if name else roots
    if len(named) != 1:
        names = ", ".join(tree.names[joint] for joint in roots)
        raise InputError(
            f"{path}: root",
            got=name or f"{len(roots)} skeletons",
            expected=f"one of {names}",
            fix=f"Pass root={tree.names[roots[0]]} (the one you want).",
        )
    return named[0]
