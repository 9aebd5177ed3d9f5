"""Which joint of another skeleton is which of this one, told by their names."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from soma_core.errors import AssetError, InputError
from soma_core.files import refuse_unreadable
from soma_core.io.joint_order import PARENT_NAMES, USER_JOINTS

__all__ = ["match_joints", "read_mapping"]

_TOKENS = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_SIDES = {"l": "Left", "left": "Left", "lft": "Left", "r": "Right", "right": "Right", "rgt": "Right"}
_PREFIXES = {
    "mixamorig",
    "bip",
    "biped",
    "character",
    "ctrl",
    "def",
    "org",
    "j",
    "bind",
    "valve",
    "cc",
    "base",
    "skel",
    "jnt",
    "bn",
}
"""Words that rigs put before every name, and a number after them."""

_FINGERS = {
    "Thumb": ("thumb",),
    "Index": ("index",),
    "Middle": ("middle", "mid"),
    "Ring": ("ring",),
    "Pinky": ("pinky", "little", "small"),
}
_PHALANGES = {"metacarpal": 1, "proximal": 2, "intermediate": 3, "distal": 4}

NEEDED = ("Hips", "LeftLeg", "RightLeg")
"""Without one leg at least nothing says how large the body is, and which way it stands."""

_TEMPLATE = (
    "Hips",
    "Neck1",
    "Head",
    *(
        f"{side}{part}"
        for side in ("Left", "Right")
        for part in ("Shoulder", "Arm", "ForeArm", "Hand", "Leg", "Shin", "Foot", "ToeBase")
    ),
)

_MOST_BYTES = 1 << 20


def match_joints(
    names: Sequence[str],
    parents: np.ndarray,
    *,
    mapping: Mapping[str, str] | None = None,
    source: str = "names",
) -> dict[str, int]:
    """Find the joints of this skeleton among those of another.

    Case, separators, what stands before a colon, and the spelling of left and right do not matter. Of the
    tables of names the one is taken that knows most of them and whose joints lie one below the other as here.

    Args:
        names: of the other skeleton's joints.
        parents: (J,) index of each joint's parent, -1 for a root.
        mapping: name of a joint here -> name there; instead of the tables.
        source: what to name where they are refused.

    Returns:
        Name of a joint here -> index there. Joints of spine and neck follow from their place.

    Raises:
        InputError: names that no table knows: the message holds the template of a mapping; or a mapping
            with a name that is none.
    """
    if mapping is not None:
        return _by_mapping(names, mapping, source)
    keys = [_key(name) for name in names]
    found: dict[str, int] = {}
    for table in _tables():
        match = {target: joint for joint, key in enumerate(keys) if (target := table.get(key))}
        if len(match) > len(found) and _one_below_the_other(match, parents):
            found = match
    if "Hips" not in found or not {"LeftLeg", "RightLeg"} & set(found):
        raise InputError(
            source,
            got=f"joints of unknown names: {', '.join(names[:12])}{' ...' if len(names) > 12 else ''}",
            expected="Hips and legs under names of " + "; ".join(_names_of_tables()),
            fix="Write which is which into a file, as far as there are such joints, and pass mapping=FILE:\n"
            + json.dumps(_template(found, names), indent=1),
        )
    return found


def read_mapping(path: str | Path) -> dict[str, str]:
    """Read a mapping file, JSON or YAML: joints of this skeleton and their names elsewhere.

    Raises:
        AssetError: missing or unreadable.
        InputError: not a table of names, or a joint that this skeleton does not have.
    """
    import yaml

    path = Path(path).expanduser()
    refuse_unreadable(path, most_bytes=_MOST_BYTES)
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise AssetError(
            path, cause="neither JSON nor YAML", fix="Write JOINT: NAME on each line."
        ) from error
    if not isinstance(found, dict) or not all(
        isinstance(text, str) for pair in found.items() for text in pair
    ):
        raise InputError(
            str(path),
            got=type(found).__name__,
            expected="names, one for each joint here",
            fix="Write JOINT: NAME on each line.",
        )
    strange = sorted(set(found) - set(USER_JOINTS))
    if strange:
        raise InputError(
            f"{path}: {strange[0]}",
            got="no joint of this skeleton",
            expected=", ".join(_TEMPLATE),
            fix="The joints of this skeleton stand before the colon.",
        )
    return {target: name for target, name in found.items() if name}


def _by_mapping(names: Sequence[str], mapping: Mapping[str, str], source: str) -> dict[str, int]:
    strange = [name for name in mapping.values() if name not in names]
    if strange:
        raise InputError(
            f"mapping: {strange[0]}",
            got=f"no joint of {source}",
            expected=", ".join(names),
            fix="Correct the name in the mapping file.",
        )
    if "Hips" not in mapping or not {"LeftLeg", "RightLeg"} & set(mapping):
        raise InputError(
            "mapping",
            got=", ".join(mapping) or "no joints",
            expected="Hips, and LeftLeg or RightLeg",
            fix="Add them to the mapping file.",
        )
    return {target: list(names).index(name) for target, name in mapping.items()}


def _template(found: Mapping[str, int], names: Sequence[str]) -> dict[str, str]:
    return {target: names[found[target]] if target in found else "" for target in _TEMPLATE}


@functools.cache
def _documents() -> dict[str, dict]:
    return dict(json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8")))


def _names_of_tables() -> list[str]:
    return list(_documents())


@functools.cache
def _tables() -> tuple[dict[str, str], ...]:
    """For each kind of skeleton: key of a name -> joint here."""
    return tuple(dict(_entries(document)) for document in _documents().values())


def _entries(document: Mapping) -> Iterator[tuple[str, str]]:
    for side in ("Left", "Right"):
        for target, names in document["joints"].items():
            for name in [names] if isinstance(names, str) else names:
                yield name.replace("*", side), target.replace("*", side)
        templates = document["fingers"]
        for template in [templates] if isinstance(templates, str) else templates:
            yield from _fingers(template.replace("*", side), side, document["first"])


def _fingers(template: str, side: str, first: int) -> Iterator[tuple[str, str]]:
    for finger, spellings in _FINGERS.items():
        for spelling in spellings:
            yield from _phalanges(template.replace("{finger}", spelling), side, finger, first)


def _phalanges(stem: str, side: str, finger: str, first: int) -> Iterator[tuple[str, str]]:
    """Joints of one finger; `first` is the joint here that a finger's number 1 is, metacarpals apart."""
    count, start = (3, 1) if finger == "Thumb" else (4, first)
    for number in range(start, count + 1):
        yield f"{stem}{number - start + 1}", f"{side}Hand{finger}{number}"
    if first == 1:
        yield f"{stem}end", f"{side}Hand{finger}End"
        return
    yield f"{stem}0", f"{side}Hand{finger}1"
    for word, number in _PHALANGES.items():
        if number <= count:
            yield stem + word, f"{side}Hand{finger}{number}"
    if finger == "Thumb":
        yield f"{stem}distal", f"{side}HandThumb3"


