"""Ten installed plugins, seven of them broken, each in its own way: the others go on working."""

from __future__ import annotations

import contextlib
import json
import site as interpreter_site
from pathlib import Path

import numpy as np
import pytest

from soma_core.io.motion import Motion
from soma_core.layer import SomaLayer
from soma_core.motion import animate
from soma_core.plugin.discovery import find_offers
from soma_core.plugin.errors import BackendError
from soma_core.plugin.listing import entries_json, entries_text
from soma_core.plugin.registry import Registry
from soma_core.tasks.backends import load
from soma_core.testing.synthetic import synthetic_canonical, write_wrap_pair
from tests.plugin.installed import Distribution

HEALTHY = """
from pathlib import Path
from soma_core import BackendSpec, Parameter, WrapPair, hookimpl

FOLDER = Path(__file__).parent

@hookimpl
def soma_backend():
    return BackendSpec(
        name=NAME, unit="cm", up="+z", forward="-y", fill_segments=("mouth_bag", "eye_bags"),
        wrap=WrapPair(native=FOLDER / "native.obj", wrap=FOLDER / "wrap.obj"),
        params=(Parameter(name="size", default=1.0, range=(0.5, 1.5)),),
    )

@hookimpl
def soma_generator(spec, device, dtype):
    import torch
    from soma_core.obj import read_obj

    class Model:
        vertices = torch.as_tensor(read_obj(spec.wrap.native)[0], dtype=dtype, device=device)

        def rest(self, params):
            return params["size"][:, None, None] * self.vertices

    return Model()
"""
BROKEN = {
    "needs": ("import native_model\n", "import", "ModuleNotFoundError: No module named 'native_model'"),
    "exits": ("raise SystemExit('no licence')\n", "import", "SystemExit: no licence"),
    "mistyped": (
        HEALTHY.replace("return BackendSpec(", "return dict("),
        "spec",
        "soma_backend returned dict, expected BackendSpec",
    ),
    "raises": (HEALTHY.replace("import torch", "raise OSError('no data')"), "build", "OSError: no data"),
    "reordered": (HEALTHY, "wrap", "neighbouring vertices"),
}
"""Backend -> its package, the stage at which it fails, and a part of the cause."""

WORKING = ("alpha", "beta", "gamma")
CANONICAL = synthetic_canonical()


def _package(name: str, body: str) -> Distribution:
    return Distribution(name=name, body=f"NAME = {name!r}\n{body}")


def _reverse_vertices(path: Path) -> None:
    """What an exporter does that sorts: other vertex order, the old faces."""
    lines = path.read_text().splitlines()
    vertices = [line for line in lines if line.startswith("v ")]
    path.write_text("\n".join(vertices[::-1] + lines[len(vertices) :]) + "\n")


@pytest.fixture
def registry(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Registry:
    """Ten distributions: wheels and checkouts."""
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path / "cache"))
    packages = {name: _package(name, body).install(site) for name, (body, _, _) in BROKEN.items()}
    packages["alpha"] = _package("alpha", HEALTHY).install(site)
    for name, finder in (("beta", False), ("gamma", True)):
        checkout = tmp_path / name
        packages[name] = _package(name, HEALTHY).install_editable(
            site, checkout, src=not finder, finder=finder
        )
    for maker in ("acme", "bodies"):
        Distribution(
            name="twice", distribution=f"{maker}-twice", package=f"soma_backend_{maker}", configs={}
        ).install(site)
    for package in packages.values():
        write_wrap_pair(package)
    _reverse_vertices(packages["reordered"] / "wrap.obj")
    interpreter_site.addsitedir(str(site))
    ours = {*packages, "twice"}
    offers = [offer for name, each in find_offers().items() if name in ours for offer in each]
    assert len(offers) == 10
    return Registry(allowed=ours)


def _motion() -> Motion:
    rig = CANONICAL[1]
    return Motion(
        rotations=np.tile(np.eye(3, dtype=np.float32), (3, len(rig.user_joint_names), 1, 1)),
        translation=np.tile(np.float32([0, 0.95, 0]), (3, 1)),
        fps=30,
        joint_names=rig.user_joint_names,
    )


def test_all_are_listed_with_their_state(registry: Registry) -> None:
    for name in registry.names():
        with contextlib.suppress(BackendError):
            load(registry, name, canonical=CANONICAL)
    rows = [entry for entry in json.loads(entries_json(registry.entries())) if entry["state"] != "blocked"]
    states = [(row["name"], row["state"], row["error"] and row["error"]["stage"]) for row in rows]
    broken = [(name, "broken", stage) for name, (_, stage, _) in BROKEN.items()]
    working = [(name, "built", None) for name in WORKING]
    assert states == sorted([*broken, *working, *[("twice", "conflict", "lookup")] * 2])
    text = entries_text(registry.entries())
    for name, (_, stage, _) in BROKEN.items():
        assert any(line.split()[:3] == [name, "broken", f"({stage})"] for line in text.splitlines())


def test_the_healthy_ones_animate(registry: Registry) -> None:
    for name in WORKING:
        load(registry, name, canonical=CANONICAL)
    for name in WORKING:
        layer = SomaLayer(name, kernels="torch", canonical=CANONICAL, registry=registry)
        result = animate(layer, layer.identity({"size": 0.5}), _motion(), keep=[0])
        height = np.ptp(result.vertices[0][:, 1])
        assert height == pytest.approx(np.ptp(CANONICAL[0].vertices[:, 1]) / 2, rel=0.05)


@pytest.mark.parametrize("name", [*BROKEN, "twice"])
def test_each_message_names_distribution_stage_cause_and_fix(registry: Registry, name: str) -> None:
    with pytest.raises(BackendError) as caught:
        SomaLayer(name, kernels="torch", canonical=CANONICAL, registry=registry)
    error = caught.value
    assert str(error) == f"{error.who}: {error.stage}: {error.cause}. {error.fix}"
    if name == "twice":
        assert error.who == 'backend "twice" (acme-twice 1.0 and bodies-twice 1.0)'
        assert (error.stage, error.fix) == ("lookup", "Keep one: pip uninstall bodies-twice")
        return
    assert error.who == f'backend "{name}" (soma-backend-{name} 1.0)'
    assert error.stage == BROKEN[name][1]
    assert BROKEN[name][2] in error.cause
    if name == "needs":
        assert error.fix == "Run: pip install native_model"
    elif name == "reordered":
        assert error.fix == "The vertices were reordered; export again with the vertex order kept."
    else:
        assert error.fix.startswith(f"Run: pip install --upgrade soma-backend-{name} ")
