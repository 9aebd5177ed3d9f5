"""From overrides to a run: what is refused, what a run leaves behind, and where."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from omegaconf import DictConfig

from soma_core.config.compose import run_task
from soma_core.config.refusals import with_settings
from soma_core.errors import InputError, SomaError
from soma_core.plugin.errors import UnknownBackendError
from soma_core.plugin.known import KNOWN_BACKENDS

Run = Callable[..., list[Path | SomaError]]


def _task(config: DictConfig, output: Path) -> None:
    if config.seed == 7:
        raise InputError("seed", got=7, expected="anything else", fix="Use 8")
    (output / "result.txt").write_text(f"{config.backend.name} {config.lod} {config.write[0]}")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a task that writes one file under the animate config, in an empty current folder."""
    monkeypatch.chdir(tmp_path)

    def call(*overrides: str) -> list[Path | SomaError]:
        outcomes: list[Path | SomaError] = []
        run_task(
            lambda: _task,
            config_name="animate",
            program="soma animate",
            overrides=overrides,
            report=outcomes.append,
        )
        return outcomes

    return call


def test_a_run_has_a_folder_of_its_own_and_writes_nothing_else(run: Run, tmp_path: Path) -> None:
    (folder,) = run("lod=low", "seed=3")
    assert isinstance(folder, Path)
    assert folder.parent == tmp_path / "outputs" / "animate"
    assert sorted(path.name for path in folder.iterdir()) == [
        "config.yaml",
        "environment.json",
        "log.txt",
        "result.txt",
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["outputs"]
    assert (folder / "result.txt").read_text() == "soma low npz"


def test_a_run_says_what_it_takes_to_run_it_again(run: Run) -> None:
    (folder,) = run("lod=low", "seed=3")
    assert isinstance(folder, Path)
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["lod"] == "low"
    assert config["backend"] == {"name": "soma", "params": {"shape": None}, "options": {"shape_space": None}}
    environment = json.loads((folder / "environment.json").read_text())
    assert environment["command"] == ["soma", "animate", "lod=low", "seed=3"]
    assert environment["seed"] == 3
    assert environment["device"] == "cpu"
    assert re.fullmatch(r"[0-9a-f]{16}", environment["rig_revision"])
    assert "torch" in environment["distributions"]
    assert "soma" in [backend["name"] for backend in environment["backends"]]


def test_the_folder_can_be_chosen(run: Run, tmp_path: Path) -> None:
    assert run("hydra.run.dir=here") == [tmp_path / "here"]


def test_a_failed_job_does_not_end_the_others(run: Run) -> None:
    first, second, third = run("--multirun", "seed=1,7,2")
    assert isinstance(first, Path)
    assert isinstance(third, Path)
    assert (first.name, third.name) == ("0", "2")
    assert isinstance(second, InputError)
    assert "seed: got 7" in str(second)


def test_the_log_of_a_failed_run_keeps_the_traceback(run: Run, tmp_path: Path) -> None:
    run("seed=7", "hydra.run.dir=failed")
    text = (tmp_path / "failed" / "log.txt").read_text()
    assert "seed: got 7" in text
    assert "Traceback" in text


def test_strict_lets_the_error_of_a_task_through(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOMA_STRICT", "1")
    with pytest.raises(InputError, match="seed: got 7"):
        run("seed=7")


@pytest.mark.parametrize(
    ("override", "text"),
    [
        (
            "picture.widht=3",
            "picture.widht: got an unknown key, expected one of frames, width in picture. "
            'Did you mean "width"?',
        ),
        (
            "backend.params.shap=[1]",
            "backend.params.shap: got an unknown key, expected one of shape in backend.params. "
            'Did you mean "shape"?',
        ),
        ("width=3", 'Did you mean "picture.width"?'),
        ("shape=[1]", 'Did you mean "backend.params.shape"?'),
        ("bakend=soma", "bakend: got an unknown key, expected one of backend, backends, motion"),
        ("out=here", "The folder of this run is named by hydra.run.dir=FOLDER"),
        ("frames=0:3", "frames: got 0:3, expected its settings one by one: frames.start, frames.stop"),
        ("lod=big", "lod: got invalid value 'big', expected one of [mid, low, xlo]"),
        ("write=[npz,uds]", "write[1]: got invalid value 'uds', expected one of [npz, usd, glb, html, png,"),
        ("picture.width=wide", "picture.width: got value 'wide' of type 'str', expected Integer"),
        ("frames.start=[", "frames.start=[: got"),
        ("backend=soma,other", "got Ambiguous value for argument 'backend=soma,other'"),
        ("hydra/output=elsewhere", "hydra/output: got elsewhere, expected one of default, soma"),
    ],
)
def test_a_wrong_override_is_named_in_full(run: Run, override: str, text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(text)):
        run(override)
    assert list(tmp_path.iterdir()) == []


def test_a_backend_that_is_not_installed_is_reported_in_our_words(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = replace(KNOWN_BACKENDS["toy"], name="absent", distribution="soma-backend-absent")
    monkeypatch.setitem(KNOWN_BACKENDS, "absent", known)
    with pytest.raises(UnknownBackendError, match=r'"absent".*pip install \./plugins/absent'):
        run("backend=absent")
    with pytest.raises(UnknownBackendError, match='"absent"'):
        run("--multirun", "backend=soma,absent")


@pytest.mark.parametrize("device", ["cuda:97", "gpu"])
def test_a_device_that_is_not_there_is_refused_before_anything_runs(run: Run, device: str) -> None:
    (error,) = run(f"device={device}")
    assert isinstance(error, InputError)
    assert str(error).startswith(f"device: got '{device}' (")
    assert str(error).endswith("Pass device=cpu.")


def test_a_parameter_is_named_by_its_setting() -> None:
    error = with_settings(InputError("params['shape']", got=1, expected=2, fix="Reshape the value."))
    assert str(error).startswith("backend.params.shape: got 1, expected 2. Correct backend.params.shape")
    other = InputError("shape", got=1, expected=2, fix="Look.")
    assert with_settings(other) is other