def _key(name: str) -> str:
    """A name without what differs between files: ``mixamorig:LeftUpLeg`` and ``up_leg.L`` are the same."""
    bare = re.split(r"[:|/]", name)[-1]
    tokens = [token.lower() for token in _TOKENS.findall(bare)]
    while len(tokens) > 1 and tokens[0] in _PREFIXES:
        tokens = tokens[2:] if tokens[1].isdigit() and len(tokens) > 2 else tokens[1:]
    side = next((_SIDES[token] for token in tokens if token in _SIDES), "")
    if side:
        tokens.remove(next(token for token in tokens if token in _SIDES))
    elif tokens and len(tokens[0]) > 4:
        side, tokens[0] = _leading_side(tokens[0])
    return side + "".join(token.lstrip("0") or "0" if token.isdigit() else token for token in tokens)


def _leading_side(word: str) -> tuple[str, str]:
    for spelling in ("left", "right"):
        if word.startswith(spelling):
            return _SIDES[spelling], word[len(spelling) :]
    return "", word


def _one_below_the_other(match: Mapping[str, int], parents: np.ndarray) -> bool:
    """Whether each joint found hangs on the nearest of its ancestors that was found."""
    for target, joint in match.items():
        above = PARENT_NAMES[target]
        while above in PARENT_NAMES and above not in match:
            above = PARENT_NAMES[above]
        if above not in match:
            continue
        parent = int(parents[joint])
        while parent >= 0 and parent != match[above]:
            parent = int(parents[parent])
        if parent < 0:
            return False
    return True
