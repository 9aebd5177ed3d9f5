"""Arrays of NPZ files come back as they were saved; what the file is too small to hold is refused."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from soma_core import npz
from soma_core.errors import AssetError
from soma_core.npz import open_npz_file, read_array_header

ARRAYS = {
    "plain": np.arange(24.0).reshape(2, 3, 4), "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)),
    "big": np.arange(3, dtype=">i4"), "text": np.array(["a", "bc"]), "empty text": np.array(""),
    "number": np.array(2.5), "none": np.zeros((0, 3), np.float32), "yes": np.array(True),  # noqa: FBT003
}  # fmt: skip


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_come_back(tmp_path, save):
    save(tmp_path / "a.npz", **ARRAYS)
    with open_npz_file(tmp_path / "a.npz") as file:
        assert file.names == tuple(ARRAYS)
        for name, expected in ARRAYS.items():
            np.testing.assert_array_equal(file.read(name), expected, strict=True)
            assert file.header(name).shape == expected.shape


def test_a_file_unfolds_to_a_multiple_of_its_size_at_most(tmp_path, monkeypatch):
    monkeypatch.setattr(npz, "_SMALL", 1000)
    np.savez_compressed(tmp_path / "a.npz", zeros=np.zeros(200_000))
    with (
        open_npz_file(tmp_path / "a.npz") as file,
        pytest.raises(ValueError, match="1600000 bytes in"),
    ):
        file.read("zeros")


@pytest.mark.parametrize(
    ("header", "cause"),
    [
        (b"\x93NUMPY\x03\x00" + bytes(100), r"NPY version \(3, 0\)"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\x7f", "a header of 2147483647 bytes"),
        (b"\x93NUMPY\x01\x00\x10\x00", "."),
        (b"nothing of the kind", "magic"),
    ],
)
def test_headers_that_are_none_are_refused(header, cause):
    with pytest.raises(ValueError, match=cause):
        read_array_header(io.BytesIO(header))


def _saved(array, **options):
    stream = io.BytesIO()
    np.save(stream, array, **options)
    return stream.getvalue()


def test_objects_and_lies_are_refused(tmp_path):
    with pytest.raises(ValueError, match="Python objects, which can run code"):
        read_array_header(io.BytesIO(_saved(np.array([{}], object))))
    with pytest.raises(ValueError, match="the shape .-2, 3."):
        read_array_header(io.BytesIO(_saved(np.zeros((12, 3))).replace(b"(12, 3)", b"(-2, 3)")))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("short.npy", _saved(np.zeros(4))[:-8])
    with (
        open_npz_file(tmp_path / "a.npz") as file,
        pytest.raises(ValueError, match=r"24 bytes for the shape \(4,\)"),
    ):
        file.read("short")


def test_what_is_no_archive_is_named(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(b"PK\x03\x04 and no more")
    with (
        pytest.raises(AssetError, match=r"a\.npz: not an NPZ file .it starts with b'PK"),
        open_npz_file(path),
    ):
        pass
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", b"x")
    path.write_bytes(path.read_bytes().replace(b"PK\x01\x02", b"PK\x01\x00"))  # where the directory begins
    with pytest.raises(AssetError, match=r"a\.npz: damaged NPZ file"), open_npz_file(path):
        pass
