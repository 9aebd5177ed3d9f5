"""Which files are opened, and which of those are taken for MHR."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from soma_backend_mhr import _model_file
from soma_backend_mhr._files import LOD1, LOD6
from soma_backend_mhr._model_file import load_model
from torch import Tensor, nn

from soma_core import AssetError
from soma_core.plugin import file_sha256
from tests.real_mhr import NEUTRAL, needs_mhr
from tests.standins.mhr_files import mhr_body, write_model

CPU = torch.device("cpu")


def load(path, lod=LOD6, *, dtype=torch.float32, trust=True):
    return load_model(path, lod, device=CPU, dtype=dtype, trust=trust)


class Answer(nn.Module):
    """Gives back the same vertices and skeleton whatever it is asked."""

    def __init__(self, vertices: Tensor, faces: Tensor | None = None, joints: int = 127) -> None:
        super().__init__()
        self.vertices, self.joints = nn.Parameter(vertices), joints
        if faces is not None:
            self.character_torch = nn.Module()
            self.character_torch.mesh = nn.Module()
            self.character_torch.mesh.register_buffer("faces", faces)

    def forward(
        self, identity_coeffs: Tensor, model_parameters: Tensor, face_expr_coeffs: Tensor
    ) -> tuple[Tensor, Tensor]:
        count = len(identity_coeffs)
        return self.vertices.expand(count, -1, -1), torch.zeros(count, self.joints, 8)


class OtherNames(Answer):
    def forward(self, betas: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        return betas, pose


class OneResult(Answer):
    def forward(self, identity_coeffs: Tensor, model_parameters: Tensor, face_expr_coeffs: Tensor) -> Tensor:
        return self.vertices.expand(len(identity_coeffs), -1, -1)


class Failing(Answer):
    def forward(
        self, identity_coeffs: Tensor, model_parameters: Tensor, face_expr_coeffs: Tensor
    ) -> tuple[Tensor, Tensor]:
        return self.vertices @ identity_coeffs, model_parameters


class SinglePrecision(Answer):
    """Holds a constant that does not follow the dtype of the module."""

    def forward(
        self, identity_coeffs: Tensor, model_parameters: Tensor, face_expr_coeffs: Tensor
    ) -> tuple[Tensor, Tensor]:
        moved = self.vertices @ torch.eye(3, dtype=torch.float32)
        return moved + identity_coeffs[:, :1, None], torch.zeros(len(identity_coeffs), 127, 8)


@pytest.fixture(scope="module")
def body():
    found = mhr_body(6)
    vertices = torch.as_tensor(100 * found.vertices, dtype=torch.float32)
    return vertices, torch.as_tensor(found.faces, dtype=torch.int64)


def test_an_unknown_file_is_not_opened(tmp_path, monkeypatch):
    path = tmp_path / "mhr_model_lod6.pt"
    path.write_bytes(b"anything")
    monkeypatch.setattr(torch.jit, "load", lambda *_, **__: pytest.fail("opened"))
    known = f"SHA-256 is {file_sha256(path)}, expected {LOD6.hashes[0]}. TorchScript runs code, so it was not"
    with pytest.raises(
        AssetError, match=f"mhr_model_lod6.pt: is not the published file: its {known} opened"
    ) as error:
        load(path, trust=False)
    assert "pass backend.options.trust=true" in error.value.fix


def test_the_published_file_is_opened_without_a_word(data_folder, caplog):
    path = data_folder / "MHR" / "mhr_model_lod6.pt"
    lod = replace(LOD6, hashes=("0" * 64, file_sha256(path)))
    with caplog.at_level(logging.INFO):
        model = load(path, lod, trust=False)
    assert not caplog.records
    assert model.faces.shape == mhr_body(6).faces.shape
    with caplog.at_level(logging.INFO):
        load(path)
    assert "is not the published file; opened because trust=true was given" in caplog.text


def test_the_file_of_the_other_lod_is_named(tmp_path, monkeypatch):
    path = tmp_path / "mhr_model_lod1.pt"
    path.write_bytes(b"anything")
    monkeypatch.setattr(_model_file, "LOD6", replace(LOD6, hashes=(file_sha256(path),)))
    with pytest.raises(
        AssetError, match="is the model of LOD 6. Name it mhr_model_lod6.pt and use backend=mhr_lod6"
    ):
        load(path, LOD1)


def test_a_pointer_is_told_from_the_file(tmp_path):
    path = tmp_path / "mhr_model_lod1.pt"
    path.write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(AssetError, match="is a git-LFS pointer"):
        load(path, LOD1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_no_torchscript_is_refused(tmp_path, dtype):
    path = tmp_path / "mhr_model_lod6.pt"
    torch.save({"a": torch.zeros(3)}, path)
    with pytest.raises(AssetError, match="mhr_model_lod6.pt: cannot be loaded and evaluated"):
        load(path, dtype=dtype)


@pytest.mark.parametrize(
    ("make", "cause"),
    [
        (lambda v, f: OtherNames(v, f), "forward takes betas, pose, expected identity_coeffs, model_"),
        (lambda v, f: OneResult(v, f), r"returns \(2, 595, 3\) for a batch of 2, expected \[\(2, 595, 3\)"),
        (lambda v, f: Answer(v, f, joints=78), r"returns \(2, 595, 3\), \(2, 78, 8\)"),
        (lambda v, f: Answer(torch.zeros(4899, 3), f), r"\(2, 4899, 3\), .*; it is LOD 3; it is no MHR"),
        (lambda v, f: Answer(torch.full_like(v, np.nan), f), "returns vertices of torch.float32 that are"),
        (lambda v, f: Answer(v), "has no character_torch.mesh.faces"),
        (lambda v, f: Answer(v, f[:, :2]), r"its faces have the shape \(\d+, 2\) of torch.int64"),
        (lambda v, f: Answer(v, f.float()), r"its faces have the shape \(\d+, 3\) of torch.float32"),
        (lambda v, f: Answer(v, f + 1), "its faces refer to vertex 595 of 595"),
        (lambda v, f: Answer(v, f - 1), "its faces refer to vertex -1 of 595"),
        (lambda v, f: Answer(v / 100, f), "its neutral body measures 1.* expected 140 to 210 cm along y"),
        (lambda v, f: Answer(v[:, [0, 2, 1]], f), "its neutral body measures"),
        (lambda v, f: Answer(v * torch.tensor([-1.0, 1, -1]), f), "its neutral body does not face .z"),
        (lambda v, f: Failing(v, f), "cannot be loaded and evaluated"),
    ],
)  # fmt: skip
def test_another_model_is_refused(tmp_path, body, make, cause):
    path = write_model(tmp_path / "mhr_model_lod6.pt", make(*body))
    with pytest.raises(AssetError, match=f"mhr_model_lod6.pt: .*{cause}"):
        load(path)


def test_a_model_of_single_precision_serves_double(tmp_path, body, caplog):
    path = write_model(tmp_path / "mhr_model_lod6.pt", SinglePrecision(*body))
    with caplog.at_level(logging.INFO):
        model = load(path, dtype=torch.float64)
    assert "it computes in float32" in caplog.text
    inputs = [torch.ones(1, width, dtype=torch.float64) for width in (45, 204, 72)]
    found = model.evaluate(*inputs)
    assert found.dtype == torch.float64
    torch.testing.assert_close(found[0].float(), body[0] + 1)


def test_every_input_has_a_gradient(data_folder):
    model = load(data_folder / "MHR" / "mhr_model_lod6.pt", dtype=torch.float64)
    inputs = [torch.zeros(1, width, dtype=torch.float64, requires_grad=True) for width in (45, 204, 72)]
    model.evaluate(*inputs).square().sum().backward()
    assert all(float(each.grad.abs().sum()) > 0 for each in inputs)


@needs_mhr
@pytest.mark.parametrize("lod", [LOD1, LOD6])
def test_the_neutral_body_of_mhr_itself_is_accepted(tmp_path, lod):
    """In a file that answers with it; LOD 6 by the published map of its vertices onto LOD 1."""
    neutral = trimesh.load(NEUTRAL, process=False, maintain_order=True)
    vertices, faces = torch.tensor(neutral.vertices), torch.tensor(neutral.faces)
    if lod is LOD6:
        mapped = np.load(NEUTRAL.with_name("lod1_to_lod6_mapping.npz"))
        corners = vertices[faces[mapped["triangle_ids"]]]
        vertices = (corners * torch.tensor(mapped["baryc_coords"])[..., None]).sum(1)
        faces = torch.tensor(mhr_body(6).faces)  # whose vertices they join does not matter here
    path = write_model(tmp_path / lod.models[0], Answer(vertices.float(), faces.long()))
    assert load(path, lod).faces.shape == faces.shape
