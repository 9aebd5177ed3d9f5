"""Arrays come out of pickles bit for bit, whoever wrote them."""

from __future__ import annotations

import numpy as np
import pytest

from soma_core.errors import AssetError
from soma_core.io.pickled_arrays import read_pickled_arrays
from soma_core.safe_pickle import read_pickle
from tests.standins.pickles import Instance, ch, csc, select, write_pickle

NUMBERS = np.random.default_rng(0).standard_normal((40, 3, 5))
IDS = np.arange(12, dtype=np.uint32).reshape(2, 6) + (1 << 31)
SPARSE = np.where(NUMBERS[0] > 0, NUMBERS[0], 0)


@pytest.mark.parametrize("python_2", [True, False])
@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4])
def test_arrays_of_every_protocol_come_back(tmp_path, protocol, python_2):
    content = {
        "plain": NUMBERS, "fortran": np.asfortranarray(NUMBERS), "big": NUMBERS.astype(">f4"), "ids": IDS,
        "ch": ch(NUMBERS), "select": select(NUMBERS), "csc": csc(SPARSE), "scalar": np.float64(0.25),
        "new": csc(SPARSE, module="scipy.sparse._csc"), "twice": (NUMBERS, "text", 1 << 40, 1.5, True, None),
        "set": {1, 2},
    }  # fmt: skip
    path = write_pickle(tmp_path / "a.pkl", content, protocol=protocol, python_2=python_2)
    found = read_pickled_arrays(path, [*content.keys() - {"twice", "set"}, "absent"])
    for key in ("plain", "fortran", "ch", "select"):
        np.testing.assert_array_equal(found[key], NUMBERS, strict=True)
        assert found[key].flags.c_contiguous
    np.testing.assert_array_equal(found["big"], NUMBERS.astype("f4"), strict=True)
    np.testing.assert_array_equal(found["ids"], IDS, strict=True)
    np.testing.assert_array_equal(found["csc"], SPARSE, strict=True)
    np.testing.assert_array_equal(found["new"], SPARSE, strict=True)
    assert found["scalar"] == 0.25
    assert "absent" not in found
    plain = read_pickle(path)
    assert plain["twice"][1:] == ("text", 1 << 40, 1.5, True, None)


def test_arrays_of_protocol_5_come_back(tmp_path):
    import pickle

    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps({"a": NUMBERS, "b": np.asfortranarray(NUMBERS[0])}, protocol=5))
    found = read_pickled_arrays(path, ["a", "b"])
    np.testing.assert_array_equal(found["a"], NUMBERS, strict=True)
    np.testing.assert_array_equal(found["b"], NUMBERS[0], strict=True)


def _sparse(*, shape=(2, 2), indptr=(0, 1, 2), indices=(0, 1)):
    state = {"_shape": shape, "data": np.ones(2), "indices": np.array(indices), "indptr": np.array(indptr)}
    return Instance("scipy.sparse.csc", "csc_matrix", state)


@pytest.mark.parametrize(
    ("value", "cause"),
    [
        (np.array([print], object), "objects"),
        (np.array(["text"]), "objects or text"),
        ("text", "a str"),
        ([1.0], "a list"),
        ({}, "a dict"),
        (Instance("chumpy.ch", "Ch", {"y": NUMBERS}), "KeyError.'x'"),
        (Instance("chumpy.reordering", "Select", {"a": NUMBERS, "idxs": np.array([600])}), "leaves its 600"),
        (Instance("chumpy.reordering", "Select", {"a": NUMBERS, "idxs": np.array([-1])}), "leaves its 600"),
        (Instance("scipy.sparse.csc", "csc_matrix", {"_shape": (2, 2)}), "KeyError.'data'"),
        (_sparse(shape=(1 << 20, 1 << 20)), "sparse matrix of 1048576"),
        (_sparse(indptr=[0, 9, 0]), "starts that do not divide 2 entries"),
        (_sparse(indptr=[0, 9, 2]), "starts that do not divide 2 entries"),
        (_sparse(indptr=[1, 1, 2]), "starts that do not divide 2 entries"),
        (_sparse(indptr=[0, 2]), "starts that do not divide 2 entries into 2"),
        (_sparse(indices=[0, 2]), "indices that leave the 2 rows"),
        (_sparse(indices=[-1, 0]), "indices that leave the 2 rows"),
        (_sparse(indices=[0.0, 1.0]), "no rows of integers"),
    ],
)
def test_a_key_without_numbers_is_named(tmp_path, value, cause):
    if isinstance(value, np.ndarray) and value.dtype == object:
        value[0] = 1.0
    path = write_pickle(tmp_path / "a.pkl", {"shapedirs": value})
    with pytest.raises(AssetError, match=f"a.pkl: shapedirs: no sound array.*{cause}"):
        read_pickled_arrays(path, ["shapedirs"])


@pytest.mark.parametrize("indices", [[0, 7], [0, -1]])
def test_sparse_indices_out_of_range_are_refused(tmp_path, indices):
    state = {"_shape": (3, 1), "data": np.ones(2), "indices": np.array(indices), "indptr": np.array([0, 2])}
    path = write_pickle(tmp_path / "a.pkl", {"m": Instance("scipy.sparse.csc", "csc_matrix", state)})
    with pytest.raises(AssetError, match="m: no sound array"):
        read_pickled_arrays(path, ["m"])


def test_objects_deep_inside_each_other_are_refused(tmp_path):
    value = NUMBERS
    for _ in range(12):
        value = Instance("chumpy.ch", "Ch", {"x": value})
    path = write_pickle(tmp_path / "a.pkl", {"m": value})
    with pytest.raises(AssetError, match="more than 8 objects inside each other"):
        read_pickled_arrays(path, ["m"])


def test_what_is_not_asked_for_is_not_looked_at(tmp_path):
    path = write_pickle(tmp_path / "a.pkl", {"a": NUMBERS, "b": Instance("chumpy.ch", "Ch", {})})
    assert list(read_pickled_arrays(path, ["a"])) == ["a"]


def test_a_pickle_of_something_else_is_refused(tmp_path):
    path = write_pickle(tmp_path / "a.pkl", [NUMBERS])
    with pytest.raises(AssetError, match="holds a list, not named arrays"):
        read_pickled_arrays(path, ["a"])
