"""``soma backends``: what is installed and in what state, one backend in full, its checks, and a new one.

What imports a plugin runs in a child process: whatever a plugin does there costs its own row.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from soma_core.errors import InputError, SomaError
from soma_core.plugin import listing
from soma_core.plugin.child import EndedError, Say, run_in_child
from soma_core.plugin.errors import BackendError, BackendWarning, PluginError, Stage
from soma_core.plugin.known import KNOWN_BACKENDS
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.requirements import read_environment
from soma_core.progress import progress
from soma_core.tasks import EXIT_BACKEND, EXIT_FAILED, EXIT_OK, exit_code

if TYPE_CHECKING:
    from soma_core.rig import CanonicalMesh, Rig
    from soma_core.testing.report import Report

__all__ = ["load", "load_one", "run_verb", "show", "show_one"]

_LOADING_S, _CHECKING_S = 300.0, 900.0
"""Longest that a stage of a backend, or one of its checks, may take: the first reading of a large model."""

_HERE = "soma_core.tasks.backends"
_LOADS = ("soma_core.layer",)
_SHARED = "soma_core.testing.apart:make_what_is_shared"


def run_verb(arguments: Sequence[str], say: Callable[[str], None]) -> int:
    """Run ``soma backends <arguments>``, pass the result to `say`, and return the exit code.

    Whatever a plugin prints meanwhile goes to stderr. With ``--json`` the result is always JSON, an object
    ``{"error": ...}`` where there is none.

    Raises:
        SomaError: the backend is not usable, or an argument is refused, and ``--json`` was not asked for.
    """
    options = _parser().parse_args(arguments)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            text, code = options.verb(options)
    except SomaError as error:
        if not getattr(options, "json", False):
            raise
        told = listing.error_document(error) if isinstance(error, BackendError) else {"cause": str(error)}
        text, code = json.dumps({"error": told}, indent=2), exit_code(error)
    say(text)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="soma backends", description="What is installed, in what state.")
    verbs = parser.add_subparsers(title="verbs", metavar="VERB")
    one = verbs.add_parser("list", help="every backend and its state (the default)")
    for each in (parser, one):
        default = False if each is parser else argparse.SUPPRESS
        each.set_defaults(verb=_list)
        each.add_argument("--load", action="store_true", default=default, help="import and build each one")
        each.add_argument(
            "--requirements", action="store_true", default=default, help="pinned versions, for a bug report"
        )
    known = verbs.add_parser("known", help="backends of this project, and the licences of their models")
    known.set_defaults(verb=_known)
    show_one = verbs.add_parser("show", help="one backend: parameters, options, licence, files, wrap pair")
    convert = verbs.add_parser("convert", help="turn a file of a model's makers into what its backend reads")
    check = verbs.add_parser("check", help="run the conformance checks of one backend, or of all")
    new = verbs.add_parser("new", help="write a distribution to start a backend of your own from")
    for each, verb in ((show_one, _show), (convert, _convert), (check, _check), (new, _new)):
        each.set_defaults(verb=verb)
        each.add_argument("name", metavar="NAME", nargs="?" if each is check else None)
    show_one.add_argument("--all", action="store_true", help="every name of groups with many parameters")
    convert.add_argument("file", type=Path, metavar="FILE")
    convert.add_argument("--output", type=Path, metavar="FILE", help="default: where the backend looks")
    _add_choices_of_check(check)
    new.add_argument("--output", type=Path, default=Path(), metavar="DIR", help="default: the current folder")
    new.add_argument("--update", action="store_true", help="bring what is there to the newest template")
    for each in (parser, one, known, show_one, check):
        default = False if each is parser else argparse.SUPPRESS
        each.add_argument("--json", action="store_true", default=default, help="for programs")
    for each, limit in ((parser, _LOADING_S), (one, None), (show_one, _LOADING_S), (check, _CHECKING_S)):
        each.add_argument(
            "--timeout", type=float, default=limit or argparse.SUPPRESS, metavar="SECONDS",
            help=f"longest for a stage or a check; default: {limit or _LOADING_S:g}",
        )  # fmt: skip
    return parser


def _add_choices_of_check(check: argparse.ArgumentParser) -> None:
    check.add_argument("--all", action="store_true", help="every installed backend, a line for each")
    check.add_argument("--explain", metavar="ID", help="what a check looks at, and how to mend what it finds")
    check.add_argument("--level", choices=("core", "full"), default="full", help="default: %(default)s")
    check.add_argument(
        "-k", dest="only", metavar="ID", action="append", default=[], help="this check only; may be repeated"
    )


def _list(options: argparse.Namespace) -> tuple[str, int]:
    registry = default_registry()
    if options.requirements:
        names = [entry.distribution for entry in registry.entries()]
        environment = read_environment(names)
        return environment.json() if options.json else environment.text(), EXIT_OK
    names = list(registry.names()) if options.load else []
    for name in progress(names, label="loading backends", total=len(names), after=5.0):
        _load_apart(registry, name, options.timeout)
    entries = registry.entries()
    states = {"broken", "conflict"} if options.load else {"broken"}
    unusable = any(entry.state in states for entry in entries if entry.name != "-")
    clashes = dict.fromkeys(registry.config_clashes().values())
    text = listing.entries_json(entries) if options.json else listing.entries_text(entries, clashes)
    return text, EXIT_BACKEND if unusable else EXIT_OK


def _load_apart(registry: Registry, name: str, seconds: float) -> None:
    """Load a backend in a child, and tell the registry how far it came."""
    stage: Stage = "import"
    try:
        documents = run_in_child(f"{_HERE}:load_one", name, seconds=seconds, prepare=_SHARED, preload=_LOADS)
        for said in documents:
            stage = said.get("stage", stage)
            if "state" in said:
                told = said["error"]
                error = told and BackendError(who=said["who"], **told)
                registry.tell(name, said["state"], error)
    except EndedError as ended:
        with contextlib.suppress(BackendError):
            _raise_ended(registry, name, stage, ended)


def _raise_ended(registry: Registry, name: str, stage: Stage, ended: EndedError) -> NoReturn:
    """Raise the end of a child as an error of the backend that ended it."""
    fix = "Give it more time by --timeout SECONDS, or end what it waits for"
    with registry.isolated(name, stage):
        raise PluginError(str(ended), fix=fix if "no answer" in str(ended) else "") from ended
    raise AssertionError  # never here: the context raises


def load_one(say: Say, name: str) -> None:
    """In a child: load backend `name`, and say its stages, and how far it came."""
    warnings.simplefilter("ignore", BackendWarning)
    registry = default_registry()
    with contextlib.suppress(BackendError):
        load(registry, name, begun=lambda stage: say({"stage": stage}))
    (entry,) = [each for each in registry.entries() if each.name == name and each.state != "conflict"]
    told = entry.error and listing.error_document(entry.error)
    say({"state": entry.state, "error": told, "who": entry.error and entry.error.who})


def load(
    registry: Registry,
    name: str,
    *,
    canonical: tuple[CanonicalMesh, Rig] | None = None,
    begun: Callable[[Stage], object] = str,
) -> None:
    """Bring a backend as far as it goes: imported, declared, built, and one body made.

    `canonical` is another mesh and rig than the shipped ones; `begun` is called before each stage.

    Raises:
        BackendError: what is wrong with it; the registry records it too.
    """
    from soma_core.layer import SomaLayer

    begun("import")
    registry.spec(name)
    begun("build")
    layer = SomaLayer(name, kernels="torch", canonical=canonical, registry=registry)
    begun("rest")
    layer.identity()


def _known(options: argparse.Namespace) -> tuple[str, int]:
    if options.json:
        return json.dumps([asdict(each) for each in KNOWN_BACKENDS.values()], indent=2), EXIT_OK
    return listing.known_text(entry.name for entry in default_registry().entries()), EXIT_OK


def _show(options: argparse.Namespace) -> tuple[str, int]:
    registry = default_registry()
    registry.usable(options.name)
    document: dict[str, Any] = {}
    try:
        document.update(
            *run_in_child(f"{_HERE}:show_one", options.name, seconds=options.timeout, preload=_LOADS)
        )
    except EndedError as ended:
        _raise_ended(registry, options.name, "import", ended)
    if "refused" in document:
        raise BackendError(**document["refused"])
    text = (
        json.dumps(document, indent=2)
        if options.json
        else listing.declaration_text(document, every=options.all)
    )
    return text, EXIT_OK if all(item["found"] for item in document["files"]) else EXIT_BACKEND


def show_one(say: Say, name: str) -> None:
    """In a child: say the declaration of backend `name`, or why there is none."""
    warnings.simplefilter("ignore", BackendWarning)
    try:
        say(show(default_registry(), name))
    except BackendError as error:
        say({"refused": {"who": error.who, **listing.error_document(error)}})


def show(registry: Registry, name: str) -> dict[str, Any]:
    """The declaration of backend `name` with figures of its wrap pair, or with what is wrong with the pair.

    Raises:
        BackendError: the backend is unknown, blocked, in conflict, or fails to declare.
    """
    document, spec = listing.declaration(registry, name), registry.spec(name)
    if spec.wrap is None or not all(item["found"] for item in document["files"]):
        return document
    from soma_core.rig import load_canonical
    from soma_core.topology.wrap_statistics import wrap_statistics

    try:
        with registry.isolated(name, "wrap"):
            document["wrap"]["statistics"] = asdict(wrap_statistics(spec, load_canonical("mid")[0]))
    except BackendError as error:
        document["wrap"]["error"] = listing.error_document(error)
    return document


def _convert(options: argparse.Namespace) -> tuple[str, int]:
    written = default_registry().convert(options.name, options.file, options.output)
    return "\n".join(map(str, written)), EXIT_OK


def _check(options: argparse.Namespace) -> tuple[str, int]:
    if options.explain:
        from soma_core.testing.run import explained

        return explained(options.explain, as_json=options.json), EXIT_OK
    if options.all == (options.name is not None):
        raise InputError(
            "NAME", got=options.name or "none", expected="one backend, or --all of them",
            fix="soma backends lists the names.",
        )  # fmt: skip
    if options.all:
        return _check_all(options)
    report = _checked(options.name, options)
    return report.json() if options.json else report.text(), _report_code(report)


def _checked(name: str, options: argparse.Namespace) -> Report:
    from soma_core.testing.apart import check_apart

    registry = default_registry()
    registry.usable(name)
    try:
        return check_apart(name, level=options.level, only=options.only, seconds=options.timeout)
    except EndedError as ended:
        _raise_ended(registry, name, "import", ended)


def _report_code(report: Report) -> int:
    if report.failed:
        return EXIT_FAILED
    return EXIT_BACKEND if report.missing_files else EXIT_OK


def _check_all(options: argparse.Namespace) -> tuple[str, int]:
    """A line for each backend that SOMA_BACKENDS lets in, and what is wrong with it."""
    texts, documents, codes = [], [], [EXIT_OK]
    entries = default_registry().entries()
    out = {"-", *(entry.name for entry in entries if entry.state == "blocked")}
    for name in sorted({entry.name for entry in entries} - out):
        try:
            report = _checked(name, options)
        except SomaError as error:
            texts.append(str(error))
            documents.append({"backend": name, "passed": False, "error": str(error)})
            codes.append(exit_code(error))
        else:
            texts.append(report.brief())
            documents.append(report.document())
            codes.append(_report_code(report))
    return json.dumps(documents, indent=2) if options.json else "\n".join(texts), max(codes)


def _new(options: argparse.Namespace) -> tuple[str, int]:
    from soma_core.template import update_backend, write_backend

    if options.update:
        return "\n".join(update_backend(options.name, options.output)), EXIT_OK
    folder = write_backend(options.name, options.output)
    shown = f"./{folder}" if not folder.is_absolute() else str(folder)
    commands = [
        f"pip install -e {shlex.quote(shown)}",
        f"soma backends check {options.name}",
        f"soma animate backend={options.name}",
    ]
    return "\n".join([*commands, str(folder)]), EXIT_OK
