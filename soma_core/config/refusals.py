"""What hydra and OmegaConf refuse, in our words: the full key or the plugin's file, and how to mend it."""

from __future__ import annotations

import re
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    OmegaConfBaseException,
)
from yaml import YAMLError

from soma_core.errors import InputError, SomaError
from soma_core.paths import configs_dir
from soma_core.plugin.declaration import did_you_mean
from soma_core.plugin.errors import BrokenBackendError
from soma_core.plugin.registry import default_registry

__all__ = ["REFUSALS", "check_backend_choice", "in_our_words", "with_settings"]

REFUSALS = (HydraException, InterpolationResolutionError, YAMLError, UnicodeError)
"""What composing a configuration may raise."""

_RUN_FOLDER = "The folder of this run is named by hydra.run.dir=FOLDER"

_SHOWN_KEYS = 16
"""A backend may have hundreds of parameters; an error message lists this many."""

_PARAMETER = re.compile(r"params\['(?P<name>.+)'\]")
_COMPOSING = re.compile(r"In '(?P<file>[^']+)': \w+ raised while composing config:\s*(?P<cause>[^\n]*)")


def in_our_words(error: Exception) -> SomaError:
    """Say what was refused while a configuration was composed, whose it is, and how to mend it."""
    if isinstance(error, MissingConfigException):
        return _missing_choice(error)
    if isinstance(error, OverrideParseException):
        return _unparsed(error)
    if isinstance(error, InterpolationResolutionError):
        name = str(error.full_key or "configuration")
        return InputError(
            name,
            got=_first_line(error),
            expected="${SETTING} or a resolver of hydra",
            fix="Correct the name.",
        )
    if not isinstance(error, HydraException):
        return _unreadable_file(error)
    shipped = _COMPOSING.match(str(error))
    if shipped:
        return _broken_file(f"{shipped['file']}.yaml", shipped["cause"])
    if isinstance(error.__cause__, OmegaConfBaseException):
        return _refused_value(error.__cause__)
    first, *rest = str(error).splitlines()
    return InputError("configuration", got=first, expected="key=value", fix=" ".join(rest) or "See --help")


def with_settings(error: SomaError) -> SomaError:
    """Name a parameter of the body by its setting, where an error has it as an argument of Python."""
    found = _PARAMETER.fullmatch(error.argument) if isinstance(error, InputError) else None
    if found is None or not isinstance(error, InputError):
        return error
    setting = f"backend.params.{found['name']}"
    fix = (
        error.fix if "soma backends show" in error.fix else f"Correct {setting}; see: soma backends show NAME"
    )
    return InputError(setting, got=error.got, expected=error.expected, fix=fix)


def _unparsed(error: OverrideParseException) -> InputError:
    """Refuse what is no setting; a path alone is the usual mistake."""
    override = error.override
    if "=" not in override:
        return InputError(
            override, got="no setting", expected="key=value", fix="A file or folder is given as input=PATH."
        )
    return InputError(
        override, got=_first_line(error), expected="key=value",
        fix="Quote values with blanks, commas or brackets: 'key=\"a, b\"'",
    )  # fmt: skip


def check_backend_choice(config: DictConfig) -> None:
    """Refuse a composed configuration whose backend is not the one that was chosen by ``backend=NAME``.

    A file of the user's ``--config-dir`` may be called as he likes, and names the backend that it is for.

    Raises:
        BackendError: the plugin's config names no backend, or another.
        InputError: the command line does.
    """
    choice = HydraConfig.get().runtime.choices.get("backend")
    if choice is None:
        return
    named = "" if OmegaConf.is_missing(config.backend, "name") else str(config.backend.name)
    if choice == named or (named and _is_own_preset(str(choice))):
        return
    if any(each.startswith("backend.name=") for each in HydraConfig.get().overrides.task):
        raise InputError(
            "backend.name", got=config.backend.name, expected=choice, fix="Choose a backend with backend=NAME"
        )
    got = f"name: {named}" if named else "no name"
    raise _broken_file(f"backend/{choice}.yaml", f"got {got}, expected name: {choice}")


def _is_own_preset(choice: str) -> bool:
    """Whether ``backend=CHOICE`` is a file of the user's own folder, which may name any backend: a preset."""
    shipped = {str(folder) for folder in (configs_dir(), *default_registry().config_offers())}
    for source in HydraConfig.get().runtime.config_sources:
        folder = str(source.path).removeprefix("file://")
        if source.schema == "file" and (Path(folder) / "backend" / f"{choice}.yaml").is_file():
            return folder not in shipped
    return False


