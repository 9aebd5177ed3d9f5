"""``soma train-shape``: from a configuration to a shape space that loads, with a report beside it."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from soma_core.config.schema import TrainShapeConfig
from soma_core.errors import InputError
from soma_core.plugin.spec import BackendSpec, Parameter
from soma_core.rig import load_canonical
from soma_core.rig.neutral import load_shape_space
from soma_core.tasks import train_shape

RANK = 3


class Layer:
    """The bind shape plus three smooth directions; stands in for a backend."""

    def __init__(self, backend, *, options=None, device="cpu", dtype=torch.float32):
        mesh, _ = load_canonical("mid")
        self._bind = torch.tensor(mesh.vertices)
        self._basis = torch.stack([torch.roll(self._bind, shift, dims=1) * 0.05 for shift in range(RANK)])
        self.spec = BackendSpec(
            name=backend,
            unit="m",
            up="+y",
            forward="+z",
            wrap=None,
            params=(Parameter(name="shape", shape=(RANK,)),),
        )

    def identity(self, params=None):
        rest = self._bind + torch.einsum("bk,kvc->bvc", torch.as_tensor(params["shape"]), self._basis)
        return SimpleNamespace(rest=rest)


@pytest.fixture
def config(monkeypatch, tmp_path):
    monkeypatch.setattr(train_shape, "SomaLayer", Layer)
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path / "cache"))
    small = {"mix": {"soma": 1.0}, "count": 12, "components": 4, "batch": 6, "held_out": 5}
    return OmegaConf.merge(OmegaConf.structured(TrainShapeConfig), small)


def test_writes_a_shape_space_that_loads_and_its_report(config, tmp_path):
    train_shape.run(config, tmp_path)
    space = load_shape_space(tmp_path / "shape_space.npz")
    report = json.loads((tmp_path / "report.json").read_text())
    assert space.component_count == 4
    assert space.metadata == report
    assert report["trained_on"][0]["distribution"] == "soma-body-core"
    assert report["trained_on"][0]["share"] == 1.0
    assert (report["identities"], report["shapes"], report["seed"]) == (12, 24, 0)
    assert report["rig_revision"] == load_canonical("mid")[0].revision
    assert [row["components"] for row in report["held_out_errors"]] == [1, 2, 4]
    assert not list((tmp_path / "cache" / "train_shape").glob("*"))


def test_same_configuration_same_file(config, tmp_path):
    for name in ("first", "second"):
        train_shape.run(config, tmp_path / name)
    first, second = (load_shape_space(tmp_path / name / "shape_space.npz") for name in ("first", "second"))
    np.testing.assert_array_equal(first.shapedirs, second.shapedirs)
    np.testing.assert_array_equal(first.mean, second.mean)


def test_out_names_another_file(config, tmp_path):
    config.out = str(tmp_path / "elsewhere" / "space.npz")
    train_shape.run(config, tmp_path)
    assert load_shape_space(config.out).component_count == 4
    assert not (tmp_path / "shape_space.npz").exists()


def test_unusable_number_of_held_out_identities_is_named(config, tmp_path):
    config.held_out = 0
    with pytest.raises(InputError, match=r"held_out: got 0, expected at least 1"):
        train_shape.run(config, tmp_path)
