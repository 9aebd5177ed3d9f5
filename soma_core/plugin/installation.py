"""How a distribution was installed, for messages that say what to run (PEP 610 metadata, read on demand)."""

from __future__ import annotations

import importlib.metadata
import json
import re
import shlex
from urllib.parse import urlsplit

from soma_core.plugin.discovery import CORE_DISTRIBUTION, normalised
from soma_core.plugin.known import publication

__all__ = [
    "core_requirement",
    "editable_folder",
    "local_source",
    "newer_core",
    "reinstall_command",
    "requirement_of_module",
]

_CORE = re.compile(
    r"soma[-_.]body[-_.]core(?![-_.\w])\s*(?:\[[^]]*])?\s*\(?(?P<versions>[^;)]*)", re.IGNORECASE
)


def local_source(distribution: str) -> tuple[str, bool] | None:
    """Folder or file that pip installed from, and whether it is editable; None: an index, or not by pip."""
    from urllib.request import url2pathname  # brings the whole HTTP client along

    try:
        text = importlib.metadata.distribution(distribution).read_text("direct_url.json")
        document = json.loads(text or "null")
        url = urlsplit(document["url"])
        editable = bool(document.get("dir_info", {}).get("editable"))
    except (
        importlib.metadata.PackageNotFoundError, ValueError, TypeError, KeyError, AttributeError,
        RecursionError,
    ):  # fmt: skip
        return None
    return (url2pathname(url.path), editable) if url.scheme == "file" else None


def editable_folder(distribution: str) -> str | None:
    """Return the checkout that an editable install points to, or None."""
    source = local_source(distribution)
    return source[0] if source and source[1] else None


def reinstall_command(distribution: str) -> str:
    """Return what to do to install `distribution` again from where it came, with what it needs.

    No line names a package of this project as if an index had it: none is published.
    """
    source = local_source(distribution)
    if source is not None:
        path, editable = source
        return f"Run: pip install {'-e' if editable else '--upgrade'} {shlex.quote(path)}"
    return publication(distribution) or f"Run: pip install --upgrade {distribution}"


def core_requirement(distribution: str) -> str:
    """Return the core that `distribution` asks for in its metadata, ``soma-body-core>=0.3`` for example."""
    try:
        lines = importlib.metadata.requires(distribution) or []
    except importlib.metadata.PackageNotFoundError:
        lines = []
    found = next(filter(None, map(_CORE.match, lines)), None)
    return CORE_DISTRIBUTION + (found["versions"].strip() if found else "")


def newer_core(distribution: str) -> str:
    """Return what to do where `distribution` needs a later core than this one."""
    wanted, source = core_requirement(distribution), local_source(CORE_DISTRIBUTION)
    named = shlex.quote(wanted) if wanted != CORE_DISTRIBUTION else f"a newer {CORE_DISTRIBUTION}"
    if source is None:
        return f"Install {named}, from where this core came"
    path, editable = source
    pulled = f"Update the core to {named}: in {path}, git pull"
    return pulled if editable else f"Install {named} in place of {path}"


_MODULES = {
    "PIL": "pillow", "cv2": "opencv-python", "skimage": "scikit-image", "sklearn": "scikit-learn",
    "yaml": "PyYAML",
}  # fmt: skip
"""Packages that are installed under another name than they are imported by."""

_REQUIREMENT = re.compile(r"\s*(?P<name>[A-Za-z0-9][A-Za-z0-9._-]*)\s*\(?(?P<versions>[<>=!~][^;)]*)?")


def requirement_of_module(package: str, distribution: str) -> str:
    """Return what pip installs to bring the top-level `package` that `distribution` imports."""
    wanted = _MODULES.get(package, package)
    try:
        lines = importlib.metadata.requires(distribution) or []
    except importlib.metadata.PackageNotFoundError:
        lines = []
    for found in filter(None, map(_REQUIREMENT.match, lines)):
        if normalised(found["name"]) == normalised(wanted):
            return found["name"] + (found["versions"] or "").replace(" ", "")
    return wanted
