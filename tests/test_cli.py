"""The command line: exit codes, where text goes, and that help and listings stay light."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import pytest

from soma_core import __version__, cli
from soma_core.cli import EXIT_BACKEND, EXIT_FAILED, EXIT_OK, EXIT_PIPE, EXIT_USAGE, TASKS, main
from soma_core.errors import AssetError, SomaError
from soma_core.paths import assets_dir, configs_dir
from soma_core.plugin.errors import BackendWarning
from soma_core.plugin.known import KNOWN_BACKENDS
from tests.plugin.installed import Distribution

ROOT = Path(__file__).resolve().parents[1]


def _write(config, output: Path) -> None:
    (output / "result.txt").write_text(config.backend.name)


def _refuse(config, output: Path) -> None:
    raise AssetError("rig.usda", cause="hash differs", fix="Run: soma assets verify")


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


def test_names_give_a_terminal_no_orders(capsys) -> None:
    assert main(["backends", "show", "a\x1b[31m"]) == 3
    assert "\x1b" not in capsys.readouterr().err


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
    assert streams.err.splitlines()[-1] == "soma: rig.usda: hash differs. Run: soma assets verify"
    assert "Traceback" not in streams.err


def test_the_worst_job_of_a_sweep_sets_the_exit_code(tmp_path: Path, monkeypatch) -> None:
    def one_fails(config, output: Path) -> None:
        if config.seed == 1:
            _refuse(config, output)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli.TaskRow, "load", lambda row: one_fails)
    assert main(["animate", "--multirun", "seed=0,1,2"]) == EXIT_FAILED


def test_a_preset_of_the_users_own_folder_names_the_backend_that_it_is_for(
    tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    own = tmp_path / "own" / "backend"
    own.mkdir(parents=True)
    (own / "heavy_man.yaml").write_text("defaults: [toy]\nparams: {girth: 1.3}\n")
    (own / "nameless.yaml").write_text("params: {girth: 1.3}\n")
    seen = []
    monkeypatch.setattr(cli.TaskRow, "load", lambda row: lambda config, folder: seen.append(config.backend))
    chosen = ["animate", "--config-dir", str(own.parent)]
    assert main([*chosen, "backend=heavy_man", "backend.params.legs=0.9"]) == EXIT_OK
    (backend,) = seen
    assert (backend.name, backend.params.girth, backend.params.legs) == ("toy", 1.3, 0.9)
    assert main([*chosen, "backend=nameless"]) == EXIT_BACKEND
    assert main([*chosen, "backend=heavy_mann"]) == EXIT_USAGE
    assert 'Did you mean "heavy_man"?' in capsys.readouterr().err


def test_a_backend_that_is_not_usable_has_its_own_exit_code(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(KNOWN_BACKENDS, "absent", replace(KNOWN_BACKENDS["toy"], name="absent"))
    assert main(["backends", "show", "absent"]) == EXIT_BACKEND
    assert main(["animate", "backend=absent"]) == EXIT_BACKEND
    assert capsys.readouterr().err.count("pip install ./plugins/toy") == 2


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


@pytest.mark.parametrize("arguments", [["animate", "--help"], ["--help"], ["backends"]])
def test_a_reader_that_goes_away_ends_the_command_quietly(arguments: list[str]) -> None:
    """As in ``soma animate --help | head -1``."""
    code = "from soma_core.cli import console; console()"
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == EXIT_PIPE


@pytest.mark.parametrize(("given", "held"), [({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")])
def test_threads_of_torch_do_not_wait_awake_unless_that_is_asked_for(given: dict, held: str) -> None:
    """They begin when torch is imported."""
    code = """
import os, sys
from soma_core import cli
cli.main = lambda arguments: print(os.environ["OMP_WAIT_POLICY"], "torch" in sys.modules)
cli.console()
"""
    kept = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    said = subprocess.run(
        [sys.executable, "-c", code], env=kept | given, capture_output=True, text=True, check=True
    )
    assert said.stdout.split() == [held, "False"]


def test_a_warning_about_a_backend_is_one_line(monkeypatch) -> None:
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    monkeypatch.setattr(cli, "main", lambda arguments: EXIT_OK)
    with pytest.raises(SystemExit, match="^0$"):
        cli.console()
    where = ("plugin.py", 3, "code()")
    assert warnings.formatwarning("is old", BackendWarning, *where) == "soma: is old\n"
    assert warnings.formatwarning("is odd", UserWarning, *where).startswith(
        "plugin.py:3: UserWarning: is odd"
    )


@pytest.mark.parametrize("stop", [0, 3, None])
def test_the_console_script_ends_with_the_code_of_the_command(stop, monkeypatch) -> None:
    def end(arguments):
        raise SystemExit(stop)

    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    monkeypatch.setattr(cli, "main", end)
    with pytest.raises(SystemExit) as caught:
        cli.console()
    assert caught.value.code == stop


def test_assets_path_and_verify(capsys, tmp_path: Path) -> None:
    assert main(["assets", "path"]) == EXIT_OK
    assert capsys.readouterr().out == f"{assets_dir()}\n"
    assert main(["assets", "verify"]) == EXIT_OK
    assert main(["assets", "verify", "--root", str(tmp_path)]) == EXIT_FAILED
    assert str(tmp_path) in capsys.readouterr().err


def _modules_after(code: str, *, path: Path | None = None) -> set[str]:
    """Top-level modules that a fresh interpreter holds after running `code`; `path` is put before its own."""
    script = f"{code}\nimport sys; sys.stderr.write(' '.join(sorted(sys.modules)))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, filter(None, (path, ROOT))))}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment
    )
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
        "soma_backend_anny",
        "anny",
    }


@pytest.mark.parametrize(
    "arguments", [["--help"], ["backends"], ["backends", "--json"], ["backends", "--help"]]
)
def test_help_and_listing_import_none_of_fifty_plugins(arguments: list[str], tmp_path: Path) -> None:
    names = [f"p{number:02d}" for number in range(50)]
    for name in names:
        Distribution(name=name).install(tmp_path)
    code = f"""
import contextlib, io
from soma_core.cli import main
text = io.StringIO()
with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
    main({arguments!r})
assert "--help" in {arguments!r} or all(name in text.getvalue() for name in {names!r})
"""
    loaded = _modules_after(code, path=tmp_path)
    assert "soma_core" in loaded
    assert not {name for name in loaded if name.startswith("soma_backend_")}
