import json
import warnings

import numpy as np
import pytest

from assets.make.neutral import compress_shape_space, write_neutral
from soma_core.errors import AssetError, InputError
from soma_core.paths import assets_dir
from soma_core.rig.manifest import NEUTRAL_NAME
from soma_core.rig.neutral import (
    TOPOLOGY_KEYS,
    ShapeSpace,
    load_shape_space,
    read_topology,
)


def space(components: int = 3, vertices: int = 50) -> ShapeSpace:
    generator = np.random.default_rng(0)
    directions = np.linalg.qr(generator.normal(size=(3 * vertices, max(components, 1))))[0].T[:components]
    return ShapeSpace(
        mean=generator.normal(size=(vertices, 3)).astype(np.float32),
        shapedirs=directions.astype(np.float32),
        eigenvalues=(1000 * 0.5 ** np.arange(components)).astype(np.float32),
        metadata={"trained_on": "noise"},
    )


def topology() -> dict[str, np.ndarray]:
    return {name: np.array("faceVarying") if "interp" in name else np.arange(3) for name in TOPOLOGY_KEYS}


def test_shape_space_comes_back_with_its_metadata(tmp_path):
    path = tmp_path / "neutral.npz"
    write_neutral(path, topology(), space(), {"units": "centimeters", "provenance": {"origin": "here"}})
    found = load_shape_space(path)
    for name in ("mean", "shapedirs", "eigenvalues"):
        np.testing.assert_array_equal(getattr(found, name), getattr(space(), name))
    assert found.metadata == {"trained_on": "noise"}
    assert found.component_count == 3
    assert set(read_topology(path)) == set(TOPOLOGY_KEYS)


def test_writing_twice_gives_the_same_bytes(tmp_path):
    for name in ("a.npz", "b.npz"):
        write_neutral(tmp_path / name, topology(), space(), {})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_file_from_elsewhere_with_more_keys_and_types_loads(tmp_path):
    path = tmp_path / "other.npz"
    values = {
        name: getattr(space(), name).astype(np.float64) for name in ("mean", "shapedirs", "eigenvalues")
    }
    metadata = json.dumps({"units": "cm", "up_axis": "Y", "provenance": "a pipeline", "gender": "neutral"})
    np.savez(
        path, **values, **topology(), bind_shape=np.zeros(3), uv_coord_st1=np.zeros(2), metadata=metadata
    )
    found = load_shape_space(path)
    assert found.mean.dtype == found.shapedirs.dtype == np.float32
    assert found.metadata["gender"] == "neutral"
    read_topology(path)


def test_metadata_is_optional_elsewhere(tmp_path):
    path = tmp_path / "bare.npz"
    np.savez(path, **{name: getattr(space(), name) for name in ("mean", "shapedirs", "eigenvalues")})
    assert load_shape_space(path).metadata == {}


@pytest.mark.parametrize("missing", ["mean", "eigenvalues"])
def test_missing_shape_keys_are_named(tmp_path, missing):
    path = tmp_path / "bare.npz"
    keys = {"mean", "shapedirs", "eigenvalues"} - {missing}
    np.savez(path, **{name: getattr(space(), name) for name in keys})
    with pytest.raises(AssetError, match=rf"missing keys \['{missing}'\]. .*git checkout -- assets"):
        load_shape_space(path)


def test_missing_topology_key_is_named(tmp_path):
    path = tmp_path / "bare.npz"
    np.savez(path, **{name: value for name, value in topology().items() if name != "triangles_low"})
    with pytest.raises(AssetError, match="triangles_low"):
        read_topology(path)
    with pytest.raises(InputError, match="triangles_low"):
        write_neutral(path, {k: v for k, v in topology().items() if k != "triangles_low"}, space(), {})


@pytest.mark.parametrize(
    ("metadata", "text"),
    [
        ('{"units": "meters"}', "units = meters"),
        ('{"up_axis": "Z"}', "up_axis = Z"),
        ('{"handedness": "left"}', "handedness = left"),
        ("{", "not JSON"),
        ("[1]", "not a JSON object"),
    ],
)
def test_metadata_of_another_convention_is_refused(tmp_path, metadata, text):
    path = tmp_path / "other.npz"
    values = {name: getattr(space(), name) for name in ("mean", "shapedirs", "eigenvalues")}
    np.savez(path, **values, metadata=metadata)
    with pytest.raises(AssetError, match=text):
        load_shape_space(path)


def test_pickled_and_broken_files_are_refused(tmp_path):
    path = tmp_path / "broken.npz"
    np.savez(path, mean=np.array([{}], object), shapedirs=0, eigenvalues=0)
    with pytest.raises(AssetError, match="mean cannot be read .Python objects"):
        load_shape_space(path)
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(AssetError, match="not an NPZ file"):
        load_shape_space(path)
    with open(path, "wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(AssetError, match="not an NPZ file"):
        load_shape_space(path)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"shapedirs": np.zeros((3, 149))}, r"\(3, 149\)"),
        ({"mean": np.zeros(150)}, r"\(150,\)"),
        ({"mean": np.full((50, 3), np.nan)}, "NaN"),
        ({"eigenvalues": np.array([1.0, 1.0, -1.0])}, "negative eigenvalue"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, change, text):
    values = {name: getattr(space(), name) for name in ("mean", "shapedirs", "eigenvalues")} | change
    with pytest.raises(InputError, match=text):
        ShapeSpace(**values)
    np.savez(tmp_path / "bad.npz", **values)
    with pytest.raises(AssetError, match=text):
        load_shape_space(tmp_path / "bad.npz")


def test_rounding_keeps_the_promised_error_and_states_it():
    exact, rounded = space(), compress_shape_space(space(), rms_error=0.002)
    coefficients = np.random.default_rng(1).normal(size=(4000, 3)) * np.sqrt(exact.eigenvalues)
    moved = (coefficients @ (rounded.shapedirs - exact.shapedirs)).reshape(-1, 3)
    measured = 10 * np.sqrt(np.square(moved).sum(axis=1).mean())
    stated = rounded.metadata["rounding"]["rms_vertex_error_mm"]
    assert stated == pytest.approx(measured, rel=0.05)  # 4,000 random draws
    assert 0 < stated <= 0.02 * 1.05
    assert rounded.metadata["trained_on"] == "noise"


def test_rounded_directions_are_few_and_stay_put():
    rounded = compress_shape_space(space(), rms_error=0.1)
    assert len(np.unique(rounded.shapedirs[2])) < len(np.unique(space().shapedirs[2]))
    assert compress_shape_space(rounded, rms_error=1.0) is rounded  # once is enough


def test_rounding_survives_empty_and_powerless_components():
    assert compress_shape_space(space(0)).component_count == 0
    dead = ShapeSpace(mean=space().mean, shapedirs=space().shapedirs, eigenvalues=np.zeros(3, np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isfinite(compress_shape_space(dead).shapedirs).all()


def test_shipped_file_declares_unit_axes_and_origin():
    with np.load(assets_dir() / NEUTRAL_NAME, allow_pickle=False) as file:
        metadata = json.loads(str(file["metadata"]))
        assert str(file["uv_interp_st"]) == "faceVarying"
        assert "uv_coord_st1" not in file.files
    assert (metadata["units"], metadata["up_axis"], metadata["forward_axis"]) == ("centimeters", "+Y", "+Z")
    assert {"model_version", "gender", "handedness", "asset_contract", "provenance"} <= set(metadata)
    assert load_shape_space().mean.shape == (18056, 3)
