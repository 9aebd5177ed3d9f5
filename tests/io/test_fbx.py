"""FBX files by their joints, read in a process that may die."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_core.errors import AssetError, InputError
from soma_core.io import fbx
from soma_core.io.skeleton_files import read_skeleton
from tests.fbx_files import write_fbx
from tests.motion.test_retarget import MIXAMO
from tests.skeletons import biped, moved

pytest.importorskip("ufbx")

SAME_MM = 0.005  # KeyValueFloat is single precision: 1e-7 of a whole turn, along two metres of bones


@pytest.fixture(scope="module")
def motion():
    return moved(*biped(MIXAMO), frames=12, seed=3)


def same_joints(motion, found):
    """Largest distance [mm] of the joints, by their names."""
    places = [found.names.index(name) for name in motion.names]
    return 1e3 * np.abs(found.positions()[:, places] - motion.positions()).max()


@pytest.mark.parametrize("skin", [False, True])
def test_joints_are_where_they_were(motion, skin, tmp_path):
    write_fbx(motion, tmp_path / "walk.fbx", skin=skin)
    found = read_skeleton(tmp_path / "walk.fbx")
    assert (found.frame_count, found.fps, found.up, found.metres) == (12, motion.fps, "+y", 1.0)
    assert same_joints(motion, found) < SAME_MM
    places = [found.names.index(name) for name in motion.names]
    np.testing.assert_allclose(found.rest[places], motion.rest, atol=1e-6)
    # The skin tells the pose of rest: turns are since then, whatever pose the nodes stand in.
    apart = found.turns()[:, places] @ np.swapaxes(motion.turns(), -1, -2)
    assert Rotation.from_matrix(apart.reshape(-1, 3, 3)).magnitude().max() < 1e-5


def test_another_rate_samples_the_same_motion(motion, tmp_path):
    write_fbx(motion, tmp_path / "walk.fbx", told=False)
    found = read_skeleton(tmp_path / "walk.fbx", fps=2 * motion.fps)
    assert (found.frame_count, found.fps) == (23, 2 * motion.fps)
    even = found.positions()[::2]
    places = [found.names.index(name) for name in motion.names]
    assert 1e3 * np.abs(even[:, places] - motion.positions()).max() < SAME_MM


def test_a_reader_that_dies_names_another_way(motion, tmp_path, monkeypatch):
    write_fbx(motion, tmp_path / "walk.fbx")
    monkeypatch.setattr(fbx, "_SECONDS", -1)  # no time at all: the process is killed, as by a crash
    monkeypatch.setattr(fbx, "_MEMORY", 1 << 20)
    with pytest.raises(AssetError, match=r"walk\.fbx: ufbx.*ends.*Blender.*\.glb"):
        read_skeleton(tmp_path / "walk.fbx")


def test_without_the_library_both_ways_are_named(motion, tmp_path, monkeypatch):
    write_fbx(motion, tmp_path / "walk.fbx")
    monkeypatch.setitem(sys.modules, "ufbx", None)
    with pytest.raises(InputError, match=r"pip install 'soma-body-core\[fbx\]'.*Blender"):
        read_skeleton(tmp_path / "walk.fbx")


def test_a_scene_of_several_skeletons_asks_for_one(motion, tmp_path):
    path = tmp_path / "two.fbx"
    write_fbx(motion, path)
    text = path.read_text().replace('C: "OO",1010,1000', 'C: "OO",1010,0')  # the spine is cut off
    path.write_text(text)
    with pytest.raises(InputError, match="2 skeletons.*one of mixamorig:Hips, mixamorig:Spine"):
        read_skeleton(path)
    assert read_skeleton(path, root="mixamorig:Spine").names[0] == "mixamorig:Spine"
