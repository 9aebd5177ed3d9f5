"""Declaring in a fresh interpreter: what is seen, and what a plugin cannot hide."""

from __future__ import annotations

import subprocess
import sys

import pytest

from soma_core.testing import import_probe
from soma_core.testing.import_probe import probe_import
from tests.testing.packages import package


def probe(tmp_path, *, line=""):
    def edit(made):
        made.replace("__init__.py", "FOLDER =", f"{line}\nFOLDER =")

    with package(tmp_path, edit) as registry:
        return probe_import(registry.offers("specimen")[0])


def test_a_light_and_silent_plugin(tmp_path):
    found = probe(tmp_path)
    assert (found.output, found.error) == ("", "")
    assert "soma_backend_specimen" in found.packages
    assert "torch" not in found.packages


@pytest.mark.parametrize(
    ("line", "output", "error"),
    [
        ("import sys; sys.stderr.write('low on memory')", "low on memory", ""),
        ("import os; os.system('echo from below')", "from below", ""),
        ("import atexit; atexit.register(print, 'goodbye')", "goodbye", ""),
        ("import os; os._exit(7)", "", "an end with exit code 7"),
        ("raise SystemExit('no key')", "", "import: SystemExit: no key"),
        ("input('your name? ')", "your name?", "import: EOFError: EOF when reading a line"),
    ],
)
def test_what_a_plugin_does(tmp_path, line, output, error):
    found = probe(tmp_path, line=line)
    assert (found.output, found.error) == (output, error)


def test_an_import_that_does_not_end(tmp_path, monkeypatch):
    monkeypatch.setattr(import_probe, "_LIMIT_S", 2)
    assert probe(tmp_path, line="import time; time.sleep(60)").error == "no end within 2 s"


def test_the_package_loads_neither_torch_nor_pytest():
    code = "import soma_core.testing, sys; print({'torch', 'pytest', 'numpy', 'hydra'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_an_unknown_name_is_refused():
    import soma_core.testing

    with pytest.raises(AttributeError, match="'conformance_suit'.*it offers.*conformance_suite"):
        _ = soma_core.testing.conformance_suit
