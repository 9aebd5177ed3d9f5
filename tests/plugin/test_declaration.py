"""What is refused in a declaration, with the offending value in the text."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from soma_core.plugin.declaration import did_you_mean, spec_problem
from soma_core.plugin.spec import FileNeeded, Parameter, WrapPair
from tests.plugin.fakes import SOUND

if TYPE_CHECKING:
    from nowhere import Missing


@dataclass
class Unreadable:
    """Options whose annotation was imported for typing only."""

    value: Missing | None = None


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
        (
            {"params": (Parameter(name="a", limits=(-1.0, 3.0)),)},
            "the limits of parameter a are (-1.0, 3.0), expected two finite numbers around (-3.0, 3.0)",
        ),
        ({"params": (Parameter(name="a", range=(1.0, 1.0)),)}, "range of parameter a is (1.0, 1.0)"),
        ({"params": (Parameter(name=3),)}, "the parameter name 3 is no key"),
        (
            {"params": (Parameter(name="a", range=(0, math.nan)),)},
            "the range of parameter a is (0, nan)",
        ),
        ({"params": (Parameter(name="a", range=3),)}, "the range of parameter a is 3, expected two finite"),
        ({"params": (Parameter(name="a", shape=10),)}, "the shape of parameter a is 10, expected a tuple"),
        ({"params": (Parameter(name="a", shape=(-1,)),)}, "the shape of parameter a is (-1,)"),
        ({"params": (Parameter(name="a", default=None),)}, "the default of parameter a is None"),
        ({"params": (Parameter(name="a", default=True),)}, "the default of parameter a is True"),
        ({"api": "1"}, "api is '1', expected the whole number of a contract version"),
        ({"licence": None}, "licence is None, expected a text"),
        ({"fill_segments": "mouth_bag"}, "fill_segments is 'mouth_bag', expected a tuple of names"),
        (
            {"wrap": WrapPair(native="a", wrap=Path())},
            "wrap.native names 'a', expected a pathlib.Path",
        ),
        ({"files": (FileNeeded(path="m", description=""),)}, "files names 'm', expected a pathlib.Path"),
        ({"options": Unreadable}, "the annotations of Unreadable cannot be read (name 'Missing' is not"),
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
