"""Where the shipped assets, the hydra configs and the user's cache live."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path, PurePosixPath

from soma_core.errors import InputError

__all__ = [
    "assets_dir",
    "assets_note",
    "cache_dir",
    "configs_dir",
    "data_dir",
    "expanded",
    "fitting",
    "model_folders",
    "shipped_assets",
]

_PACKAGE = Path(__file__).resolve().parent


def expanded(path: str | os.PathLike[str]) -> Path:
    """A path with ``~`` as the home folder, unless a file is called so or there is no such home."""
    path = Path(path)
    if not path.parts or not path.parts[0].startswith("~") or os.path.lexists(path):
        return path
    try:
        return path.expanduser()
    except RuntimeError:  # ~name of nobody on this machine: a file that is yet to be written
        return path


_LONGEST = 200
"""Bytes of the name of a file; systems take 255, and names of results are longer by up to 50."""


def fitting(name: str, *, longest: int = _LONGEST) -> str:
    """A relative path whose parts are short enough for a file system; what is cut has a digest in its place.

    Args:
        name: parts divided by ``/``.
        longest: bytes of a part.
    """
    parts = []
    for part in name.split("/"):
        told, suffix = os.fsencode(part), PurePosixPath(part).suffix
        if len(told) > longest:
            end = "-" + hashlib.sha256(told).hexdigest()[:12] + (suffix if len(suffix) <= 12 else "")
            part = told[: longest - len(os.fsencode(end))].decode(errors="ignore") + end
        parts.append(part)
    return "/".join(parts)


def _shipped(name: str) -> Path:
    """Folder `name` inside the installed wheel, or beside the package in a source checkout."""
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


def shipped_assets() -> Path:
    """Folder of the canonical assets that come with this package."""
    return _shipped("assets")


def assets_note() -> Path:
    """Where ``soma assets use`` writes which folder is to be used instead of the shipped one."""
    return data_dir() / "assets.txt"


def assets_dir() -> Path:
    """Folder of the canonical assets: SOMA_ASSETS, else that of ``soma assets use``, else the shipped one."""
    override = os.environ.get("SOMA_ASSETS")
    if override:
        return Path(override).expanduser()
    try:
        named = assets_note().read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError, InputError):
        named = ""
    return Path(named) if named else shipped_assets()


def configs_dir() -> Path:
    """Folder of the hydra configs that the core ships."""
    return _shipped("configs")


def cache_dir() -> Path:
    """Folder for derived data: SOMA_CACHE_DIR, else XDG_CACHE_HOME/soma_core, else ~/.cache/soma_core."""
    override = os.environ.get("SOMA_CACHE_DIR")
    if override:
        return Path(override).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else _home("SOMA_CACHE_DIR") / ".cache") / "soma_core"


def data_dir() -> Path:
    """Folder of models that the user supplies: SOMA_DATA_DIR, else XDG_DATA_HOME/soma_core, else the like.

    Nothing is put there but by a command that names it; the default is ~/.local/share/soma_core.
    """
    override = os.environ.get("SOMA_DATA_DIR")
    if override:
        return Path(override).expanduser()
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else _home("SOMA_DATA_DIR") / ".local" / "share") / "soma_core"


def model_folders(name: str) -> list[Path]:
    """Folders of a model's files, in any case: that of `data_dir`, there or not yet, then others there are.

    The published assets of SOMA, where they are in use, hold models and the wrap pairs that artists made.
    """
    roots = [data_dir(), *([assets_dir()] if assets_dir() != shipped_assets() else [])]
    found = [
        path
        for root in roots
        if root.is_dir()
        for path in sorted(root.iterdir())
        if path.name.lower() == name.lower() and path.is_dir()
    ]
    own = [path for path in found if path.parent == roots[0]]
    return found if own else [roots[0] / name, *found]


def _home(instead: str) -> Path:
    try:
        return Path.home()
    except RuntimeError as error:
        raise InputError(
            "HOME", got="no home folder", expected="one, for this user", fix=f"Set {instead}=FOLDER."
        ) from error
