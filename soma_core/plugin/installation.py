"""How a distribution was installed, for messages that say what to run (PEP 610 metadata, read on demand)."""

from __future__ import annotations

import importlib.metadata
import json
import re
import shlex
from urllib.parse import urlsplit

from soma_core.plugin.discovery import CORE_DISTRIBUTION

__all__ = ["core_requirement", "editable_folder", "local_source", "reinstall_command"]

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
    """Return the pip line that installs `distribution` again from where it came, with what it needs."""
    source = local_source(distribution)
    if source is None:
        return f"pip install --upgrade {distribution}"
    path, editable = source
    return f"pip install {'-e' if editable else '--upgrade'} {shlex.quote(path)}"


def core_requirement(distribution: str) -> str:
    """Return the core that `distribution` asks for in its metadata, ``soma-body-core>=0.3`` for example."""
    try:
        lines = importlib.metadata.requires(distribution) or []
    except importlib.metadata.PackageNotFoundError:
        lines = []
    found = next(filter(None, map(_CORE.match, lines)), None)
    return CORE_DISTRIBUTION + (found["versions"].strip() if found else "")
