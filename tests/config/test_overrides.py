"""Texts of a command line: what a shell delivers is what a setting gets."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from soma_core.config.compose import run_task
from soma_core.config.overrides import literal_texts
from soma_core.config.schema import SCHEMAS
from soma_core.errors import InputError
from soma_core.paths import expanded

NAMES = [
    "数据/走路.npz", "clip (1).npz", "it's.npz", "a=b.npz", "walk,turn.npz", "[v1] walk.npz", "$HOME.npz",
    "~x.npz", "#1.npz", '"q".npz', "back\\slash.npz", "ends in \\", " lead.npz", "trail.npz ", "a\\'b.npz",
    "{x}.npz",
    "${x}.npz", "50%.npz", "a;b&c.npz", "!x?*.npz", "1e5", "007", "true", "a:b.npz", "é.npz", "a\tb.npz", "=",
    "key: value", "choice(a,b)", "[", "'", "'a", "null.npz", "~", "-1", "@x", "|<>^`",
]  # fmt: skip


@dataclass
class _Part:
    files: list[str] = field(default_factory=list)
    width: int = 3


@dataclass
class _Task:
    input: str | None = None
    out: Path = Path("x")
    count: int = 1
    params: dict[str, float] = field(default_factory=dict)
    part: _Part = field(default_factory=_Part)


def parsed(*overrides):
    """Values as OmegaConf has them once hydra's parser and it are through with them."""
    read = OverridesParser.create().parse_overrides(literal_texts(overrides, _Task))
    given = {each.key_or_group: each.value() for each in read}
    for value in given.values():
        assert isinstance(value, str) or all(isinstance(part, str) for part in value)
    return OmegaConf.to_container(OmegaConf.create(given), resolve=True)


@pytest.mark.parametrize("name", NAMES)
def test_a_text_is_taken_as_it_is(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert parsed(f"input={name}", f"out={name}") == {"input": name, "out": name}


@pytest.mark.parametrize("name", [*NAMES, "'quoted'", '"also"', "${count}", "a, b"])
def test_a_file_of_that_name_comes_before_everything_else(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    place = Path(name)
    place.parent.mkdir(exist_ok=True)
    place.touch()
    assert parsed(f"input={name}") == {"input": name}
    for flag in ("--multirun", "-m"):
        (found, kept) = literal_texts([f"input={name}", flag], _Task)
        assert OverridesParser.create().parse_override(found).value() == name.replace("${", r"\${")
        assert kept == flag


def test_what_is_left_to_hydra(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for kept in (
        "count=1,2",
        "params.x=[1]",
        "input=null",
        "~input",
        "+more=a b",
        "input=",
        "part.width=4",
        "--help",
    ):
        assert literal_texts([kept], _Task) == [kept]
    assert literal_texts(["input='a b'", 'input="c, d"'], _Task) == ["input='a b'", 'input="c, d"']
    assert literal_texts(["out=to/${count}/${now:%Y}"], _Task) == ["out='to/${count}/${now:%Y}'"]


def test_a_sweep_parts_texts_at_commas_that_no_name_holds(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert literal_texts(["-m", "input=a b.npz, (c).npz"], _Task)[1] == "input='a b.npz','(c).npz'"
    assert literal_texts(["-m", "input='a, b.npz',c"], _Task)[1] == "input='a, b.npz','c'"
    assert literal_texts(["-m", "input=choice(a,b)"], _Task)[1] == "input=choice(a,b)"
    Path("walk,turn.npz").touch()
    assert literal_texts(["-m", "input=walk,turn.npz"], _Task)[1] == "input='walk,turn.npz'"


def test_lists_of_texts_are_parted_at_commas():
    assert parsed("part.files=[a b.npz, (c).npz,'d, e']") == {"part.files": ["a b.npz", "(c).npz", "d, e"]}
    assert parsed("part.files=走 路.npz") == {"part.files": ["走 路.npz"]}
    assert parsed("part.files=[]") == {"part.files": []}


@pytest.mark.parametrize(
    ("task", "override"),
    [
        ("convert", "input"), ("convert", "out"), ("invert", "input"), ("animate", "motion"),
        ("animate", "correctives"), ("wrap", "native"), ("wrap", "landmarks"), ("wrap", "mask"),
        ("wrap", "out"),
        ("evaluate", "experiment.data"), ("evaluate", "experiment.checkpoint"), ("train_shape", "out"),
        ("animate", "hydra.run.dir"), ("invert", "backend.options.shape_space"),
    ],
)  # fmt: skip
def test_every_path_of_every_task_is_a_text(task, override):
    assert literal_texts([f"{override}=a (1).npz"], SCHEMAS[task]) == [f"{override}='a (1).npz'"]


def test_a_task_gets_the_name_and_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = []
    for name in ("[v1] 走路, it's #1 ${x}", "a=b"):
        run_task(
            lambda: lambda config, output: found.append((config.motion, output)),
            config_name="animate", program="soma animate",
            overrides=[f"motion={name}.npz", f"hydra.run.dir={name}"], report=found.append,
        )  # fmt: skip
        assert found.pop(0) == (f"{name}.npz", Path(name).absolute()), name
        assert found.pop(0) == Path(name).absolute()


@pytest.mark.parametrize(("task", "setting"), [("convert", "out"), ("animate", "hydra.run.dir")])
def test_a_folder_that_cannot_be_made_is_said(tmp_path, monkeypatch, task, setting):
    monkeypatch.chdir(tmp_path)
    Path("taken").touch()
    for name in ("taken", "taken/below"):
        said = rf"{setting}: got {name}, which cannot be made \(a file of that name.*Pass {setting}=DIR"
        with pytest.raises(InputError, match=said):
            run_task(
                lambda: None, config_name=task, program="soma", overrides=[f"{setting}={name}"], report=print
            )


def test_a_path_alone_is_told_from_a_setting():
    with pytest.raises(InputError, match=r"walk\.npz: got no setting.*input=PATH"):
        run_task(lambda: None, config_name="convert", program="soma", overrides=["walk.npz"], report=print)


def test_the_home_folder_is_meant_only_where_no_file_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/someone")
    assert expanded("~/x") == Path("/home/someone/x")
    assert expanded("~nobody-of-that-name/x") == Path("~nobody-of-that-name/x")
    assert expanded("a~/x") == Path("a~/x")
    Path("~").mkdir()
    Path("~/x").touch()
    assert expanded("~/x") == Path("~/x")
