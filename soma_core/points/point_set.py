"""Point sets: JSON files that say where named points lie in the canonical rig."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from soma_core.errors import AssetError, InputError
from soma_core.json_file import read_json
from soma_core.paths import configs_dir
from soma_core.plugin.registry import Registry, default_registry

__all__ = ["Point", "PointSet", "find_point_sets", "load_point_set", "read_point_set"]

_FOLDER = "point_sets"

_SUM = 1e-6
"""How far the weights of one point may be from one."""

_KEYS = {"name", "about", "source", "licence", "points", "bones"}
_PLACE_KEYS = {"joint", "joints", "vertices", "offset"}


@dataclass(frozen=True, kw_only=True)
class Point:
    """A fixed place in the rig: a combination of joints and vertices whose weights sum to one.

    Attributes:
        joints: joint name -> weight.
        vertices: id of a vertex of the canonical mesh -> weight. Ids below 4505 are those of both levels of
            detail, mid and low.
        offset: [m] from the joint, in the axes of the world at T-pose, on a body of the rig's own size; a
            point of one joint only.
    """

    joints: Mapping[str, float] = field(default_factory=dict)
    vertices: Mapping[int, float] = field(default_factory=dict)
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class PointSet:
    """Named points in a fixed order.

    Attributes:
        name: by which it is found.
        points: name -> place, in the order in which files list their values.
        bones: pairs of names that a picture joins by a line.
        about: one line that says what the points are.
        source: where the places come from.
    """

    name: str
    points: Mapping[str, Point]
    bones: Sequence[tuple[str, str]] = ()
    about: str = ""
    source: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the points, in order."""
        return tuple(self.points)

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points)


def find_point_sets(registry: Registry | None = None) -> dict[str, Path]:
    """Name -> file of every point set of the core and of the installed plugins; the core's own come first."""
    folders = [configs_dir()] + [folder for _, folder in (registry or default_registry()).config_dirs()]
    found: dict[str, Path] = {}
    for folder in folders:
        for path in sorted((folder / _FOLDER).glob("*.json")):
            found.setdefault(path.stem, path)
    return found


def load_point_set(name: str | Path | PointSet, registry: Registry | None = None) -> PointSet:
    """A point set by its name, or by the path of a JSON file.

    Raises:
        InputError: no such point set.
        AssetError: a file that is no point set; see :func:`read_point_set`.
    """
    if isinstance(name, PointSet):
        return name
    if str(name).endswith(".json"):
        return read_point_set(name)
    known = find_point_sets(registry)
    if str(name) not in known:
        near = difflib.get_close_matches(str(name), known, n=1)
        meant = f"Did you mean points={near[0]}? " if near else ""
        raise InputError(
            "points", got=repr(str(name)), expected="a point set: " + ", ".join(known),
            fix=f"{meant}List them with: soma points list; or give a JSON file of your own.",
        )  # fmt: skip
    return read_point_set(known[str(name)])


def read_point_set(path: Path | str) -> PointSet:
    """Read a point set.

    Raises:
        AssetError: no JSON, an unknown key, a place that names nothing, weights that do not sum to one, a
            bone between points that are not there.
    """
    fix = "soma points show coco17 prints one; docs/points.md has the layout."

    def refuse(cause: str) -> AssetError:
        return AssetError(path, cause=cause, fix=fix)

    values = read_json(path, fix=fix)
    if not isinstance(values, dict) or not isinstance(values.get("points"), dict) or not values["points"]:
        raise refuse('no object with "points": {name: place}')
    if unknown := sorted(set(values) - _KEYS):
        raise refuse(f"unknown keys {', '.join(unknown)}; known are {', '.join(sorted(_KEYS))}")
    points = {}
    for name, place in values["points"].items():
        try:
            points[name] = _place(place)
        except (TypeError, ValueError, AttributeError) as error:
            raise refuse(f"point {name!r}: {error}") from error
    bones = values.get("bones", [])
    for bone in bones:
        if not (isinstance(bone, list) and len(bone) == 2 and all(end in points for end in bone)):
            raise refuse(f"bone {bone!r} is no pair of names of points")
    name = str(values.get("name", Path(path).stem))
    texts = {key: str(values.get(key, "")) for key in ("about", "source")}
    return PointSet(name=name, points=points, bones=[(a, b) for a, b in bones], **texts)


def _place(place: Any) -> Point:
    """A point from its JSON: a joint's name, or an object."""
    place = {"joint": place} if isinstance(place, str) else place
    if not isinstance(place, dict) or not place or set(place) - _PLACE_KEYS:
        raise ValueError(f"got {place!r}, expected a joint's name or some of {sorted(_PLACE_KEYS)}")
    joints = {place["joint"]: 1.0} if "joint" in place else place.get("joints", {})
    joints = {str(joint): float(weight) for joint, weight in joints.items()}
    vertices = {int(vertex): float(weight) for vertex, weight in place.get("vertices", {}).items()}
    total = sum(joints.values()) + sum(vertices.values())
    if not abs(total - 1) <= _SUM:
        raise ValueError(f"its weights sum to {total:.6g}, expected 1")
    offset = tuple(float(value) for value in place.get("offset", (0, 0, 0)))
    if len(offset) != 3 or not all(map(math.isfinite, offset)):
        raise ValueError(f"offset {offset!r}, expected three numbers [m]")
    if any(offset) and (len(joints) != 1 or vertices):
        raise ValueError("an offset is from one joint: leave out the others")
    if min(vertices, default=0) < 0:
        raise ValueError(f"vertex {min(vertices)}, expected ids from 0")
    return Point(joints=joints, vertices=vertices, offset=(offset[0], offset[1], offset[2]))
