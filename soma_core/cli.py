"""The ``soma`` command: verbs. A task is imported only when it is asked for."""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from soma_core._version import __version__
from soma_core.errors import InputError, SomaError
from soma_core.progress import PrintableFormatter, printable
from soma_core.tasks import EXIT_BACKEND, EXIT_FAILED, EXIT_OK, EXIT_USAGE, exit_code

if TYPE_CHECKING:
    from soma_core.config.compose import Task

__all__ = [
    "EXIT_BACKEND",
    "EXIT_FAILED",
    "EXIT_OK",
    "EXIT_PIPE",
    "EXIT_USAGE",
    "TASKS",
    "TaskRow",
    "console",
    "main",
]

EXIT_INTERRUPTED = 130
_PLACE = "Make room, give the right to it, or choose another folder: hydra.run.dir=FOLDER."
EXIT_PIPE = 141
"""What a shell reports for a program whose reader went away, as in ``soma --help | head -1``."""


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
    "invert": TaskRow(
        module="invert", summary="find the pose of every frame of a moving mesh, errors in millimetres"
    ),
    "convert": TaskRow(
        module="convert", summary="bring motions of AMASS, SAM 3D Body and kimodo to this skeleton, and back"
    ),
    "clean": TaskRow(
        module="clean", summary="smooth a motion, replace spikes, resample, mirror; jitter and foot slide"
    ),
    "wrap": TaskRow(module="wrap", summary="lay the canonical mesh on any human mesh: an OBJ pair, a report"),
    "train-shape": TaskRow(
        module="train_shape", summary="learn the native shape space from installed backends"
    ),
    "train-correctives": TaskRow(
        module="train_correctives",
        summary="learn pose correctives from a teacher: elastic skin, or a backend",
    ),
    "evaluate": TaskRow(module="evaluate", summary="measure a claim of the paper, in millimetres"),
    "export-model": TaskRow(
        module="export_model",
        summary="write a body model as ONNX and torch.export, for use without this package",
    ),
    "bench": TaskRow(module="bench", summary="time the forward path, correctness first"),
    "view": TaskRow(module="view", summary="serve a page that shows bodies, poses them and plays motions"),
}


def _say(text: str) -> None:
    sys.stdout.write(printable(text) + "\n")
    sys.stdout.flush()


def _complain(text: str) -> None:
    sys.stderr.write(printable(f"soma: {text}\n"))


