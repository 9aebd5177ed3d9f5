"""The export task: what it refuses, what it writes, and that it compares."""

import json

import pytest
from omegaconf import OmegaConf

from soma_core.choices import ModelPart
from soma_core.config.schema import ExportModelConfig
from soma_core.errors import InputError, SomaError
from soma_core.tasks import export_model


def configured(**changes):
    settings = {"backend": {"name": "soma"}, "what": "joints"}
    return OmegaConf.merge(OmegaConf.structured(ExportModelConfig), settings | changes)


def test_nothing_to_write_is_refused(tmp_path):
    with pytest.raises(InputError, match="write: got none, expected onnx, pt2 or both"):
        export_model.run(configured(write=[]), tmp_path)


@pytest.mark.slow
def test_files_are_compared_with_the_layer(tmp_path, monkeypatch):
    for name in ("onnxscript", "onnxruntime"):
        pytest.importorskip(name)
    config = configured(backend={"name": "soma", "params": {"shape": [1.0, -1.0]}})
    export_model.run(config, tmp_path)
    about = json.loads((tmp_path / "model.json").read_text(encoding="utf-8"))
    assert about["identity"]["shape"][:3] == [1, -1, 0]
    assert {path.name for path in tmp_path.iterdir()} == {"model.json", "model.onnx", "model.pt2"}
    monkeypatch.setitem(export_model._AGREEMENT_MM, ModelPart.joints, -1.0)
    with pytest.raises(SomaError, match=r"model\.onnx: .* mm from the layer, bound -1"):
        export_model.run(config, tmp_path)
