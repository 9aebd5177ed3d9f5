"""Configs that plugins ship: found without an import, or missed in words that help."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
from omegaconf import DictConfig

from soma_core.config import compose, refusals, searchpath
from soma_core.errors import InputError, SomaError
from soma_core.plugin.errors import BackendConflictError, BrokenBackendError, UnknownBackendError
from soma_core.plugin.registry import Registry
from tests.plugin.fakes import FakeEntryPoint, declares
from tests.plugin.installed import Distribution


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Registry:
    """A registry of three plugins: one with a config folder, one without, and a name with two owners."""
    found = Registry(
        [
            FakeEntryPoint("good", declares("good"), value="soma_backend_with_configs.plugin"),
            FakeEntryPoint("bare", declares("bare"), value="json"),
            FakeEntryPoint("twice", distribution="acme"),
            FakeEntryPoint("twice", distribution="bodies"),
        ]
    )
    _use(monkeypatch, found)
    return found


def _use(monkeypatch: pytest.MonkeyPatch, registry: Registry) -> None:
    for module in (searchpath, refusals):
        monkeypatch.setattr(module, "default_registry", lambda: registry)


def _compose(tmp_path: Path, *overrides: str) -> list[DictConfig]:
    seen: list[DictConfig] = []
    outcomes: list[Path | SomaError] = []
    compose.run_task(
        lambda: lambda config, output: seen.append(config),
        config_name="animate",
        program="soma animate",
        overrides=[f"hydra.run.dir={tmp_path}/run", *overrides],
        report=outcomes.append,
    )
    for outcome in outcomes:
        if isinstance(outcome, SomaError):
            raise outcome
    return seen


def test_a_plugin_brings_its_config(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "site" / "soma_backend_with_configs"
    (package / "configs" / "backend").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')\n")
    (package / "configs" / "backend" / "good.yaml").write_text(
        "name: good\nparams: {size: 0.5}\noptions: {}\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    importlib.invalidate_caches()
    (config,) = _compose(tmp_path, "backend=good", "backend.params.size=0.25")
    assert config.backend == {"name": "good", "params": {"size": 0.25}, "options": {}}
    assert "soma_backend_with_configs" not in sys.modules


def test_one_sweep_runs_over_backends_of_the_core_and_of_plugins(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("acme", "bodies"):
        Distribution(name=name).install(site)
    _use(monkeypatch, Registry())
    sweep = ("--multirun", f"hydra.sweep.dir={tmp_path}/sweep")
    configs = _compose(tmp_path, *sweep, "backend=acme,soma,bodies")
    assert [config.backend.name for config in configs] == ["acme", "soma", "bodies"]
    with pytest.raises(UnknownBackendError, match='"bodie": .*Did you mean "bodies"'):
        _compose(tmp_path, *sweep, "backend=acme,bodie")
    assert "soma_backend_acme" not in sys.modules


def test_a_plugin_without_a_config_is_told_what_to_add(registry: Registry, tmp_path: Path) -> None:
    with pytest.raises(
        BrokenBackendError,
        match=r'"bare" \(soma-backend-bare 1.0\): config: .*ships no configs/backend/bare.yaml',
    ):
        _compose(tmp_path, "backend=bare")


def test_two_plugins_with_one_file_are_our_conflict_and_nobody_elses(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """hydra would take the file of whoever comes first, without a word."""
    Distribution(name="acme").install(site)
    Distribution(name="bodies", configs={"backend/acme.yaml": "", "backend/bodies.yaml": ""}).install(site)
    Distribution(name="innocent").install(site)
    _use(monkeypatch, Registry())
    for choice in ("acme", "bodies"):
        with pytest.raises(BackendConflictError) as caught:
            _compose(tmp_path, f"backend={choice}")
        assert (
            caught.value.who
            == 'config "backend/acme.yaml" (soma-backend-acme 1.0 and soma-backend-bodies 1.0)'
        )
        assert caught.value.stage == "config"
    (config,) = _compose(tmp_path, "backend=innocent", "backend.params.size=0.25")
    assert config.backend.params.size == 0.25


def test_a_plugin_cannot_take_the_place_of_a_config_of_the_core(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Distribution(
        name="acme", configs={"backend/soma.yaml": "name: acme", "experiment/mine.yaml": ""}
    ).install(site)
    _use(monkeypatch, Registry())
    (config,) = _compose(tmp_path, "backend=soma")
    assert config.backend.name == "soma"
    with pytest.raises(BackendConflictError, match='"backend/soma.yaml" .soma-body-core .*acme'):
        _compose(tmp_path, "+experiment=mine")


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("name: acme\n  params: {\n", 'mapping values are not allowed here in "{path}", line 2, column 9'),
        ("\udcff", "'utf-8' codec can't decode byte 0xff in position 0: invalid start byte"),
        ("name: acme\nparms: {}\n", "Key 'parms' not in 'BackendChoice'"),
        ("[1, 2]", "Merge error: list is not a subclass of BackendChoice. value: [1, 2]"),
        ("name: other\n", "got name: other, expected name: acme"),
        ("params: {}\n", "got no name, expected name: acme"),
        ("", "got no name, expected name: acme"),
    ],
)
def test_a_config_that_is_wrong_is_its_plugins_fault_and_nobody_elses(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, cause: str
) -> None:
    package = Distribution(name="acme", configs={"backend/acme.yaml": ""}).install(site)
    path = package / "configs" / "backend" / "acme.yaml"
    path.write_text(text, errors="surrogateescape")
    _use(monkeypatch, Registry())
    with pytest.raises(BrokenBackendError) as caught:
        _compose(tmp_path, "backend=acme")
    assert str(caught.value) == (
        f'config "backend/acme.yaml" (soma-backend-acme 1.0): config: {cause.format(path=path)}. '
        f"Correct {path}; the keys of a backend are name, params and options"
    )
    assert _compose(tmp_path, "backend=soma")


def test_the_name_of_the_chosen_backend_is_not_to_be_overridden(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="backend.name: got anny, expected soma. Choose a backend with"):
        _compose(tmp_path, "backend=soma", "backend.name=anny")


def test_a_conflict_is_reported_as_one(registry: Registry, tmp_path: Path) -> None:
    with pytest.raises(BackendConflictError, match="acme 1.0 and bodies 1.0"):
        _compose(tmp_path, "backend=twice")
