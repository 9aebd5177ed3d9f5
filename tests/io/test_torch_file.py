"""Files of tensors are read as torch wrote them, and refused where their metadata lie."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict, defaultdict

import numpy as np
import pytest
import torch

from soma_core.errors import AssetError
from soma_core.io.data_files import read_torch_arrays

NUMBERS = torch.arange(24.0).reshape(2, 3, 4)


def saved(path, content, **options):
    torch.save(content, path, **options)
    return read_torch_arrays(path)


@pytest.mark.parametrize(
    "tensor",
    [
        NUMBERS, NUMBERS.double(), NUMBERS.half(), NUMBERS.long(), NUMBERS.short(), NUMBERS.byte(),
        NUMBERS > 3, NUMBERS.transpose(0, 2), NUMBERS[1:, ::2], torch.ones(1, 10).expand(5, 10),
        torch.zeros(0, 3), torch.tensor(4.0), torch.nn.Parameter(NUMBERS), NUMBERS.to(torch.complex64),
    ],
    ids=lambda tensor: f"{tensor.dtype}-{tuple(tensor.shape)}-{tensor.stride()}",
)  # fmt: skip
def test_tensors_come_as_their_numbers(tmp_path, tensor):
    found = saved(tmp_path / "a.pt", {"a": tensor})["a"]
    expected = tensor.detach().numpy()
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


def test_half_of_a_float_becomes_a_float(tmp_path):
    found = saved(tmp_path / "a.pt", NUMBERS.bfloat16())
    np.testing.assert_array_equal(found, NUMBERS.bfloat16().float().numpy())


@pytest.mark.filterwarnings("ignore:Sparse:UserWarning")
@pytest.mark.parametrize("layout", ["sparse_coo", "sparse_csr", "sparse_csc", "sparse_bsr", "sparse_bsc"])
def test_sparse_tensors_come_dense(tmp_path, layout):
    dense = torch.eye(4)[[0, 2, 1, 3]] * torch.arange(1.0, 5)
    block = (2, 2) if layout[-3:-1] == "bs" else None
    found = saved(tmp_path / "a.pt", dense.to_sparse(layout=getattr(torch, layout), blocksize=block))
    np.testing.assert_array_equal(found, dense.numpy())


def test_structure_is_kept(tmp_path):
    content = {
        "list": [1, 2.5, "text", None, (True, NUMBERS)], 3: {"size": NUMBERS.shape}, "set": {1},
        "ordered": OrderedDict(a=1), "default": defaultdict(list, {1: [2]}), "numpy": np.eye(2),
        "scalar": np.float64(3), "device": torch.device("cpu"),
        "weights": torch.nn.Linear(2, 3).state_dict(),
    }  # fmt: skip
    found = saved(tmp_path / "a.pt", content)
    assert found["list"][:4] == [1, 2.5, "text", None]
    assert found["list"][4][0] is True
    assert found[3] == {"size": (2, 3, 4)}
    assert (found["set"], found["ordered"], found["default"]) == ([1], {"a": 1}, {1: [2]})
    np.testing.assert_array_equal(found["numpy"], np.eye(2))
    assert found["scalar"] == 3
    assert {key: value.shape for key, value in found["weights"].items()} == {"weight": (3, 2), "bias": (3,)}


def test_the_order_of_bytes_is_followed(tmp_path):
    path = tmp_path / "a.pt"
    torch.save(NUMBERS.int(), path)
    members = read_members(path)
    swapped = np.frombuffer(members["a/data/0"], "<i4").astype(">i4").tobytes()
    write_members(path, members | {"a/byteorder": b"big", "a/data/0": swapped})
    np.testing.assert_array_equal(read_torch_arrays(path), NUMBERS.int().numpy())


def read_members(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_members(path, members, **options):
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"a/data/0": bytes(8)}, "8 bytes in the storage '0' of 24 numbers"),
        ({"a/constants.pkl": b""}, "TorchScript"),
        ({"b/data.pkl": b"N."}, "no data.pkl, or several"),
        ({"a/data.pkl": pickle.dumps(NUMBERS.numpy)}, "asks for"),
        ({"a/data.pkl": b"ctorch.hub\nload\n."}, "asks for torch.hub.load, which is no part of a file of te"),
        ({"a/data.pkl": b"N"}, "is cut off"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, change, cause):
    path = tmp_path / "a.pt"
    torch.save(NUMBERS, path)
    write_members(path, read_members(path) | change)
    with pytest.raises(AssetError, match=rf"a\.pt: .*{cause}.*Nothing of it was run"):
        read_torch_arrays(path)


class _View:
    """A tensor of any metadata over the storage of another."""

    def __init__(self, tensor, *view):
        self.tensor, self.view = tensor, view

    def __reduce__(self):
        storage = torch.storage.TypedStorage(
            wrap_storage=self.tensor.untyped_storage(), dtype=self.tensor.dtype, _internal=True
        )
        return torch._utils._rebuild_tensor_v2, (storage, *self.view, False, OrderedDict())


@pytest.mark.parametrize(
    ("view", "cause"),
    [
        ((0, (2, 13), (12, 1)), "leaves its storage of 24 numbers"),
        ((20, (5,), (1,)), "leaves its storage"),
        ((-1, (2,), (1,)), "do not belong together"),
        ((0, (2,), (-1,)), "a stride that is none"),
        ((0, (-2,), (1,)), "a size that is none"),
        ((0, (2, 2), (1,)), "do not belong together"),
        ((0, (10**9,), (0,)), "unfold to far more"),
        ((0, (2**40, 2**40), (0, 0)), "unfold to far more"),
        ((0, (1.5,), (1,)), "a size that is none"),
    ],
)
def test_tensors_that_lie_are_refused(tmp_path, view, cause):
    torch.save({"poses": [_View(NUMBERS, *view)]}, tmp_path / "a.pt")
    with pytest.raises(AssetError, match=rf"poses: .*{cause}"):
        read_torch_arrays(tmp_path / "a.pt")


def test_compressed_members_are_refused(tmp_path):
    path = tmp_path / "a.pt"
    torch.save(NUMBERS, path)
    write_members(path, read_members(path), compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(AssetError, match="compressed members"):
        read_torch_arrays(path)


def test_the_layout_of_old_is_named_with_the_way_on(tmp_path):
    torch.save(NUMBERS, tmp_path / "a.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(AssetError, match=r"before 1\.6.*weights_only=True"):
        read_torch_arrays(tmp_path / "a.pt")


def test_a_program_is_refused(tmp_path):
    stream = io.BytesIO()
    with pytest.warns(DeprecationWarning, match="torch.jit"):
        torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), stream)
    (tmp_path / "a.pt").write_bytes(stream.getvalue())
    with pytest.raises(AssetError, match="TorchScript program"):
        read_torch_arrays(tmp_path / "a.pt")
