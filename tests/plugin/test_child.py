"""Plugins in child processes: whatever one does, it costs one row, and what comes out is JSON."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from soma_core.plugin.child import EndedError, run_in_child
from tests.plugin.installed import Distribution

ROOT = Path(__file__).resolve().parents[2]
_SOUND = """
from soma_core.plugin import BackendSpec, hookimpl
@hookimpl
def soma_backend():
    {declare}
    return BackendSpec(name="{name}", api=2, unit="cm", up="+y", forward="+z", params=(), wrap=None)
@hookimpl
def soma_generator(device, dtype):
    {build}
    from soma_core import load_canonical
    class Model:
        import torch
        rest_ = torch.as_tensor(100 * load_canonical("mid")[0].vertices, device=device, dtype=dtype)
        def rest(self, params):
            {rest}
            return self.rest_[None]
    return Model()
"""

# Name -> where, what, and what the row must say.
HARM = {
    "exits": ("module", "import os; os._exit(7)", "import: an end of the process with exit code 7"),
    "exits_ok": ("declare", "import os; os._exit(0)", "import: an end of the process with exit code 0"),
    "segfaults": ("module", "import ctypes; ctypes.string_at(0)", "import: an end of the process by SIGSEGV"),
    "aborts": ("build", "import os; os.abort()", "build: an end of the process by SIGABRT"),
    "hangs": ("rest", "import time; time.sleep(600)", "rest: no answer within 30 s"),
    "interrupts": ("build", "raise KeyboardInterrupt", "build: KeyboardInterrupt"),
    "kills": ("module", "import os; os.kill(0, 9)", "import: an end of the process by SIGKILL"),
    "forks": ("module", "import os; os.fork() or os._exit(5)", ""),
    "patches": ("declare", "import torch; torch.as_tensor = torch.nn.Linear = None", "build: TypeError"),
    "raises": ("module", "raise GeneratorExit", "import: GeneratorExit"),
    "recurses": ("declare", "f = lambda: f(); f()", "hooks: RecursionError"),
    "prints_c": ("module", "import ctypes; ctypes.CDLL(None).puts(b'from C')", ""),
    "prints": ("rest", "import os; os.write(1, b'from below'); print('x', flush=True)", ""),
    "closes": ("declare", "import os; os.close(1); os.close(2)", ""),
    "reads_others": ("module", "import importlib.metadata as found; found.entry_points()", ""),
    "exit_hook": ("module", "import atexit, os; atexit.register(os.write, 1, b'bye')", ""),
}


def _body(name: str, place: str, harm: str) -> str:
    hooks = _SOUND.format(
        name=name, **{each: harm if each == place else "pass" for each in ("declare", "build", "rest")}
    )
    return f"{harm}\n{hooks}" if place == "module" else hooks


def _soma(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return _run(site, "backends", *arguments, names=",".join(["soma", *HARM]))


def _run(site: Path, *arguments: str, names: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join((str(site), str(ROOT)))
    return subprocess.run(
        [sys.executable, "-c", "from soma_core.cli import console; console()", *arguments],
        env=os.environ | {"PYTHONPATH": path, "SOMA_BACKENDS": names},
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip


def _damage(site: Path) -> None:
    """Install metadata that cannot be read, and a Triton that reads it once PyTorch asks for it."""
    broken = Distribution(name="unrelated", distribution="unrelated").write_metadata(site)
    (broken / "entry_points.txt").write_bytes(b"\xff\xfe[soma_core.backends]\nno value\n")
    (site / "triton").mkdir()
    (site / "triton" / "__init__.py").write_text(_TRITON)


_TRITON = """
import importlib.metadata, os
if os.environ.get("TRITON_BACKENDS_IN_TREE") != "1":
    importlib.metadata.entry_points()
