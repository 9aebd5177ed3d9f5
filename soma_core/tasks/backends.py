"""``soma backends``: what is installed and in what state, one backend in full, its checks, and a new one."""

from __future__ import annotations

import argparse
import contextlib
import json
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from soma_core.plugin import listing
from soma_core.plugin.errors import BackendError
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.requirements import read_environment
from soma_core.progress import progress
from soma_core.tasks import EXIT_BACKEND, EXIT_FAILED, EXIT_OK

if TYPE_CHECKING:
    from soma_core.rig import CanonicalMesh, Rig

__all__ = ["load_all", "run_verb", "show"]


def run_verb(arguments: Sequence[str], say: Callable[[str], None]) -> int:
    """Run ``soma backends <arguments>``, pass the result to `say`, and return the exit code.

    Whatever a plugin prints meanwhile goes to stderr, so that the result stays what a program can read.

    Raises:
        SomaError: the backend is not usable, or an argument is refused.
    """
    options = _parser().parse_args(arguments)
    with contextlib.redirect_stdout(sys.stderr):
        text, code = options.verb(options)
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
    show_one = verbs.add_parser("show", help="one backend: parameters, options, licence, files, wrap pair")
    convert = verbs.add_parser("convert", help="turn a file of a model's makers into what its backend reads")
    check = verbs.add_parser("check", help="run the conformance checks of one backend")
    new = verbs.add_parser("new", help="write a distribution to start a backend of your own from")
    for each, verb in ((show_one, _show), (convert, _convert), (check, _check), (new, _new)):
        each.set_defaults(verb=verb)
        each.add_argument("name", metavar="NAME")
    convert.add_argument("file", type=Path, metavar="FILE")
    convert.add_argument("--output", type=Path, metavar="FILE", help="default: where the backend looks")
    check.add_argument("--level", choices=("core", "full"), default="full", help="default: %(default)s")
    check.add_argument(
        "-k", dest="only", metavar="ID", action="append", default=[], help="this check only; may be repeated"
    )
    new.add_argument("--output", type=Path, default=Path(), metavar="DIR", help="default: the current folder")
    for each in (parser, one, show_one, check):
        default = False if each is parser else argparse.SUPPRESS
        each.add_argument("--json", action="store_true", default=default, help="for programs")
    return parser


def _list(options: argparse.Namespace) -> tuple[str, int]:
    registry = default_registry()
    if options.requirements:
        environment = read_environment(entry.distribution for entry in registry.entries())
        return environment.json() if options.json else environment.text(), EXIT_OK
    if options.load:
        load_all(registry)
    entries = registry.entries()
    broken = any(entry.state == "broken" for entry in entries)
    clashes = dict.fromkeys(registry.config_clashes().values())
    text = listing.entries_json(entries) if options.json else listing.entries_text(entries, clashes)
    return text, EXIT_BACKEND if broken else EXIT_OK


def load_all(registry: Registry, *, canonical: tuple[CanonicalMesh, Rig] | None = None) -> None:
    """Bring every usable backend as far as it goes: imported, declared, built, and one body made.

    What fails is recorded in the registry; with SOMA_STRICT=1 the first failure is raised. `canonical` is
    another mesh and rig than the shipped ones.
    """
    from soma_core.layer import SomaLayer

    names = registry.names()
    for name in progress(names, label="loading backends", total=len(names), after=5.0):
        with contextlib.suppress(BackendError):
            SomaLayer(name, kernels="torch", canonical=canonical, registry=registry).identity()


def _show(options: argparse.Namespace) -> tuple[str, int]:
    document = show(default_registry(), options.name)
    text = json.dumps(document, indent=2) if options.json else listing.declaration_text(document)
    return text, EXIT_OK if all(item["found"] for item in document["files"]) else EXIT_BACKEND


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
    from soma_core.testing import check_backend

    report = check_backend(options.name, level=options.level, only=options.only)
    text = report.json() if options.json else report.text()
    if report.failed:
        return text, EXIT_FAILED
    return text, EXIT_BACKEND if report.missing_files else EXIT_OK


def _new(options: argparse.Namespace) -> tuple[str, int]:
    from soma_core.template import write_backend

    folder = write_backend(options.name, options.output)
    commands = [
        f"pip install -e {shlex.quote(str(folder))}",
        f"soma backends check {options.name}",
        f"soma animate backend={options.name}",
    ]
    return "\n".join([*commands, str(folder)]), EXIT_OK
