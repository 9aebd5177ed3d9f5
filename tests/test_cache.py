import os
import subprocess
import sys

import numpy as np
import pytest

from soma_core.cache import atomic_arrays, atomic_text, atomic_write, cached_arrays
from soma_core.errors import SomaError
from soma_core.paths import data_dir


def test_what_fails_half_way_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "kept.txt"
    atomic_text(path, "whole \u00e9\n")

    def fail(temporary):
        temporary.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        atomic_write(path, fail)
    assert path.read_text(encoding="utf-8") == "whole \u00e9\n"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("name", ["a.npz", "a.other"])
def test_arrays_come_back_whatever_the_file_is_called(tmp_path, name, compressed):
    arrays = {"x": np.arange(1000.0), "text": np.array("T-pose")}
    atomic_arrays(tmp_path / name, arrays, compressed=compressed)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    with np.load(tmp_path / name) as found:
        assert {key: found[key].tolist() for key in found.files} == {k: v.tolist() for k, v in arrays.items()}


def built(value=1.0):
    return lambda: {"a": np.full(3, value), "b": np.zeros((2, 2), np.int32)}


@pytest.mark.parametrize(
    "damage",
    [{}, {"a": np.ones(3)}, {"a": np.ones(3), "b": np.zeros((2, 3), np.int32)}, {"other": np.ones(3)}],
)
def test_a_sound_file_of_other_arrays_is_built_again(tmp_path, monkeypatch, damage, caplog):
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path))
    cached_arrays("kind", "key", built())
    found = cached_arrays("kind", "key", built(2.0))
    assert {name: array.tolist() for name, array in found.items()} == {"a": [1.0] * 3, "b": [[0, 0], [0, 0]]}
    with np.load(tmp_path / "kind/key.npz") as stored:
        kept = {name: stored[name] for name in stored.files if name not in "ab"}
    np.savez(tmp_path / "kind/key.npz", **kept, **damage)
    assert cached_arrays("kind", "key", built(3.0))["a"].tolist() == [3.0] * 3
    assert "building it again" in caplog.text


def test_what_cannot_be_written_is_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(SomaError, match=r"file.b\.txt: cannot be written \(.+\)\. Make room") as caught:
        atomic_text(tmp_path / "file/b.txt", "text")
    assert isinstance(caught.value, OSError)
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path / "file"))
    assert cached_arrays("kind", "key", built())["a"].tolist() == [1.0] * 3


def test_without_a_home_nothing_is_cached_and_models_need_a_setting(monkeypatch):
    for name in ("HOME", "SOMA_CACHE_DIR", "SOMA_DATA_DIR", "XDG_CACHE_HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)

    def no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr("pathlib.Path.home", no_home)
    assert cached_arrays("kind", "key", built())["a"].tolist() == [1.0] * 3
    with pytest.raises(SomaError, match="HOME: got no home folder.*Set SOMA_DATA_DIR=FOLDER"):
        data_dir()


def test_what_killed_processes_left_is_swept_at_the_next_run(tmp_path):
    script = (
        "import os, signal, sys; from pathlib import Path; from soma_core.cache import atomic_write\n"
        "atomic_write(Path(sys.argv[1]), lambda path: os.kill(os.getpid(), signal.SIGKILL))"
    )
    subprocess.run([sys.executable, "-c", script, str(tmp_path / "motion.npz")], check=False)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".motion-")
    alive = tmp_path / left.name.replace(left.name.split("-")[2], str(os.getpid()))
    alive.touch()
    atomic_text(tmp_path / "report.json", "{}")
    assert sorted(path.name for path in tmp_path.iterdir()) == [alive.name, "report.json"]
