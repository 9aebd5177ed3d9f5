"""Bodies of the SMPL family in a file, wherever its tool has put them: whose, in which space, which parts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from soma_core.errors import InputError
from soma_core.io.data_files import DataFile
from soma_core.io.rotation_shapes import split_shape
from soma_core.io.smpl_names import PARTS, RATES, Space, Tool, frame_number, part_of, space_of, tool_of

__all__ = [
    "BODY_JOINTS", "POSE_JOINTS", "FoundBody", "choose_body", "find_bodies", "holds_poses",
    "no_bodies", "people_in", "shown_names",
]  # fmt: skip

POSE_JOINTS = (24, 52, 55, 22)
"""Joints that a whole pose may have: SMPL, SMPL-H, SMPL-X, and the body without hands and face."""

BODY_JOINTS = (21, 23)
"""Those without the root: SMPL has a joint for each hand."""

_JOINTS = {"pose": (*POSE_JOINTS, *BODY_JOINTS), "body": BODY_JOINTS}
"""Joints that parts may have by which a body is told."""

_MOTION_X = {
    "root": 3, "body": 63, "hands": 90, "jaw": 3, "expression": 50, "face_shape": 100, "trans": 3,
    "betas": 10,
}  # fmt: skip
"""Parts of the 322 numbers of Motion-X, in order, and their widths."""

_SHARED = ("gender", "frames", "model", *RATES, "seconds", "betas", "flat", "trans")
"""Parts that may stand beside a body, or further up."""

_CONTAINERS = frozenset(
    [
        *("people", "persons", "tracks", "person_data", "results", "result", "data", "output", "outputs"),
        *("net_outputs", "pred", "smpl", "smplx", "smplh", "params", "smpl_params", "smplx_params"),
        *("motion", "motions", "body"),
    ]
)
"""Names on the way to a body that tell nothing about whose it is."""

_ROMP = ("smpl_thetas", "smpl_betas", "cam_trans")
"""Keys of a result of ROMP or BEV."""

_DEEPEST, _MOST_NODES, _MOST_SEEN = 6, 50_000, 1_000_000
_LONGEST_LIST = 64
"""People in a list; longer lists are frames or something else."""


@dataclass(frozen=True, kw_only=True)
class FoundBody:
    """One body in a file.

    Attributes:
        person: whose; empty where the file holds one.
        space: of root and translation, where names tell.
        parts: part -> where it is in the file, and its value.
        tool: that wrote it, where names tell.
        index: which of `count` people along the first axis of the parts; None for one body.
        count: see `index`.
        time_last: whether frames are the last axis.
    """

    person: str
    space: Space | None
    parts: Mapping[str, tuple[str, Any]]
    tool: Tool | None = None
    index: int | None = None
    count: int = 1
    time_last: bool = False


def find_bodies(file: DataFile) -> list[FoundBody]:
    """Every body of a file, those nearest to its top first; of people and spaces each once."""
    found: dict[tuple[str, Space | None], FoundBody] = {}
    walk = _Walk(file)
    for _, body in sorted(walk.bodies(file.content, (), {}), key=lambda entry: entry[0]):
        found.setdefault((body.person, body.space), body)
    return list(found.values())


def people_in(bodies: Sequence[FoundBody]) -> list[str]:
    """Whose bodies they are, in the order of the file."""
    return list(dict.fromkeys(body.person for body in bodies))


def holds_poses(file: DataFile) -> bool:
    """Whether the names at the top are those of poses of the SMPL family, readable or not."""
    if not isinstance(file.content, dict):
        return False
    named = {found[0] for key in file.content if (found := part_of(str(key))) is not None}
    return "body" in named or {"pose", "betas"} <= named or {"pose", "trans"} <= named


def choose_body(
    file: DataFile, bodies: Sequence[FoundBody], *, person: str | None, space: Space | None
) -> FoundBody:
    """The body of a person, in the world where the file has it.

    Raises:
        InputError: several people and none chosen, or one or a space that is not there.
    """
    people = people_in(bodies)
    if person is None and len(people) > 1:
        raise InputError(
            f"{file.path}: person", got=f"{len(people)} people: {_listed(people)}", expected="one of them",
            fix=f"Pass person={people[0]}, or person=all to write a motion of each.",
        )  # fmt: skip
    if person is not None and str(person) not in people:
        raise InputError(
            f"{file.path}: person", got=repr(str(person)), expected=f"one of {_listed(people)}",
            fix=f"Pass person={people[0]}." if people != [""] else "It holds one body: leave person out.",
        )  # fmt: skip
    own = [body for body in bodies if person is None or body.person == str(person)]
    spaces = {body.space: body for body in own}
    if space is not None and space not in spaces and None not in spaces:
        other = ", ".join(str(name) for name in spaces)
        raise InputError(
            f"{file.path}: coordinates", got=f"{space}, which is not in the file", expected=other,
            fix=f"Pass coordinates={next(iter(spaces))}.",
        )  # fmt: skip
    order = (space, None) if space is not None else ("world", None, "camera")
    return next(spaces[name] for name in order if name in spaces)


def _listed(people: Sequence[str]) -> str:
    return ", ".join(people[:20]) + (" ..." if len(people) > 20 else "")


class _Walk:
    """A walk through the content of a file, which may be a graph that never ends."""

    def __init__(self, file: DataFile) -> None:
        self._file, self._left = file, _MOST_NODES

    def bodies(
        self, node: Any, way: tuple[str, ...], above: Mapping[str, tuple[str, Any]]
    ) -> Iterator[tuple[int, FoundBody]]:
        """Bodies at a node and below, with how deep they lie."""
        self._left -= 1
        if self._left < 0 or len(way) > _DEEPEST:
            return
        if isinstance(node, (list, tuple)):
            yield from self._of_list(node, way, above)
        elif isinstance(node, dict):
            yield from self._of_names(node, way, above)
        elif not way and (self._file.shape(node) or ())[-1:] == (322,):
            yield from self._motion_x(node)

    def _of_list(self, node: Sequence[Any], way: tuple[str, ...], above: Mapping[str, Any]) -> Iterator[Any]:
        if not node or not all(isinstance(item, dict) for item in node):
            return
        if len(node) > 1 and len(node) * len(node[0]) < _MOST_SEEN and self._is_frame(node[0]):
            common = [key for key in node[0] if all(key in item for item in node)]
            yield from self.bodies({key: [item[key] for item in node] for key in common}, way, above)
        elif len(node) <= _LONGEST_LIST:
            for number, item in enumerate(node):
                yield from self.bodies(item, (*way, str(number)), above)

    def _numbered(self, node: Mapping[Any, Any]) -> list[dict[Any, Any]]:
        """Frames by their number or the name of their picture, in order; none of people or other things."""
        number = {key: found for key in node if (found := frame_number(key)) is not None}
        whole = len(number) > 1 and all(isinstance(value, dict) for value in node.values())
        if not whole or len(number) < len(node) or len(node) * len(next(iter(node.values()))) >= _MOST_SEEN:
            return []
        counted = all(type(key) is int for key in node)  # a row of one frame may be a person's
        if not self._is_frame(next(iter(node.values())), leads=((),) if counted else ((), (1,))):
            return []
        return [{"frame_id": number[key]} | node[key] for key in sorted(node, key=lambda key: number[key])]

    def _is_frame(self, node: Mapping[Any, Any], leads: Sequence[tuple[int, ...]] = ((), (1,))) -> bool:
        """Whether a body of a list is one frame, and the list their sequence."""
        poses = [(part, value) for (part, _), (_, value) in self._named(node, ()).items() if part in _JOINTS]
        shapes = [(self._file.shape(value), _JOINTS[part]) for part, value in poses]
        splits = [split_shape(shape, joints) for shape, joints in shapes if shape is not None]
        return any(split is not None and split[0] in leads for split in splits)

    def _of_names(
        self, node: Mapping[Any, Any], way: tuple[str, ...], above: Mapping[str, Any]
    ) -> Iterator[Any]:
        if frames := self._numbered(node):
            yield from self._of_list(frames, way, above)
            return
        tracks, tool = _tracks(node), tool_of({"tracks"})
        if not tracks:
            tracks, tool = self._images(node), tool_of({"smpl_thetas", "cam_trans"})
        if tracks:
            for person, parts in tracks.items():
                yield len(way), FoundBody(person=person, space="camera", parts=parts, tool=tool)
            return
        named = self._named(node, way)
        shared = dict(above) | {part: named[part, None] for part in _SHARED if (part, None) in named}
        names = {*way, *map(str, node)}
        spaces = dict.fromkeys(space for part, space in named if part in _JOINTS)
        paths = {space for part, space in named if part == "trans"}
        for space in paths if spaces == {None: None} and len(paths) == 1 else spaces:
            parts = shared | {part: value for (part, other), value in named.items() if other in (space, None)}
            parts |= {part: value for (part, other), value in named.items() if other == space}
            for body in self._people(parts, way, space, names):
                yield len(way), body
        for key, value in node.items():
            again = key == "sequence_results" and "results" in node  # the same by track, as ROMP has it
            if isinstance(value, (dict, list, tuple)) and not again:
                yield from self.bodies(value, (*way, str(key)), shared)

    def _images(self, node: Mapping[Any, Any]) -> dict[str, dict[str, tuple[str, Any]]]:
        """Bodies of a result that lists the people of each image (ROMP, BEV), by their tracks or order."""
        images = [node] if "smpl_thetas" in node else list(node.values())
        seen: dict[str, dict[str, list[Any]]] = {}
        for number, image in enumerate(images):
            if not isinstance(image, dict) or "frame_id" in image or not {*_ROMP} <= image.keys():
                return {}
            try:
                arrays = {key: self._file.array(image[key]) for key in (*_ROMP, "track_ids") if key in image}
            except ValueError:
                return {}
            count = len(np.atleast_1d(arrays["smpl_thetas"]))
            if any(array.ndim < 1 or len(array) != count for array in arrays.values()):
                return {}
            for place in range(count):
                person = str(arrays["track_ids"][place]) if "track_ids" in arrays else str(place)
                track = seen.setdefault(person, {name: [] for name in (*_ROMP, "frames")})
                track["frames"].append(number)
                for name in _ROMP:
                    track[name].append(arrays[name][place])
        parts = dict(zip((*_ROMP, "frames"), ("pose", "betas", "trans", "frames"), strict=True))
        return {
            person: {parts[name]: (name, values) for name, values in track.items()}
            for person, track in seen.items()
        }

    def _named(
        self, node: Mapping[Any, Any], way: tuple[str, ...]
    ) -> dict[tuple[str, Space | None], tuple[str, Any]]:
        """Parts among the values of a node, the first name of each."""
        ranked: dict[tuple[str, Space | None], tuple[int, str, Any]] = {}
        for key, value in node.items():
            found = part_of(str(key)) if not isinstance(value, dict) else None
            if found is None or value is None:
                continue
            part, space, rank = found
            known = ranked.get((part, space))
            if (known is None or rank < known[0]) and (part not in _JOINTS or self._layout(part, value)):
                ranked[part, space] = rank, "/".join((*way, str(key))), value
        return {part: (name, value) for part, (_, name, value) in ranked.items()}

    def _layout(self, part: str, value: Any) -> tuple[int | None, bool] | None:
        """People along the first axis (None: one), and whether time is last; None for no rotations."""
        joints = _JOINTS[part]
        if isinstance(value, (list, tuple)) and value:
            first = self._file.shape(value[0])
            split = split_shape(first, joints) if first is not None else None
            if split is not None and len(split[0]) == 1 and split[0] != (1,) and len(value) <= _LONGEST_LIST:
                return len(value), False
        shape = self._file.shape(value)
        if shape is None:
            return None
        split = split_shape(shape, joints)
        if split is not None:
            lead = split[0]
            return (lead[0] if len(lead) == 2 and 1 not in lead else None), False
        if len(shape) == 3 and split_shape(shape[:2], joints) is not None:
            return None, True
        return None

    def _people(
        self, parts: Mapping[str, Any], way: tuple[str, ...], space: Space | None, names: set[str]
    ) -> Iterator[FoundBody]:
        """The bodies of a node: one, or several along the first axis."""
        leading = "body" if "body" in parts and "root" in parts else "pose"
        layout = self._layout(leading, parts[leading][1]) if leading in parts else None
        if layout is None:
            return
        tool = tool_of(names)
        told = next((found for name in way if (found := space_of(name))), None)
        body = FoundBody(
            person="/".join(name for name in way if name.lower() not in _CONTAINERS and not space_of(name)),
            space=space or told or (tool.space if tool else None), parts=parts, tool=tool,
            time_last=layout[1],
        )  # fmt: skip
        count = layout[0]
        if count is None or count == 1:
            yield body if count is None else replace(body, index=0, count=1)
            return
        for index in range(min(count, _LONGEST_LIST)):
            person = f"{body.person}/{index}".lstrip("/")
            yield replace(body, person=person, index=index, count=count)

    def _motion_x(self, node: Any) -> Iterator[tuple[int, FoundBody]]:
        array, at, parts = self._file.array(node), 0, {}
        values = array.reshape(-1, 322)
        if len(values) not in array.shape[:-1]:
            return
        for part, width in _MOTION_X.items():
            parts[part] = f"columns {at} to {at + width}", values[:, at : at + width]
            at += width
        parts = {part: value for part, value in parts.items() if part in PARTS}
        yield 0, FoundBody(person="", space=None, parts=parts, tool=tool_of({"motion_x_322"}))


def _tracks(node: Mapping[Any, Any]) -> dict[str, dict[str, tuple[str, Any]]]:
    """Bodies of a result that lists, for every frame, the tracks seen in it (4D-Humans, PHALP)."""
    frames = [
        frame for frame in node.values() if isinstance(frame, dict) and isinstance(frame.get("smpl"), list)
    ]
    if not frames or len(frames) < len(node) or sum(len(frame["smpl"]) for frame in frames) > _MOST_SEEN:
        return {}
    seen: dict[str, dict[str, list[Any]]] = {}
    for number, frame in enumerate(frames):
        time = frame.get("time") if type(frame.get("time")) is int else number
        for person, body in _seen_in(frame):
            track = seen.setdefault(person, {"root": [], "body": [], "betas": [], "frames": []})
            values = (body["global_orient"], body["body_pose"], body.get("betas"), time)
            for part, value in zip(track, values, strict=True):
                track[part].append(value)
    names = {"root": "smpl/global_orient", "body": "smpl/body_pose", "betas": "smpl/betas", "frames": "time"}
    return {
        person: {
            part: (names[part], values)
            for part, values in parts.items()
            if all(value is not None for value in values)
        }
        for person, parts in seen.items()
    }


def _seen_in(frame: Mapping[Any, Any]) -> Iterator[tuple[str, Mapping[Any, Any]]]:
    """Whose bodies were seen in a frame, and not predicted for it."""
    bodies, people, unseen = (
        frame["smpl"],
        frame.get("tid", frame.get("tracked_ids")),
        frame.get("tracked_time"),
    )
    if not isinstance(people, (list, tuple)) or len(people) != len(bodies):
        people = range(len(bodies))
    if not isinstance(unseen, (list, tuple)) or len(unseen) != len(bodies):
        unseen = [0] * len(bodies)
    for person, body, age in zip(people, bodies, unseen, strict=True):
        if isinstance(body, dict) and age == 0 and {"global_orient", "body_pose"} <= body.keys():
            yield str(person), body


def _strange_poses(file: DataFile) -> Iterator[tuple[str, str]]:
    """Names of what should be poses and is not, and what they hold, at the top and one level down."""
    top = file.content if isinstance(file.content, dict) else {}
    nested = {
        f"{key}/{name}": value
        for key, node in top.items()
        if isinstance(node, dict)
        for name, value in node.items()
    }
    for name, value in (*top.items(), *nested.items()):
        part = part_of(str(name).rpartition("/")[2])
        if part is None or part[0] not in ("pose", "body"):
            continue
        try:
            yield str(name), f"shape {file.array(value).shape}"
        except ValueError as error:
            yield str(name), f"an unreadable array ({error})"


def no_bodies(file: DataFile) -> InputError:
    """What a file holds that has no pose to read: a pose of a shape that is none's, or other names."""
    name, reason = next(_strange_poses(file), ("pose", f"only the keys {shown_names(file)}"))
    return InputError(
        f"{file.path}: {name}", got=reason,
        expected="72 values (smpl), 156 (smplh) or 165 (smplx) a frame, or as many joints as matrices, "
        f"quaternions or 6D; keys: {_wanted_names()}",
        fix="Rename the keys, or convert another file.",
    )  # fmt: skip


def _wanted_names() -> str:
    """Names of parts that are looked for, for a refusal."""
    shown = ("pose", "root", "body", "trans", "betas")
    return "; ".join(f"{part}: {', '.join(PARTS[part][:5])}" for part in shown)


def shown_names(file: DataFile) -> str:
    """Names in a file, as far as they fit a message."""
    found: list[str] = []

    def walk(node: Any, way: str, depth: int) -> None:
        if len(found) > 40:
            return
        if isinstance(node, dict) and depth < 4:
            for key, value in list(node.items())[:40]:
                walk(value, f"{way}/{key}" if way else str(key), depth + 1)
        else:
            shape = np.shape(node) if isinstance(node, np.ndarray) else file.shape(node)
            found.append(f"{way[:60]} {shape}" if shape else way[:60])

    walk(file.content, "", 0)
    return ", ".join(found[:40]) + (" ..." if len(found) > 40 else "") or "(none)"
