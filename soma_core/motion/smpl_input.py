"""Files of the SMPL family as the settings of a conversion have them read."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from soma_core.io.amass import SmplMotion
from soma_core.io.rotation_vectors import in_radians
from soma_core.io.smpl_files import SmplChoices, read_smpl
from soma_core.io.smpl_skeleton import with_sides_swapped
from soma_core.motion.options import ConvertOptions

__all__ = ["SMPL_LAYOUTS", "chosen_reading", "smpl_choices", "smpl_motion"]

SMPL_LAYOUTS = ("amass", "smpl")
"""Layouts whose bodies are of the SMPL family."""

_SETTINGS = (
    "gender", "betas", "betas_from", "model", "person", "coordinates", "rotation_layout", "flat_hand_mean",
    "gaps", "longest_gap",
)  # fmt: skip
"""Options that choose how their files are read."""


def smpl_motion(path: Path, options: ConvertOptions, choices: SmplChoices) -> SmplMotion:
    """A file of the SMPL family, in radians and metres.

    Raises:
        SomaError: the file cannot be read.
    """
    motion = read_smpl(path, choices)
    motion = with_sides_swapped(motion) if options.swap_sides else motion
    return replace(
        motion,
        rotations=in_radians(path, motion.rotations, options.angles),
        translation=motion.translation * (options.metres or 1.0),
    )


def smpl_choices(options: ConvertOptions) -> SmplChoices:
    """How a file of the SMPL family is read; ``person=all`` of a file of one is that one."""
    given = {
        name: str(value) if isinstance(value, StrEnum) else value
        for name in _SETTINGS
        if (value := getattr(options, name)) is not None
    }
    if given.get("person") == "all":
        del given["person"]
    return SmplChoices(**given, up=options.upward, fps=options.fps)


def chosen_reading(options: ConvertOptions) -> dict[str, Any]:
    """Settings of the reading that are not those of every file, for the report."""
    plain = SmplChoices()
    read = vars(smpl_choices(options))
    names = [name for name in _SETTINGS if name != "gender" and read[name] != getattr(plain, name)]
    return {name: read[name] for name in names} | ({"swap_sides": True} if options.swap_sides else {})
