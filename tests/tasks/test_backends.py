"""The verbs of ``soma backends``: what they print, for people and for programs, and their exit codes."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from soma_core.errors import InputError
from soma_core.plugin.registry import Registry
from soma_core.tasks import EXIT_BACKEND, EXIT_FAILED, EXIT_OK, EXIT_USAGE, backends
from soma_core.testing.report import Outcome, Report
from soma_core.testing.synthetic import synthetic_canonical, write_wrap_pair
from tests.plugin.fakes import FakeEntryPoint, declares, good
from tests.plugin.installed import Distribution


def _run(*arguments: str) -> tuple[str, int]:
    said: list[str] = []
    code = backends.run_verb(arguments, said.append)
    (text,) = said
    return text, code


def _install(monkeypatch: pytest.MonkeyPatch, *points: FakeEntryPoint) -> Registry:
    registry = Registry(points)
    monkeypatch.setattr(backends, "default_registry", lambda: registry)
    monkeypatch.setattr(backends, "run_in_child", _run_here)
    return registry


def _run_here(function: str, *arguments: Any, seconds: float, **_: Any) -> Iterator[Any]:
    """In place of a child process, in which there would be other registries."""
    said: list[Any] = []
    getattr(backends, function.partition(":")[2])(said.append, *arguments)
    return iter(json.loads(json.dumps(said)))


def _with_pair(folder: Path) -> FakeEntryPoint:
    pair = write_wrap_pair(folder)
    segments = ("mouth_bag", "eye_bags")
    plugin = declares(wrap=pair, unit="cm", up="+z", forward="-y", fill_segments=segments)
    return FakeEntryPoint("good", plugin)


@pytest.fixture
def _synthetic(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("soma_core.rig.load_canonical", lambda lod: synthetic_canonical(), raising=False)
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path / "cache"))


def test_the_list_is_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch, good("a"), good("b"))
    text, code = _run()
    assert (text, code) == _run("list")
    assert [line.split()[:2] for line in text.splitlines()[1:3]] == [["a", "found"], ["b", "found"]]
    assert code == EXIT_OK
    assert json.loads(_run("--json")[0]) == json.loads(_run("list", "--json")[0])


def test_a_clash_of_configs_is_listed_once(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    configs = {"backend/acme.yaml": "", "backend/bodies.yaml": ""}
    for name in ("acme", "bodies"):
        Distribution(name=name, configs=configs).install(site)
    monkeypatch.setattr(backends, "default_registry", Registry)
    assert _run()[0].count('config "backend/acme.yaml" (soma-backend-acme 1.0') == 1


def test_loading_shows_what_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    registry = _install(monkeypatch, FakeEntryPoint("bad", declares("other")), good())
    monkeypatch.setattr(backends, "load", lambda registry, name, *, begun: registry.spec(name))
    text, code = _run("--load")
    assert "bad      broken (spec)" in text
    assert code == EXIT_BACKEND
    assert [entry["state"] for entry in json.loads(_run("list", "--load", "--json")[0])] == [
        "broken",
        "declared",
    ]
    assert registry.names() == ("good",)


def test_loading_with_a_conflict_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch, FakeEntryPoint("b", distribution="x"), FakeEntryPoint("b", distribution="y"))
    assert _run("--load")[1] == EXIT_BACKEND
    assert _run()[1] == EXIT_OK


def test_json_is_json_where_there_is_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch, FakeEntryPoint("bad", declares("other")))
    for arguments in (["show", "bad"], ["show", "nobody"], ["check", "nobody"], ["check"]):
        text, code = _run(*arguments, "--json")
        assert json.loads(text)["error"]["cause"]
        assert code == (EXIT_USAGE if arguments == ["check"] else EXIT_BACKEND)


def test_what_is_known_is_listed_with_the_licence_that_the_plugin_declares() -> None:
    rows = {row["name"]: row for row in json.loads(_run("known", "--json")[0])}
    registry = Registry()
    for name in {*rows} & {*registry.names()}:
        assert rows[name]["licence"] == registry.spec(name).licence
        assert rows[name]["distribution"] == registry.offers(name)[0].distribution
    assert "LICENCE OF THE MODEL" in _run("known")[0]


def test_requirements_name_each_distribution(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch, good())
    text, code = _run("--requirements")
    assert any(line.startswith("soma-body-core==") for line in text.splitlines())
    assert code == EXIT_OK
    assert "python" in json.loads(_run("--requirements", "--json")[0])


@pytest.mark.usefixtures("_synthetic")
def test_a_wrap_pair_is_measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _install(monkeypatch, _with_pair(tmp_path))
    text, code = _run("show", "good")
    assert code == EXIT_OK
    assert "wrap distance  mean 0.00 mm" in text
    wrap = json.loads(_run("show", "good", "--json")[0])["wrap"]
    assert wrap["error"] is None
    assert wrap["statistics"]["wrap_count"] == synthetic_canonical()[0].vertex_count


@pytest.mark.usefixtures("_synthetic")
def test_a_pair_that_cannot_be_used_is_shown_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    point = _with_pair(tmp_path)
    (tmp_path / "wrap.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    _install(monkeypatch, point)
    text, code = _run("show", "good")
    assert code == EXIT_OK
    assert f"cannot be used: wrap {tmp_path / 'wrap.obj'}: got 3 vertices, expected" in text
    wrap = json.loads(_run("show", "good", "--json")[0])["wrap"]
    assert (wrap["statistics"], wrap["error"]["stage"]) == (None, "wrap")


def test_a_backend_without_a_pair_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    _install(monkeypatch, good())
    assert "wrap pair     none: the vertices are those of the canonical mesh" in _run("show", "good")[0]


def test_what_a_plugin_prints_does_not_reach_the_result(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def chatty() -> object:
        sys.stdout.write("loading weights\n")
        return declares()

    _install(monkeypatch, FakeEntryPoint("good", load=chatty))
    assert json.loads(_run("show", "good", "--json")[0])["name"] == "good"
    streams = capsys.readouterr()
    assert (streams.out, streams.err) == ("", "loading weights\n")


def _report(*states: str, missing: tuple[Path, ...] = ()) -> Report:
    document = {"level": "core", "summary": "it holds", "got": "3", "expected": "4", "seconds": 0.5}
    outcomes = [
        Outcome.of_document(document | {"id": f"check-{number}", "state": state})
        for number, state in enumerate(states)
    ]
    return Report(
        backend="acme", distribution="a 1", level="core", outcomes=tuple(outcomes), missing_files=missing
    )


@pytest.mark.parametrize(
    ("report", "code"),
    [
        (_report("passed"), EXIT_OK),
        (_report("passed", "failed"), EXIT_FAILED),
        (_report("passed", missing=(Path("model.npz"),)), EXIT_BACKEND),
    ],
)
def test_the_outcome_of_the_checks_sets_the_exit_code(
    report: Report, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    _install(monkeypatch, good("acme"), good("bodies"))
    monkeypatch.setattr(backends, "_checked", lambda name, options: report)
    assert _run("check", "acme") == (report.text(), code)
    assert _run("check", "acme", "--json") == (report.json(), code)
    assert _run("check", "--all") == (f"{report.brief()}\n{report.brief()}", code)
    assert json.loads(_run("check", "--all", "--json")[0]) == [report.document()] * 2


def test_backends_that_are_blocked_are_not_among_all(monkeypatch: pytest.MonkeyPatch) -> None:
    registry = Registry([good("acme"), good("bodies")], allowed=["acme"])
    monkeypatch.setattr(backends, "default_registry", lambda: registry)
    monkeypatch.setattr(backends, "_checked", lambda name, options: _report("passed"))
    assert _run("check", "--all") == (_report("passed").brief(), EXIT_OK)


def test_a_new_backend_is_written_and_the_next_steps_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, code = _run("new", "acme", "--output", str(tmp_path))
    folder = tmp_path / "soma-backend-acme"
    assert (folder / "pyproject.toml").is_file()
    assert text.splitlines() == [
        f"pip install -e {folder}",
        "soma backends check acme",
        "soma animate backend=acme",
        str(folder),
    ]
    assert code == EXIT_OK
    with pytest.raises(InputError, match="soma-backend-acme, expected a folder that does not exist"):
        _run("new", "acme", "--output", str(tmp_path))


@pytest.mark.parametrize(
    "arguments", [["shwo", "x"], ["show"], ["check", "x", "--level", "some"], ["--nothing"]]
)
def test_a_wrong_command_is_a_usage_error(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="^2$"):
        _run(*arguments)
    assert "usage: soma backends" in capsys.readouterr().err
