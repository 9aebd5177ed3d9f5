"""The command line: exit codes, where text goes, and that help and listings stay light."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from soma_core import __version__, cli
from soma_core.cli import EXIT_BACKEND, EXIT_FAILED, EXIT_OK, EXIT_USAGE, TASKS, main
from soma_core.errors import AssetError, SomaError
from soma_core.paths import assets_dir, configs_dir


def _write(config, output: Path) -> None:
    (output / "result.txt").write_text(config.backend.name)


def _refuse(config, output: Path) -> None:
    raise AssetError("rig.usda", cause="hash differs", fix="Run: soma assets build")


def test_help_lists_every_task(capsys) -> None:
    assert main(["--help"]) == EXIT_OK
    text = capsys.readouterr().out
    assert all(name in text for name in TASKS)


@pytest.mark.parametrize("task", TASKS)
def test_help_of_a_task_starts_with_its_verb(task: str, capsys) -> None:
    with pytest.raises(SystemExit, match="^0$"):  # hydra ends the process once it has printed its help
        main([task, "--help"])
    assert capsys.readouterr().out.startswith(f"usage: soma {task} [key=value ...]\n")


def test_nothing_asked_for_is_a_usage_error(capsys) -> None:
    assert main([]) == EXIT_USAGE
    assert "usage: soma" in capsys.readouterr().out


def test_version(capsys) -> None:
    assert main(["--version"]) == EXIT_OK
    assert capsys.readouterr().out == f"soma-body-core {__version__}\n"


def test_unknown_command_suggests_the_closest(capsys) -> None:
    assert main(["animat"]) == EXIT_USAGE
    streams = capsys.readouterr()
    assert streams.out == ""
    assert "soma: command: got animat, expected one of animate" in streams.err
    assert 'Did you mean "animate"?' in streams.err


def test_every_task_in_the_table_has_a_module_and_a_config() -> None:
    for row in TASKS.values():
        assert importlib.util.find_spec(f"soma_core.tasks.{row.module}") is not None
        assert (configs_dir() / f"{row.module}.yaml").is_file()


def test_a_task_prints_its_folder_as_the_last_line(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli.TaskRow, "load", lambda row: _write)
    assert main(["animate"]) == EXIT_OK
    folder = Path(capsys.readouterr().out.splitlines()[-1])
    assert folder.parent == Path("outputs/animate")
    assert (folder / "result.txt").read_text() == "soma"


def test_a_failed_check_is_one_message_without_traceback(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli.TaskRow, "load", lambda row: _refuse)
    assert main(["animate"]) == EXIT_FAILED
    streams = capsys.readouterr()
    assert streams.out == ""
    assert streams.err.splitlines()[-1] == "soma: rig.usda: hash differs. Run: soma assets build"
    assert "Traceback" not in streams.err


def test_the_worst_job_of_a_sweep_sets_the_exit_code(tmp_path: Path, monkeypatch) -> None:
    def one_fails(config, output: Path) -> None:
        if config.seed == 1:
            _refuse(config, output)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli.TaskRow, "load", lambda row: one_fails)
    assert main(["animate", "--multirun", "seed=0,1,2"]) == EXIT_FAILED


def test_a_backend_that_is_not_usable_has_its_own_exit_code(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["backends", "show", "smpl"]) == EXIT_BACKEND
    assert main(["animate", "backend=smpl"]) == EXIT_BACKEND
    assert capsys.readouterr().err.count("Run: pip install soma-backend-smpl") == 2


def test_strict_lets_the_traceback_through(monkeypatch) -> None:
    monkeypatch.setenv("SOMA_STRICT", "1")
    with pytest.raises(SomaError, match="animat"):
        main(["animat"])


def test_ctrl_c_ends_quietly(monkeypatch, capsys) -> None:
    def interrupt(arguments) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_dispatch", interrupt)
    assert main(["backends"]) == 130
    assert capsys.readouterr().err == "soma: interrupted\n"


@pytest.mark.parametrize("arguments", [["backends"], ["backends", "list"]])
def test_backends_are_listed(arguments: list[str], capsys) -> None:
    assert main(arguments) == EXIT_OK
    assert "soma-body-core" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["backends", "--json"], ["backends", "list", "--json"]])
def test_backends_are_listed_as_json(arguments: list[str], capsys) -> None:
    assert main(arguments) == EXIT_OK
    names = [entry["name"] for entry in json.loads(capsys.readouterr().out)]
    assert "soma" in names


def test_a_backend_is_shown(capsys) -> None:
    assert main(["backends", "show", "soma"]) == EXIT_OK
    assert "unit" in capsys.readouterr().out
    assert main(["backends", "show", "soma", "--json"]) == EXIT_OK
    assert json.loads(capsys.readouterr().out)["name"] == "soma"


def test_assets_path_and_verify(capsys, tmp_path: Path) -> None:
    assert main(["assets", "path"]) == EXIT_OK
    assert capsys.readouterr().out == f"{assets_dir()}\n"
    assert main(["assets", "verify"]) == EXIT_OK
    assert main(["assets", "verify", "--root", str(tmp_path)]) == EXIT_FAILED
    assert str(tmp_path) in capsys.readouterr().err


def _modules_after(code: str) -> set[str]:
    """Top-level modules that a fresh interpreter holds after running `code`."""
    script = f"{code}\nimport sys; sys.stderr.write(' '.join(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return {name.partition(".")[0] for name in done.stderr.split()}


@pytest.mark.parametrize("arguments", [["--help"], ["backends"], ["backends", "--json"]])
def test_help_and_listing_import_no_plugin_and_nothing_heavy(arguments: list[str]) -> None:
    loaded = _modules_after(f"from soma_core.cli import main; main({arguments!r})")
    assert not loaded & {
        "torch",
        "warp",
        "pxr",
        "trimesh",
        "numpy",
        "hydra",
        "rich",
        "soma_backend_anny",
        "anny",
    }
