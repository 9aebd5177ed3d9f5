"""A wrap pair that the user has yet to make: made in the context of a command, where the backend looks."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest
import torch

import soma_core.cli
from soma_core.errors import InputError
from soma_core.native import NativeTransfer
from soma_core.obj import read_obj, write_obj
from soma_core.plugin.errors import BackendError
from soma_core.plugin.hookspecs import hookimpl
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import FileNeeded, Parameter, WrapPair
from soma_core.registration import missing_wrap
from soma_core.registration.pair_files import WRAP_FILE
from soma_core.registration.register import Registration
from soma_core.registration.target import Frame, Skin
from soma_core.rig import load_canonical
from tests.plugin.fakes import FakeEntryPoint, declares

KIND = {"device": torch.device("cpu"), "dtype": torch.float32}


class _Generator:
    """The canonical mesh in centimetres, and a little further."""

    def __init__(self, options):
        self.options = options

    def rest(self, params):
        return 100 * torch.tensor(load_canonical("mid")[0].vertices)[None] + params["size"][:, None, None]

    def triangles(self):
        return torch.tensor(load_canonical("mid")[0].triangles)


def made_of(folder: Path, *, needed: bool = True, wrap: str = WRAP_FILE) -> Registry:
    """One backend, "good", whose pair belongs into `folder`."""
    pair = WrapPair(native=folder / "base_body.obj", wrap=folder / wrap)
    files = tuple(FileNeeded(path=path, description="of the pair") for path in (pair.native, pair.wrap))
    plugin = declares(
        wrap=pair, unit="cm", params=(Parameter(name="size"),), files=files if needed else (),
        fill_segments=("mouth_bag", "eye_bags"),
    )  # fmt: skip
    plugin.soma_generator = hookimpl(lambda options: _Generator(options))
    return Registry([FakeEntryPoint("good", plugin)])


@pytest.fixture
def registered(monkeypatch):
    """Replaces the registration; what it was given."""
    given = []
    mesh = load_canonical("mid")[0]

    def register(vertices, triangles, *, options):
        given.append((vertices, triangles, options))
        return Registration(
            wrap=100 * mesh.vertices,
            frame=Frame(unit="cm", up="+y", forward="+z", centre=(0.0, 0.0, 0.0)),
            skin=Skin(vertices=vertices, triangles=triangles),
            filled=np.zeros(mesh.vertex_count, bool),
            symmetric=True,
            fitted=100 * mesh.vertices,
            notes=(),
        )

    monkeypatch.setattr(missing_wrap, "register", register)
    return given


def maker(registry):
    return lambda name, options: missing_wrap.make_missing_wrap(name, options, registry=registry)


def test_it_is_made_once_and_said_before(tmp_path, registered, caplog):
    registry = made_of(tmp_path / "pair")
    with caplog.at_level(logging.INFO), registry.making_wraps(maker(registry)):
        registry.generator("good", **KIND)
        registry.generator("good", **KIND)
    assert len(registered) == 1
    assert (
        f"good has no wrap yet: laying the canonical mesh on its own mesh, which takes a few minutes, once. "
        f"It is kept in {tmp_path / 'pair'}" == caplog.messages[0]
    )
    options = registered[0][2]
    assert (options.unit, options.up, options.forward) == ("cm", "+y", "+z")
    assert options.fill == ("mouth_bag", "eye_bags")
    assert json.loads((tmp_path / "pair" / "report.json").read_text())["native"] == "base_body.obj"
    native, _ = read_obj(tmp_path / "pair" / "base_body.obj")
    assert len(native) == len(load_canonical("mid")[0].vertices)
    registry.generator("good", **KIND)  # nobody makes wraps any more, and nobody needs to


def test_a_native_mesh_that_is_there_is_the_one_that_is_wrapped(tmp_path, registered):
    registry = made_of(tmp_path)
    native = tmp_path / "base_body.obj"
    mesh = load_canonical("mid")[0]
    write_obj(native, 100 * mesh.vertices, mesh.triangles)
    native.write_text("# made by hand\n" + native.read_text())
    with registry.making_wraps(maker(registry)):
        registry.generator("good", **KIND)
    assert native.read_text().startswith("# made by hand\n")


def test_a_wrap_with_faults_is_not_kept(tmp_path, registered):
    registry = made_of(tmp_path)
    (tmp_path / "base_body.obj").write_text("v 0 0 0\nv 100 0 0\nv 0 170 0\nf 1 2 3\n")
    with (
        registry.making_wraps(maker(registry)),
        pytest.raises(
            BackendError, match=r"the wrap that was made: got torso: \d+% is off the mesh.*landmarks=FILE"
        ),
    ):
        registry.generator("good", **KIND)
    assert len(registered[0][0]) == 3
    assert not (tmp_path / "SOMA_wrap.obj").exists()


def test_a_transfer_makes_it_as_well(tmp_path, registered):
    registry = made_of(tmp_path)
    with registry.making_wraps(maker(registry)):
        assert NativeTransfer("good", registry=registry).count == len(registered[0][0])


def test_nothing_is_made_without_a_command_around_it(tmp_path, registered):
    with pytest.raises(BackendError, match=f"of the pair is missing at {tmp_path}"):
        made_of(tmp_path).generator("good", **KIND)
    assert not registered


@pytest.mark.parametrize("changes", [{"needed": False}, {"wrap": "SOMA_wrap_lod1.obj"}])
def test_a_pair_that_comes_from_elsewhere_is_not_made(tmp_path, registered, changes):
    registry = made_of(tmp_path, **changes)
    with registry.making_wraps(maker(registry)), pytest.raises(BackendError, match="base_body.obj"):
        registry.generator("good", **KIND)
    assert not registered


def test_what_registration_refuses_is_said_of_the_backend(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise InputError("native", got="a chair", expected="a human body", fix="Give one.")

    monkeypatch.setattr(missing_wrap, "register", refuse)
    registry = made_of(tmp_path)
    with registry.making_wraps(maker(registry)):  # noqa: SIM117 - the context is what is tested
        with pytest.raises(BackendError, match='backend "good".*wrap: native: got a chair'):
            registry.generator("good", **KIND)
    assert not (tmp_path / WRAP_FILE).exists()


def test_commands_make_wraps(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        missing_wrap, "make_missing_wrap", lambda name, options: asked.append((name, options))
    )
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path))
    registry = made_of(tmp_path)
    monkeypatch.setattr("soma_core.plugin.registry._registry_for", lambda *_: registry)

    def run(*_, **__):
        with pytest.raises(BackendError, match="missing"):  # the fake makes nothing
            registry.generator("good", options={}, **KIND)

    monkeypatch.setattr("soma_core.config.compose.run_task", run)
    assert soma_core.cli.main(["animate"]) == 0
    assert asked == [("good", {})]
