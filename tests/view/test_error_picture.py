"""The picture of errors: colours follow the millimetres, and the bar says which is which."""

import numpy as np
import pytest

from soma_core.view.error_picture import colour_bar, error_colours, error_sheet, scale_top
from soma_core.view.stage import Body

PIL = pytest.importorskip("PIL.Image", reason="pictures need pyvista and Pillow")


def test_colours_run_from_light_to_dark_and_stop_at_the_top():
    colours = error_colours(np.linspace(0, 12, 13), 10.0)
    brightness = colours.sum(axis=1)
    assert (np.diff(brightness[:11]) < 0).all()
    np.testing.assert_array_equal(colours[10], colours[12])


def test_vertices_without_a_target_have_a_colour_of_their_own():
    known, unknown = error_colours(np.array([0.0, np.nan]), 1.0)
    assert known[0] > known[2]
    assert unknown[2] > unknown[0]


@pytest.mark.parametrize(
    ("errors", "top"),
    [([0.0], 0.1), ([3.1] * 100, 5.0), ([0.2] * 100, 0.2), ([80.0], 100.0), ([np.nan], 0.1)],
)
def test_the_top_of_the_scale_is_a_round_number(errors, top):
    assert scale_top(np.array(errors)) == pytest.approx(top)


def test_one_outlier_does_not_bleach_the_rest():
    assert scale_top(np.array([1.0] * 500 + [900.0])) == 1.0


def test_the_bar_shows_the_whole_scale():
    pixels = np.asarray(colour_bar(400, 10.0), float)
    row = pixels[11 + 5, 100:300]
    np.testing.assert_allclose(row[0] / 255, error_colours(np.array([0.0]), 1.0)[0], atol=0.01)
    np.testing.assert_allclose(row[-1] / 255, error_colours(np.array([1.0]), 1.0)[0], atol=0.01)


def test_the_sheet_colours_the_body_by_its_errors(tmp_path):
    pytest.importorskip("pyvista", reason="pictures need pyvista")
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - [0.5, 0, 0.5]
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    body = Body(vertices=corners, triangles=triangles, colour=(0, 0, 0), caption="frame 7")
    reds = []
    for errors in ([np.zeros(8), np.full(8, 5.0)], [np.zeros(8), np.zeros(8)]):
        error_sheet(tmp_path / "errors.png", [body, body], errors, width=400)
        with PIL.open(tmp_path / "errors.png") as picture:
            pixels = np.asarray(picture, float)[:150]
        assert pixels.shape[1] == 400
        red = pixels[..., 0] > pixels[..., 1] + 40
        reds.append((red[:, :200].sum(), red[:, 200:].sum()))
    assert reds[0][0] == reds[1][0] == reds[1][1] == 0
    assert reds[0][1] > 1000
