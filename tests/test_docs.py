"""The documentation is true: snippets run and print what they say, links lead somewhere, names exist."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest

from soma_core.cli import TASKS
from soma_core.io import USER_JOINTS, Motion, write_motion
from soma_core.paths import configs_dir

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
OTHER_VERBS = {"backends", "assets", "points"}

_SNIPPET = re.compile(
    r"<!-- runnable -->\n```python\n(?P<code>.*?)```\n(?:```text\n(?P<printed>.*?)```)?", re.DOTALL
)
_ROUNDING = re.compile(r"\b\d(\.\d+)?e-1[3-9]\b")
"""Numbers of order one that differ by float64 rounding alone: how much is up to the processor."""
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
    found, expected = (_ROUNDING.sub("rounding", text) for text in (stream.getvalue(), printed or ""))
    assert found == expected


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
        if name.islower() and not name.startswith("my_"):
            assert (configs_dir() / "experiment" / f"{name}.yaml").is_file(), f"{page.name} names {name}"


def test_the_table_of_motion_keys_is_complete(tmp_path):
    table = _text(ROOT / "docs/conventions.md").split("<!-- motion-keys:begin -->")[1]
    named = set(re.findall(r"^\| `(\w+)` \|", table.split("<!-- motion-keys:end -->")[0], re.MULTILINE))
    motion = Motion(
        rotations=np.tile(np.eye(3), (2, 77, 1, 1)),
        translation=np.zeros((2, 3)),
        fps=30,
        joint_names=USER_JOINTS,
        contacts=np.zeros((2, 4), bool),
        skeleton=np.zeros((77, 3)),
        identity={
            "backend": "soma",
            "params": {"shape": [1.0]},
            "options": {"a": 1},
            "rest": np.zeros((4, 3)),
            "scale_params": np.zeros((1, 68)),
        },
    )
    write_motion(motion, tmp_path / "m.npz", joint_orient=np.tile(np.eye(3), (77, 1, 1)))
    with np.load(tmp_path / "m.npz", allow_pickle=False) as file:
        assert named == set(file.files)


def test_the_short_table_of_the_benchmarks_keeps_its_place():
    text = _text(ROOT / "docs/benchmarks.md")
    assert text.count("<!-- benchmarks:begin -->") == text.count("<!-- benchmarks:end -->") == 1
