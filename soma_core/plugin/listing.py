"""How ``soma backends`` shows what is installed: as text for people, as JSON for programs."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from soma_core.paths import configs_dir
from soma_core.plugin.discovery import CORE_PACKAGE, config_folder
from soma_core.plugin.errors import BackendError
from soma_core.plugin.installation import local_source
from soma_core.plugin.known import KNOWN_BACKENDS
from soma_core.plugin.options import option_rows
from soma_core.plugin.registry import Entry, Registry
from soma_core.plugin.spec import API_VERSION, BackendSpec

__all__ = [
    "declaration",
    "declaration_text",
    "entries_json",
    "entries_text",
    "error_document",
    "known_text",
]


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Left-aligned columns, two spaces apart."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def entries_text(entries: Sequence[Entry], notes: Iterable[BackendError] = ()) -> str:
    """One line a backend with its state, then each error once; `notes` are errors of no single backend."""
    if not entries:
        return "no backends are installed"
    rows = [("BACKEND", "STATE", "DISTRIBUTION", "VERSION")]
    rows += [(entry.name, _state(entry), entry.distribution, entry.version) for entry in entries]
    errors = [str(entry.error) for entry in entries if entry.error] + [str(note) for note in notes]
    lines = _aligned(rows) + [line for error in dict.fromkeys(errors) for line in ("", error)]
    if any(entry.state == "found" for entry in entries):
        lines += ["", "found: not imported yet; soma backends --load tries each one"]
    return "\n".join(lines)


def _state(entry: Entry) -> str:
    return f"broken ({entry.error.stage})" if entry.state == "broken" and entry.error else entry.state


def entries_json(entries: Sequence[Entry]) -> str:
    """The same as a JSON list; `error` is null, or names stage, cause and fix."""
    return json.dumps(
        [
            {
                "name": entry.name,
                "state": entry.state,
                "distribution": entry.distribution,
                "version": entry.version,
                "error": None if entry.error is None else error_document(entry.error),
            }
            for entry in entries
        ],
        indent=2,
    )


def error_document(error: BackendError) -> dict[str, str]:
    """An error as JSON: stage, cause and fix."""
    return {"stage": error.stage, "cause": error.cause, "fix": error.fix}


def declaration(registry: Registry, name: str) -> dict[str, Any]:
    """Everything that the declaration of backend `name` says, and where it was found, ready for JSON.

    Raises:
        BackendError: the backend is unknown, blocked, in conflict, or fails to declare.
    """
    spec, offer = registry.spec(name), registry.offers(name)[0]
    source = local_source(offer.distribution)
    folder = configs_dir() if offer.package == CORE_PACKAGE else config_folder(offer)
    clash = registry.config_clashes().get(f"backend/{name}.yaml")
    config = folder / "backend" / f"{name}.yaml" if folder else None
    return {
        "name": spec.name,
        "description": spec.description,
        "distribution": offer.distribution,
        "version": offer.version,
        "source": source[0] if source else None,
        "plugin": offer.target,
        "config": str(config) if config and config.is_file() and clash is None else None,
        "config_error": error_document(clash) if clash else None,
        "api": spec.api,
        "licence": spec.licence,
        "url": spec.url,
        "unit": spec.unit,
        "up": spec.up,
        "forward": spec.forward,
        "wrap": _wrap(spec),
        "fill_segments": list(spec.fill_segments),
        "files": [
            {
                "path": str(item.path),
                "found": item.path.exists(),
                "description": item.description,
                "url": item.url,
                "command": item.command,
            }
            for item in spec.files
        ],
        "options": [
            {"name": row.name, "type": row.type, "default": row.default} for row in option_rows(spec.options)
        ],
        "params": [
            {
                "name": item.name,
                "shape": list(item.shape),
                "default": item.default,
                "range": list(item.range),
                "group": item.group,
                "description": item.description,
            }
            for item in spec.params
        ],
    }


def _wrap(spec: BackendSpec) -> dict[str, Any] | None:
    if spec.wrap is None:
        return None
    return {
        "native": str(spec.wrap.native),
        "wrap": str(spec.wrap.wrap),
        "up": spec.wrap_up or spec.up,
        "forward": spec.wrap_forward or spec.forward,
        "found": spec.wrap.native.is_file() and spec.wrap.wrap.is_file(),
        "statistics": None,
        "error": None,
    }


def declaration_text(document: Mapping[str, Any], *, every: bool = False) -> str:
    """What :func:`declaration` returned, for people: facts, options, files and parameters.

    Many parameters that differ in nothing but their names are one row, which names all if `every`.
    """
    source = f", installed from {document['source']}" if document["source"] else ""
    facts = [
        ("backend", document["name"]),
        ("about", document["description"]),
        ("distribution", f"{document['distribution']} {document['version']}{source}"),
        ("plugin", f"{document['plugin']} ({_api(document['api'])})"),
        ("config", document["config"] or _told(document["config_error"]) or "none: only for Python"),
        ("licence", document["licence"]),
        ("url", document["url"]),
        ("unit", document["unit"]),
        ("axes", f"{document['up']} up, {document['forward']} forward"),
        *_wrap_facts(document),
    ]
    lines = _aligned([(key, value) for key, value in facts if value])
    lines += _table("files that you supply", [_file_row(item) for item in document["files"]])
    lines += [f"  {line}" for line in _supplies(document["files"])]
    lines += _table("options (backend.options)", [_option_row(item) for item in document["options"]])
    groups = dict.fromkeys(item["group"] for item in document["params"])
    for group in groups:
        items = [item for item in document["params"] if item["group"] == group]
        lines += _parameters(group or "parameters (backend.params)", items, every=every)
    return "\n".join(lines)


_ALIKE = 10
"""Parameters that differ in nothing but their names are one row from here on."""


def _parameters(heading: str, items: Sequence[Mapping[str, Any]], *, every: bool) -> list[str]:
    """A table of parameters, or one row and the names where all of many say the same."""
    rows = [_parameter_row(item) for item in items]
    if len({row[1:] for row in rows}) > 1 or len(rows) < _ALIKE:
        return _table(heading, rows)
    shown = ", ".join(row[0] for row in (rows if every else rows[:_ALIKE]))
    more = "" if every or len(rows) == _ALIKE else f" and {len(rows) - _ALIKE} more: --all names them"
    names = textwrap.wrap(shown + more, 106, break_long_words=False, break_on_hyphens=False)
    return ["", f"{heading}: {len(rows)}, each {'  '.join(rows[0][1:])}", *(f"  {line}" for line in names)]


def _api(version: int) -> str:
    return f"api {version}" + (f", the newest is {API_VERSION}" if version < API_VERSION else "")


def _told(error: Mapping[str, str] | None) -> str:
    return f"cannot be used: {error['cause']}. {error['fix']}" if error else ""


def _wrap_facts(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    wrap = document["wrap"]
    filled = ", ".join(document["fill_segments"])
    if wrap is None:
        return [("wrap pair", "none: the vertices are those of the canonical mesh"), ("filled", filled)]
    facts = [("native mesh", wrap["native"]), ("wrap", wrap["wrap"])]
    if (wrap["up"], wrap["forward"]) != (document["up"], document["forward"]):
        facts.append(("wrap axes", f"{wrap['up']} up, {wrap['forward']} forward"))
    figures = wrap["statistics"]
    if figures:
        facts += [
            ("vertices", f"{figures['native_count']} native, {figures['wrap_count']} canonical"),
            (
                "wrap distance",
                f"mean {figures['mean_mm']:.2f} mm, 95 % below {figures['p95_mm']:.2f} mm, "
                f"at most {figures['max_mm']:.2f} mm from the native surface",
            ),
            (
                "wrap offset",
                f"from {figures['lowest_mm']:+.2f} mm (inside) to {figures['highest_mm']:+.2f} mm (outside)",
            ),
        ]
        filled += f" ({figures['filled_count']} vertices)" if filled else ""
    return [*facts, ("wrap state", _told(wrap["error"])), ("filled", filled)]


def _table(heading: str, rows: Sequence[Sequence[str]]) -> list[str]:
    return ["", f"{heading}: {len(rows)}", *(f"  {line}" for line in _aligned(rows))] if rows else []


def _file_row(item: Mapping[str, Any]) -> tuple[str, ...]:
    return ("found" if item["found"] else "missing", item["path"], item["description"])


def _supplies(files: Iterable[Mapping[str, Any]]) -> list[str]:
    """What to do about the first file that is missing: the others may come with it."""
    missing = next((item for item in files if not item["found"]), None)
    if missing is None:
        return []
    steps = [f"get it from {missing['url']}"] if missing["url"] else []
    steps += [f"run: {missing['command']}"] if missing["command"] else [f"put it at {missing['path']}"]
    return [f"next: {', then '.join(steps)}"]


def _option_row(item: Mapping[str, Any]) -> tuple[str, ...]:
    default = "must be given" if item["default"] is None else f"default {item['default']}"
    return (item["name"], item["type"], default)


def _parameter_row(item: Mapping[str, Any]) -> tuple[str, ...]:
    shape = "x".join(map(str, item["shape"])) or "scalar"
    low, high = item["range"]
    default = f"default {item['default']:g}"
    return (item["name"], shape, default, f"{low:g} to {high:g}", item["description"])


def known_text(installed: Iterable[str]) -> str:
    """The backends that the project knows of, with the licences of the models, for people."""
    there = set(installed)
    rows = [("BACKEND", "INSTALLED", "LICENCE OF THE MODEL", "MODEL", "YOU SUPPLY")]
    rows += [
        (each.name, "yes" if each.name in there else "no", each.licence, each.model, each.files or "nothing")
        for each in KNOWN_BACKENDS.values()
    ]
    return "\n".join([*_aligned(rows), "", "no index has them: pip install ./plugins/FOLDER in a checkout"])
