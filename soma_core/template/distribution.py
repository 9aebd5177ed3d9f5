"""Write the distribution of a new backend: texts from templates, meshes from the canonical mesh."""

from __future__ import annotations

import hashlib
import json
import keyword
import re
import shutil
import string
import tempfile
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

import numpy as np

from soma_core.cache import atomic_text
from soma_core.errors import InputError
from soma_core.json_file import read_json
from soma_core.obj import write_obj
from soma_core.plugin.discovery import CORE_DISTRIBUTION, normalised
from soma_core.plugin.registry import Registry, default_registry
from soma_core.rig import load_canonical

__all__ = ["TEMPLATE_VERSION", "update_backend", "write_backend"]

TEMPLATE_VERSION = 2
"""Grows with each change to the files that are written."""

_RECORD = ".soma-template.json"
"""Says of which version the written texts are, with hashes by which an update knows what was changed."""

_NAME = re.compile(r"[a-z][a-z0-9_]*")
_WORDS = {"all", "null", "none", "true", "false", "yes", "no", "on", "off", "nan", "inf"}
"""Names that the command line or YAML reads as something else."""

_TEMPLATES = {
    "pyproject.toml": "pyproject.toml.in",
    "README.md": "README.md.in",
    "LICENSE": "LICENSE.in",
    "$package/__init__.py": "__init__.py.in",
    "$package/_generator.py": "_generator.py.in",
    "$package/configs/backend/$name.yaml": "config.yaml.in",
    "tests/test_$name.py": "test.py.in",
    ".github/workflows/test.yml": "ci.yml.in",
}
"""Path in the distribution -> template in ``files/``."""


def write_backend(name: str, folder: Path | str = ".", *, registry: Registry | None = None) -> Path:
    """Write the distribution ``soma-backend-<name>`` into `folder` and return where it is.

    It is a working backend around a linear model with two coefficients, in metres, +Y up, facing +Z. Its
    native mesh is the low level of detail of the canonical mesh, and its wrap is the mid level. It appears
    whole or not at all.

    Args:
        name: of the backend: lower-case letters, digits and underscores.
        folder: where the new folder goes; made if need be.
        registry: whose backends' names are taken; by default what is installed.

    Raises:
        InputError: a name that will not do or is taken, a folder that exists or cannot be written.
    """
    _check_name(name, registry or default_registry())
    target = Path(folder) / _distribution(name)
    if target.exists():
        raise InputError(
            "folder", got=str(target), expected="a folder that does not exist yet",
            fix="Remove it, or write the backend elsewhere.",
        )  # fmt: skip
    try:
        _write(target, name)
    except OSError as error:
        raise InputError(
            "folder", got=f"{folder} ({error.strerror})", expected="a folder to write into",
            fix="Write the backend elsewhere.",
        ) from error  # fmt: skip
    return target


def _write(target: Path, name: str) -> None:
    """Write everything beside `target`, then move it there."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}-") as temporary:
        made = Path(temporary) / target.name
        _write_texts(made, name)
        _write_model(made / f"soma_backend_{name}")
        shutil.move(made, target)


def _check_name(name: str, registry: Registry) -> None:
    if not _NAME.fullmatch(name):
        wish = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_").lstrip("0123456789_")
        raise InputError(
            "name", got=repr(name), expected="lower-case letters, digits and underscores, a letter first",
            fix=f'For example "{wish or "acme"}".',
        )  # fmt: skip
    if keyword.iskeyword(name) or name in _WORDS:
        raise InputError(
            "name", got=repr(name), expected="no word of Python, YAML or the command line",
            fix=f'For example "{name}_model".',
        )  # fmt: skip
    for entry in registry.entries():
        if entry.name == name:
            ours = normalised(entry.distribution) == CORE_DISTRIBUTION
            other = "" if ours else f", or run: pip uninstall {entry.distribution}"
            raise InputError(
                "name", got=f'"{name}", which {entry.distribution} {entry.version} offers',
                expected="a name that no installed backend has",
                fix=f"Choose another{other}.",
            )  # fmt: skip


def _texts(name: str) -> dict[str, str]:
    """What the template says today: path in the distribution -> text."""
    words = name.split("_")
    values = {
        "name": name,
        "package": f"soma_backend_{name}",
        "distribution": _distribution(name),
        "title": " ".join(words).capitalize(),
        "camel": "".join(word.capitalize() for word in words),
    }
    return {
        string.Template(path).substitute(values): string.Template(
            files(__package__).joinpath("files", template).read_text(encoding="utf-8")
        ).substitute(values)
        for path, template in _TEMPLATES.items()
    }


def _distribution(name: str) -> str:
    return f"soma-backend-{name.replace('_', '-')}"


def _record_of(texts: Mapping[str, str]) -> str:
    hashes = {path: _hash(text) for path, text in texts.items()}
    return json.dumps({"template": TEMPLATE_VERSION, "files": hashes}, indent=2) + "\n"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _write_texts(folder: Path, name: str) -> None:
    texts = _texts(name)
    for path, text in {**texts, _RECORD: _record_of(texts)}.items():
        atomic_text(folder / path, text)


def update_backend(name: str, folder: Path | str = ".") -> list[str]:
    """Bring the texts of a distribution that :func:`write_backend` wrote to the newest template.

    What its author did not change is written anew. Beside a changed file whose template moved on, the new
    text is laid as ``FILE.new``. Meshes and the model are the author's.

    Args:
        name: of the backend.
        folder: the distribution, or where it lies.

    Returns:
        A line for each file that was written, and how the versions stand.

    Raises:
        InputError: no distribution that was written from a template.
    """
    target = next(
        (each for each in (Path(folder), Path(folder) / _distribution(name)) if (each / _RECORD).is_file()),
        None,
    )
    if target is None:
        raise InputError(
            "folder", got=str(folder), expected=f"one that holds {_distribution(name)} with its {_RECORD}",
            fix="Pass --output FOLDER.",
        )  # fmt: skip
    before = read_json(target / _RECORD, fix="Delete it, and compare with: soma backends new")
    told, kept = [], dict(before["files"])
    for path, text in _texts(name).items():
        file = target / path
        mine = _hash(file.read_text(encoding="utf-8")) if file.is_file() else None
        if mine == _hash(text) or kept.get(path) == _hash(text):
            continue  # as it is today, or nothing new since the author changed it
        unchanged = mine is None or mine == kept.get(path)
        place = file if unchanged else file.with_name(f"{file.name}.new")
        atomic_text(place, text)
        told.append(f"wrote {place}" + ("" if unchanged else f": {file.name} is changed, merge them"))
    atomic_text(target / _RECORD, _record_of(_texts(name)))
    return [*told, f"template {before['template']} -> {TEMPLATE_VERSION}"]


def _write_model(folder: Path) -> None:
    """Write the wrap pair and the linear model; the model's mesh is the canonical one at its low LOD."""
    native, wrap = load_canonical("low")[0], load_canonical("mid")[0]
    for name, mesh in (("native.obj", native), ("SOMA_wrap.obj", wrap)):
        write_obj(folder / name, mesh.vertices, mesh.triangles, digits=6)
    template = native.vertices.round(6)
    directions = np.stack([0.05 * template, 0.08 * template * [1, 0, 1]])
    np.savez_compressed(folder / "model.npz", template=template, directions=directions)
