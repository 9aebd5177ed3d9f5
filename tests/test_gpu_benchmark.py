"""The script that is run once on a rented GPU, at toy sizes on the CPU."""

import json
import os
import subprocess
import sys

import pytest

from tests.test_house_rules import ROOT

SCRIPT = ROOT / "benchmarks" / "gpu.py"


def run(*arguments):
    known = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *map(str, arguments)], capture_output=True, text=True, timeout=300,
        env={**os.environ, "PYTHONPATH": known},
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


@pytest.mark.slow
def test_every_section_runs_on_the_cpu(tmp_path):
    only = ("machine", "kernels", "layer", "fit", "table4", "graph", "inversion", "after")
    code, text = run("--device", "cpu", "--quick", "--out", tmp_path, "--only", *only)
    state = json.loads((tmp_path / "gpu.json").read_text())
    assert code == 0, text
    assert {name: section["status"] for name, section in state["sections"].items()} == dict.fromkeys(
        only, "done"
    )
    assert not state.get("restarts")
    assert sum(len(section["rows"]) for section in state["sections"].values()) > 80
    code, table = run("--table", tmp_path / "gpu.json")
    assert code == 0
    assert "| kinematics float32 |" in table


def test_a_section_without_time_says_so(tmp_path):
    code, _ = run(
        "--device", "cpu", "--quick", "--seconds-budget", "0", "--out", tmp_path, "--only", "kernels"
    )
    state = json.loads((tmp_path / "gpu.json").read_text())
    assert code == 0
    assert state["sections"]["kernels"]["status"] == "skipped"
