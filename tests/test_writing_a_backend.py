"""docs/writing_a_backend.md is true: its steps lead to a backend that passes, its tables are complete."""

from __future__ import annotations

import ast
import inspect
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import soma_core.plugin
from soma_core import load_canonical, read_motion
from soma_core.plugin.errors import Stage
from soma_core.testing.checks import CORE_CHECKS
from soma_core.testing.synthetic import NATIVE_FROM_CANONICAL

FEW_JOINTS_MM = 30.0
"""Twelve joints cannot follow seventy-seven: hands, feet, neck and spine stay as they are at rest."""

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs/writing_a_backend.md").read_text(encoding="utf-8")

_STEP = re.compile(r"<!-- (?P<kind>session|runnable: session|file|append)(?:: (?P<path>\S+))? -->\n"
                   r"```\w+\n(?P<text>.*?)```", re.DOTALL)  # fmt: skip
_SMALL = {"animate": ["lod=low", "write=[npz]"], "convert": ["lod=low"]}
"""Added to commands of the page, so that the test does not draw pictures."""


def a_model(path: Path) -> None:
    """A linear model as an author might have it: its own unit and axes, ten smooth directions."""
    mesh, _ = load_canonical("low")
    x, y, z = mesh.vertices.T
    waves = [np.sin(count * y + phase) for count in (2, 4, 6) for phase in (0.0, 1.0, 2.0)]
    fields = [mesh.vertices, *(np.stack([wave * x, 0 * y, wave * z], 1) for wave in waves)]
    names, parents, weights = _skeleton()
    both = weights * np.where(parents[None] < 0, 1, weights[:, parents]) + 1e-9  # the crease at a joint
    np.savez(
        path,
        joint_names=names,
        parents=parents,
        weights=weights,
        regressor=(both / both.sum(0)).T,
        template=mesh.vertices @ NATIVE_FROM_CANONICAL.T,
        directions=0.02 * np.stack(fields) @ NATIVE_FROM_CANONICAL.T,
        faces=mesh.triangles,
    )


