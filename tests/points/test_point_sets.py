"""Point sets: what is shipped lies on the rig, files are checked, plugins add their own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

import soma_core.tasks.points as tasks_points
from soma_core import SomaLayer
from soma_core.errors import AssetError, InputError
from soma_core.plugin.registry import Registry
from soma_core.points.point_set import Point, PointSet, find_point_sets, load_point_set, read_point_set
from tests.bodies import randn

LAYER = SomaLayer("soma", lod="low", dtype=torch.float64)


@pytest.fixture(scope="module")
def both() -> list[SomaLayer]:
    return [SomaLayer("soma", lod=lod) for lod in ("low", "mid")]


@pytest.mark.parametrize("name", sorted(find_point_sets(Registry(()))))
def test_every_shipped_set_lies_on_both_meshes(name: str, both: list[SomaLayer]) -> None:
    points = load_point_set(name)
    assert points.name == name
    assert points.about
    assert points.source
    for layer in both:
        places = layer.places(points)
        assert places.names == points.names


def test_points_follow_the_body_rigidly() -> None:
    points = PointSet(
        name="some",
        points={
            "wrist": Point(joints={"LeftHand": 1.0}),
            "beside": Point(joints={"Head": 1.0}, offset=(0.0, 0.2, 0.1)),
            "middle": Point(joints={"LeftLeg": 0.5, "RightLeg": 0.5}),
            "skin": Point(vertices={10: 0.25, 4000: 0.75}),
        },
    )
    turn = torch.zeros(1, 77, 3, dtype=torch.float64)
    turn[:, 0, 1] = 0.7  # the Hips alone: the whole body is turned
    # By plain skinning: correctives see the turn of the Hips.
    still, turned = (LAYER.pose_plain(LAYER.identity(), one) for one in (turn * 0, turn))
    before, after = (LAYER.points(one, points)[0] for one in (still, turned))
    torch.testing.assert_close(torch.cdist(before, before), torch.cdist(after, after), atol=1e-9, rtol=0)
    head = still.joints[0, LAYER.joint_names.index("Head")]
    away, size = before[1] - head, LAYER.places(points).size(still.transforms[..., :3, 3])
    torch.testing.assert_close(away, size * torch.tensor([0.0, 0.2, 0.1], dtype=torch.float64))
    expected = 0.25 * still.vertices[0, 10] + 0.75 * still.vertices[0, 4000]
    torch.testing.assert_close(before[3], expected)


def test_points_carry_gradients() -> None:
    rotations = (0.2 * randn(1, 77, 3)).requires_grad_()
    identity = LAYER.identity()

    def seen(given: torch.Tensor) -> torch.Tensor:
        return LAYER.points(LAYER.pose(identity, given), "humanml3d22")[:, -1]

    (slope,) = torch.autograd.grad(seen(rotations).sum(), rotations)
    step = torch.zeros_like(rotations)
    step[0, LAYER.joint_names.index("RightArm"), 1] = 1e-6
    rise = (seen(rotations + step) - seen(rotations - step)).sum() / 2
    torch.testing.assert_close((slope * step).sum(), rise, rtol=1e-4, atol=1e-13)


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ({"joints": {"Hips": 0.5}}, "sum to 0.5"),
        ({"vertices": {"12": 1}, "offset": [1, 0, 0]}, "from one joint"),
        ({"jiont": "Hips"}, "jiont"),
        ({"joint": "Hips", "offset": [1, 2]}, "three numbers"),
        ({"vertices": {"-4": 1}}, "vertex -4"),
        (7, "7"),
    ],
)
def test_a_place_that_is_none_is_refused(tmp_path: Path, place: object, said: str) -> None:
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"points": {"a": place}}), encoding="utf-8")
    with pytest.raises(AssetError, match="point 'a'") as refused:
        read_point_set(path)
    assert said in str(refused.value)


def test_names_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="coco71"):
        load_point_set("coco71")
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"points": {"a": "Hip"}}), encoding="utf-8")
    with pytest.raises(InputError, match="joint 'Hip'"):
        LAYER.places(path)
    path.write_text(json.dumps({"points": {"a": {"vertices": {"9999": 1}}}}), encoding="utf-8")
    with pytest.raises(InputError, match="vertex 9999 at lod=low"):
        LAYER.places(path)
    path.write_text(json.dumps({"points": {"a": "Hips"}, "bones": [["a", "b"]]}), encoding="utf-8")
    with pytest.raises(AssetError, match="'b'"):
        read_point_set(path)


def test_a_plugin_ships_sets_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "point_sets").mkdir()
    file = tmp_path / "point_sets" / "lab12.json"
    file.write_text(json.dumps({"points": {"clavicle": "Chest"}}), encoding="utf-8")

    class Plugins(Registry):
        def config_dirs(self) -> tuple[tuple[str, Path], ...]:
            return (("acme", tmp_path),)

    registry = Plugins(())
    assert find_point_sets(registry)["lab12"] == file
    assert load_point_set("lab12", registry).names == ("clavicle",)


def test_a_damaged_set_costs_one_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "broken.json"
    broken.write_text("{")
    shipped = find_point_sets(Registry(()))
    monkeypatch.setattr(tasks_points, "find_point_sets", lambda: {"broken": broken, **shipped})
    said: list[str] = []
    assert tasks_points.run_verb(["list"], said.append) == 0
    first, *others = said[0].splitlines()
    assert first.startswith("broken")
    assert "not valid JSON" in first
    assert [line.split()[0] for line in others] == [*shipped]