raise ImportError("only a stand-in")
"""


@pytest.mark.parametrize("verb", [["backends", "check", "--explain", "finite"], ["assets", "show"]])
def test_what_needs_no_plugin_steps_around_damage(site: Path, verb: list[str]) -> None:
    _damage(site)
    ended = _run(site, *verb, names="toy")
    assert ended.returncode == 0, ended.stderr


def test_a_first_body_steps_around_damage(site: Path) -> None:
    _damage(site)
    assert _run(site, "backends", "--load", names="soma").returncode == 0


@pytest.mark.slow
def test_harm_costs_one_row_and_the_listing_stays_json(site: Path) -> None:
    for name, (place, harm, _) in HARM.items():
        Distribution(name=name, body=_body(name, place, harm)).install(site)
    _damage(site)
    ended = _soma(site, "--load", "--json", "--timeout", "30")
    rows = {row["name"]: row for row in json.loads(ended.stdout) if row["state"] != "blocked"}
    assert ended.returncode == 3
    assert rows["soma"]["state"] == "built", rows["soma"]["error"]
    assert "damaged" in rows["-"]["error"]["cause"]
    for name, (_, _, told) in HARM.items():
        row = rows[name]
        if told:
            error = row["error"]
            assert row["state"] == "broken", row
            assert f"{error['stage']}: {error['cause']}".startswith(told), row
        else:
            assert row["state"] == "built", row
    assert "from C" in ended.stderr
    assert json.loads(_soma(site, "show", "prints_c", "--json").stdout)["name"] == "prints_c"
    died = _soma(site, "show", "segfaults", "--json")
    assert "SIGSEGV" in json.loads(died.stdout)["error"]["cause"]
    assert died.returncode == 3


@pytest.mark.slow
def test_a_check_that_ends_the_process_is_one_failure(site: Path) -> None:
    harm = "import os, sys; sys._getframe(1).f_code.co_name == 'finite' and os._exit(9)"
    Distribution(name="exits", body=_body("exits", "rest", harm)).install(site)
    ended = _soma(site, "check", "exits", "--level", "core", "--json")
    report = json.loads(ended.stdout)
    (ours,) = [each for each in report["checks"] if each["id"] == "finite"]
    assert (ours["state"], ours["got"]) == ("failed", "an end of the process with exit code 9")
    states = {each["id"]: each["state"] for each in report["checks"]}
    assert states["generator-dtype"] == "passed"
    assert states["deterministic"] == "not run"
    assert ended.returncode == 1


def test_a_child_says_and_is_gone() -> None:
    assert list(run_in_child(f"{__name__}:_counts", 3, seconds=60)) == [0, 1, 2]


def test_what_a_child_raises_is_told() -> None:
    with pytest.raises(EndedError, match="ZeroDivisionError: division by zero"):
        list(run_in_child(f"{__name__}:_counts", 0, seconds=60))


def test_a_caller_that_stops_listening_leaves_nothing() -> None:
    begun = time.monotonic()
    said = run_in_child(f"{__name__}:_waits", seconds=60)
    pid = next(said)
    said.close()
    assert time.monotonic() - begun < 40
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.slow
def test_what_a_child_prepares_is_not_in_the_limit() -> None:
    """On a busy machine imports and a first compilation took longer than what a plugin was given."""
    assert list(run_in_child(f"{__name__}:_counts", 2, seconds=5, prepare=f"{__name__}:_takes_6_s")) == [0, 1]


def test_a_child_that_never_is_ready_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("soma_core.plugin.child._STARTS_S", 0.1)
    with pytest.raises(EndedError, match=r"not ready within 0\.1 s"):
        list(run_in_child(f"{__name__}:_counts", 2, seconds=60, prepare=f"{__name__}:_takes_6_s"))


def _takes_6_s() -> None:
    time.sleep(6)


def _counts(say, count: int) -> None:
    1 / count
    for number in range(count):
        say(number)


def _waits(say) -> None:
    say(os.getpid())
    time.sleep(600)