def _skeleton() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Names, parents and weights (n, J) of a skeleton: the canonical one without hands, feet and face."""
    rig = load_canonical("low")[1]
    full = rig.weights.toarray()
    kept = [index for index, name in enumerate(rig.joint_names) if index and name in _JOINTS]
    owner = np.zeros(len(rig.joint_names), int)
    for index, parent in enumerate(rig.parents):
        owner[index] = kept.index(index) if index in kept else owner[max(parent, 0)]
    weights = np.stack([full[:, owner == number].sum(1) for number in range(len(kept))], 1)
    parents = [-1 if not number else owner[rig.parents[index]] for number, index in enumerate(kept)]
    return np.array([rig.joint_names[index] for index in kept]), np.array(parents), weights


_JOINTS = (
    *("Hips", "Spine1", "Chest", "Head"),
    *(side + part for side in ("Left", "Right") for part in ("Arm", "ForeArm", "Leg", "Shin")),
)


def _install(folder: Path) -> Path:
    """Put metadata beside the package, as an editable install has them; return what goes on the path."""
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    metadata = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir()
    text = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (metadata / "METADATA").write_text(text, encoding="utf-8")
    points = [
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    ]
    (metadata / "entry_points.txt").write_text("\n".join(points), encoding="utf-8")
    return folder


def _soma(folder: Path, arguments: list[str], installed: list[Path]) -> str:
    """Run a command of the page in a fresh interpreter that sees what the page has installed."""
    done = subprocess.run(
        [sys.executable, "-c", "from soma_core.cli import console; console()", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, [*installed, ROOT]))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"soma {shlex.join(arguments)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def walked(tmp_path_factory) -> tuple[Path, list[tuple[str, str]]]:
    """The folder after every step of the page, and each command with what it printed."""
    folder = tmp_path_factory.mktemp("walk")
    a_model(folder / "my_model.npz")
    installed: list[Path] = []
    printed: list[tuple[str, str]] = []
    before = Path.cwd()
    os.chdir(folder)
    try:
        for step in _STEP.finditer(PAGE):
            _take(step, folder, installed, printed)
    finally:
        os.chdir(before)
    return folder, printed


def _take(step: re.Match, folder: Path, installed: list[Path], printed: list[tuple[str, str]]) -> None:
    if step["kind"] == "runnable: session":
        exec(compile(step["text"], "<step>", "exec"), {"__name__": "step"})
    elif step["kind"] in ("file", "append"):
        target = folder / step["path"]
        assert target.parent.is_dir(), f"the page writes {step['path']} before its folder is there"
        with open(target, "a" if step["kind"] == "append" else "w", encoding="utf-8") as stream:
            stream.write("\n\n" * (step["kind"] == "append") + step["text"])
    else:
        for line in step["text"].splitlines():
            program, *arguments = shlex.split(line)
            if program == "pip":
                assert arguments[:2] == ["install", "-e"]
                installed.append(_install(folder / arguments[2]))
            else:
                arguments += _SMALL.get(arguments[0], [])
                printed.append((line, _soma(folder, arguments, installed)))


def test_the_page_leads_from_nothing_to_a_backend_that_passes(walked):
    folder, printed = walked
    checks = [text for command, text in printed if command == "soma backends check acme"]
    assert len(checks) == 2  # as generated, and as changed
    for text in checks:
        assert "FAILED" not in text
        assert re.search(rf"\b{len(CORE_CHECKS) - 10} passed, 10 not applicable", text)
    assert any("acme/first-is-stature" in text for command, text in printed if command.endswith('"acme/*"'))
    shown = next(text for command, text in printed if command == "soma backends show acme")
    assert "4505 native, 18056 canonical" in shown
    animated = [text for command, text in printed if command.startswith("soma animate")]
    assert all((folder / text.splitlines()[-1] / "motion.npz").is_file() for text in animated)


def test_a_model_of_others_is_a_source_and_a_target_of_convert(walked):
    folder, _ = walked
    with np.load(folder / "as_acme/motion.npz") as file:
        assert file["acme_turns"].shape == (5, len(_skeleton()[0]), 3)
        assert np.abs(file["acme_turns"]).max() > 0.1
    report = json.loads((folder / "as_acme/report.json").read_text())
    assert report["settings"]["format"] == "acme_npz"
    assert report["error_mm"]["all"]["mean"] < FEW_JOINTS_MM
    back = json.loads((folder / "back/report.json").read_text())
    assert back["settings"]["layout"] == "acme_npz"
    assert back["error_mm"]["all"]["mean"] < FEW_JOINTS_MM
    assert len(read_motion(folder / "back/motion.npz").rotations) == 5


@pytest.mark.parametrize("line", re.findall(r"^\| `(\w+)\((.*)\) -> (.*?)` \| `(\w+)`", PAGE, re.MULTILINE))
def test_the_page_has_the_signatures_of_the_capabilities(line):
    method, arguments, returned, protocol = line
    signature = inspect.signature(getattr(getattr(soma_core.plugin, protocol), method))
    found = ", ".join(map(str, signature.parameters.values())).replace("'", "")
    assert (found, signature.return_annotation) == (arguments, returned)


def test_the_page_names_every_capability():
    protocols = {name for name in soma_core.plugin.__all__ if name.startswith("Has")}
    part = PAGE.split("<!-- capabilities:begin -->")[1].split("<!-- capabilities:end -->")[0]
    assert set(re.findall(r"`(Has\w+)`", part)) == protocols


def test_the_page_shows_every_file_that_is_written(walked):
    block = re.search(r"<!-- layout -->\n```text\n(?P<head>\S+)/\n(?P<rows>.*?)```", PAGE, re.DOTALL)
    shown = {row.split()[0] for row in block["rows"].splitlines()}
    folder = walked[0] / block["head"]
    written = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    ours = {path for path in written if "__pycache__" not in path and ".dist-info" not in path}
    assert ours == shown | {"soma_backend_acme/_checks.py", "soma_backend_acme/_posed.py"}  # added later


def test_the_generator_of_the_page_is_the_generated_one():
    template = (ROOT / "soma_core/template/files/_generator.py.in").read_text(encoding="utf-8")
    assert f"```python\n{template}```" in PAGE


def _rows(name: str) -> list[list[str]]:
    """Cells of the table rows between two markers, without heads and rulers."""
    part = PAGE.split(f"<!-- {name}:begin -->")[1].split(f"<!-- {name}:end -->")[0]
    lines = [line for line in part.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def test_the_table_of_checks_is_the_list_of_checks():
    assert [(row[0].strip("`"), row[1]) for row in _rows("checks")] == [
        (check.id, check.summary) for check in CORE_CHECKS
    ]
    for row, check in zip(_rows("checks"), CORE_CHECKS, strict=True):
        assert row[2] == check.mend or check.id == "declares"  # which links to the errors


def test_the_errors_are_ordered_by_stage():
    part = PAGE.split("<!-- errors:begin -->")[1].split("<!-- errors:end -->")[0]
    assert set(re.findall(r"^### (\w+)$", part, re.MULTILINE)) == set(get_args(Stage))


def _text(node: ast.expr, names: dict[str, ast.expr]) -> str:
    """What a message says, with … for what is only known when it is raised."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=values):
            return "".join(_text(value, names) for value in values)
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _text(left, names) + _text(right, names)
        case ast.Name(id=name) if name in names:
            return _text(names[name], {key: value for key, value in names.items() if key != name})
    return "…"


