"""JSON of strangers: its length is bounded, and brackets that nest too deep are an error like any other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from soma_core.errors import AssetError
from soma_core.files import refuse_unreadable

__all__ = ["parse_json", "read_json"]

_MOST_BYTES = 16 * 2**20
"""Twenty times as many are in memory where it is all brackets."""


def parse_json(text: str | bytes) -> Any:
    """Values of a JSON text.

    Raises:
        ValueError: no JSON, too long, or nested too deep.
    """
    if len(text) > _MOST_BYTES:
        raise ValueError(f"JSON of {len(text)} bytes, more than {_MOST_BYTES}")
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("brackets nested too deep") from error


def read_json(path: Path | str, *, fix: str) -> Any:
    """Values of a JSON file in UTF-8.

    Raises:
        AssetError: missing, no regular file, a git-LFS pointer, too long, or no JSON.
    """
    refuse_unreadable(path, fix=fix, most_bytes=_MOST_BYTES)
    try:
        return parse_json(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise AssetError(path, cause=f"not valid JSON ({error})", fix=fix) from error
