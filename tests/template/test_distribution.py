"""``write_backend``: what it writes is complete, valid and works; what it cannot write it refuses."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from soma_core import SomaLayer, load_canonical
from soma_core.errors import InputError
from soma_core.obj import read_obj
from soma_core.plugin.registry import Registry
from soma_core.template import distribution, update_backend, write_backend
from tests.plugin.fakes import FakeDistribution, FakeEntryPoint, good

FILE_PRECISION = 1e-6
"""Metres: the meshes keep six decimals."""
FLOAT32 = 1e-5
"""Relative; a sparse product of a few float32 terms."""
NOBODY = Registry([])


@pytest.fixture(scope="module")
def acme(tmp_path_factory) -> Path:
    return write_backend("acme", tmp_path_factory.mktemp("new"), registry=NOBODY)


@pytest.fixture
def layer(acme, monkeypatch) -> Iterator[SomaLayer]:
    """The generated backend, imported from its folder through its own entry point, and forgotten again."""
    monkeypatch.syspath_prepend(str(acme))
    project = tomllib.loads((acme / "pyproject.toml").read_text())["project"]
    ((name, target),) = project["entry-points"]["soma_core.backends"].items()
    point = EntryPoint(name=name, value=target, group="soma_core.backends")
    entry = FakeEntryPoint(name, load=point.load, value=target, distribution=project["name"])
    yield SomaLayer("acme", lod="low", registry=Registry([entry]))
    for imported in [each for each in sys.modules if each.partition(".")[0] == "soma_backend_acme"]:
        del sys.modules[imported]


def test_the_folder_holds_exactly_what_an_author_needs(acme):
    assert acme.name == "soma-backend-acme"
    assert {str(path.relative_to(acme)) for path in acme.rglob("*") if path.is_file()} == {
        "pyproject.toml",
        "README.md",
        "LICENSE",
        ".soma-template.json",
        ".github/workflows/test.yml",
        "soma_backend_acme/__init__.py",
        "soma_backend_acme/_generator.py",
        "soma_backend_acme/configs/backend/acme.yaml",
        "soma_backend_acme/model.npz",
        "soma_backend_acme/native.obj",
        "soma_backend_acme/SOMA_wrap.obj",
        "tests/test_acme.py",
    }


def test_every_template_is_used():
    shipped = {path.name for path in (Path(distribution.__file__).parent / "files").iterdir()}
    assert shipped == set(distribution._TEMPLATES.values())


def test_every_file_is_of_its_kind_and_names_the_backend(tmp_path):
    folder = write_backend("two_words", tmp_path, registry=NOBODY)
    assert folder.name == "soma-backend-two-words"
    project = tomllib.loads((folder / "pyproject.toml").read_text())
    assert project["project"]["name"] == "soma-backend-two-words"
    assert project["project"]["entry-points"] == {
        "soma_core.backends": {"two_words": "soma_backend_two_words"}
    }
    assert project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"] == ["soma_backend_two_words"]
    config = yaml.safe_load((folder / "soma_backend_two_words/configs/backend/two_words.yaml").read_text())
    assert config == {"name": "two_words", "params": {"shape": None}, "options": {}}
    jobs = yaml.safe_load((folder / ".github/workflows/test.yml").read_text())
    assert {"run": "pip install './[test]'"} in jobs["jobs"]["test"]["steps"]
    for source in folder.rglob("*.py"):
        compile(source.read_text(), source.name, "exec")
    assert 'TestTwoWords = conformance_suite("two_words")' in (folder / "tests/test_two_words.py").read_text()
    assert "Two words as a backend" in (folder / "README.md").read_text()


def test_the_generator_is_about_twenty_lines(acme):
    lines = (acme / "soma_backend_acme/_generator.py").read_text().splitlines()
    assert sum(bool(line.strip()) and not line.strip().startswith(('"""', "#")) for line in lines) <= 25


def test_the_meshes_are_the_canonical_one_and_the_model_agrees(acme):
    package = acme / "soma_backend_acme"
    native, _ = read_obj(package / "native.obj")
    np.testing.assert_allclose(native, load_canonical("low")[0].vertices, atol=FILE_PRECISION, rtol=0)
    wrap, faces = read_obj(package / "SOMA_wrap.obj")
    np.testing.assert_allclose(wrap, load_canonical("mid")[0].vertices, atol=FILE_PRECISION, rtol=0)
    np.testing.assert_array_equal(faces, load_canonical("mid")[0].triangles)
    with np.load(package / "model.npz", allow_pickle=False) as model:
        np.testing.assert_array_equal(model["template"], native)
        assert model["directions"].shape == (2, *native.shape)