def _message(node: ast.AST, function: ast.FunctionDef, names: dict[str, ast.expr]) -> str:
    """Text of a message that this node makes, or nothing."""
    match node:
        case ast.Return(value=ast.JoinedStr() | ast.IfExp(body=ast.JoinedStr())) if function.name.endswith(
            ("_problem", "_spoken")
        ):
            return _text(getattr(node.value, "body", node.value), names)
        case ast.Call(func=ast.Name(id="PluginError" | "_broken_file"), args=[*_, text]):
            return _text(text, names)
        case ast.Call(func=ast.Name(id="InputError"), args=[argument], keywords=keywords):
            got, expected = (_text(word.value, names) for word in keywords[:2])
            return f"{_text(argument, names)}: got {got}, expected {expected}"
        case ast.Call(func=ast.Name(id=error), keywords=keywords) if error.endswith("Error"):
            cause = next((word.value for word in keywords if word.arg == "cause"), None)
            text = _text(cause, names) if cause else ""
            return f"…: {text}" if text and error == "AssetError" else text
    return ""


def _assignments(function: ast.FunctionDef) -> Iterator[dict[str, ast.expr]]:
    """What each name stands for; one dictionary for each time that a name is assigned anew."""
    found: dict[str, list[ast.expr]] = {}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            found.setdefault(node.targets[0].id, []).append(node.value)
    for turn in range(max(map(len, found.values()), default=1)):
        yield {name: values[turn % len(values)] for name, values in found.items()}


def _messages(*modules: str) -> Iterator[str]:
    """Every message that the modules can make, each with … for its variable parts."""
    for module in modules:
        for function in ast.walk(ast.parse((ROOT / "soma_core" / module).read_text(encoding="utf-8"))):
            if not isinstance(function, ast.FunctionDef):
                continue
            for names in _assignments(function):
                texts = (re.sub("…+", "…", _message(node, function, names)) for node in ast.walk(function))
                yield from (text for text in texts if not _SAYS_NOTHING.fullmatch(text))


BACKEND = (
    *(f"plugin/{name}.py" for name in ("declaration", "hooks", "registry", "record", "configs", "options")),
    "files.py",
    "obj.py",
    *(f"topology/{name}.py" for name in ("wrap_pair", "correspondence", "transfer")),
    "config/refusals.py",
)
_SAYS_NOTHING = re.compile(r"([….,: ]|got|expected|configuration|one of)*")
RAISED_BY_PLUGINS = "…Error: …"


@pytest.mark.parametrize(
    ("table", "modules"), [("errors", BACKEND), ("names", ("template/distribution.py",))]
)
def test_the_page_lists_every_error(table, modules):
    listed = {row[0].strip("`") for row in _rows(table)} - {RAISED_BY_PLUGINS}
    patterns = {re.escape(text).replace("…", ".*"): text for text in _messages(*modules)}
    assert len(patterns) >= len(listed) / 2
    missing = [
        text for pattern, text in patterns.items() if not any(re.fullmatch(pattern, row) for row in listed)
    ]
    assert not missing, "errors that the page does not list"
    strange = [row for row in listed if not any(re.fullmatch(pattern, row) for pattern in patterns)]
    assert not strange, "rows of the page that no error reads like"
