"""Read ``SOMA_procedural_transforms.json``; every error names the field by its path in the document."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from soma_core.errors import AssetError
from soma_core.json_file import read_json
from soma_core.rig.manifest import RESTORE
from soma_core.rig.procedural import MODES, ProceduralDefinition, TwistMode, TwistSegment

__all__ = ["parse_procedural", "read_procedural"]

_MAJOR = "1"
_ALIGNED = "aligned_x_swing_twist"
_AXES = {"x": 0, "y": 1, "z": 2, 0: 0, 1: 1, 2: 2}
_SUM_TOLERANCE = 1e-4  # shares are float32 decimals such as 0.3333333

_CONVENTIONS: dict[str, tuple[str, ...]] = {
    "linear_unit": ("cm", "centimeter", "centimeters"),
    "units": ("cm", "centimeter", "centimeters"),
    "angular_unit": ("rad", "radian", "radians"),
    "matrix_storage": ("row_major", "row-major"),
    "quaternion_order": ("xyzw",),
    "up_axis": ("y", "+y"),
    "forward_axis": ("z", "+z"),
}
"""Values that mean what this reader assumes; a definition that states another one would be misread."""


@dataclass(frozen=True)
class _Field:
    """A value of the document with the path that leads to it."""

    file: Path
    path: str
    value: Any

    def refuse(self, expected: str, fix: str = "Correct the field") -> AssetError:
        """The error that this field is not as expected."""
        text = repr(self.value)
        got = text if len(text) <= 80 else text[:77] + "..."
        return AssetError(
            self.file, cause=f"{self.path or 'document'} is {got}, expected {expected}", fix=fix
        )

    def at(self, key: str | int) -> _Field:
        """A member of an object, None where it is left out, or an item of an array."""
        if isinstance(key, int):
            return _Field(self.file, f"{self.path}[{key}]", self.value[key])
        path = f"{self.path}.{key}" if self.path else key
        return _Field(self.file, path, self.object().get(key))

    def object(self) -> dict[str, Any]:
        """The value as an object."""
        if not isinstance(self.value, dict):
            raise self.refuse("an object")
        return self.value

    def items(self) -> list[_Field]:
        """The items of an array that is not empty."""
        if not isinstance(self.value, list) or not self.value:
            raise self.refuse("a non-empty array")
        return [self.at(index) for index in range(len(self.value))]

    def one_of(self, choices: Sequence[str], meaning: str) -> Any:
        """The value as one of the given texts."""
        if not isinstance(self.value, str) or self.value not in choices:
            raise self.refuse(meaning)
        return self.value

    def names(self) -> tuple[str, ...]:
        """The items as texts, each once."""
        found: list[str] = []
        for item in self.items():
            if not isinstance(item.value, str) or not item.value or item.value in found:
                raise item.refuse("a name that is not repeated")
            found.append(item.value)
        return tuple(found)

    def number(self) -> float:
        """The value as a finite number."""
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            raise self.refuse("a number")
        if not abs(self.value) <= sys.float_info.max:  # JSON may hold NaN, infinity and any integer
            raise self.refuse("a finite number")
        return float(self.value)


def _check_head(root: _Field) -> None:
    """Refuse another schema, other conventions, or extractors that do not match the modes."""
    version = root.at("schema_version")
    if not isinstance(version.value, str) or version.value.partition(".")[0] != _MAJOR:
        raise version.refuse(f"a version {_MAJOR}.x", "Convert the definition to schema 1.1.0")
    for key, accepted in _CONVENTIONS.items():
        stated = root.at("conventions").at(key) if root.value.get("conventions") else None
        if stated is not None and stated.value is not None and str(stated.value).lower() not in accepted:
            raise stated.refuse(f"one of {', '.join(accepted)}", "Convert the definition")
    modes = root.at("modes")
    for name, item in zip(modes.names(), modes.items(), strict=True):
        if name not in MODES:
            raise item.refuse(f"one of {', '.join(MODES)}")
    extractors = root.at("channel_extractors")
    if set(extractors.object()) != set(modes.value):
        raise _Field(root.file, extractors.path, sorted(extractors.value)).refuse(
            f"an extractor for each of {', '.join(modes.value)} and no other"
        )


def _segment(field: _Field, public: Sequence[str], taken: set[str]) -> TwistSegment:
    joint = "one of public_rig_derivation.main_joint_names"
    parent, reverse = field.at("parent_joint"), field.at("reverse")
    if reverse.value is not None and not isinstance(reverse.value, bool):
        raise reverse.refuse("true or false")
    helpers = field.at("twist_joints")
    for name, item in zip(helpers.names(), helpers.items(), strict=True):
        if name in public or name in taken:
            raise item.refuse("the name of a joint that is neither public nor a helper of another segment")
        taken.add(name)
    axis, sign = field.at("source_axis"), field.at("source_sign")
    known = not isinstance(axis.value, bool) and isinstance(axis.value, str | int) and axis.value in _AXES
    if not known:
        raise axis.refuse("'x', 'y' or 'z', or 0, 1 or 2")
    if isinstance(sign.value, bool) or sign.value not in (1, -1):
        raise sign.refuse("1 or -1")
    start, end = (field.at(key).one_of(public, joint) for key in ("start_joint", "end_joint"))
    if start == end:
        raise field.at("end_joint").refuse("another joint than start_joint")
    return TwistSegment(
        start=start,
        end=end,
        helpers=helpers.names(),
        reverse=bool(reverse.value),
        parent=None if parent.value is None else parent.one_of(public, joint),
        axis=_AXES[axis.value],
        sign=int(sign.value),
    )


def _check_sources(field: _Field, segments: Sequence[TwistSegment]) -> None:
    """One axis and sign for each joint that gives a twist."""
    found: dict[str, tuple[int, int]] = {}
    for index, segment in enumerate(segments):
        for joint in (segment.start, segment.end) if segment.reverse else (segment.end,):
            if found.setdefault(joint, (segment.axis, segment.sign)) != (segment.axis, segment.sign):
                expected = f"the axis and sign that another segment gives {joint}"
                raise field.at(index).at("source_axis").refuse(expected)


def _modes(root: _Field, helpers: Sequence[str]) -> dict[str, TwistMode]:
    """Extraction mode of every helper."""
    policy, declared = root.at("rotation_extraction"), tuple(root.value["modes"])
    expected = f"one of modes: {', '.join(declared)}"
    if isinstance(policy.value, str):
        return dict.fromkeys(helpers, policy.one_of(declared, expected))
    single = policy.at("per_procedural_joint")
    chosen = {} if single.value is None else single.object()
    for name in chosen:
        if name not in helpers:
            raise single.at(name).refuse(f"no entry, as {name} is not a twist joint of any segment")
    found = {name: single.at(name).one_of(declared, expected) for name in chosen}
    default = policy.at("default")
    missing = [name for name in helpers if name not in found]
    if missing and default.value is None:
        raise default.refuse(f"a mode, as {missing[0]} has none of its own")
    if default.value is not None:
        default.one_of(declared, expected)
    return {name: found.get(name, default.value) for name in helpers}


def _matrix(field: _Field, rows: Sequence[str], columns: Sequence[str]) -> dict[str, dict[str, float]]:
    """One of the named sparse matrices as row -> {column -> value}."""
    field.at("format").one_of(("sparse_coo_named",), "'sparse_coo_named'")
    dtype = field.at("dtype")
    if dtype.value not in (None, "float32", "float64"):
        raise dtype.refuse("'float32'")
    matrix: dict[str, dict[str, float]] = {}
    for entry in field.at("entries").items():
        row = entry.at("row").one_of(rows, "a twist joint of a segment")
        column = entry.at("column").one_of(columns, "a joint that may stand in this matrix")
        if column in matrix.setdefault(row, {}):
            raise entry.refuse(f"one entry for row {row} and column {column}")
        matrix[row][column] = entry.at("value").number()
    return matrix


def _check_places(
    field: _Field, translation: Mapping[str, Mapping[str, float]], helpers: Sequence[str]
) -> None:
    """Refuse helpers without a place, shares that do not sum to 1, and helpers that place each other."""
    done: set[str] = set()
    while len(done) < len(helpers):
        ready = {
            name
            for name in helpers
            if name not in done and all(c in done or c not in helpers for c in translation.get(name, {}))
        }
        if not ready:
            stuck = sorted(set(helpers) - done)
            raise _Field(field.file, field.path, stuck).refuse(
                "helpers that do not place each other in a circle"
            )
        done |= ready
    for name in helpers:
        total = sum(translation.get(name, {}).values())
        if abs(total - 1) > _SUM_TOLERANCE:
            raise _Field(field.file, f"{field.path} (sum of row {name})", total).refuse("1")


def _check_channels(field: _Field, definition: ProceduralDefinition) -> None:
    """Refuse angles made of a joint whose twist nothing defines in the helper's mode."""
    ends = {segment.end for segment in definition.segments}
    starts = {segment.start: segment for segment in definition.segments if segment.reverse}
    for helper, row in definition.rotation.items():
        for column in row:
            entry = _Field(field.file, f"{field.path} (row {helper}, column {column})", row[column])
            if column not in ends and column not in starts:
                raise entry.refuse("the end joint of a segment, or the start joint of a reversed one")
            aligned = definition.modes[helper] == _ALIGNED and column not in ends
            if aligned and starts[column].parent is None:
                index = definition.segments.index(starts[column])
                raise _Field(field.file, f"segments[{index}].parent_joint", None).refuse(
                    f"a joint, as {helper} reads the twist of {column} by {_ALIGNED}"
                )