def test_the_backend_gives_human_bodies(layer):
    rest = layer.identity({"shape": [[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]]}).fitted_rest
    size = rest.amax(1) - rest.amin(1)
    assert 1.7 < float(size[0, 1]) < 1.8  # metres
    torch.testing.assert_close(size[1], 1.05 * size[0], rtol=FLOAT32, atol=0)
    torch.testing.assert_close(size[2], size[0] * torch.tensor([1.16, 1, 1.16]), rtol=FLOAT32, atol=0)


@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("Acme", '"acme"'),
        ("my-model", '"my_model"'),
        ("2d", '"d"'),
        ("", '"acme"'),
        ("größe", '"gr_e"'),
        ("a b/../c", '"a_b_c"'),
    ],
)
def test_a_name_of_other_characters_is_refused(name, fix, tmp_path):
    with pytest.raises(InputError, match=f"name: got '{name}', expected lower-case letters.*{fix}"):
        write_backend(name, tmp_path, registry=NOBODY)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["class", "all", "null", "true", "off"])
def test_a_word_that_means_something_else_is_refused(name, tmp_path):
    with pytest.raises(InputError, match=f"name: got '{name}', expected no word of.*\"{name}_model\""):
        write_backend(name, tmp_path, registry=NOBODY)


def test_a_name_that_is_taken_is_refused(tmp_path):
    with pytest.raises(InputError, match=r'got "soma", which soma-body-core .* Choose another\.$'):
        write_backend("soma", tmp_path)
    with pytest.raises(InputError, match=r'got "good", which soma-backend-good 1.0 offers'):
        write_backend("good", tmp_path, registry=Registry([good()]))


def test_a_name_that_is_taken_twice_is_refused(tmp_path):
    rivals = [FakeEntryPoint("acme", distribution=name) for name in ("one", "two")]
    assert isinstance(rivals[0].dist, FakeDistribution)
    with pytest.raises(InputError, match=r'got "acme", which one 1.0 offers'):
        write_backend("acme", tmp_path, registry=Registry(rivals))


def test_a_folder_that_exists_is_left_alone(tmp_path):
    (tmp_path / "soma-backend-acme").mkdir()
    (tmp_path / "soma-backend-acme/mine.txt").write_text("kept")
    with pytest.raises(InputError, match=r"folder: got .*soma-backend-acme, expected a folder that does not"):
        write_backend("acme", tmp_path, registry=NOBODY)
    assert [path.name for path in (tmp_path / "soma-backend-acme").iterdir()] == ["mine.txt"]


def test_a_failure_leaves_nothing_behind(tmp_path, monkeypatch):
    def fail(folder):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(distribution, "_write_model", fail)
    with pytest.raises(InputError, match=r"folder: got .* \(No space left on device\), expected a folder to"):
        write_backend("acme", tmp_path, registry=NOBODY)
    assert not list(tmp_path.iterdir())


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"folder: got .*/file \(File exists\), expected a folder to write"):
        write_backend("acme", tmp_path / "file", registry=NOBODY)


def test_the_folder_above_is_made(tmp_path):
    assert write_backend("acme", tmp_path / "a/b", registry=NOBODY).parent == tmp_path / "a/b"


def test_an_update_writes_what_the_author_left_alone(tmp_path, monkeypatch):
    folder = write_backend("acme", tmp_path, registry=NOBODY)
    readme, config = folder / "README.md", folder / "soma_backend_acme/configs/backend/acme.yaml"
    config.write_text("name: acme # mine\n")
    assert update_backend("acme", tmp_path) == ["template 2 -> 2"]
    plain = distribution._texts
    monkeypatch.setattr(distribution, "TEMPLATE_VERSION", 3)
    later = {path: f"{text}# later\n" for path, text in plain("acme").items()}
    monkeypatch.setattr(distribution, "_texts", lambda name: later)
    told = update_backend("acme", folder)
    assert told[-1] == "template 2 -> 3"
    assert readme.read_text().endswith("# later\n")
    assert config.read_text() == "name: acme # mine\n"
    assert config.with_name("acme.yaml.new").read_text().endswith("# later\n")
    assert any("acme.yaml is changed, merge them" in line for line in told)
    assert update_backend("acme", folder) == ["template 3 -> 3"]


def test_nothing_to_update_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"holds soma-backend-acme with its \.soma-template\.json"):
        update_backend("acme", tmp_path)
