"""How ``soma backends`` shows what is installed: as text for people, as JSON for programs."""

from __future__ import annotations

import json
from collections.abc import Sequence

from soma_core.plugin.registry import Entry
from soma_core.plugin.spec import BackendSpec, Parameter

__all__ = ["entries_json", "entries_text", "spec_json", "spec_text"]


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Left-aligned columns, two spaces apart."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def entries_text(entries: Sequence[Entry]) -> str:
    """One line a backend, and below it what is wrong with it."""
    if not entries:
        return "no backends are installed"
    rows = [("BACKEND", "STATE", "DISTRIBUTION", "VERSION")]
    rows += [(entry.name, entry.state, entry.distribution, entry.version) for entry in entries]
    lines = _aligned(rows)
    for entry in entries:
        if entry.error is not None and str(entry.error) not in lines:
            lines.append(str(entry.error))
    return "\n".join(lines)


def entries_json(entries: Sequence[Entry]) -> str:
    """The same as a JSON list; `error` is null, or names stage, cause and fix."""
    return json.dumps(
        [
            {
                "name": entry.name,
                "state": entry.state,
                "distribution": entry.distribution,
                "version": entry.version,
                "error": None
                if entry.error is None
                else {"stage": entry.error.stage, "cause": entry.error.cause, "fix": entry.error.fix},
            }
            for entry in entries
        ],
        indent=2,
    )


def _parameter_row(item: Parameter) -> tuple[str, ...]:
    shape = "x".join(map(str, item.shape)) or "scalar"
    low, high = item.range
    return ("  " + item.name, shape, f"default {item.default:g}", f"{low:g} to {high:g}", item.description)


def spec_text(spec: BackendSpec) -> str:
    """The declaration of one backend: units, axes, licence, files and parameters by group."""
    wrap = (
        f"{spec.wrap.native} and {spec.wrap.wrap}" if spec.wrap else "none: the topology is the canonical one"
    )
    facts = [
        ("backend", spec.name),
        ("about", spec.description),
        ("unit", spec.unit),
        ("axes", f"{spec.up} up, {spec.forward} forward"),
        ("licence", spec.licence),
        ("url", spec.url),
        ("wrap pair", wrap),
        ("filled", ", ".join(spec.fill_segments)),
        ("api", str(spec.api)),
    ]
    lines = _aligned([(key, value) for key, value in facts if value])
    for needed in spec.files:
        there = "found" if needed.path.exists() else f"missing, {needed.url}".rstrip(", ")
        lines.append(f"needs {needed.description}: {needed.path} ({there})")
    for group in dict.fromkeys(item.group for item in spec.params):
        members = [item for item in spec.params if item.group == group]
        lines += ["", f"{group or 'parameters'} ({len(members)})"]
        lines += _aligned([_parameter_row(item) for item in members])
    return "\n".join(lines)


def spec_json(spec: BackendSpec) -> str:
    """The same as one JSON object."""
    document = {
        "name": spec.name,
        "description": spec.description,
        "api": spec.api,
        "unit": spec.unit,
        "up": spec.up,
        "forward": spec.forward,
        "licence": spec.licence,
        "url": spec.url,
        "wrap": {"native": str(spec.wrap.native), "wrap": str(spec.wrap.wrap)} if spec.wrap else None,
        "fill_segments": list(spec.fill_segments),
        "files": [
            {"path": str(item.path), "description": item.description, "found": item.path.exists()}
            for item in spec.files
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
    return json.dumps(document, indent=2)