def _usage() -> str:
    width = max(map(len, TASKS)) + 2
    rows = [f"  {name:<{width}}{row.summary}" for name, row in TASKS.items()]
    return "\n".join(
        [
            "usage: soma <task> [key=value ...]",
            "       soma backends [list | known | show NAME | check NAME | new NAME] [--json]",
            "       soma points [list | show NAME [--picture FILE.png] | check NAME]",
            "       soma assets [verify | show | use | path | landmarks]",
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
    from soma_core.plugin.registry import default_registry

    row = TASKS[name]
    codes = [EXIT_OK]

    def report(outcome: Path | SomaError) -> None:
        if isinstance(outcome, SomaError):
            _complain(str(outcome))
            codes.append(exit_code(outcome))
        else:
            _say(_shown(outcome))

    with default_registry().making_wraps(_make_missing_wrap):
        run_task(row.load, config_name=row.module, program=f"soma {name}", overrides=overrides, report=report)
    return max(codes)


def _make_missing_wrap(name: str, options: Mapping[str, Any]) -> None:
    """Registration is imported when a backend lacks its wrap."""
    importlib.import_module("soma_core.registration.missing_wrap").make_missing_wrap(name, options)


def _shown(folder: Path) -> str:
    """Path as a person in the current folder would type it."""
    here = Path.cwd()
    return str(folder.relative_to(here) if folder.is_relative_to(here) else folder)


def _backends(arguments: Sequence[str]) -> int:
    return importlib.import_module("soma_core.tasks.backends").run_verb(arguments, _say)


def _points(arguments: Sequence[str]) -> int:
    return importlib.import_module("soma_core.tasks.points").run_verb(arguments, _say)


def _assets(arguments: Sequence[str]) -> int:
    from soma_core.paths import assets_dir

    parser = argparse.ArgumentParser(
        prog="soma assets", description="The canonical mesh, rig and shape space."
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    verify = verbs.add_parser("verify", help="check every file against MANIFEST.json")
    verify.add_argument("--root", type=Path, default=assets_dir(), help="folder (default: %(default)s)")
    verbs.add_parser("path", help="print the folder")
    landmarks = verbs.add_parser("landmarks", help="list the named points of the canonical mesh")
    landmarks.add_argument("picture", type=Path, nargs="?", help="PNG file to draw them into")
    show = verbs.add_parser("show", help="what a folder holds, what can be used of it, what is missing")
    show.add_argument("root", type=Path, nargs="?", metavar="FOLDER", help="default: the one in use")
    use = verbs.add_parser("use", help="use another folder from now on, such as the published assets of SOMA")
    use.add_argument("root", metavar="FOLDER|shipped", help="the folder; shipped: that of this package")
    options = parser.parse_args(arguments)
    if options.verb == "path":
        _say(str(assets_dir()))
        return EXIT_OK
    task = importlib.import_module("soma_core.tasks.assets")
    if options.verb == "show":
        _say("\n".join(task.show_assets(options.root)))
    elif options.verb == "landmarks":
        _say(task.list_landmarks(options.picture))
    elif options.verb == "use":
        _say(task.use_assets(options.root))
    else:
        checked = task.verify_assets(options.root)
        state = "are what MANIFEST.json says" if (options.root / "MANIFEST.json").is_file() else "can be read"
        _say(f"{options.root}: {len(checked)} files {state}")
    return EXIT_OK


_VERBS: dict[str, Callable[[Sequence[str]], int]] = {
    "assets": _assets,
    "backends": _backends,
    "points": _points,
}


def _dispatch(arguments: Sequence[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        _say(_usage())
        return EXIT_OK if arguments else EXIT_USAGE
    verb, rest = arguments[0], arguments[1:]
    if verb in ("-V", "--version"):
        _say(f"soma-body-core {__version__}")
        return EXIT_OK
    if verb in TASKS or verb in _VERBS:
        from soma_core.plugin.registry import default_registry

        default_registry()  # before PyTorch is imported, which dies of damage that this steps around
        return _run_task(verb, rest) if verb in TASKS else _VERBS[verb](rest)
    from soma_core.plugin.declaration import did_you_mean

    known = [*TASKS, *_VERBS]
    fix = did_you_mean(verb, known) or "See: soma --help"
    raise InputError("command", got=verb, expected=f"one of {', '.join(known)}", fix=fix)


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
        return exit_code(error)
    except BrokenPipeError:
        raise
    except OSError as error:  # a full disk, a folder that may not be written: no defect
        if os.environ.get("SOMA_STRICT") == "1" or error.errno is None:
            raise
        _complain(f"{error.filename or 'a file'}: {error.strerror}. {_PLACE}")
        return EXIT_FAILED
    except KeyboardInterrupt:
        _complain("interrupted")
        return EXIT_INTERRUPTED


def _warning_text(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """A backend's warning as one line; everybody else's as Python writes it."""
    from soma_core.plugin.errors import BackendWarning

    if issubclass(category, BackendWarning):
        return printable(f"soma: {message}\n")
    return printable(_PYTHON_WARNING_TEXT(message, category, filename, lineno, line))


_PYTHON_WARNING_TEXT = warnings.formatwarning


def console() -> None:
    """Entry point of the console script."""
    if "torch" not in sys.modules:  # whose threads otherwise wait awake, in the way of those of the kernels
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    warnings.formatwarning = _warning_text
    if logging.lastResort:
        logging.lastResort.setFormatter(PrintableFormatter("%(message)s"))
    try:
        code: int | str | None = main(sys.argv[1:])
    except SystemExit as stop:  # hydra and argparse end the process once they have printed their help
        code = stop.code
    except BrokenPipeError:
        code = EXIT_PIPE
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        code = EXIT_PIPE
    if code == EXIT_PIPE:  # the interpreter flushes once more at its end; let it have somewhere to write
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)
