"""Units and axes: a proper rotation for every valid declaration, a refusal for the others."""

import itertools

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.topology.frames import METRES, native_to_canonical

AXES = ["+x", "-x", "+y", "-y", "+z", "-z"]
PAIRS = [(up, ahead) for up, ahead in itertools.product(AXES, AXES) if up[1] != ahead[1]]


def direction(axis):
    return np.eye(3)["xyz".index(axis[1])] * (1 if axis[0] == "+" else -1)


def test_there_are_24_orientations():
    frames = {tuple(native_to_canonical(*pair).ravel()) for pair in PAIRS}
    assert len(PAIRS) == len(frames) == 24


@pytest.mark.parametrize(("up", "forward"), PAIRS)
def test_up_becomes_y_and_forward_becomes_z_without_mirroring(up, forward):
    frame = native_to_canonical(up, forward)
    np.testing.assert_array_equal(frame @ direction(up), [0, 1, 0])
    np.testing.assert_array_equal(frame @ direction(forward), [0, 0, 1])
    np.testing.assert_array_equal(frame @ np.cross(direction(up), direction(forward)), [1, 0, 0])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3))
    assert np.linalg.det(frame) == pytest.approx(1)


def test_blender_axes():
    """(x, y, z) with +Z up, facing -Y, is (x, z, -y)."""
    np.testing.assert_array_equal(native_to_canonical("+z", "-y") @ [1, 2, 3], [1, 3, -2])


@pytest.mark.parametrize("axis", AXES)
def test_parallel_axes_are_refused(axis):
    for forward in (axis, {"+": "-", "-": "+"}[axis[0]] + axis[1]):
        text = rf"forward: got '\{forward}', expected an axis perpendicular to up='\{axis}'"
        with pytest.raises(InputError, match=text):
            native_to_canonical(axis, forward)


@pytest.mark.parametrize("wrong", ["y", "up", "+w", "++", "", "*x", "+xy"])
def test_unknown_axes_are_refused(wrong):
    with pytest.raises(InputError, match=r"up: got .*, expected one of \+x -x") as caught:
        native_to_canonical(wrong, "+z")
    assert repr(wrong) in str(caught.value)
    with pytest.raises(InputError, match="forward: got"):
        native_to_canonical("+y", wrong)


def test_units():
    assert METRES == {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "inch": 0.0254}
