"""The documentation is true: snippets run and print what they say, links lead somewhere, names exist."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from soma_core.cli import TASKS
from soma_core.io import USER_JOINTS, Motion, write_motion
from soma_core.layer import SomaLayer
from soma_core.paths import configs_dir
from soma_core.plugin.registry import Registry

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
OTHER_VERBS = {"backends", "assets"}
FLOAT32 = 1e-5
"""Ratio of two lengths in float32, through a sparse product."""

_SNIPPET = re.compile(
    r"<!-- runnable -->\n```python\n(?P<code>.*?)```\n(?:```text\n(?P<printed>.*?)```)?", re.DOTALL
)
_FILE = re.compile(r"<!-- file: (?P<name>\S+) -->\n```\w+\n(?P<text>.*?)```", re.DOTALL)
_LINK = re.compile(r"\]\(([^)#\s]+)")
_COMMAND = re.compile(r"\bsoma ([a-z][a-z-]*)")


def _text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def _snippets() -> list:
    found = []
    for page in PAGES:
        for match in _SNIPPET.finditer(_text(page)):
            line = _text(page)[: match.start()].count("\n") + 2
            found.append(pytest.param(match["code"], match["printed"], id=f"{page.name}:{line}"))
    return found


@pytest.mark.filterwarnings("default:Sparse CSR tensor support:UserWarning")
@pytest.mark.parametrize(("code", "printed"), _snippets())
def test_snippets_print_what_the_page_says(code, printed, tmp_path, monkeypatch):
    if '"anny"' in code:
        pytest.importorskip("soma_backend_anny")
    monkeypatch.chdir(tmp_path)
    stream = io.StringIO()
    with contextlib.redirect_stdout(stream):
        exec(compile(code, "<snippet>", "exec"), {"__name__": "snippet"})
    assert stream.getvalue() == (printed or "")


def test_every_marked_snippet_is_found():
    marks = sum(_text(page).count("<!-- runnable -->") for page in PAGES)
    assert len(_snippets()) == marks > 0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in _LINK.findall(_text(page)):
        if not target.startswith(("http://", "https://")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_exist(page):
    code = "\n".join(re.findall(r"```sh\n.*?```|`soma [^`]*`", _text(page), re.DOTALL))
    for verb in _COMMAND.findall(code):
        assert verb in {*TASKS, *OTHER_VERBS}, f"{page.name} names the command soma {verb}"
    for name in re.findall(r"experiment=(\w+)", code):
        if name.islower():
            assert (configs_dir() / "experiment" / f"{name}.yaml").is_file(), f"{page.name} names {name}"


def test_the_table_of_motion_keys_is_complete(tmp_path):
    table = _text(ROOT / "docs/conventions.md").split("<!-- motion-keys:begin -->")[1]
    named = set(re.findall(r"^\| `(\w+)` \|", table.split("<!-- motion-keys:end -->")[0], re.MULTILINE))
    motion = Motion(
        rotations=np.tile(np.eye(3), (2, 77, 1, 1)),
        translation=np.zeros((2, 3)),
        fps=30,
        joint_names=USER_JOINTS,
        identity={"backend": "soma", "params": {"shape": [1.0]}},
    )
    write_motion(motion, tmp_path / "m.npz", joint_orient=np.tile(np.eye(3), (77, 1, 1)))
    with np.load(tmp_path / "m.npz", allow_pickle=False) as file:
        assert named == set(file.files)


def test_the_readme_keeps_its_place_for_the_benchmark_tables():
    text = _text(ROOT / "README.md")
    assert text.count("<!-- benchmarks:begin -->") == text.count("<!-- benchmarks:end -->") == 1


@pytest.fixture(scope="module")
def mannequin(tmp_path_factory):
    """The plugin of docs/backends.md, laid out as pip would: its files and its metadata on the path."""
    folder = tmp_path_factory.mktemp("mannequin")
    for match in _FILE.finditer(_text(ROOT / "docs/backends.md")):
        path = folder / match["name"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(match["text"], encoding="utf-8")
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    metadata = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir()
    lines = ["Metadata-Version: 2.1", f"Name: {project['name']}", f"Version: {project['version']}"]
    (metadata / "METADATA").write_text("\n".join(lines) + "\n", encoding="utf-8")
    points = [
        f"[{group}]\n" + "\n".join(f"{name} = {value}" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    ]
    (metadata / "entry_points.txt").write_text("\n".join(points) + "\n", encoding="utf-8")
    _run(folder, "make_wrap.py")
    return folder


def _run(folder: Path, *arguments: str) -> str:
    """Run Python in `folder` with this checkout and the folder itself on the path; return what it prints."""
    paths = os.pathsep.join([str(folder), str(ROOT)])
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


_SOMA = ("-c", "from soma_core.cli import console; console()")


def test_the_plugin_of_the_page_is_found_and_declared(mannequin):
    listed = {entry["name"]: entry for entry in json.loads(_run(mannequin, *_SOMA, "backends", "--json"))}
    assert listed["mannequin"]["distribution"] == "soma-backend-mannequin"
    assert "girth" in _run(mannequin, *_SOMA, "backends", "show", "mannequin")


def test_the_plugin_of_the_page_gives_bodies(mannequin, monkeypatch):
    monkeypatch.syspath_prepend(str(mannequin))
    layer = SomaLayer("mannequin", lod="low", registry=Registry())
    rest = layer.identity({"height": [0.6, 1.2]}).fitted_rest
    stature = rest[..., 1].amax(1) - rest[..., 1].amin(1)
    assert float(stature[1] / stature[0]) == pytest.approx(2.0, rel=FLOAT32)


def test_the_plugin_of_the_page_holds_what_every_backend_must(mannequin):
    command = ["evaluate", "experiment=forward_path", "experiment.backend=mannequin", "experiment.count=2"]
    folder = mannequin / _run(mannequin, *_SOMA, *command).splitlines()[-1]
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert all(figure["passed"] for figure in report["figures"])
