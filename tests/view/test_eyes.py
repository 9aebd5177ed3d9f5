"""Eyeballs of pictures: they lie in their sockets and turn with their joints."""

import numpy as np
import torch

from soma_core import USER_JOINTS, SomaLayer
from soma_core.view.eyes import eyeball, with_eyes
from soma_core.view.stage import Body


def test_eyes_lie_in_their_sockets_and_look_where_their_joints_do():
    layer = SomaLayer("soma", lod="low", correctives=None, procedural=False)
    rotations = torch.zeros(2, 77, 3)
    rotations[1, USER_JOINTS.index("LeftEye"), 1] = 0.5
    rotations[1, USER_JOINTS.index("Head"), 0] = 0.3
    posed = layer.pose(layer.identity(), rotations)
    ball, _, _ = eyeball()
    front = ball[:, 2].argmax()
    for frame, turned in ((0, 0.0), (1, 0.5)):
        skin = posed.vertices[frame].numpy()
        world = posed.transforms[frame].numpy()
        shown = with_eyes(
            Body(vertices=skin, triangles=layer.mesh.triangles, colour=(1.0, 0.5, 0.0)), world, layer.rig
        )
        count = len(skin)
        np.testing.assert_array_equal(shown.shades[:count], np.tile([1.0, 0.5, 0.0], (count, 1)))
        assert len(shown.vertices) == len(shown.shades) == count + 2 * len(ball)
        assert shown.triangles.max() == len(shown.vertices) - 1
        left, right = (shown.vertices[count + k * len(ball) :][: len(ball)] for k in (0, 1))
        radius = np.ptp(left[:, 0]) / 2
        for eye in (left, right):
            apart = np.linalg.norm(skin - eye.mean(0), axis=1).min()
            assert 0.8 < apart / radius < 1.1  # lids touch the ball, and none cuts deep into it
        looks = [eye[front] - eye.mean(0) for eye in (left, right)]
        cosine = looks[0] @ looks[1] / np.prod([np.linalg.norm(look) for look in looks])
        np.testing.assert_allclose(cosine, np.cos(turned), atol=2e-3)
