"""The closed form of the second stage, and what pruning keeps."""

import numpy as np
import pytest
import torch

from soma_core.correctives.features import PoseFeatures
from soma_core.correctives.finish import entry_budget, finished
from soma_core.correctives.model import Correctives
from soma_core.correctives.network import CorrectivesNetwork
from soma_core.correctives.poses import random_rotations
from soma_core.correctives.second_stage import accumulate, all_entries, pruned, solve, to_matrix
from soma_core.correctives.teacher import Clip
from soma_core.correctives.weights import read_weights, write_weights
from soma_core.errors import InputError
from soma_core.topology.lod_transfer import offset_rows
from tests.correctives.conftest import CHANNELS

EXACT = 1e-6  # relative to the largest value; activations are float32
HALF = 2e-5  # metres: offsets of centimetres in half precision


@pytest.fixture(scope="module")
def network(body):
    return CorrectivesNetwork(body.masks.joints, body.masks.vertices, channels=CHANNELS, seed=7)


@pytest.fixture(scope="module")
def features(body):
    drawn = random_rotations(body.rig.user_joint_names, 400, np.random.default_rng(0))
    return PoseFeatures(body.rig, dtype=torch.float32, device="cpu")(torch.as_tensor(drawn).float())


@pytest.fixture(scope="module")
def normal(network, features, body):
    targets = torch.randn(
        len(features), body.mesh.vertex_count, 3, generator=torch.Generator().manual_seed(0)
    )
    with torch.no_grad():
        active = network.activations(features)
    samples = [(active[:, part], targets[part]) for part in (slice(0, 150), slice(150, 400))]
    found = accumulate(samples, list(network.sizes), network.vertices, CHANNELS)
    return found, active.transpose(0, 1).flatten(1).double(), targets.double()


def _entries(network, normal):
    strength = network.strength.double().numpy()
    return all_entries(normal, network.vertices.numpy(), list(network.sizes), strength, CHANNELS)


def test_each_vertex_is_a_ridge_regression_on_its_own_activations(network, normal):
    sums, flat, targets = normal
    entries = _entries(network, sums)
    values = solve(sums.gram, entries, ridge=1e-3)
    base = 1e-3 * float(sums.gram.diagonal().mean())
    for vertex in np.unique(entries.vertex)[::200]:
        own = entries.vertex == vertex
        a = flat[:, entries.activation[own]].numpy()
        system = a.T @ a + base * np.diag(entries.penalty[own])
        expected = np.linalg.solve(system, a.T @ targets[:, vertex].numpy())
        np.testing.assert_allclose(values[own], expected, atol=EXACT * 100)


def test_pruning_keeps_the_budget_and_what_matters(network, normal):
    sums, _, _ = normal
    entries = _entries(network, sums)
    budget = len(entries.vertex) // 3
    kept, values = pruned(sums.gram, entries, ridge=1e-3, budget=budget)
    assert len(kept.vertex) == len(values) == budget
    assert (np.diff(kept.vertex) >= 0).all()
    np.testing.assert_allclose(values, solve(sums.gram, kept, ridge=1e-3))
    same, _ = pruned(sums.gram, entries, ridge=1e-3, budget=len(entries.vertex))
    assert len(same.vertex) == len(entries.vertex)


def test_the_matrix_has_every_value_in_its_place(network, normal, body):
    sums, _, _ = normal
    entries = _entries(network, sums)
    values = np.random.default_rng(0).standard_normal(entries.cross.shape)
    shape = (body.rig.joint_count * CHANNELS, 3 * body.mesh.vertex_count)
    matrix = to_matrix(entries, values, network.joints, CHANNELS, shape)
    joint, channel = divmod(int(entries.activation[5]), CHANNELS)
    row, column = CHANNELS * network.joints[joint] + channel, 3 * entries.vertex[5] + 2
    assert matrix[row, column] == values[5, 2]
    assert matrix.nnz == values.size


def test_a_finished_model_is_the_teacher_where_it_can_be(body, teacher, tmp_path, features):
    """The first stage known, nothing pruned: the second comes out as it was taught, file and all."""

    class Store:
        def read(self, clip, vertices, *, mirrored):
            lesson = teacher.teach(clip)
            seen = teacher.features(torch.as_tensor(clip.rotations).float())
            return type("Batch", (), {"features": seen, "offsets": torch.as_tensor(lesson.offsets)})

    names = body.rig.user_joint_names
    clips = [
        Clip(name=str(index), rotations=random_rotations(names, 300, np.random.default_rng(index)))
        for index in range(2)
    ]
    weights = finished(
        teacher.network, body.masks, Store(), clips, body.rig, ridge=1e-9, smoothness=0.2, budget=10**6,
        mirror=False, meta={},
    )  # fmt: skip
    write_weights(tmp_path / "model.pt", weights)
    stored = read_weights(tmp_path / "model.pt")
    model = Correctives(stored, body.rig, offset_rows(body.mesh), dtype=torch.float32, device="cpu")
    with torch.no_grad():
        torch.testing.assert_close(
            model.offsets(features), teacher.network(features) / 100, atol=HALF, rtol=2e-3
        )


def test_the_network_forms_no_product_over_all_vertices(network, features):
    """What autograd keeps is as large as activations and masks, not as joints times vertices."""
    kept = []

    def pack(tensor):
        kept.append(tensor.numel())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        out = network(features[:4])
    assert out.shape == (4, network.vertex_count, 3)
    assert max(kept) <= max(network.second.numel(), 4 * network.first.shape[1] * len(network.joints))


def test_a_file_too_small_for_the_masks_is_refused(body):
    assert entry_budget(1.0, body.masks, CHANNELS) > entry_budget(0.5, body.masks, CHANNELS) > 0
    with pytest.raises(InputError, match=r"mebibytes: got 0\.01, expected more than the 0\.\d+ MiB"):
        entry_budget(0.01, body.masks, CHANNELS)
