"""SAM 3D Body outputs: axes, units, one frame or many, npz and parquet, and what is refused."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from soma_core.errors import AssetError, InputError
from soma_core.io import sam3d
from soma_core.io.sam3d import MHR_VERTICES, read_sam3d

FRAMES = 3


def _person(frames: int | None = None) -> dict[str, np.ndarray]:
    """An upright cloud of points 1.7 m tall, in camera axes, with the parameters beside it."""
    rng = np.random.default_rng(0)
    front = () if frames is None else (frames,)
    vertices = rng.uniform([-0.3, -1.7, -0.1], [0.3, 0, 0.1], (*front, MHR_VERTICES, 3))
    vertices[..., 2809, :], vertices[..., 13069, :] = (0, -1.7, 0), (0.1, 0, 0)
    person = {
        "pred_vertices": vertices,
        "pred_cam_t": rng.normal(size=(*front, 3)),
        "mhr_model_params": rng.normal(size=(*front, 204)),
        "shape_params": rng.normal(size=(*front, 45)),
        "expr_params": np.zeros((*front, 72)),
    }
    return {key: value.astype(np.float32) for key, value in person.items()}


def _save(path: Path, person: dict[str, np.ndarray]) -> Path:
    np.savez(path, **person)
    return path


@pytest.mark.parametrize("frames", [None, FRAMES])
def test_a_person_comes_back_in_the_axes_of_the_model(tmp_path, frames):
    person = _person(frames)
    read = read_sam3d(_save(tmp_path / "person.npz", person))
    stacked = {key: value if frames else value[None] for key, value in person.items()}
    assert len(read) == (frames or 1)
    np.testing.assert_array_equal(read.vertices, stacked["pred_vertices"] * [1, -1, -1])
    np.testing.assert_array_equal(read.placement, stacked["pred_cam_t"] * [1, -1, -1])
    assert set(read.parameters) == {"mhr_model_params", "shape_params", "expr_params"}
    for key, value in read.parameters.items():
        np.testing.assert_array_equal(value, stacked[key])


def test_early_outputs_hold_less(tmp_path):
    read = read_sam3d(_save(tmp_path / "p.npz", {"pred_vertices": _person()["pred_vertices"]}))
    assert read.placement is None
    assert not read.parameters


def test_keys_that_are_not_needed_stay_unread(tmp_path):
    person = _person() | {"mask": np.array(None, object), "pred_keypoints_2d": np.zeros((70, 2))}
    assert len(read_sam3d(_save(tmp_path / "p.npz", person))) == 1


def test_vertices_turned_back_already_are_taken_as_they_are(tmp_path, caplog):
    person = _person()
    person["pred_vertices"] = person["pred_vertices"] * np.float32([1, -1, -1])
    path = _save(tmp_path / "p.npz", person)
    np.testing.assert_array_equal(read_sam3d(path, axes="model").vertices[0], person["pred_vertices"])
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        read_sam3d(path)
    assert "upside down in most frames; if that is not its pose, pass up=y" in caplog.text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pred_vertices": None}, "pred_vertices: got only the keys pred_cam_t.*The parameters alone need"),
        ({"pred_vertices": np.zeros((595, 3), "f4")}, r"got shape \(595, 3\).*\(18439, 3\) of MHR LOD 1"),
        ({"shape_params": np.zeros(10, "f4")}, r"shape_params: got shape \(10,\).*numbers \(45\)"),
        ({"shape_params": np.zeros(45, int)}, "shape_params: got shape .45,., dtype int64"),
        ({"mhr_model_params": np.zeros((2, 204), "f4")}, "mhr_model_params: got 2 frames, expected as many"),
        ({"pred_cam_t": np.float32([0, np.nan, 0])}, r"pred_cam_t: got nan at index \(0, 1\)"),
        ({"pred_vertices": 100 * _person()["pred_vertices"]}, "a body of 170 m, as of a file in cm.*=cm"),
        ({"pred_vertices": 1000 * _person()["pred_vertices"]}, "of 1700 m, as of a file in mm.*unit=mm"),
        ({"pred_vertices": np.zeros((0, MHR_VERTICES, 3), "f4")}, "pred_vertices: got 0 frames"),
        ({"pred_vertices": np.array([{}], object)}, "pred_vertices: got an unreadable array .Python objects"),
    ],
)  # fmt: skip
def test_another_layout_is_refused(tmp_path, change, message):
    person = {key: value for key, value in (_person() | change).items() if value is not None}
    with pytest.raises(InputError, match=f"p.npz: .*{message}"):
        read_sam3d(_save(tmp_path / "p.npz", person))


def test_other_files_and_axes_are_refused(tmp_path):
    with pytest.raises(InputError, match="got the suffix '.npy', expected .npz or .parquet"):
        read_sam3d(tmp_path / "p.npy")
    with pytest.raises(AssetError, match="file is missing"):
        read_sam3d(tmp_path / "p.npz")
    with pytest.raises(InputError, match="axes: got 'world', expected 'camera' or 'model'"):
        read_sam3d(tmp_path / "p.npz", axes="world")


def test_parquet_without_pyarrow_names_it(tmp_path, monkeypatch):
    (tmp_path / "p.parquet").write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"got no pyarrow.*soma-body-core\[parquet\]"):
        read_sam3d(tmp_path / "p.parquet")


class TestParquet:
    @pytest.fixture
    def save(self, tmp_path):
        pa = pytest.importorskip("pyarrow")
        from pyarrow import parquet

        def save(columns: dict[str, object]) -> Path:
            table = columns if isinstance(columns, pa.Table) else pa.table(columns)
            parquet.write_table(table, tmp_path / "p.parquet")
            return tmp_path / "p.parquet"

        return save

    @pytest.mark.parametrize("nested", [True, False])
    def test_rows_are_frames(self, save, tmp_path, nested):
        person = _person(FRAMES)
        rows = {key: list(value.reshape(FRAMES, -1)) for key, value in person.items()}
        if nested:
            rows["pred_vertices"] = [list(frame) for frame in person["pred_vertices"]]
        read = read_sam3d(save(rows | {"bbox": [[0.0, 1.0]] * FRAMES}))
        reference = read_sam3d(_save(tmp_path / "p.npz", person))
        np.testing.assert_array_equal(read.vertices, reference.vertices)
        np.testing.assert_array_equal(read.placement, reference.placement)
        np.testing.assert_array_equal(
            read.parameters["mhr_model_params"], reference.parameters["mhr_model_params"]
        )

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"pred_vertices": None}, "got only the keys pred_cam_t"),
            ({"pred_cam_t": [[0.0, 1.0, 2.0], None]}, "pred_cam_t: got 2 rows of .* 1 nulls"),
            ({"pred_cam_t": [[0.0, 1.0], [0.0, 1.0, 2.0, 3.0]]}, "pred_cam_t: got .*ragged"),
            ({"pred_cam_t": [[0, 1, 2], [0, 1, 2]]}, "pred_cam_t: got 2 rows of list<.*int64"),
            ({"pred_cam_t": ["a", "b"]}, "pred_cam_t: got 2 rows of string"),
        ],
    )
    def test_another_layout_is_refused(self, save, change, message):
        person = _person(2)
        rows = {key: list(value.reshape(2, -1)) for key, value in person.items()} | change
        with pytest.raises(InputError, match=f"p.parquet: .*{message}"):
            read_sam3d(save({key: value for key, value in rows.items() if value is not None}))

    def test_what_unfolds_to_more_than_its_size_can_mean_is_refused(self, save, monkeypatch):
        path = save({"pred_vertices": list(np.zeros((9, 3 * MHR_VERTICES), np.float32))})
        monkeypatch.setattr(sam3d, "_SMALL", 0)
        with pytest.raises(AssetError, match=r"p.parquet: unfolds to 1991412 bytes, at most \d+ are read"):
            read_sam3d(path)

    def test_a_key_twice_is_refused(self, save):
        pa = pytest.importorskip("pyarrow")
        column = pa.array([[0.0]])
        path = save(pa.Table.from_arrays([column, column], ["pred_vertices", "pred_vertices"]))
        with pytest.raises(AssetError, match="p.parquet: damaged"):
            read_sam3d(path)

    def test_damage_is_said(self, save):
        path = save({"pred_vertices": [[0.0]]})
        path.write_bytes(path.read_bytes()[:-9])
        with pytest.raises(AssetError, match="p.parquet: damaged"):
            read_sam3d(path)


@pytest.mark.parametrize("subject", [0, 1])
def test_the_published_outputs(subject):
    folder = os.environ.get("SOMA_TEST_DATA", "")
    path = Path(folder) / "mhr" / f"sam3d_subject{subject}.npz"
    if not folder or not path.is_file():
        pytest.skip(f"SOMA_TEST_DATA has no mhr/{path.name}")
    read = read_sam3d(path)
    assert read.vertices.shape == (1, MHR_VERTICES, 3)
    assert np.ptp(read.vertices[0, :, 1]) > 1.4
    assert set(read.parameters) == {"mhr_model_params", "shape_params", "expr_params"}
    assert read.placement[0, 2] < 0  # before the camera, which looks along -z in these axes
