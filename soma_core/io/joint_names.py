"""Which joint of another skeleton is which of this one, told by their names."""

from __future__ import annotations

import json
import logging
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from soma_core.errors import AssetError, InputError
from soma_core.files import refuse_unreadable
from soma_core.io.joint_order import PARENT_NAMES, USER_JOINTS

__all__ = ["match_joints", "read_mapping"]

_log = logging.getLogger(__name__)

_TOKENS = re.compile(r"[LR](?=[UF]Arm)|[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+|[^\W\d_A-Za-z]+")
_SIDES = {"l": "Left", "left": "Left", "lft": "Left", "r": "Right", "right": "Right", "rgt": "Right"}
_LEADING = {"left": "Left", "right": "Right", "左": "Left", "右": "Right", "l": "Left", "r": "Right"}
_MIDDLE = {"c", "m"}
"""What stands in the place of a side in names of the trunk."""

_PREFIXES = {
    "mixamorig", "bip", "biped", "character", "ctrl", "def", "org", "j", "bind", "valve", "cc", "base",
    "skel", "jnt", "bn",
}  # fmt: skip
"""Words that rigs put before every name, and a number after them."""

_SUFFIXES = {"jnt", "joint", "bone"}

_COMMON = 0.75
"""Share of names with the same first or last word, from which on it says nothing."""

_HIPS = (
    ("hips", "pelvis", "hip", "spinebase", "センター"),
    ("root", "spine", "base", "waist", "腰"),
)
"""Words for Hips, and those that may be another joint, for where there is none of the first."""

_TRUNK: dict[str, tuple[str, ...]] = {
    "Neck1": ("neck", "neck0", "neck1", "lowerneck", "necklower", "necktwist1", "necka", "首"),
    "Head": ("head", "head1", "頭", "spine6"),
    "Jaw": ("jaw", "jawroot"),
}
_LIMBS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("Leg", ("upleg", "upperleg", "thigh", "femur", "thighbend", "upperleg1", "hip", "足")),
    ("Shin", ("shin", "lowerleg", "lowleg", "calf", "tibia", "lowerleg1", "knee", "ひざ")),
    ("Leg", ("leg",)),
    ("Shin", ("leg",)),
    ("Foot", ("ankle", "foot", "足首")),
    ("ToeBase", ("toebase", "toe", "toes", "ball", "toe0", "foot", "つま先")),
    ("Arm", ("upperarm", "uparm", "uarm", "shldr", "shldrbend", "humerus", "upperarm1")),
    (
        "ForeArm",
        ("forearm", "lowerarm", "lowarm", "farm", "radius", "forearmbend", "lowerarm1", "elbow", "ひじ"),
    ),
    ("Arm", ("arm", "腕", "shoulder")),
    ("Shoulder", ("clavicle", "clav", "collar", "collarbone", "scapula", "shoulder", "thorax", "肩")),
    ("Hand", ("wrist", "hand", "手首")),
    ("Eye", ("eye", "eyesmplhf", "faceeye")),
)
"""Words for joints of a side, in the order in which they are looked for; a joint is taken once. So ``leg`` is
the shin of an ``upleg``, and ``shoulder`` the collar bone of an ``upperarm`` but the arm of an ``elbow``."""

_FINGERS = {
    "Thumb": ("thumb",),
    "Index": ("index",),
    "Middle": ("middle", "mid"),
    "Ring": ("ring",),
    "Pinky": ("pinky", "little", "small"),
}

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

_MAIN = tuple(name for name in _TEMPLATE if not name.endswith(("Neck1", "Shoulder", "ToeBase")))
_MOST_BYTES = 1 << 20


