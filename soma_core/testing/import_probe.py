"""Declaring a backend in a fresh interpreter, to see what that imports and what it says."""

from __future__ import annotations

import importlib.metadata
import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from soma_core.plugin.discovery import Offer
from soma_core.plugin.errors import BackendError, BackendWarning
from soma_core.plugin.hookspecs import ENTRY_POINT_GROUP
from soma_core.plugin.registry import Registry
from soma_core.testing.global_state import changes, snapshot

__all__ = ["ImportProbe", "main", "probe_import"]

_LIMIT_S = 60
"""Far above any import; ends one that waits for input or for the network."""


@dataclass(frozen=True, kw_only=True)
class ImportProbe:
    """What declaring did.

    Attributes:
        packages: top-level packages that were imported.
        output: what was written to stdout and stderr, warnings included.
        error: what went wrong, or an empty text.
        changed: what is global in the process and was changed.
    """

    packages: frozenset[str]
    output: str
    error: str
    changed: tuple[str, ...] = ()


def probe_import(offer: Offer) -> ImportProbe:
    """Declare the backend of `offer` in an interpreter of its own, on the same import path."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with tempfile.TemporaryDirectory(prefix="soma-probe-") as name:
        folder = Path(name)
        command = [sys.executable, "-P", "-W", "default", "-m", __name__, offer.name, offer.target, name]
        try:
            code = subprocess.run(  # noqa: S603 - this interpreter and this module
                command, env=environment, cwd=folder, timeout=_LIMIT_S, stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False,
            ).returncode  # fmt: skip
        except subprocess.TimeoutExpired:
            return ImportProbe(packages=frozenset(), output="", error=f"no end within {_LIMIT_S} s")
        output = folder / "output.txt"
        said = output.read_text(encoding="utf-8", errors="replace").strip() if output.exists() else ""
        try:
            document = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return ImportProbe(packages=frozenset(), output=said, error=f"an end with exit code {code}")
    return ImportProbe(
        packages=frozenset(document["packages"]), output=said, error=document["error"],
        changed=tuple(document["changed"]),
    )  # fmt: skip


def _filters_of(package: str) -> list[str]:
    """Note where `package` itself adds warning filters from now on; libraries do when they are imported."""
    found: list[str] = []

    def watched(plain: Callable[..., None]) -> Callable[..., None]:
        def added(*given: Any, **named: Any) -> None:
            module = str(sys._getframe(1).f_globals.get("__name__"))
            found.extend([module] * (module.partition(".")[0] == package))
            plain(*given, **named)

        return added

    warnings.filterwarnings = watched(warnings.filterwarnings)
    warnings.simplefilter = watched(warnings.simplefilter)
    return found


def main(name: str, target: str, folder: str) -> None:
    """Declare backend `name` at entry point `target`; leave what was seen in `folder`."""
    warnings.simplefilter("ignore", BackendWarning)  # spoken by the core, not by the plugin
    point = importlib.metadata.EntryPoint(name=name, value=target, group=ENTRY_POINT_GROUP)
    registry = Registry([point], allowed=())
    with open(Path(folder) / "output.txt", "wb") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    own_filters = _filters_of(target.partition(":")[0].partition(".")[0])
    error, before = "", snapshot()
    try:
        registry.spec(name)
    except BackendError as reason:
        error = f"{reason.stage}: {reason.cause}"
    packages = sorted({module.partition(".")[0] for module in sys.modules})
    changed = [part for part in changes(before) if part != "the warning filters" or own_filters]
    document = {"packages": packages, "error": error, "changed": changed}
    (Path(folder) / "result.json").write_text(json.dumps(document))


if __name__ == "__main__":
    main(*sys.argv[1:])
