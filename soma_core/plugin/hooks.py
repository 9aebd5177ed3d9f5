"""The hooks of one plugin, checked before any of them is called."""

from __future__ import annotations

from collections.abc import Iterable
from types import ModuleType

import pluggy

from soma_core.plugin import hookspecs
from soma_core.plugin.declaration import did_you_mean
from soma_core.plugin.errors import PluginError

__all__ = ["REQUIRED_HOOKS", "hook_manager"]

REQUIRED_HOOKS = ("soma_backend", "soma_generator")


def hook_manager(
    plugin: object, name: str, *, specifications: ModuleType | type = hookspecs
) -> pluggy.PluginManager:
    """Return a pluggy manager that holds `plugin` alone, so that no other plugin answers its calls.

    An implementation takes those arguments of a hook that it names. A hook may therefore gain arguments
    without breaking the plugins that were written before.

    Raises:
        PluginError: a hook that does not exist, an argument that its hook does not have, or a missing hook.
    """
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(specifications)
    known = {hook: set(vars(manager.hook)[hook].spec.argnames) for hook in vars(manager.hook)}
    offered = pluggy.PluginManager(hookspecs.PROJECT)  # without specifications: looked at before checked
    offered.register(plugin, name=name)
    for caller in offered.get_hookcallers(plugin) or ():
        for implementation in caller.get_hookimpls():
            if caller.name in known:
                _check_arguments(caller.name, implementation.argnames, known[caller.name])
            elif not implementation.optionalhook:
                raise PluginError(
                    f"unknown hook {caller.name!r}",
                    fix=did_you_mean(caller.name, known) or f"The hooks are {', '.join(sorted(known))}",
                )
    manager.register(plugin, name=name)
    for hook in REQUIRED_HOOKS:
        if not getattr(manager.hook, hook).get_hookimpls():
            raise _missing(plugin, hook)
    return manager


def _check_arguments(hook: str, arguments: Iterable[str], known: set[str]) -> None:
    for argument in arguments:
        if argument not in known:
            offers = f"Leave it out: {hook} offers {', '.join(sorted(known)) or 'no arguments'}"
            raise PluginError(
                f"{hook} takes an argument {argument!r} that the hook does not have",
                fix=did_you_mean(argument, known) or offers,
            )


def _missing(plugin: object, hook: str) -> PluginError:
    if callable(getattr(plugin, hook, None)):
        return PluginError(
            f"{hook} is defined but not marked as a hook", fix="Put @soma_core.hookimpl above it"
        )
    return PluginError(f"the plugin does not implement the hook {hook}")
