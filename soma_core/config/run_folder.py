"""What a run leaves beside its result: the configuration, the environment and the log."""

from __future__ import annotations

import importlib
import json
import logging
import os
import platform
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from soma_core.cache import atomic_text
from soma_core.errors import SomaError
from soma_core.paths import assets_dir
from soma_core.plugin.discovery import installed_versions
from soma_core.plugin.registry import default_registry
from soma_core.progress import PrintableFormatter
from soma_core.rig.manifest import read_manifest

__all__ = ["describe_environment", "run_log", "write_provenance"]

_log = logging.getLogger(__name__)


def _rig_revision() -> str:
    """Revision of the rig that the assets declare; empty where they are not built."""
    try:
        listed = read_manifest(assets_dir()).rig_revision
        return listed or importlib.import_module("soma_core.rig.canonical").load_canonical()[1].revision
    except SomaError as error:
        _log.warning("the assets name no rig revision (%s); run: soma assets verify", error)
        return ""


def describe_environment(config: DictConfig, *, command: Sequence[str]) -> dict[str, Any]:
    """What is needed to run it again: versions, rig, device, seed, SOMA_* variables, command line."""
    return {
        "command": list(command),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "rig_revision": _rig_revision(),
        "device": OmegaConf.select(config, "device", default=None),
        "seed": OmegaConf.select(config, "seed", default=None),
        "backends": [
            {"name": entry.name, "distribution": entry.distribution, "version": entry.version}
            for entry in default_registry().entries()
        ],
        "variables": {key: value for key, value in sorted(os.environ.items()) if key.startswith("SOMA_")},
        "distributions": dict(sorted(installed_versions().items(), key=lambda item: item[0].lower())),
    }


def write_provenance(folder: Path, config: DictConfig, *, command: Sequence[str]) -> None:
    """Write ``config.yaml`` and ``environment.json`` into `folder`."""
    text = OmegaConf.to_yaml(config, resolve=True)
    atomic_text(folder / "config.yaml", text)
    document = json.dumps(describe_environment(config, command=command), indent=2) + "\n"
    atomic_text(folder / "environment.json", document)


class _OwnRecords(logging.Filter):
    """Keep what SOMA and its backends say, and the warnings of everybody else."""

    def filter(self, record: logging.LogRecord) -> bool:
        return record.levelno >= logging.WARNING or record.name.startswith("soma_")


@contextmanager
def run_log(folder: Path) -> Iterator[None]:
    """Send log records to stderr and to ``log.txt`` in `folder` while the run lasts.

    An error that ends the run is written into the file with its traceback; the terminal gets the
    command line's one message instead.
    """
    root = logging.getLogger()
    level = root.level
    file = logging.FileHandler(folder / "log.txt", encoding="utf-8")
    file.setFormatter(PrintableFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    terminal = logging.StreamHandler(sys.stderr)
    terminal.setFormatter(PrintableFormatter("%(message)s"))
    handlers: list[logging.Handler] = [file, terminal]
    root.setLevel(min(level, logging.INFO))
    for handler in handlers:
        handler.addFilter(_OwnRecords())
        root.addHandler(handler)
    try:
        yield
    except BaseException as error:
        trace = sys.exc_info()
        file.handle(_log.makeRecord(_log.name, logging.ERROR, __file__, 0, "%r", (error,), trace))
        raise
    finally:
        for handler in handlers:
            root.removeHandler(handler)
            handler.close()
        root.setLevel(level)
