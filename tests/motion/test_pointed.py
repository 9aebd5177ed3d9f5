"""Motions from files of points: the pose comes back, unit and axes are questioned, gaps are bridged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from soma_core import SomaLayer
from soma_core.errors import InputError
from soma_core.io.camera import read_cameras
from soma_core.io.motion_files import read_motion
from soma_core.motion import (
    BackendChoice,
    ConvertOptions,
    IdentityChoice,
    InvertOptions,
    convert_file,
    invert,
    load_clip,
)
from soma_core.points.point_set import load_point_set

LAYER = SomaLayer("soma", lod="low")
CLIP = load_clip().cut(slice(0, 24))
POSED = LAYER.joints(LAYER.identity(), torch.as_tensor(CLIP.rotations), torch.as_tensor(CLIP.translation))
POINTS = LAYER.points(POSED, "smpl22").numpy()


def _run(tmp_path: Path, values: np.ndarray, **options: object):
    np.save(tmp_path / "points.npy", values)
    given = ConvertOptions(**({"points": "smpl22", "fps": 30, "lod": "low"} | options))
    found = convert_file(tmp_path / "points.npy", tmp_path / "out", options=given)
    motion = read_motion(found.files.motion)
    again = LAYER.joints(
        LAYER.identity(), torch.as_tensor(motion.rotations), torch.as_tensor(motion.translation)
    )
    return found, LAYER.points(again, "smpl22").numpy()


def test_points_become_a_motion_that_meets_them(tmp_path: Path) -> None:
    gaps = POINTS.copy()
    gaps[10:12] = np.nan
    found, again = _run(tmp_path, gaps)
    assert np.abs(again - POINTS).max() < 0.02  # the bridged frames as well [m]
    assert np.linalg.norm(again - POINTS, axis=-1)[:8].mean() < 1e-3
    assert found.report["valid_frames"] == 22
    assert any("bridged" in one for one in found.report["warnings"])


def test_units_and_axes_are_told_or_questioned(tmp_path: Path) -> None:
    found, again = _run(tmp_path, 100 * POINTS)
    assert any("taken for cm" in one for one in found.report["warnings"])
    assert np.linalg.norm(again - POINTS, axis=-1).mean() < 1e-3
    upright = POINTS[..., [0, 2, 1]] * [1, -1, 1]  # +Z up
    found, _ = _run(tmp_path, upright)
    assert any("up=z" in one for one in found.report["warnings"])
    found, again = _run(tmp_path, upright, up="z")
    assert not found.report["warnings"]
    assert np.linalg.norm(again - POINTS, axis=-1).mean() < 1e-3


def test_exchanged_sides_are_told_and_mended(tmp_path: Path) -> None:
    names = load_point_set("smpl22").names
    other = [
        names.index(name.replace("left", "#").replace("right", "left").replace("#", "right"))
        for name in names
    ]
    for wrong in (POINTS[:, other], POINTS * [-1, 1, 1]):
        found, _ = _run(tmp_path, wrong)
        assert any("swap_sides=true" in one for one in found.report["warnings"])
        found, _ = _run(tmp_path, wrong, swap_sides=True)
        assert not found.report["warnings"]
        assert found.error_mm is not None
        assert found.error_mm["mean"] < 1
    found, _ = _run(tmp_path, POINTS + 0.01 * np.random.default_rng(0).normal(size=POINTS.shape))
    assert not any("swap_sides" in one for one in found.report["warnings"])


def test_points_at_zero_are_not_known(tmp_path: Path) -> None:
    zeros = POINTS.copy()
    zeros[10:12], zeros[3, 5:7] = 0, 0
    found, again = _run(tmp_path, zeros)
    assert any("46 points at exactly zero" in one for one in found.report["warnings"])
    assert np.abs(again - POINTS).max() < 0.02


def test_another_person_keeps_the_lengths_of_the_points(tmp_path: Path) -> None:
    found, _ = _run(tmp_path, 0.8 * POINTS)
    scale = found.report["bone_scale"]
    assert [scale[name] for name in ("LeftShin", "RightForeArm", "HeadEnd")] == pytest.approx(
        [0.8] * 3, abs=1e-3
    )
    assert found.error_mm is not None
    assert found.error_mm["mean"] < 1


def test_invert_takes_points_as_well(tmp_path: Path) -> None:
    np.savez(tmp_path / "points.npz", points=POINTS, fps=30)
    options = InvertOptions(points="smpl22", lod="low")
    found = invert(tmp_path / "points.npz", tmp_path / "out", options=options)
    assert json.loads(found.files.report.read_text(encoding="utf-8"))["points"] == "smpl22"


@pytest.mark.parametrize(
    ("points", "options", "said"),
    [
        (POINTS, {"fps": None}, "fps=30"),
        (POINTS * 0, {}, "at one place"),
        (POINTS * np.nan, {}, "in no frame"),
        (POINTS[:, :17], {}, "got 17 points"),
        (POINTS, {"points": "smpl23"}, "points=smpl2"),
    ],
)
def test_what_is_no_motion_is_refused(tmp_path: Path, points, options, said: str) -> None:
    with pytest.raises(InputError, match=said):
        _run(tmp_path, points, **options)


def _cameras(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """Two cameras before and beside the body, and what they see (2, F, 22, 2)."""
    lens = {"fx": 1000, "fy": 1000, "cx": 640, "cy": 640}
    front = [[1, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 4]]
    side = [[0, 0, -1, 0], [0, -1, 0, 1], [-1, 0, 0, 4]]
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([lens | {"extrinsics": one} for one in (front, side)]), encoding="utf-8")
    return path, np.stack([camera.project(POINTS)[0] for camera in read_cameras(path)])


def test_pictures_become_a_motion(tmp_path: Path) -> None:
    path, seen = _cameras(tmp_path)
    found, again = _run(tmp_path, seen, camera=str(path))
    assert np.linalg.norm(again - POINTS, axis=-1).mean() < 5e-3
    assert found.report["error_px"]["all"]["mean"] < 0.5
    assert "px" in str(found)
    assert found.report["size"] == pytest.approx(1, abs=0.01)
    one = tmp_path / "one.json"
    one.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8"))[0]), encoding="utf-8")
    found, again = _run(tmp_path, np.where(seen[0] < 0, np.nan, seen[0]), camera=str(one))
    assert np.abs(read_cameras(one)[0].project(again)[0] - seen[0]).mean() < 1
    with pytest.raises(InputError, match="list of cameras"):
        _run(tmp_path, seen[0], camera=str(path))


def test_a_camera_without_points_is_refused() -> None:
    with pytest.raises(InputError, match="points=NAME"):
        InvertOptions(camera="camera.json")


def test_an_unknown_body_is_found_and_kept(tmp_path: Path) -> None:
    layer = SomaLayer("toy", lod="low")
    body = {"size": 0.8, "legs": 1.1}
    points = LAYER.points(
        layer.joints(
            layer.identity(body), torch.as_tensor(CLIP.rotations), torch.as_tensor(CLIP.translation)
        ),
        "smpl22",
    ).numpy()
    np.save(tmp_path / "points.npy", points)
    options = {"points": "smpl22", "fps": 30, "lod": "low", "backend": BackendChoice(name="toy")}
    choice = IdentityChoice(method="backend", free=["size", "legs"])
    given = ConvertOptions(identity=choice, **options)
    found = convert_file(tmp_path / "points.npy", tmp_path / "out", options=given)
    kept = found.report["identity"]
    assert kept["backend"] == "toy"
    assert kept["params"]["size"] == pytest.approx(0.8, abs=0.01)
    assert kept["params"]["legs"] == pytest.approx(1.1, abs=0.02)
    assert read_motion(found.files.motion).identity["params"] == kept["params"]
    given = ConvertOptions(identity=IdentityChoice(method="unpose"), **options)
    with pytest.raises(InputError, match="unpose of points"):
        convert_file(tmp_path / "points.npy", tmp_path / "out2", options=given)
