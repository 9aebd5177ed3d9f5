"""What ``soma backends`` shows, as text and as JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from soma_core.plugin.errors import BackendError
from soma_core.plugin.listing import declaration, declaration_text, entries_json, entries_text
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import FileNeeded, Parameter, WrapPair
from tests.plugin.fakes import FakeEntryPoint, declares, good
from tests.plugin.installed import Distribution


@dataclass
class Options:
    """Two options, one of which must be given."""

    model: str
    tolerance: float = 0.5


def _registry(**changes: Any) -> Registry:
    return Registry([FakeEntryPoint("good", declares(**changes))])


def _lines(registry: Registry) -> list[str]:
    return declaration_text(declaration(registry, "good")).splitlines()


def test_every_offer_is_listed_with_its_state_and_each_error_once() -> None:
    broken = FakeEntryPoint("c", declares("other"))
    registry = Registry(
        [good("a"), FakeEntryPoint("b", distribution="x"), FakeEntryPoint("b", distribution="y"), broken]
    )
    with pytest.raises(BackendError, match="'other'"):
        registry.spec("c")
    lines = entries_text(registry.entries()).splitlines()
    assert lines[0].split() == ["BACKEND", "STATE", "DISTRIBUTION", "VERSION"]
    assert [line.split() for line in lines[1:5]] == [
        ["a", "found", "soma-backend-a", "1.0"],
        ["b", "conflict", "x", "1.0"],
        ["b", "conflict", "y", "1.0"],
        ["c", "broken", "(spec)", "soma-backend-c", "1.0"],
    ]
    assert [line.partition(": ")[0] for line in lines[5:] if line] == [
        'backend "b" (x 1.0 and y 1.0)',
        'backend "c" (soma-backend-c 1.0)',
        "found",
    ]
    document = json.loads(entries_json(registry.entries()))
    assert [entry["state"] for entry in document] == ["found", "conflict", "conflict", "broken"]
    assert document[0]["error"] is None
    assert document[1]["error"]["fix"] == "Keep one: pip uninstall y"
    assert document[3]["error"]["stage"] == "spec"


def test_an_empty_environment_says_so() -> None:
    assert entries_text(()) == "no backends are installed"


def test_a_declaration_is_shown_with_all_that_a_user_must_know(tmp_path: Path) -> None:
    there, missing = tmp_path / "there.npz", tmp_path / "missing.npz"
    there.touch()
    registry = _registry(
        files=(
            FileNeeded(path=there, description="the model"),
            FileNeeded(path=missing, description="the texture", url="https://example.org"),
        ),
        options=Options,
        api=2,
        licence="CC0-1.0",
        url="https://example.org/good",
        params=(
            Parameter(name="size", range=(0.0, 1.0), description="factor"),
            Parameter(name="shape", shape=(10,), group="details"),
        ),
        fill_segments=("mouth_bag",),
    )
    assert _lines(registry) == [
        "backend       good",
        "distribution  soma-backend-good 1.0",
        "plugin        soma_backend_good (api 2)",
        "config        none: only for Python",
        "licence       CC0-1.0",
        "url           https://example.org/good",
        "unit          m",
        "axes          +y up, +z forward",
        "wrap pair     none: the vertices are those of the canonical mesh",
        "filled        mouth_bag",
        "",
        "files that you supply: 2",
        f"  found    {there}    the model",
        f"  missing  {missing}  the texture",
        f"  next: get it from https://example.org, then put it at {missing}",
        "",
        "options (backend.options): 2",
        "  model      str    must be given",
        "  tolerance  float  default 0.5",
        "",
        "parameters (backend.params): 1",
        "  size  scalar  default 0  0 to 1  factor",
        "",
        "details: 1",
        "  shape  10  default 0  -3 to 3",
    ]
    document = json.loads(json.dumps(declaration(registry, "good")))
    assert document["params"][0]["range"] == [0.0, 1.0]
    assert [item["found"] for item in document["files"]] == [True, False]
    assert document["options"][0] == {"name": "model", "type": "str", "default": None}


def test_a_wrap_pair_is_shown_with_its_own_axes_and_its_figures() -> None:
    pair = WrapPair(native=Path("/nowhere/native.obj"), wrap=Path("/nowhere/wrap.obj"))
    registry = _registry(wrap=pair, wrap_up="+z", wrap_forward="-y", fill_segments=("eye_bags",))
    document = declaration(registry, "good")
    assert document["wrap"]["found"] is False
    document["wrap"]["statistics"] = {
        "native_count": 10, "wrap_count": 20, "filled_count": 3, "mean_mm": 0.5, "p95_mm": 1.25,
        "max_mm": 2.0, "lowest_mm": -2.0, "highest_mm": 1.0,
    }  # fmt: skip
    text = declaration_text(document)
    for line in (
        "native mesh    /nowhere/native.obj",
        "wrap           /nowhere/wrap.obj",
        "wrap axes      +z up, -y forward",
        "vertices       10 native, 20 canonical",
        "wrap distance  mean 0.50 mm, 95 % below 1.25 mm, at most 2.00 mm from the native surface",
        "wrap offset    from -2.00 mm (inside) to +1.00 mm (outside)",
        "filled         eye_bags (3 vertices)",
    ):
        assert line in text.splitlines()
    document["wrap"]["error"] = {"stage": "wrap", "cause": "it lies apart", "fix": "Scale it"}
    assert "wrap state     cannot be used: it lies apart. Scale it" in declaration_text(document).splitlines()


def test_a_config_is_named_or_the_reason_why_it_is_left_out(site: Path) -> None:
    body = "from tests.plugin.fakes import declares\nplugin = declares('good')\n"
    points = {"good": "soma_backend_good:plugin"}
    package = Distribution(name="good", body=body, points=points).install(site)
    document = declaration(Registry(), "good")
    assert document["config"] == str(package / "configs" / "backend" / "good.yaml")
    assert (document["source"], document["config_error"]) == (None, None)
    Distribution(name="other", configs={"backend/good.yaml": ""}).install(site)
    document = declaration(Registry(), "good")
    assert document["config"] is None
    assert document["config_error"]["stage"] == "config"
    assert "config        cannot be used: 2 distributions ship this file" in declaration_text(document)


def test_the_backend_of_the_core_shows_the_config_of_the_core() -> None:
    assert declaration(Registry(), "soma")["config"].endswith("configs/backend/soma.yaml")


def test_the_declaration_of_nobody_is_refused() -> None:
    with pytest.raises(BackendError, match='"goood".*Did you mean "good"'):
        declaration(_registry(), "goood")
