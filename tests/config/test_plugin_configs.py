"""Configs that plugins ship: found without an import, or missed in words that help."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
from omegaconf import DictConfig

from soma_core.config import compose, searchpath
from soma_core.plugin.errors import BackendConflictError, BrokenBackendError
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
    monkeypatch.setattr(searchpath, "default_registry", lambda: found)
    monkeypatch.setattr(compose, "default_registry", lambda: found)
    return found


def _compose(tmp_path: Path, *overrides: str) -> list[DictConfig]:
    seen: list[DictConfig] = []
    compose.run_task(
        lambda: lambda config, output: seen.append(config),
        config_name="animate",
        program="soma animate",
        overrides=[f"hydra.run.dir={tmp_path}/run", *overrides],
        report=lambda outcome: None,
    )
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
    found = Registry()
    monkeypatch.setattr(searchpath, "default_registry", lambda: found)
    monkeypatch.setattr(compose, "default_registry", lambda: found)
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
    found = Registry()
    monkeypatch.setattr(searchpath, "default_registry", lambda: found)
    monkeypatch.setattr(compose, "default_registry", lambda: found)
    (config,) = _compose(tmp_path, "backend=soma")
    assert config.backend.name == "soma"
    with pytest.raises(BackendConflictError, match='"backend/soma.yaml" .soma-body-core .*acme'):
        _compose(tmp_path, "+experiment=mine")


def test_a_conflict_is_reported_as_one(registry: Registry, tmp_path: Path) -> None:
    with pytest.raises(BackendConflictError, match="acme 1.0 and bodies 1.0"):
        _compose(tmp_path, "backend=twice")
