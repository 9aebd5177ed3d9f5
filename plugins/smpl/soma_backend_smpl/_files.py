"""Where the files of a model lie: names as their makers and their users write them, in any case."""

from __future__ import annotations

import re
from pathlib import Path

from soma_backend_smpl.family import GENDERS, Family
from soma_core.plugin import data_dir, model_folders

__all__ = ["SUFFIXES", "canonical_path", "find_models", "gender_of", "wrap_paths"]

SUFFIXES = (".npz", ".pkl")
_SHORT = {"m": "male", "f": "female"}


def gender_of(path: Path, *families: Family) -> str | None:
    """Gender that the name of a file of these models tells, or its folder for ``<gender>/model.npz``."""
    match = re.fullmatch("|".join(family.pattern for family in families), path.stem, re.IGNORECASE)
    if match:
        told = next(group for group in match.groups() if group).lower()
        return _SHORT.get(told, told)
    folder = path.parent.name.lower()
    return folder if path.stem.lower() == "model" and folder in GENDERS else None


def find_models(family: Family) -> dict[str, Path]:
    """Gender -> file, for each model of the family in the data folder, or else in published assets.

    The folder's own files come before those in its folders of a gender, ``.npz`` before ``.pkl``, and of
    two versions the newer.
    """
    found: dict[str, Path] = {}
    for folder in filter(Path.is_dir, model_folders(family.folder)):
        files = [
            *folder.iterdir(),
            *(file for gender in GENDERS for file in (folder / gender).glob("model.*")),
        ]
        files = [file for file in files if file.suffix.lower() in SUFFIXES and gender_of(file, family)]
        for file in sorted(files, key=lambda file: _preference(file, folder, family)):
            found.setdefault(gender_of(file, family) or "", file)
    return found


def _preference(file: Path, folder: Path, family: Family) -> tuple[object, ...]:
    canonical = file.stem.lower().startswith(f"{family.name}_") and not file.stem.endswith("_2020")
    version = [-int(digits) for digits in re.findall(r"\d+", file.stem)]
    return (file.parent != folder, file.suffix.lower() != ".npz", not canonical, version, file.name)


def canonical_path(family: Family, gender: str) -> Path:
    """Where a converted model goes."""
    return data_dir() / family.folder / f"{family.name.upper()}_{gender.upper()}.npz"


def wrap_paths(family: Family) -> tuple[Path, Path]:
    """The native mesh and the wrap: an official pair, or the one that ``soma wrap`` writes."""
    pairs = [
        (folder / "base_body.obj", folder / "SOMA_wrap.obj") for folder in model_folders(family.wrap_folder)
    ]
    return next((pair for pair in pairs if all(path.is_file() for path in pair)), pairs[0])
