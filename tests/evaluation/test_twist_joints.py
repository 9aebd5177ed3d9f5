"""The experiment on twist joints, and the measures it takes of a mesh."""

import numpy as np
import pytest
from omegaconf import OmegaConf

from soma_core.evaluation.twist_joints import run, section_areas
from soma_core.geometry.mesh import enclosed_volume
from tests.bodies import cube_sphere

FACETS = 0.03
"""Relative: a sphere of 384 quads lies that far inside the round one."""


@pytest.fixture(scope="module")
def ball():
    """Vertices and triangles of a ball of radius 2 around (1, 0, 0)."""
    vertices, quads = cube_sphere(8)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return 2 * vertices + [1, 0, 0], triangles


@pytest.mark.parametrize("normal", [(1.0, 0.0, 0.0), (0.0, 0.6, 0.8)])
def test_sections_and_volume_of_a_ball(ball, normal):
    places = np.array([-1.5, 0.05, 1.0, 3.0])
    found = section_areas(*ball, np.array([1.0, 0, 0]), np.array(normal), places)
    np.testing.assert_allclose(found, np.pi * np.maximum(4 - places**2, 0), rtol=FACETS, atol=FACETS)
    assert enclosed_volume(*ball) == pytest.approx(4 / 3 * np.pi * 8, rel=FACETS)


def test_twisted_limbs_keep_what_they_must():
    report = run(OmegaConf.create({"experiment": {"backend": "soma"}}))
    assert not report.failed
    values = {figure.name: figure.value for figure in report.figures}
    assert values["volume lost by the wrist, plain skinning"] > 20  # or nothing would be shown
    for _, plain, helped in report.tables[0].rows:
        assert helped < plain
    assert len(report.bodies) == 4
