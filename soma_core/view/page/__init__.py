"""A page that shows a moving body in any browser, without a server and without a network."""

from __future__ import annotations

import base64
import gzip
import html
from pathlib import Path

from soma_core.cache import atomic_text
from soma_core.errors import InputError
from soma_core.io.clip import SkinnedClip
from soma_core.io.gltf import gltf_bytes

__all__ = ["write_page"]

_HERE = Path(__file__).parent


def write_page(path: str | Path, clip: SkinnedClip) -> None:
    """Write one HTML file with the body, its motion and what shows them: orbit, timeline, skeleton, facts.

    The page holds the GLB of ``write_gltf`` and evaluates it with every influence and every morph target,
    so that vertices are where the model has them. Everything is in the file: three.js (MIT License) draws.

    Args:
        path: an ``.html`` file.
        clip: what to show.

    Raises:
        InputError: another suffix.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError("path", got=repr(path.name), expected="an .html file", fix="Change the suffix.")
    packed = gzip.compress(gltf_bytes(clip), compresslevel=6, mtime=0)
    filled = {
        "title": html.escape(clip.name),
        "body": base64.b64encode(packed).decode(),
        "three": (_HERE / "three.js").read_text(encoding="utf-8"),
        "page": (_HERE / "page.js").read_text(encoding="utf-8"),
    }
    page = (_HERE / "page.html").read_text(encoding="utf-8")
    pieces = page.split("{{")
    text = pieces[0] + "".join(
        filled[name] + rest for name, _, rest in (piece.partition("}}") for piece in pieces[1:])
    )
    atomic_text(path, text)
