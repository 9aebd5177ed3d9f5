"""Every layout of the official files is read; what is no such file is refused, with the reason."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from soma_backend_smpl import smpl, smplh, smplx
from soma_backend_smpl._files import find_models
from soma_backend_smpl._model_file import read_model, shape_width
from soma_backend_smpl.family import SMPL, SMPLH, SMPLX

from soma_core import AssetError, InputError
from tests.standins.pickles import ch
from tests.standins.smpl_files import FAMILIES, smpl_arrays, smpl_model, write_npz, write_smpl_pickle

SINGLE = 1e-6
"""Metres and weights: what float32 keeps of them."""


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path / "data"))
    return tmp_path / "data"


def same(model, arrays, *, tolerance=0.0):
    pairs = (
        (model.template, "v_template"), (model.pose_directions, "posedirs"), (model.regressor, "J_regressor"),
        (model.weights, "weights"), (model.faces, "f"),
    )  # fmt: skip
    for found, key in pairs:
        np.testing.assert_allclose(found, arrays[key], atol=tolerance, rtol=0)
    directions = np.concatenate([model.shapes, model.expressions], axis=2)
    np.testing.assert_allclose(directions, arrays["shapedirs"], atol=tolerance, rtol=0)


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
@pytest.mark.parametrize(("chumpy", "width"), [(True, 10), (False, 12)])
def test_pickles_are_read_bit_for_bit(tmp_path, chumpy, width, protocol):
    arrays = smpl_arrays("smpl", width=width)
    path = write_smpl_pickle(tmp_path / "SMPL_MALE.pkl", arrays, chumpy=chumpy, protocol=protocol)
    same(read_model(path, SMPL), arrays)
    assert shape_width(path, SMPL) == width


@pytest.mark.parametrize(
    ("name", "width", "shapes", "expressions"),
    [("smpl", 10, 10, 0), ("smplh", 10, 10, 0), ("smplh", 16, 16, 0), ("smplx", 20, 10, 10)],
)
def test_widths_are_told_apart(tmp_path, name, width, shapes, expressions):
    arrays = smpl_arrays(name, width=width)
    path = write_npz(tmp_path / "model.npz", arrays)
    model = read_model(path, FAMILIES[name])
    assert (model.shapes.shape[2], model.expressions.shape[2]) == (shapes, expressions)
    assert shape_width(path, FAMILIES[name]) == shapes
    same(model, arrays)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "width", "shapes"), [("smpl", 300, 300), ("smplx", 400, 300)])
def test_the_wide_files_are_read(tmp_path, name, width, shapes):
    arrays = smpl_arrays(name, width=width)
    path = write_npz(tmp_path / "model.npz", arrays)
    assert shape_width(path, FAMILIES[name]) == shapes
    model = read_model(path, FAMILIES[name])
    assert model.shapes.shape[2] == shapes
    np.testing.assert_array_equal(model.expressions, arrays["shapedirs"][:, :, shapes:])


@pytest.mark.parametrize("plugin", [smpl, smplh, smplx])
def test_converting_keeps_the_body(tmp_path, root, plugin):
    name = plugin.__name__.rpartition(".")[2]
    arrays = smpl_arrays(name, width={"smplx": 20}.get(name, 10))
    source = tmp_path / f"{name.upper()}_FEMALE.pkl"
    write_smpl_pickle(source, arrays)
    converted, obj = plugin.soma_convert(source, None)
    assert converted == root / name.upper() / f"{name.upper()}_FEMALE.npz"
    assert obj == root / ("SMPLX" if name == "smplx" else "SMPL") / "base_body.obj"
    same(read_model(converted, FAMILIES[name]), arrays, tolerance=SINGLE)
    with np.load(converted, allow_pickle=False) as file:
        assert {array.dtype.kind for array in file.values()} <= set("fiU")
        assert '"gender": "female"' in str(file["meta"])
    assert plugin.soma_convert(converted, tmp_path / "again.npz") == [tmp_path / "again.npz"]


def test_names_tell_the_gender_in_any_case(root):
    names = {
        "SMPL": ["basicmodel_neutral_lbs_10_207_0_v1.0.0.pkl", "basicModel_f_lbs_10_207_0_v1.0.0.pkl",
                 "basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl", "smpl_male.PKL", "SMPL_MALE.npz", "note.txt"],
        "smplh": ["male/model.npz", "SMPLH_FEMALE.pkl", "other/model.npz"],
        "SMPLX": ["SMPLX_NEUTRAL_2020.npz", "SMPLX_NEUTRAL.pkl", "SMPLX_FEMALE_2020.npz"],
    }  # fmt: skip
    for folder, files in names.items():
        for file in files:
            (root / folder / file).parent.mkdir(parents=True, exist_ok=True)
            (root / folder / file).touch()
    found = {gender: path.name for gender, path in find_models(SMPL).items()}
    assert found == {
        "male": "SMPL_MALE.npz",
        "female": "basicModel_f_lbs_10_207_0_v1.0.0.pkl",
        "neutral": "basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl",
    }
    assert {gender: path.name for gender, path in find_models(SMPLH).items()} == {
        "male": "model.npz",
        "female": "SMPLH_FEMALE.pkl",
    }
    assert find_models(SMPLX)["neutral"].name == "SMPLX_NEUTRAL_2020.npz"


def changed(**changes):
    arrays = smpl_arrays("smpl", width=10)
    for key, change in changes.items():
        arrays[key] = change(arrays[key].copy())
    return arrays


def _put(index, value):
    def change(array):
        array[index] = value
        return array

    return change


@pytest.mark.parametrize(
    ("key", "change", "cause"),
    [
        ("shapedirs", lambda a: a[:, :, :0], "shapedirs has 0 directions, expected 1 to 300"),
        ("shapedirs", lambda a: a.reshape(-1, 10), r"shapedirs has the shape \(20670, 10\)"),
        ("v_template", lambda a: a[:-1], r"v_template has the shape \(6889, 3\), expected \(6890, 3\)"),
        ("v_template", lambda a: a[:778], "it is a MANO hand"),
        ("v_template", _put((7, 1), np.nan), r"v_template is nan at \(7, 1\), expected finite"),
        ("v_template", lambda a: 100 * a, "tall, expected metres"),
        ("v_template", lambda a: a[:, [0, 2, 1]], "tall, expected metres"),
        ("v_template", lambda a: a * [-1, 1, -1], "does not stand along .y and face .z"),
        ("posedirs", lambda a: a[:, :, :-9], r"posedirs has the shape \(6890, 3, 198\)"),
        ("weights", lambda a: 2 * a, "of weights sums to 2, expected 1"),
        ("weights", lambda a: a.astype(int), "weights holds int64, expected floating-point"),
        ("J_regressor", lambda a: 0 * a, "row 0 of J_regressor sums to 0"),
        ("kintree_table", _put((0, 3), 5), "kintree_table gives joint 3 the parent 5, expected 0"),
        ("kintree_table", _put((0, 1), 4), "kintree_table gives joint 1 the parent 4, expected 0"),
        ("f", lambda a: _put((0, 0), 6890)(a), "f refers to vertex 6890 of 6890"),
        ("f", lambda a: _put((0, 0), -2)(a.astype(np.int64)), "f refers to vertex -2 of 6890"),
        ("f", lambda a: a.astype(float), "f holds float64, expected whole numbers"),
    ],
)
def test_what_cannot_be_a_body_is_refused(tmp_path, key, change, cause):
    path = write_npz(tmp_path / "SMPL_MALE.npz", changed(**{key: change}))
    with pytest.raises(AssetError, match=f"SMPL_MALE.npz: .*{cause}.*smpl.is.tue.mpg.de"):
        read_model(path, SMPL)


@pytest.mark.parametrize(
    ("name", "family"), [("smplh", SMPL), ("smpl", SMPLH), ("smplx", SMPL), ("smplh", SMPLX)]
)
def test_another_model_is_named(tmp_path, name, family):
    arrays = smpl_arrays(name, width={"smplx": 20}.get(name, 10))
    path = write_npz(tmp_path / "model.npz", arrays)
    with pytest.raises(AssetError, match=f"it is {FAMILIES[name].title}: use the backend {name}"):
        read_model(path, family)


def test_a_width_between_the_known_ones_is_refused(tmp_path):
    path = write_npz(tmp_path / "SMPLX_MALE.npz", smpl_arrays("smplx", width=10))
    with pytest.raises(AssetError, match="shapedirs has 10 directions, expected 400 or 20"):
        read_model(path, SMPLX)
    assert shape_width(path, SMPLX) is None


def test_missing_keys_and_objects_are_refused(tmp_path):
    arrays = smpl_arrays("smpl", width=10)
    del arrays["f"], arrays["posedirs"]
    with pytest.raises(AssetError, match="has no posedirs, f, so it is no SMPL model"):
        read_model(write_npz(tmp_path / "a.npz", arrays), SMPL)
    objects = smpl_arrays("smpl", width=10) | {"shapedirs": np.array([{}], object)}
    with pytest.raises(AssetError, match="shapedirs cannot be read: Python objects.*Convert the official"):
        read_model(write_npz(tmp_path / "b.npz", objects), SMPL)
    assert shape_width(tmp_path / "b.npz", SMPL) is None


def test_conversion_says_what_it_needs(tmp_path, root):
    source = write_smpl_pickle(tmp_path / "body.pkl", smpl_arrays("smpl", width=10))
    with pytest.raises(
        InputError, match="FILE: got the name body.pkl, expected a name that tells the gender"
    ):
        smpl.soma_convert(source, None)
    assert smpl.soma_convert(source, tmp_path / "SMPL_MALE.npz")[0].is_file()
    with pytest.raises(InputError, match="FILE: got .*body.txt"):
        smpl.soma_convert(tmp_path / "body.txt", None)
    with pytest.raises(InputError, match="FILE: got .*out.pkl"):
        smpl.soma_convert(source, tmp_path / "out.pkl")


def test_declaring_reads_a_width_and_loads_no_torch(tmp_path, root, monkeypatch):
    assert smpl.soma_backend().params[0].shape == (10,)
    write_smpl_pickle(root / "SMPL" / "SMPL_FEMALE.pkl", smpl_arrays("smpl", width=12))
    code = (
        "from soma_backend_smpl import smpl; import sys; print(smpl.soma_backend().params[0].shape,"
        "'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "(12,) False\n"
    (root / "SMPL" / "SMPL_NEUTRAL.npz").write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    assert smpl.soma_backend().params[0].shape == (10,)


def test_a_model_with_other_chumpy_classes_is_refused(tmp_path):
    content = smpl_model(smpl_arrays("smpl", width=10), chumpy=True)
    strange = ch(np.zeros(3))
    strange.module, strange.name = "chumpy.linalg", "Svd"
    from tests.standins.pickles import write_pickle

    path = write_pickle(tmp_path / "SMPL_MALE.pkl", content | {"unused": strange})
    with pytest.raises(AssetError, match="SMPL_MALE.pkl: asks for chumpy.linalg.Svd.*Nothing of it was run"):
        read_model(path, SMPL)
