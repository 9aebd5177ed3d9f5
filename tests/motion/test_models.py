"""Bodies as sequences: layers made once, vertices of another topology, and a backend that does not pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from soma_core.errors import InputError
from soma_core.motion.models import FitBackends, HeldSequence, ModelSequence, TransferredSequence
from soma_core.motion.options import FitOptions
from soma_core.plugin.errors import BackendError
from soma_core.plugin.registry import default_registry
from soma_core.topology.frames import native_to_canonical

ROUNDING = 1e-5
"""Metres, float32."""

FILE = Path("body.npz")


@pytest.fixture(scope="module")
def backends():
    return FitBackends(FitOptions(lod="low"))


def test_a_layer_is_made_once(backends):
    assert backends.get("soma", {}) is backends.get("soma", {})
    with pytest.raises(BackendError, match='"nobody"'):
        backends.get("nobody", {})


def test_a_backend_that_does_not_pose_is_refused(backends):
    pose = {"rotations": np.zeros((2, 77, 3))}
    with pytest.raises(InputError, match=r"backend: got soma, whose generator has no posed\(\).*soma invert"):
        ModelSequence(FILE, backends.get("soma", {}), {}, pose, fps=30, up="+y")


def test_vertices_of_another_topology_become_canonical(backends):
    pytest.importorskip("soma_backend_toy")
    layer = backends.get("toy", {}).layer
    identity = layer.identity({"legs": 1.1})
    generator = default_registry().generator("toy", device=torch.device("cpu"), dtype=torch.float32)
    native = generator.rest(identity.params)
    metres = 0.01 * native.numpy() @ native_to_canonical(layer.spec.up, layer.spec.forward).T
    held = HeldSequence(FILE, np.repeat(metres, 3, axis=0), fps=25)
    found = TransferredSequence(held, "toy")
    assert (found.frame_count, found.fps, found.metres, found.up) == (3, 25, 1.0, "+y")
    canonical = found.read(1, 3)
    assert canonical.shape == (2, found.vertex_count, 3)
    expected = identity.fitted_rest.numpy()
    np.testing.assert_allclose(canonical[:1, layer.mesh.mid_ids], expected, atol=ROUNDING)
