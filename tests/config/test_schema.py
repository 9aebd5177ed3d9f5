"""Every task's config agrees with its schema, and every backend's config with its declaration."""

from __future__ import annotations

from dataclasses import fields

import pytest
from hydra import compose, initialize
from omegaconf import OmegaConf

from soma_core.cli import TASKS
from soma_core.config.schema import register_schemas
from soma_core.config.searchpath import register_search_path
from soma_core.options import ModelOptions
from soma_core.plugin.registry import default_registry


@pytest.fixture(autouse=True)
def _registered() -> None:
    register_schemas()
    register_search_path()


@pytest.mark.parametrize("task", [row.module for row in TASKS.values()])
def test_each_task_composes_and_states_every_key_of_its_schema(task: str) -> None:
    with initialize(config_path=None, version_base="1.3"):
        config = compose(task)
    assert OmegaConf.missing_keys(config) == set()
    assert OmegaConf.get_type(config) is not dict


@pytest.mark.parametrize("task", ["animate", "invert", "convert"])
def test_commands_share_the_options_of_a_model(task: str) -> None:
    shared = {field.name: getattr(ModelOptions(), field.name) for field in fields(ModelOptions)}
    with initialize(config_path=None, version_base="1.3"):
        config = OmegaConf.to_object(compose(task, overrides=["++out=here"] if task == "convert" else []))
    assert isinstance(config, ModelOptions)
    assert {name: getattr(config, name) for name in shared} == shared


def test_each_backend_config_lists_exactly_the_declared_parameters() -> None:
    registry = default_registry()
    for name in registry.names():
        spec = registry.spec(name)
        with initialize(config_path=None, version_base="1.3"):
            backend = compose("animate", overrides=[f"backend={name}"]).backend
        assert backend.name == name
        assert sorted(backend.params) == sorted(parameter.name for parameter in spec.params)
        assert all(value is None for value in backend.params.values())
