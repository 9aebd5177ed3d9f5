"""Pictures of point sets: labels stay inside and apart."""

from itertools import combinations

import numpy as np
import pytest

from soma_core.view import point_picture

SIZE = point_picture._TALL


def test_labels_are_inside_and_on_no_other():
    pytest.importorskip("PIL")
    from PIL import Image, ImageDraw, ImageFont

    draw, font = ImageDraw.Draw(Image.new("RGB", (SIZE, SIZE))), ImageFont.load_default(15)
    taken: list[tuple[float, float, float, float]] = []
    near = np.array([[SIZE - 3, 5 + 12 * k] for k in range(9)] + [[4, SIZE - 3], [SIZE / 2, SIZE / 2]])
    for at in near:
        point_picture._label(draw, font, "RightHandMiddleEnd", at, taken)
    boxes = np.array(taken)
    assert boxes[:, :2].min() >= 0
    assert boxes[:, 2:].max() <= SIZE
    assert not any(point_picture._meet(one, other) for one, other in combinations(taken, 2))
