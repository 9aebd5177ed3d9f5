"""From a command line to a run: hydra composes the configuration, the task runs in a folder of its own."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from soma_core.config.run_folder import run_log, write_provenance
from soma_core.config.schema import register_schemas
from soma_core.config.searchpath import register_search_path
from soma_core.errors import InputError, SomaError
from soma_core.plugin.declaration import did_you_mean
from soma_core.plugin.registry import default_registry

__all__ = ["Task", "run_task"]

_SHOWN_KEYS = 16
"""A backend may have hundreds of parameters; an error message lists this many."""

Task: TypeAlias = Callable[[DictConfig, Path], None]


def run_task(
    task: Callable[[], Task],
    *,
    config_name: str,
    program: str,
    overrides: Sequence[str],
    report: Callable[[Path | SomaError], None],
) -> None:
    """Compose the configuration and run the task once, or once for each job of ``--multirun``.

    Args:
        task: imports the task; called once the configuration is known to be sound.
        config_name: primary config in the search path.
        program: how help and usage texts name the command.
        overrides: hydra's command line.
        report: takes the folder of each job that succeeded and the error of each that failed. A
            failed job does not end the others.

    Raises:
        InputError: an override that does not parse, an unknown key, a value of the wrong type.
        BackendError: the backend asked for is not installed or not usable.
    """
    register_schemas()
    register_search_path()

    def job(config: DictConfig) -> None:
        folder = Path(HydraConfig.get().runtime.output_dir)
        try:
            with run_log(folder):
                write_provenance(folder, config, command=[*program.split(), *overrides])
                task()(config, folder)
        except SomaError as error:
            if os.environ.get("SOMA_STRICT") == "1":
                raise
            report(error)
        else:
            report(folder)

    with _hydra_process(program, overrides):
        try:
            hydra.main(config_path=None, config_name=config_name, version_base="1.3")(job)()
        except HydraException as error:
            raise _in_our_words(error) from error


@contextmanager
def _hydra_process(program: str, overrides: Sequence[str]) -> Iterator[None]:
    """Give hydra the command line it reads from the process, and have it raise instead of print.

    HYDRA_FULL_ERROR is hydra's switch for letting exceptions through.
    """
    arguments, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv, os.environ["HYDRA_FULL_ERROR"] = [program, *overrides], "1"
    try:
        yield
    finally:
        sys.argv = arguments
        if full_error is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = full_error


def _in_our_words(error: HydraException) -> SomaError:
    """Say what hydra refused, and how to mend it."""
    if isinstance(error, MissingConfigException):
        return _missing_choice(error)
    if isinstance(error, OverrideParseException):
        return InputError(
            error.override,
            got=_first_line(error),
            expected="key=value",
            fix="Quote values with spaces, commas or brackets: 'key=\"a, b\"'",
        )
    if isinstance(error.__cause__, OmegaConfBaseException):
        return _refused_value(error.__cause__)
    first, *rest = str(error).splitlines()
    return InputError("configuration", got=first, expected="key=value", fix=" ".join(rest) or "See --help")


def _missing_choice(error: MissingConfigException) -> SomaError:
    group, _, choice = (error.missing_cfg_file or "").rpartition("/")
    registry = default_registry()
    clash = registry.config_clashes().get(f"{error.missing_cfg_file}.yaml")
    if clash is not None:
        return clash
    if group == "backend":
        return registry.missing_config(choice)
    options = list(error.options or ())
    return InputError(
        group or "configuration",
        got=choice or str(error),
        expected=f"one of {', '.join(options) or 'none'}",
        fix=did_you_mean(choice, options) or "See --help",
    )


def _refused_value(cause: OmegaConfBaseException) -> InputError:
    """Name the full key of an unknown key or a value of the wrong type."""
    name = str(cause.full_key or cause.key)
    if not isinstance(cause, ConfigKeyError | ConfigAttributeError):
        return _wrong_type(name, _first_line(cause))
    parent, _, key = name.rpartition(".")
    known = [str(item) for item in cause.parent_node or () if item != "hydra"]
    shown = known[:_SHOWN_KEYS] + [f"{len(known) - _SHOWN_KEYS} more"] * (len(known) > _SHOWN_KEYS)
    return InputError(
        name,
        got="an unknown key",
        expected=f"one of {', '.join(shown) or 'no keys'}" + (f" in {parent}" if parent else ""),
        fix=did_you_mean(key, known) or "See --help",
    )


def _wrong_type(name: str, text: str) -> InputError:
    """Take OmegaConf's sentence apart into got and expected."""
    for separator in (", expected ", " could not be converted to "):
        got, found, expected = text.partition(separator)
        if found:
            return InputError(name, got=got[0].lower() + got[1:], expected=expected, fix="See --help")
    return InputError(name, got=text, expected="a value of the declared type", fix="See --help")


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]
