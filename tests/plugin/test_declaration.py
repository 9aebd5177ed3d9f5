"""What is refused in a declaration, with the offending value in the text."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from soma_core.plugin.declaration import did_you_mean, spec_problem
from soma_core.plugin.spec import Parameter
from tests.plugin.fakes import SOUND


def test_a_sound_declaration_has_no_problem() -> None:
    assert spec_problem(SOUND, "good") is None


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"unit": "inch"}, "unit is 'inch', expected one of m, cm, mm"),
        ({"up": "y"}, "up is 'y', expected one of +x"),
        ({"forward": "north"}, "forward is 'north'"),
        ({"forward": "-y"}, "up '+y' and forward '-y' lie on one axis"),
        ({"wrap_up": "-z"}, "wrap_up '-z' and wrap_forward '+z' lie on one axis"),
        ({"params": [Parameter(name="a")]}, "expected a tuple of Parameter"),
        ({"params": ("a",)}, "params is ('a',)"),
        ({"params": (Parameter(name="a"), Parameter(name="a"))}, "declares a more than once"),
        ({"params": (Parameter(name="a b"),)}, "'a b' is no key"),
        ({"params": (Parameter(name="a", range=(1.0, 1.0)),)}, "range of parameter a is (1.0, 1.0)"),
        ({"wrap": ("a.obj", "b.obj")}, "wrap is ('a.obj', 'b.obj')"),
        ({"files": ("model.pkl",)}, "files is ('model.pkl',)"),
        ({"options": dict}, "options is <class 'dict'>, expected a dataclass type"),
    ],
)
def test_a_wrong_declaration_is_described(changes: dict[str, Any], text: str) -> None:
    problem = spec_problem(replace(SOUND, **changes), "good")
    assert problem is not None
    assert text in problem


def test_other_objects_are_not_declarations() -> None:
    assert spec_problem(None, "good") == "soma_backend returned NoneType, expected BackendSpec"


def test_did_you_mean_stays_silent_when_nothing_is_close() -> None:
    assert did_you_mean("annny", ["anny", "soma"]) == 'Did you mean "anny"?'
    assert did_you_mean("xyz", ["anny", "soma"]) == ""