def match_joints(
    names: Sequence[str],
    parents: np.ndarray,
    *,
    mapping: Mapping[str, str] | None = None,
    source: str = "names",
) -> dict[str, int]:
    """Find the joints of this skeleton among those of another.

    Case, separators, words that all names begin or end with, and the spelling of left and right do not
    matter. Joints must lie one below the other as here; Hips may have any name between head and legs.

    Args:
        names: of the other skeleton's joints.
        parents: (J,) index of each joint's parent, -1 for a root.
        mapping: name of a joint here -> name there; instead of the words that are known.
        source: what to name where they are refused.

    Returns:
        Name of a joint here -> index there. Joints of spine and neck follow from their place.

    Raises:
        InputError: names that are not known: the message holds the template of a mapping; or a mapping
            with a name that is none.
    """
    if mapping is not None:
        return _by_mapping(names, mapping, source)
    places: dict[str, int] = {}
    for joint, key in enumerate(_keys(names)):
        places.setdefault(key, joint)
    found = _own(places) or _known(places, parents)
    if not (
        _one_below_the_other(found, parents) and "Hips" in found and {"LeftLeg", "RightLeg"} & set(found)
    ):
        raise InputError(
            source,
            got=f"joints of unknown names: {', '.join(names[:12])}{' ...' if len(names) > 12 else ''}",
            expected="Hips and legs under names such as those of SOMA, Mixamo, LAFAN1, CMU, Xsens, 100STYLE, "
            "SMPL, VRM, Unity, Unreal, 3ds Max, Rigify or Daz",
            fix="Write which is which into a file, as far as there are such joints, and pass mapping=FILE:\n"
            + json.dumps(_template(found, names), indent=1),
        )
    _say_missing(found, names, parents, source)
    return found


def _say_missing(found: Mapping[str, int], names: Sequence[str], parents: np.ndarray, source: str) -> None:
    """Warn of main joints that no name tells, where joints of unknown names hang on those above them."""
    known = {joint: name for name, joint in found.items()}
    loose: dict[str, list[str]] = {}
    for joint, name in enumerate(names):
        above = next((known[each] for each in _above(joint, parents) if each in known), None)
        if joint not in known and above is not None:
            loose.setdefault(above, []).append(name)
    for target in _MAIN:
        above = PARENT_NAMES[target] if target != "Hips" else target
        while above not in found:
            above = PARENT_NAMES[above]
        if target not in found and above in loose:
            _log.warning(
                "%s: no joint is known as %s, which stays at rest; if it is one of %s, pass mapping=FILE",
                source, target, ", ".join(loose[above][:6]),
            )  # fmt: skip


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


def _own(places: Mapping[str, int]) -> dict[str, int]:
    """Joints under this skeleton's names, whose ``Leg`` is a thigh; none where they are another's."""
    own = {
        name: places[key] for name, key in zip(USER_JOINTS, _keys(USER_JOINTS), strict=True) if key in places
    }
    thighs = any(f"{side}{word}" in places for side in ("Left", "Right") for word in _LIMBS[0][1])
    return own if not thighs and any({f"{s}Leg", f"{s}Shin"} <= own.keys() for s in ("Left", "Right")) else {}


def _known(places: Mapping[str, int], parents: np.ndarray) -> dict[str, int]:
    """Joints under any words that are known."""
    found: dict[str, int] = {}
    for target, words in _TRUNK.items():
        _take(found, target, [places[word] for word in words if word in places])
    for side in ("Left", "Right"):
        for target, words in _LIMBS:
            _take(found, side + target, [places[side + word] for word in words if side + word in places])
        for key, target in _fingers(side, places):
            if key in places:
                _take(found, target, [places[key]])
    hips = _hips(places, found, parents)
    found |= {} if hips is None else {"Hips": hips}
    return {name: found[name] for name in USER_JOINTS if name in found}


def _take(found: dict[str, int], target: str, joints: Sequence[int]) -> None:
    """Take the first joint that is none of those found."""
    joint = next((joint for joint in joints if joint not in found.values()), None)
    if joint is not None:
        found.setdefault(target, joint)


def _hips(places: Mapping[str, int], found: Mapping[str, int], parents: np.ndarray) -> int | None:
    """The joint from which legs and trunk go: the lowest of a known name, else the lowest of all."""
    ways = {name: [joint, *_above(joint, parents)] for name, joint in found.items()}
    legs = [ways[name][1:] for name in ("LeftLeg", "RightLeg") if name in ways]
    tops = [ways[name] for name in ("Head", "Neck1", "LeftArm", "RightArm") if name in ways]
    if not legs:
        return next((places[word] for words in _HIPS for word in words if word in places), None)
    shared = [joint for joint in legs[0] if all(joint in way for way in legs)]
    trunk = [joint for joint in shared if all(joint in way for way in tops[:1])]
    for words in _HIPS:
        named = {places[word] for word in words if word in places}
        if lowest := [joint for joint in (*trunk, *shared) if joint in named]:
            return lowest[0]
    return trunk[0] if trunk and tops and len(legs) > 1 else None


