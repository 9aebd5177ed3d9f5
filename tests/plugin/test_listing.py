"""What ``soma backends`` shows."""

from __future__ import annotations

import json

from soma_core.plugin.listing import entries_json, entries_text, spec_json, spec_text
from soma_core.plugin.registry import Registry
from tests.plugin.fakes import SOUND, FakeEntryPoint, good


def test_every_offer_is_listed_with_its_state_and_error() -> None:
    registry = Registry(
        [good("a"), FakeEntryPoint("b", distribution="x"), FakeEntryPoint("b", distribution="y")]
    )
    lines = entries_text(registry.entries()).splitlines()
    assert lines[0].split() == ["BACKEND", "STATE", "DISTRIBUTION", "VERSION"]
    assert [line.split() for line in lines[1:4]] == [
        ["a", "found", "soma-backend-a", "1.0"],
        ["b", "conflict", "x", "1.0"],
        ["b", "conflict", "y", "1.0"],
    ]
    assert lines[4].startswith('backend "b" (x 1.0 and y 1.0): lookup: ')
    assert len(lines) == 5
    document = json.loads(entries_json(registry.entries()))
    assert [entry["state"] for entry in document] == ["found", "conflict", "conflict"]
    assert document[0]["error"] is None
    assert document[1]["error"]["fix"] == "Keep one: pip uninstall y"


def test_an_empty_environment_says_so() -> None:
    assert entries_text(()) == "no backends are installed"


def test_a_declaration_is_shown_in_both_forms() -> None:
    text = spec_text(SOUND)
    assert "+y up, +z forward" in text
    assert "size" in text
    assert json.loads(spec_json(SOUND))["params"][0]["range"] == [0.0, 1.0]
