"""Plugins that are not installed: entry points and hook holders, sound or broken in one way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

from soma_core.plugin.hookspecs import hookimpl
from soma_core.plugin.spec import BackendSpec, Parameter

SOUND = BackendSpec(
    name="good",
    unit="m",
    up="+y",
    forward="+z",
    params=(Parameter(name="size", range=(0.0, 1.0)),),
    wrap=None,
)


@dataclass
class FakeDistribution:
    name: str
    version: str = "1.0"


class FakeEntryPoint:
    """An entry point whose plugin is an object at hand, or a callable that makes or refuses it."""

    def __init__(
        self,
        name: str,
        plugin: object = None,
        *,
        distribution: str | None = None,
        version: str = "1.0",
        value: str | None = None,
        load: Callable[[], object] | None = None,
    ) -> None:
        self.name = name
        self.value = value or f"soma_backend_{name}"
        self.dist = FakeDistribution(distribution or f"soma-backend-{name}", version)
        self.loads = 0
        self._load = load or (lambda: plugin)

    def load(self) -> object:
        self.loads += 1
        return self._load()


class FakeGenerator:
    """Remembers what it was built with."""

    def __init__(self, **built: Any) -> None:
        self.built = built

    def rest(self, params: Any) -> Any:
        return params


class SoundPlugin:
    """Declares `spec` and builds a FakeGenerator."""

    def __init__(self, spec: BackendSpec = SOUND) -> None:
        self.declared = spec

    @hookimpl
    def soma_backend(self) -> BackendSpec:
        return self.declared

    @hookimpl
    def soma_generator(self, spec: Any, device: Any, dtype: Any, options: Any) -> Any:
        return FakeGenerator(spec=spec, device=device, dtype=dtype, options=options)


def declares(name: str = "good", **changes: Any) -> SoundPlugin:
    """A sound plugin whose declaration differs in `changes`."""
    return SoundPlugin(replace(SOUND, name=name, **changes))


def good(name: str = "good") -> FakeEntryPoint:
    return FakeEntryPoint(name, declares(name))


def hooks(**functions: Callable[..., Any]) -> SimpleNamespace:
    """A plugin from functions, as a module would be."""
    return SimpleNamespace(**{name: hookimpl(function) for name, function in functions.items()})
