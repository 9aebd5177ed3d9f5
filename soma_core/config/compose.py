"""From a command line to a run: hydra composes the configuration, the task runs in a folder of its own."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from soma_core.config.overrides import literal_texts
from soma_core.config.refusals import REFUSALS, check_backend_choice, in_our_words, with_settings
from soma_core.config.run_folder import run_log, write_provenance
from soma_core.config.schema import SCHEMAS, register_schemas
from soma_core.config.searchpath import register_search_path
from soma_core.errors import InputError, SomaError

__all__ = ["Task", "run_task"]

Task: TypeAlias = Callable[[DictConfig, Path], Path | None]
"""Takes the configuration and the folder of the run; returns where else its result lies, if not there."""


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
    _check_one_folder(config_name, overrides)
    running: list[Path] = []

    def job(config: DictConfig) -> None:
        # As hydra made it: a name that holds ${...} would be taken for an interpolation when it is read.
        runtime: Any = OmegaConf.to_container(HydraConfig.get().runtime, resolve=False)
        folder = Path(runtime["output_dir"])
        running.append(folder)
        try:
            with run_log(folder):
                check_backend_choice(config)
                _check_device(config)
                write_provenance(folder, config, command=[*program.split(), *overrides])
                result = task()(config, folder)
        except SomaError as error:
            if os.environ.get("SOMA_STRICT") == "1":
                raise
            report(with_settings(error))
        else:
            report(result or folder)
        running.clear()

    with _hydra_process(program, literal_texts(overrides, SCHEMAS[config_name])):
        try:
            hydra.main(config_path=None, config_name=config_name, version_base="1.3")(job)()
        except REFUSALS as error:
            raise in_our_words(error) from error
        except OSError as error:
            if running or error.filename is None:
                raise
            raise _no_folder(error, config_name) from error


def _check_one_folder(config_name: str, overrides: Sequence[str]) -> None:
    """Refuse two folders for one run, of which hydra's would be taken in silence."""
    given = dict(each.split("=", 1) for each in overrides if each.startswith(("out=", "hydra.run.dir=")))
    if config_name == "convert" and len(given) > 1 and len({*given.values()}) > 1:
        raise InputError(
            "hydra.run.dir", got=f"{given['hydra.run.dir']} beside out={given['out']}",
            expected="one folder of the results", fix="Leave hydra.run.dir out.",
        )  # fmt: skip


def _check_device(config: DictConfig) -> None:
    """Refuse a device that this machine has not, before anything is written; `--help` imports no torch."""
    if config.get("device") is not None:
        importlib.import_module("soma_core._inputs").usable_device(config.device)


def _no_folder(error: OSError, config_name: str) -> InputError:
    """Say that the folder of a run cannot be made, and which setting names another."""
    setting = "out" if config_name == "convert" else "hydra.run.dir"
    files = isinstance(error, FileExistsError | NotADirectoryError)
    why = "a file of that name is in the way" if files else error.strerror
    return InputError(
        setting, got=f"{error.filename}, which cannot be made ({why})", expected="a folder, or a new name",
        fix=f"Pass {setting}=DIR.",
    )  # fmt: skip


@contextmanager
def _hydra_process(program: str, overrides: Sequence[str]) -> Iterator[None]:
    """Give hydra the command line it reads from the process, and have it raise instead of print.

    HYDRA_FULL_ERROR is hydra's switch for letting exceptions through. hydra's parser takes no overrides
    after a flag that follows others, so the flag that users put anywhere goes first.
    """
    arguments, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    ordered = sorted(overrides, key=lambda each: each not in ("--multirun", "-m"))
    sys.argv, os.environ["HYDRA_FULL_ERROR"] = [program, *ordered], "1"
    try:
        yield
    finally:
        sys.argv = arguments
        if full_error is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = full_error
