"""GarmentMeasurements on a stand-in: the file's layout, its refusals, and what every backend must hold."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import soma_backend_garment as garment
import torch
from soma_backend_garment._generator import GarmentGenerator
from soma_backend_garment._point_pca import PointSpace, read_npz, read_pca

from soma_core import AssetError, InputError
from soma_core.plugin import BrokenBackendError, Registry
from soma_core.testing import check_backend
from tests.standins.garment_files import COMPONENTS, VERTICES, garment_arrays, write_garment_pair, write_pca

ROUNDING = 1e-12
"""Metres: sums of a few float64 terms."""


@pytest.fixture(scope="module")
def arrays():
    return garment_arrays()


@pytest.fixture
def data_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path))
    return tmp_path / "GarmentMeasurements"


def test_the_file_has_the_size_of_the_real_one(tmp_path, arrays):
    assert write_pca(tmp_path / "point.pca", *arrays).stat().st_size == 9_120_896


def test_a_file_comes_back_bit_for_bit(tmp_path, arrays, data_folder):
    source = write_pca(tmp_path / "point.pca", *arrays)
    (converted,) = garment.soma_convert(source, None)
    assert converted == data_folder / "point.npz"
    for space in (read_pca(source), read_npz(converted)):
        for found, expected in zip((space.matrix, space.mean, space.eigenvalues), arrays, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_bodies_follow_the_formula(arrays):
    matrix, mean, eigenvalues = arrays
    eigenvalues = eigenvalues.copy()
    eigenvalues[-2:] = [1e-14, -2e-15]  # below the threshold the magnitude itself is the scale
    space = PointSpace(matrix=matrix, mean=mean, eigenvalues=eigenvalues)
    coefficients = np.random.default_rng(0).standard_normal((2, COMPONENTS))
    body = GarmentGenerator(space, torch.device("cpu"), torch.float64).rest(
        {"coefficients": torch.as_tensor(coefficients)}
    )
    scales = [*np.sqrt(eigenvalues[:-2]), 1e-14, 2e-15]
    for row, found in zip(coefficients, body.numpy(), strict=True):
        expected = mean + sum(matrix[:, k] * row[k] * scales[k] for k in range(COMPONENTS))
        np.testing.assert_allclose(found, expected.reshape(-1, 3), atol=ROUNDING, rtol=0)


def test_the_mean_body_comes_along(tmp_path, arrays, data_folder):
    source = write_pca(tmp_path / "point.pca", *arrays)
    (tmp_path / "mean.obj").write_text("v 0 0 0\n")
    copied = data_folder / "mean.obj"
    assert garment.soma_convert(source, None) == [data_folder / "point.npz", copied]
    assert copied.read_text() == "v 0 0 0\n"
    assert garment.soma_convert(source, None) == [data_folder / "point.npz"]


@pytest.mark.parametrize(
    ("header", "cause"),
    [
        ((71_257, 15), "71257 coordinates and 15 components"),
        ((0, 15), "0 coordinates"),
        ((3_000_000, 15), "3000000 coordinates"),
        ((71_256, 0), "0 components"),
        ((71_256, 4_000_000_000), "4000000000 components"),
        ((71_256, 14), "goes on after its end: 9120896 bytes, expected 8550840"),
        ((71_256, 16), "is cut off: 9120896 bytes, expected 9690952"),
        ((71_259, 15), "is cut off"),
    ],
)
def test_a_header_that_does_not_fit_is_refused_before_reading(tmp_path, arrays, header, cause):
    path = write_pca(tmp_path / "point.pca", *arrays)
    path.write_bytes(struct.pack("<II", *header) + path.read_bytes()[8:])
    with pytest.raises(AssetError, match=f"point.pca: .*{cause}"):
        read_pca(path)


def test_a_big_endian_file_is_refused(tmp_path, arrays):
    path = write_pca(tmp_path / "point.pca", *arrays)
    path.write_bytes(struct.pack(">II", 71_256, 15) + path.read_bytes()[8:])
    with pytest.raises(AssetError, match="its header says"):
        read_pca(path)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (
            lambda matrix, mean, values: (matrix, np.where(np.arange(len(mean)) == 5, np.nan, mean), values),
            "not finite",
        ),
        (lambda matrix, mean, values: (matrix, 100 * mean, values), "tall, expected metres"),
        (
            lambda matrix, mean, values: (matrix[:-3], mean[:-3], values),
            "pca_matrix has the shape .71253, 15.",
        ),
    ],
)
def test_values_that_are_no_body_are_refused(tmp_path, arrays, change, cause):
    with pytest.raises(AssetError, match=f"point.pca: .*{cause}"):
        read_pca(write_pca(tmp_path / "point.pca", *change(*arrays)))


def test_short_files_and_other_files_are_refused(tmp_path, data_folder):
    path = tmp_path / "point.pca"
    path.write_bytes(b"abc")
    with pytest.raises(AssetError, match="is cut off: 3 bytes"):
        read_pca(path)
    np.savez(tmp_path / "point.npz", pca_matrix=np.zeros(3))
    with pytest.raises(AssetError, match="has no pca_mean, eigenvalues"):
        read_npz(tmp_path / "point.npz")
    objects = np.array([{}], object)
    np.savez(tmp_path / "point.npz", pca_matrix=objects, pca_mean=objects, eigenvalues=objects)
    with pytest.raises(AssetError, match="pca_matrix cannot be read .Python objects"):
        read_npz(tmp_path / "point.npz")
    with pytest.raises(InputError, match="--output: got .*a.txt, expected an .npz"):
        garment.soma_convert(path, tmp_path / "a.txt")


def test_a_user_without_the_files_is_told_what_to_do(data_folder):
    registry = Registry()
    with pytest.raises(
        BrokenBackendError, match="files: the converted shape space is missing at .*point.npz.*Get it"
    ) as error:
        registry.generator("garment", device=torch.device("cpu"), dtype=torch.float32)
    assert "then run: soma backends convert garment point.pca" in error.value.fix


def test_a_published_file_in_a_folder_of_assets_is_named(tmp_path, arrays, data_folder, monkeypatch):
    path = write_pca(tmp_path / "point.pca", *arrays)
    monkeypatch.setattr(garment, "model_folders", lambda name: [data_folder, tmp_path])
    assert garment.soma_backend().files[0].command == f"soma backends convert garment {path}"


@pytest.mark.slow
def test_conformance(tmp_path, arrays, data_folder, monkeypatch):
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path / "cache"))
    garment.soma_convert(write_pca(tmp_path / "point.pca", *arrays), None)
    write_garment_pair(data_folder)
    report = check_backend("garment", registry=Registry())
    assert not report.missing_files
    assert not report.failed, report.text()
    assert len(arrays[1]) == 3 * VERTICES
