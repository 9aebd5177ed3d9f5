"""Folders of assets as SOMA publishes them: no manifest, other layouts, files that are missing or stubs."""

import shutil

import numpy as np
import pytest
import torch

from soma_core import SomaLayer, load_canonical
from soma_core.cli import main
from soma_core.errors import AssetError
from soma_core.paths import assets_dir, model_folders, shipped_assets
from soma_core.rig.manifest import CORRECTIVES_NAME, NEUTRAL_NAME, PROCEDURAL_NAME, RIG_NAME
from soma_core.tasks.assets import show_assets

SAME_M = 2e-6
"""Transforms and weights in float32 centimetres against ours in float64 metres, on bodies of two metres."""


@pytest.fixture(autouse=True)
def apart(tmp_path, monkeypatch):
    monkeypatch.delenv("SOMA_ASSETS", raising=False)
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path / "data"))


def first_release(folder, **changed):
    """The rig within SOMA_neutral.npz, no template, no mirror, no texture coordinates, empty segments."""
    folder.mkdir()
    rig = load_canonical("mid")[1]
    with np.load(shipped_assets() / NEUTRAL_NAME) as file:
        kept = {name: file[name] for name in file.files if not name.startswith(("mirror", "uv"))}
    worlds = [np.array(world) for world in (rig.bind_world, rig.t_pose_world)]
    for world in worlds:
        world[:, :3, 3] *= 100
    columns = rig.weights.tocsc()
    kept |= {
        "joint_names": np.array(rig.joint_names),
        "joint_parent_ids": np.maximum(rig.parents, 0).astype(np.int32),
        "bind_pose_world": worlds[0].astype(np.float32),
        "t_pose_world": worlds[1].astype(np.float32),
        "bind_shape": (100 * rig.bind_shape).astype(np.float32),
        "skinning_weights_data": columns.data.astype(np.float32),
        "skinning_weights_indices": columns.indices,
        "skinning_weights_indptr": columns.indptr,
        "skinning_weights_shape": np.array(columns.shape),
        "segment_head": np.zeros(0, np.int32),
    }
    np.savez(folder / NEUTRAL_NAME, **(kept | changed))
    return folder


def newer_release(folder, *, without=()):
    """Template, definition and correctives beside the topology, and no manifest."""
    folder.mkdir()
    for name in {RIG_NAME, NEUTRAL_NAME, PROCEDURAL_NAME, CORRECTIVES_NAME} - {*without}:
        shutil.copy(shipped_assets() / name, folder / name)
    return folder


def posed(**options):
    layer = SomaLayer("soma", lod="low", **options)
    rotations = 0.3 * torch.randn(2, 77, 3, generator=torch.Generator().manual_seed(3))
    return layer, layer.pose(layer.identity({"shape": [1.0, -1.0]}), rotations).vertices


def test_the_first_release_is_the_plain_rig(tmp_path):
    root = first_release(tmp_path / "assets")
    layer, vertices = posed(assets=root)
    assert (layer.procedural, layer.correctives_file, layer.mesh.root) == (False, None, root)
    torch.testing.assert_close(vertices, posed(procedural=False)[1], atol=SAME_M, rtol=0)
    ours, theirs = load_canonical("low")[0], layer.mesh
    np.testing.assert_array_equal(theirs.mirror, ours.mirror)
    np.testing.assert_array_equal(theirs.segments["head"], ours.segments["head"])
    with pytest.raises(AssetError, match=r"no extra-low mesh\. Use lod=low"):
        load_canonical("xlo", root)


def test_a_folder_without_manifest_is_the_shipped_one_where_its_files_are(tmp_path):
    root = newer_release(tmp_path / "assets")
    layer, vertices = posed(assets=root)
    ours, expected = posed()
    assert layer.rig.revision == ours.rig.revision
    assert layer.correctives_file == root / CORRECTIVES_NAME
    torch.testing.assert_close(vertices, expected, atol=0, rtol=0)


def test_without_a_definition_a_template_folds_to_the_joints_of_a_pose(tmp_path):
    root = newer_release(tmp_path / "assets", without=[PROCEDURAL_NAME])
    layer, vertices = posed(assets=root)
    assert not layer.procedural
    torch.testing.assert_close(vertices, posed(procedural=False)[1], atol=SAME_M, rtol=0)


def test_a_folder_is_chosen_shown_and_forgotten(tmp_path, capsys, monkeypatch):
    root = newer_release(tmp_path / "assets", without=[CORRECTIVES_NAME])
    (root / "SMPLX").mkdir()
    (root / "smplx.txt").touch()
    assert main(["assets", "use", str(root)]) == 0
    assert assets_dir() == root
    assert model_folders("smplx") == [tmp_path / "data" / "smplx", root / "SMPLX"]
    shown = "\n".join(show_assets())
    for text in ("soma assets use", "32 twist joints", "128 components", f"{CORRECTIVES_NAME}: missing"):
        assert text in shown
    assert main(["assets", "verify"]) == 0
    assert "can be read" in capsys.readouterr().out
    monkeypatch.setenv("SOMA_ASSETS", str(tmp_path))
    assert assets_dir() == tmp_path
    monkeypatch.delenv("SOMA_ASSETS")
    assert main(["assets", "use", "shipped"]) == 0
    assert assets_dir() == shipped_assets()
    assert model_folders("smplx") == [tmp_path / "data" / "smplx"]


def test_what_cannot_be_assets_is_not_chosen(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    stub = newer_release(tmp_path / "stub")
    (stub / RIG_NAME).write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    short = newer_release(tmp_path / "short")
    (short / NEUTRAL_NAME).write_bytes((short / NEUTRAL_NAME).read_bytes()[:-9999])
    said = {
        "none": "is no folder",
        "empty": "holds no SOMA_neutral.npz",
        "stub": "git lfs pull",
        "short": "NPZ",
    }
    for name, text in said.items():
        assert main(["assets", "use", str(tmp_path / name)]) != 0
        assert text.lower() in capsys.readouterr().err.lower()
    assert assets_dir() == shipped_assets()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"joint_parent_ids": np.full(78, 99)}, "do not fit together"),
        ({"skinning_weights_indptr": np.r_[0, 10**6, np.zeros(77, int)]}, "skinning_weights"),
        ({"triangles": np.full((4, 3), 20000)}, "triangles holds"),
        ({"face_vert_counts": np.array([4, 4])}, "does not add up"),
        ({"bind_shape": np.full((18056, 3), np.nan)}, "do not fit together"),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(tmp_path, changed, said):
    root = first_release(tmp_path / "assets", **changed)
    with pytest.raises(AssetError, match=said):
        load_canonical("mid", root)
