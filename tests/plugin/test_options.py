"""Options are checked by name and by type against the plugin's own dataclass."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from omegaconf import OmegaConf

from soma_core.errors import InputError
from soma_core.plugin.options import OptionRow, checked_options, option_rows, options_by_name
from tests.plugin.fakes import SOUND


class Quality(enum.Enum):
    """How much work."""

    draft = 1
    fine = 2


@dataclass
class Solver:
    """Nested options."""

    steps: int = 10
    tolerance: float = 1e-3


@dataclass
class Options:
    """One field of each kind."""

    number: int = 1
    factor: float = 0.5
    flag: bool = False
    text: str = "fast"
    file: Path | None = None
    mode: Literal["a", "b", 3] = "a"
    quality: Quality = Quality.draft
    either: int | str = 0
    loose: Any = None
    marked: Annotated[float, "in metres"] = 1.0
    names: list[str] = field(default_factory=list)
    pair: tuple[float, float] = (0.0, 1.0)
    many: tuple[int, ...] = ()
    row: Sequence[float] = ()
    weights: dict[str, float] = field(default_factory=dict)
    table: Mapping[str, list[int]] = field(default_factory=dict)
    bare: list = field(default_factory=list)
    solver: Solver = field(default_factory=Solver)
    callback: Sequence[int] | None = None
    derived: int = field(init=False, default=7)

    def __post_init__(self) -> None:
        if self.number < 0:
            raise ValueError("number must not be negative")
        if self.number == 13:
            raise InputError("backend.options.number", got=13, expected="a lucky number", fix="Use 12")


SPEC = replace(SOUND, options=Options)


def checked(**options: Any) -> dict[str, Any]:
    return options_by_name(checked_options(SPEC, options))


def test_defaults_are_filled_in() -> None:
    values = checked(text="slow")
    assert values["text"] == "slow"
    assert values["factor"] == 0.5
    assert "derived" not in values


@pytest.mark.parametrize(
    ("name", "given", "taken"),
    [
        ("number", 3, 3),
        ("factor", 2, 2.0),
        ("flag", True, True),
        ("file", "a/b.npz", Path("a/b.npz")),
        ("file", None, None),
        ("mode", 3, 3),
        ("quality", "fine", Quality.fine),
        ("quality", Quality.fine, Quality.fine),
        ("either", "3", "3"),
        ("either", 3, 3),
        ("loose", {"any": ["thing"]}, {"any": ["thing"]}),
        ("marked", 3, 3.0),
        ("names", ("x", "y"), ["x", "y"]),
        ("pair", [1, 2], (1.0, 2.0)),
        ("many", [1, 2, 3], (1, 2, 3)),
        ("row", [1], [1.0]),
        ("weights", {"a": 1}, {"a": 1.0}),
        ("table", {"a": [1]}, {"a": [1]}),
        ("bare", [1, "x"], [1, "x"]),
        ("solver", {"steps": 3}, Solver(steps=3)),
        ("solver", Solver(steps=4), Solver(steps=4)),
        ("callback", [1], [1]),
    ],
)
def test_what_is_taken(name: str, given: Any, taken: Any) -> None:
    value = checked(**{name: given})[name]
    assert value == taken
    assert type(value) is type(taken)


@pytest.mark.parametrize(
    ("name", "given", "text"),
    [
        ("number", "3", "backend.options.number: got '3' (str), expected int. "),
        ("number", True, "backend.options.number: got True (bool), expected int. "),
        ("number", 2.5, "backend.options.number: got 2.5 (float), expected int. "),
        ("factor", "big", "backend.options.factor: got 'big' (str), expected float. "),
        ("factor", True, "backend.options.factor: got True (bool), expected float. "),
        ("flag", 1, "backend.options.flag: got 1 (int), expected bool. "),
        ("text", 3, "backend.options.text: got 3 (int), expected str. "),
        ("file", 3, "backend.options.file: got 3 (int), expected Path | None. "),
        ("mode", "c", "backend.options.mode: got 'c' (str), expected one of 'a', 'b', 3. "),
        ("mode", 3.0, "backend.options.mode: got 3.0 (float), expected one of 'a', 'b', 3. "),
        ("quality", "best", "backend.options.quality: got 'best' (str), expected one of draft, fine. "),
        ("either", 2.5, "backend.options.either: got 2.5 (float), expected int | str. "),
        ("marked", "x", "backend.options.marked: got 'x' (str), expected float. "),
        ("names", "x", "backend.options.names: got 'x' (str), expected list[str]. "),
        ("names", ["x", 3], "backend.options.names[1]: got 3 (int), expected str. "),
        ("pair", [1], "backend.options.pair: got [1] (list), expected tuple[float, float]. "),
        ("many", [1, "x"], "backend.options.many[1]: got 'x' (str), expected int. "),
        ("weights", [1], "backend.options.weights: got [1] (list), expected dict[str, float]. "),
        ("weights", {"a": "x"}, "backend.options.weights.a: got 'x' (str), expected float. "),
        ("table", {"a": [1, "x"]}, "backend.options.table.a[1]: got 'x' (str), expected int. "),
        ("bare", "x", "backend.options.bare: got 'x' (str), expected list. "),
        ("solver", {"steps": "x"}, "backend.options.solver.steps: got 'x' (str), expected int. "),
        ("solver", 3, "backend.options.solver: got 3 (int), expected Solver. "),
        ("number", -1, "backend.options: got {'number': -1}, expected what Options takes (number must"),
        ("number", 13, "backend.options.number: got 13, expected a lucky number. Use 12"),
    ],
)
def test_what_is_refused(name: str, given: Any, text: str) -> None:
    with pytest.raises(InputError) as caught:
        checked(**{name: given})
    assert str(caught.value).startswith(text)
    assert str(caught.value).endswith(("See: soma backends show good", "Use 12"))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"facter": 1}, "backend.options.facter: got 1, expected one of the options number, factor, flag"),
        (
            {"solver": {"stebs": 1}},
            "backend.options.solver.stebs: got 1, expected one of the options steps, ",
        ),
    ],
)
def test_a_typo_is_named_in_full_with_what_was_meant(options: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError) as caught:
        checked(**options)
    assert str(caught.value).startswith(text)
    meant = "factor" if "facter" in options else "steps"
    assert str(caught.value).endswith(f'Did you mean "{meant}"?')


def test_an_option_nothing_like_the_others_points_to_the_list() -> None:
    with pytest.raises(InputError, match="backend.options.zzz: got 1, .*See: soma backends show good"):
        checked(zzz=1)


@dataclass
class Required:
    """An option that has no default."""

    model: str


def test_an_option_without_default_must_be_given() -> None:
    spec = replace(SOUND, options=Required)
    assert checked_options(spec, {"model": "x"}) == Required("x")
    with pytest.raises(InputError) as caught:
        checked_options(spec, {})
    assert str(caught.value) == (
        "backend.options.model: got nothing, expected str. Give backend.options.model"
    )


def test_a_backend_without_options_takes_none() -> None:
    assert checked_options(SOUND, {}) is None
    with pytest.raises(InputError) as caught:
        checked_options(SOUND, {"speed": 3})
    assert str(caught.value) == (
        "backend.options.speed: got 3, expected nothing: backend 'good' has no options. Leave it out"
    )


def test_a_composed_configuration_is_taken_as_it_is() -> None:
    config = OmegaConf.create({"names": ["x"], "weights": {"a": 1}, "solver": {"steps": 3}})
    values = checked_options(SPEC, config)  # type: ignore[arg-type]
    assert (values.names, values.weights, values.solver.steps) == (["x"], {"a": 1.0}, 3)


def test_options_are_listed_with_type_and_default() -> None:
    rows = {row.name: row for row in option_rows(Options)}
    assert rows["factor"] == OptionRow(name="factor", type="float", default="0.5")
    assert rows["file"].type == "Path | None"
    assert rows["names"] == OptionRow(name="names", type="list[str]", default="[]")
    assert rows["row"].type == "Sequence[float]"
    assert "derived" not in rows
    assert option_rows(Required) == (OptionRow(name="model", type="str", default=None),)
    assert option_rows(None) == ()
