"""Pictures show what they were given: every cell its own body, nobody cut off."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from soma_core.errors import SomaError
from soma_core.view import picture
from soma_core.view.joint_picture import draw_joints
from soma_core.view.picture import backend_colour, contact_sheet, gallery
from soma_core.view.stage import Body

PIL = pytest.importorskip("PIL.Image", reason="pictures need pyvista and Pillow")


def box(width, height, colour):
    """A box that stands on the floor."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - [0.5, 0, 0.5]
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Body(
        vertices=corners * [width, height, 0.3], triangles=triangles, colour=colour, caption="a box\n1 m"
    )


def painted(path, colour):
    """Which pixels have the hue of `colour`, (rows, columns)."""
    with PIL.open(path) as picture:
        pixels = np.asarray(picture, float)
    channel = int(np.argmax(colour))
    others = np.delete(pixels, channel, axis=2).max(axis=2)
    return pixels[..., channel] > others + 40


@pytest.fixture(scope="module")
def pyvista():
    return pytest.importorskip("pyvista", reason="pictures need pyvista")


def test_contact_sheet_draws_each_frame_anew(pyvista, tmp_path):
    red = (0.9, 0.2, 0.2)
    bodies = [box(0.4, height, red) for height in (1.8, 0.9, 0.45)]
    contact_sheet(tmp_path / "sheet.png", bodies, width=300, columns=3)
    mask = painted(tmp_path / "sheet.png", red)
    assert mask.shape[1] == 300
    heights = [np.ptp(np.flatnonzero(mask[:, start : start + 100].any(axis=1))) for start in (0, 100, 200)]
    assert heights[0] > 1.5 * heights[1] > 2 * heights[2] > 0
    assert not mask[[0, -1]].any()
    assert not mask[:, [0, 99, 100, 199, 200, 299]].any()


def test_nothing_near_the_camera_fades_at_the_edge_of_its_cell(pyvista, tmp_path):
    red = (0.9, 0.2, 0.2)
    low = box(0.5, 0.3, red)
    bodies = [box(0.4, 1.7, red), replace(low, vertices=low.vertices * [1, 1, 6])]
    contact_sheet(tmp_path / "sheet.png", bodies, width=400, columns=2)
    mask = painted(tmp_path / "sheet.png", red)
    tall = len(mask) - picture._caption_sizes(200)[1]
    assert np.flatnonzero(mask.any(axis=1)).max() < (1 - 0.035) * tall
    columns = np.flatnonzero(mask[:, 200:].any(axis=0))
    assert columns.min() > 0.06 * 200
    assert columns.max() < 0.94 * 200


def test_contact_sheet_wraps_into_rows(pyvista, tmp_path):
    contact_sheet(tmp_path / "a.png", [box(0.5, 1.5, (0.2, 0.8, 0.2))] * 3, width=200, columns=2)
    contact_sheet(tmp_path / "b.png", [box(0.5, 1.5, (0.2, 0.8, 0.2))] * 2, width=200, columns=2)
    with PIL.open(tmp_path / "a.png") as two_rows, PIL.open(tmp_path / "b.png") as one_row:
        assert two_rows.height == 2 * one_row.height


def test_gallery_shows_every_body_whole(pyvista, tmp_path):
    colours = [(0.9, 0.2, 0.2), (0.2, 0.8, 0.2), (0.2, 0.3, 0.9)]
    bodies = [box(width, 1.7, colour) for width, colour in zip((0.4, 1.6, 0.6), colours, strict=True)]
    gallery(tmp_path / "gallery.png", bodies, width=400)
    middles = []
    for colour in colours:
        columns = np.flatnonzero(painted(tmp_path / "gallery.png", colour).any(axis=0))
        assert columns.min() > 0
        assert columns.max() < 399
        middles.append(columns.mean())
    assert middles == sorted(middles)


def test_gallery_fills_its_rows_evenly(pyvista, tmp_path):
    above, below = (0.2, 0.8, 0.2), (0.2, 0.3, 0.9)
    bodies = [box(0.5, 1.7, colour) for colour in (above, above, below, below)]
    gallery(tmp_path / "gallery.png", bodies, width=400, columns=3)
    rows = [
        np.flatnonzero(painted(tmp_path / "gallery.png", colour).any(axis=1)) for colour in (above, below)
    ]
    assert rows[0].max() < rows[1].min()


def test_missing_pyvista_is_named_with_the_pip_line(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(SomaError, match=r"got no pyvista.*pip install 'soma-body-core\[render\]'"):
        gallery(tmp_path / "gallery.png", [box(1, 1, (1, 0, 0))])
    assert not list(tmp_path.iterdir())


def test_colours_are_steady_and_distinct():
    assert backend_colour("mybody") == backend_colour("mybody")
    names = ("soma", "anny", "mhr", "mybody", "other")
    assert len({backend_colour(name) for name in names}) == len(names)


def test_gallery_turns_every_body_alike_towards_the_camera():
    distance, bodies = 5.0, [box(1.0, 1.7, (1, 0, 0))] * 5
    moved, _, _ = picture._line(bodies, distance)
    seen = []
    for body in moved:
        front = body.vertices[4] - body.vertices[0]  # the edge that pointed along +x
        towards = (
            np.array([0, distance]) - (body.vertices[:, [0, 2]].min(0) + body.vertices[:, [0, 2]].max(0)) / 2
        )
        seen.append(np.arctan2(front[2], front[0]) - np.arctan2(towards[1], towards[0]))
    np.testing.assert_allclose(seen, seen[0], atol=1e-9)


def test_one_floor_lies_under_all_frames(pyvista, tmp_path):
    """A body in the air is drawn in the air."""
    red = (0.9, 0.2, 0.2)
    low = box(0.4, 1.0, red)
    high = replace(low, vertices=low.vertices + np.array([0, 0.8, 0]))
    contact_sheet(tmp_path / "sheet.png", [low, high], width=400, columns=2)
    mask = painted(tmp_path / "sheet.png", red)
    feet = [np.flatnonzero(mask[:, part].any(axis=1)).max() for part in (slice(200), slice(200, 400))]
    heights = np.ptp(np.flatnonzero(mask[:, :200].any(axis=1)))
    assert feet[0] - feet[1] > 0.5 * heights


def test_a_single_frame_is_a_third_as_wide(pyvista, tmp_path):
    contact_sheet(tmp_path / "sheet.png", [box(0.5, 1.5, (0.2, 0.8, 0.2))], width=600)
    with PIL.open(tmp_path / "sheet.png") as picture:
        assert picture.width == 200


@pytest.mark.slow  # 20 s: seventy-two cells
def test_bent_joints_are_drawn_from_near(pyvista, tmp_path):
    draw_joints(tmp_path / "joints.png")
    drawn = np.asarray(PIL.open(tmp_path / "joints.png").convert("RGB"), int)
    cells = [np.array_split(row, 9, axis=1) for row in np.array_split(drawn, 8)]
    assert all((np.abs(cell - drawn[0, 0]).sum(-1) > 60).mean() > 0.05 for row in cells for cell in row)
    assert all(not np.array_equal(row[6], row[8]) for row in cells)  # plain skinning and correctives