def _missing_choice(error: MissingConfigException) -> SomaError:
    group, _, choice = (error.missing_cfg_file or "").rpartition("/")
    registry = default_registry()
    clash = registry.config_clashes().get(f"{error.missing_cfg_file}.yaml")
    if clash is not None:
        return clash
    options = list(error.options or ())
    presets = [each for each in options if each not in registry.names()]
    if group == "backend" and not did_you_mean(choice, presets):
        return registry.missing_config(choice)
    return InputError(
        group or "configuration",
        got=choice or str(error),
        expected=f"one of {', '.join(options) or 'none'}",
        fix=did_you_mean(choice, options) or "See --help",
    )


def _unreadable_file(error: Exception) -> SomaError:
    """Find the file that is not YAML among those of the plugins; hydra does not always say."""
    for folder in default_registry().config_offers():
        for path in sorted(folder.rglob("*.yaml")):
            try:
                OmegaConf.load(path)
            except (YAMLError, UnicodeError, OSError) as reason:
                return _broken_file(path.relative_to(folder).as_posix(), " ".join(str(reason).split()))
    cause = " ".join(str(error).split())
    return InputError("configuration", got=cause, expected="YAML in UTF-8", fix="Correct the file")


def _broken_file(file: str, cause: str) -> SomaError:
    owners = {folder / file: offer.source for folder, offer in default_registry().config_offers().items()}
    path, source = next(
        ((path, source) for path, source in owners.items() if path.is_file()), (Path(file), "not of a plugin")
    )
    return BrokenBackendError(
        who=f'config "{file}" ({source})',
        stage="config",
        cause=cause.rstrip("."),
        fix=f"Correct {path}; the keys of a backend are name, params and options",
    )


def _refused_value(cause: OmegaConfBaseException) -> InputError:
    """Name the full key of an unknown key or a value of the wrong type."""
    name = str(cause.full_key or cause.key)
    parent, _, key = name.rpartition(".")
    if not isinstance(cause, ConfigKeyError | ConfigAttributeError):
        group = cause.parent_node.get(key) if isinstance(cause.parent_node, DictConfig) else None
        return _wrong_type(name, _first_line(cause), list(group) if isinstance(group, DictConfig) else [])
    known = [str(item) for item in cause.parent_node or () if item != "hydra"]
    shown = known[:_SHOWN_KEYS] + [f"{len(known) - _SHOWN_KEYS} more"] * (len(known) > _SHOWN_KEYS)
    return InputError(
        name,
        got="an unknown key",
        expected=f"one of {', '.join(shown) or 'no keys'}" + (f" in {parent}" if parent else ""),
        fix=_RUN_FOLDER
        if name == "out"
        else _elsewhere(key, cause.parent_node) or did_you_mean(key, known) or "See --help",
    )


def _elsewhere(key: str, config: object, prefix: str = "") -> str:
    """Name the full key of a setting given without its group: ``backend.params.age`` for ``age``."""
    if not isinstance(config, DictConfig):
        return ""
    for name in (
        each for each in map(str, config) if each != "hydra" and not OmegaConf.is_missing(config, each)
    ):
        if prefix and name == key:
            return f'Did you mean "{prefix}{name}"?'
        if found := _elsewhere(key, config[name], f"{prefix}{name}."):
            return found
    return ""


def _wrong_type(name: str, text: str, keys: list[object]) -> InputError:
    """Take OmegaConf's sentence apart into got and expected; `keys` are those of a group of settings."""
    whole = re.search(r"is not a subclass of \w+\. value: (.*)", text)
    if whole and keys:
        named = ", ".join(f"{name}.{key}" for key in keys)
        fix = f"Write {name}.{keys[0]}=VALUE, or another of them"
        return InputError(name, got=whole[1], expected=f"its settings one by one: {named}", fix=fix)
    for separator in (", expected ", " could not be converted to "):
        got, found, expected = text.partition(separator)
        if found:
            return InputError(name, got=got[0].lower() + got[1:], expected=expected, fix="See --help")
    return InputError(name, got=text, expected="a value of the declared type", fix="See --help")


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]