def _above(joint: int, parents: np.ndarray) -> Iterator[int]:
    """Joints above one, from the next on."""
    while (joint := int(parents[joint])) >= 0:
        yield joint


def _fingers(side: str, places: Mapping[str, int]) -> Iterator[tuple[str, str]]:
    """Key of a name and joint here; numbers count from the first phalanx on, of thumbs from the hand."""
    for number, (finger, spellings) in enumerate(_FINGERS.items()):
        for stem in [form.format(each) for each in spellings for form in ("hand{}", "{}", "f{}", "inhand{}")]:
            for key, place in _phalanges(stem, finger, side, places):
                yield side + key, f"{side}Hand{finger}{place}"
        for place, end in enumerate(("", "1", "2")):  # 3ds Max
            yield f"{side}finger{number}.{end}", f"{side}Hand{finger}{place + 1 + (finger != 'Thumb')}"


def _phalanges(stem: str, finger: str, side: str, places: Mapping[str, int]) -> Iterator[tuple[str, int]]:
    """Keys of one finger and the numbers of its joints here; a thumb may be told from another joint on."""
    thumb = finger == "Thumb"
    first = f"{side}{stem}0" in places
    yield from ((f"{stem}{number}", number + (first or not thumb)) for number in (0, 1, 2, 3))
    words: tuple[str, ...] = ("metacarpal", "proximal", "intermediate", "distal")
    if thumb:
        words = words[1:] if f"{side}{stem}intermediate" in places else (*words[:2], "distal")
    yield from ((stem + word, place) for place, word in enumerate(words, start=1))
    if not thumb:
        yield stem, 1


def _keys(names: Sequence[str]) -> list[str]:
    """Names without what differs between files: ``mixamorig:LeftUpLeg`` and ``up_leg.L`` are the same."""
    rows = [_words(_TOKENS.findall(re.split(r"[:|/]", name)[-1])) for name in names]
    for end, rest in ((0, slice(1, None)), (-1, slice(None, -1))):
        while (common := _common([row[end] for row in rows if len(row) > 1], len(rows))) is not None:
            rows = [row[rest] if len(row) > 1 and row[end] == common else row for row in rows]
    sided = any(token in _SIDES for row in rows for token in row)
    return [_key([token for token in row if not (sided and token in _MIDDLE)] or row) for row in rows]


def _words(found: Sequence[str]) -> list[str]:
    """Words of a name in small letters, without those that rigs put before or behind every one."""
    tokens = [token.lower() for token in found]
    while len(tokens) > 1 and tokens[0] in _PREFIXES:
        tokens = tokens[2:] if tokens[1].isdigit() and len(tokens) > 2 else tokens[1:]
    return tokens[:-1] if len(tokens) > 1 and tokens[-1] in _SUFFIXES else tokens


def _common(words: Sequence[str], count: int) -> str | None:
    """The word that most of `count` names have, and that is no side and no number of its own."""
    word, times = Counter(words).most_common(1)[0] if words else ("", 0)
    return word if count > 2 and times >= _COMMON * count and word not in _SIDES else None


def _key(tokens: list[str]) -> str:
    side = next((_SIDES[token] for token in tokens if token in _SIDES), "")
    if side:
        tokens.remove(next(token for token in tokens if token in _SIDES))
    elif tokens:
        side, tokens[0] = _leading_side(tokens[0])
    if len(tokens) > 1 and tokens[-2] == "finger" and re.fullmatch(r"[0-4][12]?", tokens[-1]):
        return f"{side}finger{tokens[-1][0]}.{tokens[-1][1:]}"
    return side + "".join(token.lstrip("0") or "0" if token.isdigit() else token for token in tokens)


def _leading_side(word: str) -> tuple[str, str]:
    """Side and rest of a word that begins with it; of one letter only before a joint of a limb."""
    for spelling, side in _LEADING.items():
        rest = word.removeprefix(spelling)
        if rest and rest != word and (len(spelling) > 1 or not spelling.isascii() or rest in _OF_LIMBS):
            return side, rest
    return "", word


_OF_LIMBS = {word for _, words in _LIMBS for word in words}


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
