"""Hooks are checked before they are called, and may gain arguments without breaking anybody."""

from __future__ import annotations

import inspect
import itertools
from types import SimpleNamespace
from typing import Any

import pytest

from soma_core.plugin import hookspecs
from soma_core.plugin.errors import PluginError
from soma_core.plugin.hooks import hook_manager
from soma_core.plugin.hookspecs import hookimpl, hookspec
from soma_core.plugin.registry import Registry
from tests.plugin.fakes import SOUND, FakeEntryPoint, FakeGenerator, hooks

ARGUMENTS = tuple(inspect.signature(hookspecs.soma_generator).parameters)
SUBSETS = [part for size in range(len(ARGUMENTS) + 1) for part in itertools.combinations(ARGUMENTS, size)]


def _sound(**more: Any) -> SimpleNamespace:
    return hooks(**{"soma_backend": lambda: SOUND, "soma_generator": lambda: FakeGenerator(), **more})


def _plugin_that_takes(arguments: tuple[str, ...]) -> SimpleNamespace:
    """A plugin whose soma_generator has exactly these arguments."""
    names = ", ".join(arguments)
    space: dict[str, Any] = {"make": FakeGenerator}
    exec(f"def soma_generator({names}): return make({', '.join(f'{n}={n}' for n in arguments)})", space)
    return _sound(soma_generator=space["soma_generator"])


@pytest.mark.parametrize("arguments", SUBSETS, ids=lambda part: "+".join(part) or "none")
def test_a_plugin_may_take_any_of_the_arguments(arguments: tuple[str, ...]) -> None:
    registry = Registry([FakeEntryPoint("good", _plugin_that_takes(arguments))])
    generator = registry.generator("good", device="cpu", dtype="float32")  # type: ignore[arg-type]
    assert isinstance(generator, FakeGenerator)
    assert set(generator.built) == set(arguments)


class Tomorrow:
    """The hooks of a later core: soma_generator has one more argument, and there is one more hook."""

    @staticmethod
    @hookspec(firstresult=True)
    def soma_backend() -> Any:
        """Declare."""

    @staticmethod
    @hookspec(firstresult=True)
    def soma_generator(spec: Any, device: Any, dtype: Any, options: Any, seed: int) -> Any:
        """Build, with a seed."""

    @staticmethod
    @hookspec(firstresult=True)
    def soma_preview(spec: Any) -> Any:
        """Draw."""


@pytest.mark.parametrize("arguments", [ARGUMENTS, ("device", "dtype"), ()])
def test_a_plugin_of_today_works_when_a_hook_gains_an_argument(arguments: tuple[str, ...]) -> None:
    hook = hook_manager(_plugin_that_takes(arguments), "good", specifications=Tomorrow).hook
    given = {name: name for name in ARGUMENTS}
    assert hook.soma_backend() is SOUND
    assert hook.soma_generator(**given, seed=3).built == {name: name for name in arguments}
    assert hook.soma_preview(spec=SOUND) is None


@pytest.mark.parametrize(
    ("plugin", "text"),
    [
        (
            _sound(soma_bakend=lambda: SOUND),
            "unknown hook 'soma_bakend'. Did you mean \"soma_backend\"?",
        ),
        (
            _sound(soma_zzz=lambda: SOUND),
            "unknown hook 'soma_zzz'. The hooks are soma_backend, soma_checks, soma_convert, "
            "soma_generator, soma_motions",
        ),
        (
            _sound(soma_generator=lambda spec, devise: None),
            "soma_generator takes an argument 'devise' that the hook does not have. Did you mean \"device\"?",
        ),
        (
            _sound(soma_backend=lambda colour: SOUND),
            "soma_backend takes an argument 'colour' that the hook does not have. "
            "Leave it out: soma_backend offers no arguments",
        ),
        (
            _sound(soma_generator=lambda colour: None),
            "soma_generator takes an argument 'colour' that the hook does not have. "
            "Leave it out: soma_generator offers device, dtype, options, spec",
        ),
        (
            SimpleNamespace(soma_backend=lambda: SOUND),
            "soma_backend is defined but not marked as a hook. Put @soma_core.hookimpl above it",
        ),
        (
            hooks(soma_backend=lambda: SOUND),
            "the plugin does not implement the hook soma_generator.",
        ),
        (SimpleNamespace(), "the plugin does not implement the hook soma_backend."),
    ],
)
def test_what_is_wrong_with_the_hooks_is_said_in_full(plugin: object, text: str) -> None:
    with pytest.raises(PluginError) as caught:
        hook_manager(plugin, "bad")
    assert str(caught.value) == text


def test_a_hook_of_a_later_core_may_be_marked_optional() -> None:
    plugin = _sound()
    plugin.soma_preview = hookimpl(optionalhook=True)(lambda spec: None)
    assert hook_manager(plugin, "good").hook.soma_backend() is SOUND
