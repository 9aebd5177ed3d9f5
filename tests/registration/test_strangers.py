"""What shows no human body is refused, early where it can be, with how far it is from one."""

from __future__ import annotations

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.layer import SomaLayer
from soma_core.registration.alignment import find_starts
from soma_core.registration.body_fit import BodyFit
from soma_core.registration.body_model import BodyModel
from soma_core.registration.register import register
from soma_core.registration.strangers import refuse_distant
from soma_core.registration.surface import Surface
from soma_core.registration.target import Skin
from tests.registration.test_target import sphere

SHARE = 0.01


def cells(occupied: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a set of cubes that share no edge without sharing a face."""
    filled, quads = np.pad(occupied, 1), []
    for axis in range(3):
        for side in (0, 1):
            base = np.argwhere(filled & ~np.roll(filled, 1 - 2 * side, axis))
            base[:, axis] += side
            steps = np.roll(np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]]), axis, axis=1)
            corners = base[:, None] + (steps if side else steps[::-1])
            quads.append(corners)
    corners = np.concatenate(quads)
    points, ids = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    ids = ids.reshape(-1, 4)
    return size * points.astype(float), np.concatenate([ids[:, [0, 1, 2]], ids[:, [0, 2, 3]]])


def table() -> tuple[np.ndarray, np.ndarray]:
    """A table, 75 cm high."""
    occupied = np.zeros((40, 25, 24), bool)
    occupied[:, 23:] = True
    for x in (0, 38):
        for z in (0, 22):
            occupied[x : x + 2, :23, z : z + 2] = True
    return cells(occupied, 0.03)


@pytest.mark.parametrize("shape", [sphere, table])
def test_what_no_stance_comes_near_is_refused_at_once(shape) -> None:
    with pytest.raises(InputError, match=r"got a surface of which [5-9]\d% lies apart from a human body"):
        register(*shape())


@pytest.fixture(scope="module")
def mean() -> tuple[BodyModel, BodyFit]:
    model = BodyModel(SomaLayer("soma", lod="low", procedural=False))
    pose = model.start(0.5)
    return model, BodyFit(pose=pose, vertices=model.evaluate(pose)[0], cost=0.0)


@pytest.mark.parametrize("arms", [(0.0, 1.8), (1.4, 0.0)])
def test_one_arm_up_and_one_hanging_are_found(mean, arms) -> None:
    model, _ = mean
    pose = model.start(*arms)
    skin = Skin(vertices=model.evaluate(pose)[0], triangles=model.triangles)
    best, *_ = find_starts(skin, model, unit=None, up="+y", forward=None, count=1)
    assert best.frame.forward == "+z"
    np.testing.assert_allclose(best.pose.rotations, pose.rotations, atol=1e-6)


def test_a_body_on_its_own_surface_is_let_through(mean) -> None:
    model, fit = mean
    refuse_distant(fit, model, Surface(fit.vertices, model.triangles), share=SHARE)


def test_a_body_that_the_surface_only_half_covers_is_refused(mean) -> None:
    """The lower half has nothing to lie on, though every point of the surface is met."""
    model, fit = mean
    above = fit.vertices[:, 1] > np.median(fit.vertices[:, 1])
    bust = Surface(fit.vertices, model.triangles[above[model.triangles].all(1)])
    with pytest.raises(InputError, match=r"got a surface \d{3} mm from the nearest human body on average"):
        refuse_distant(fit, model, bust, share=SHARE)
    with pytest.raises(InputError, match=r"\(1% of its height\)"):
        refuse_distant(fit, model, Surface(1.1 * fit.vertices, model.triangles), share=SHARE)