def _joint_count(root: _Field, least: int) -> int | None:
    """Number of joints of the template, where it is stated."""
    template = root.at("template_asset")
    count = None if template.value is None else template.at("joint_count")
    if count is None or count.value is None:
        return None
    if isinstance(count.value, bool) or not isinstance(count.value, int) or count.value < least:
        raise count.refuse(f"at least the {least} joints that the definition names")
    return count.value


def parse_procedural(document: object, file: Path) -> ProceduralDefinition:
    """Check the content of a procedural definition.

    Args:
        document: parsed JSON.
        file: named in errors.

    Raises:
        AssetError: naming the path of the field, what it holds and what it must.
    """
    root = _Field(file, "", document)
    root.object()
    _check_head(root)
    public = root.at("public_rig_derivation").at("main_joint_names").names()
    fields, taken = root.at("segments"), set[str]()
    segments = tuple(_segment(field, public, taken) for field in fields.items())
    _check_sources(fields, segments)
    helpers = tuple(name for segment in segments for name in segment.helpers)
    matrices = root.at("parameter_matrices")
    definition = ProceduralDefinition(
        main_joints=public,
        segments=segments,
        modes=_modes(root, helpers),
        rotation=_matrix(matrices.at("rotation"), helpers, public),
        translation=_matrix(matrices.at("translation"), helpers, (*public, *helpers)),
        joint_count=_joint_count(root, len(public) + len(helpers)),
    )
    _check_places(matrices.at("translation").at("entries"), definition.translation, helpers)
    _check_channels(matrices.at("rotation").at("entries"), definition)
    return definition


def read_procedural(path: Path | str) -> ProceduralDefinition:
    """Read a procedural definition from its JSON file.

    Raises:
        AssetError: unreadable file, or a field that is not as the schema says.
    """
    path = Path(path)
    return parse_procedural(read_json(path, fix=RESTORE), path)
