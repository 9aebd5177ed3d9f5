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


def test_a_conflict_is_reported_as_one(registry: Registry, tmp_path: Path) -> None:
    with pytest.raises(BackendConflictError, match="acme 1.0 and bodies 1.0"):
        _compose(tmp_path, "backend=twice")
