"""The forward path at the extra-low level of detail."""

import pickle

import numpy as np
import pytest
import scipy.sparse
import torch

from soma_core import PoseInversion, SomaLayer, load_canonical
from soma_core.correctives.features import local_bind_rotations
from soma_core.correctives.weights import CorrectiveWeights, write_weights
from soma_core.errors import InputError
from soma_core.topology.lod_transfer import LodTransfer

LINEAR_M = 1e-5  # offsets that the composed path linearises: below 0.01 mm by its own rule
FLOAT32_M = 2e-6
ROUNDING_M = 1e-12
INVERSION_M = 1e-4  # the round trip of low converges to 0.01 mm
BETWEEN_LODS_M = 0.003  # low to the faces of xlo at the bind shape: 2.4 mm on average


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="xlo", correctives=None)


@pytest.fixture(scope="module")
def low_layer():
    return SomaLayer("soma", lod="low", correctives=None)


@pytest.fixture(scope="module")
def params():
    shape = torch.randn(3, 10, generator=torch.Generator().manual_seed(1))
    return {"shape": torch.nn.functional.pad(shape, (0, 118))}


@pytest.fixture(scope="module")
def rotations():
    return 0.2 * torch.randn(3, 77, 3, generator=torch.Generator().manual_seed(2))


def test_the_skeleton_is_the_one_of_low(layer, low_layer, params, rotations):
    ours, theirs = layer.identity(params), low_layer.identity(params)
    torch.testing.assert_close(ours.bind_world, theirs.bind_world, rtol=0, atol=FLOAT32_M)
    torch.testing.assert_close(ours.fitted_world, theirs.fitted_world, rtol=0, atol=FLOAT32_M)
    posed = layer.pose(ours, rotations)
    assert posed.vertices.shape == (3, 612, 3)
    torch.testing.assert_close(
        posed.transforms, low_layer.pose(theirs, rotations).transforms, rtol=0, atol=4 * FLOAT32_M
    )


def test_identities_are_those_of_low_carried_over(layer, low_layer, params):
    low, xlo = load_canonical("low")[0], load_canonical("xlo")[0]
    transfer = LodTransfer(low, xlo, dtype=torch.float32, device="cpu")
    expected = transfer(low_layer.identity(params).fitted_rest)
    torch.testing.assert_close(layer.identity(params).fitted_rest, expected, rtol=0, atol=FLOAT32_M)


@pytest.mark.parametrize("backend", ["soma", "toy"])
def test_composed_and_exact_paths_agree(backend):
    rests = [
        SomaLayer(backend, lod="xlo", exact=exact, dtype=torch.float64, correctives=None).identity()
        for exact in (False, True)
    ]
    assert (rests[0].rest - rests[1].rest).norm(dim=-1).max() < LINEAR_M


def test_a_rest_shape_of_low_serves(layer, low_layer, params):
    known = low_layer.identity(params)
    found = layer.identity_from_rest(known.fitted_rest)
    torch.testing.assert_close(found.rest, layer.identity(params).rest, rtol=0, atol=4 * FLOAT32_M)
    with pytest.raises(InputError, match=r"rest: got \(1, 612, 3\), expected \(batch, 4505, 3\)"):
        layer.identity_from_rest(torch.zeros(1, 612, 3))


def test_posed_bodies_follow_low(layer, low_layer, params, rotations):
    ours = layer(params, rotations).vertices
    theirs = low_layer(params, rotations).vertices
    low, xlo = load_canonical("low")[0], load_canonical("xlo")[0]
    carried = LodTransfer(low, xlo, dtype=torch.float32, device="cpu")(theirs)
    assert (ours - carried).norm(dim=-1).mean() < BETWEEN_LODS_M


def test_gradients_reach_the_parameters(layer, params):
    given = {"shape": params["shape"].clone().requires_grad_()}
    layer.identity(given).rest.square().sum().backward()
    assert given["shape"].grad[:, :10].abs().min() > 0


def test_it_moves_and_pickles(layer):
    copy = pickle.loads(pickle.dumps(layer)).double()
    assert copy.mesh.lod == "xlo"
    torch.testing.assert_close(copy.identity().rest.float(), layer.identity().rest, rtol=0, atol=FLOAT32_M)


def test_its_own_vertices_are_inverted(layer, params, rotations):
    identity = layer.identity(params)
    posed = layer.pose(identity, rotations)
    with torch.no_grad():
        found = PoseInversion(layer)(posed.vertices, identity)
    again = layer.pose(identity, found.rotations, found.translation)
    assert (again.joints - posed.joints).norm(dim=-1).mean() < INVERSION_M


@pytest.fixture
def checkpoint(tmp_path):
    """Correctives that bulge the skin around the left elbow and knee when they bend."""
    mesh, rig = load_canonical("mid")
    joints, count = rig.joint_count, mesh.vertex_count
    first, second = (scipy.sparse.lil_array(shape) for shape in ((6 * joints, joints), (joints, 3 * count)))
    vertex_mask = scipy.sparse.lil_array((joints, count))
    for name in ("LeftForeArm", "LeftShin"):
        joint = rig.joint_names.index(name)
        away = mesh.vertices - rig.bind_world[joint, :3, 3]
        bump = np.exp(-(away**2).sum(1) / 0.1**2)
        bump[bump < 0.01] = 0
        first[[6 * joint, 6 * joint + 4], joint] = -20  # 1 - cos of its angle
        second[joint] = (0.2 * bump[:, None] * away).ravel()
        vertex_mask[joint] = bump > 0
    weights = CorrectiveWeights(
        channels=1,
        use_tanh=False,
        bind_pose=local_bind_rotations(rig),
        first=first.tocsr(),
        second=second.tocsr(),
        joint_mask=scipy.sparse.eye_array(joints).tocsr(),
        vertex_mask=vertex_mask.tocsr(),
    )
    path = tmp_path / "correctives.pt"
    write_weights(path, weights)
    return path


def test_correctives_reach_it(checkpoint, rotations):
    low, xlo = load_canonical("low")[0], load_canonical("xlo")[0]
    transfer = LodTransfer(low, xlo, dtype=torch.float64, device="cpu")
    layers = {
        lod: SomaLayer("soma", lod=lod, dtype=torch.float64, correctives=checkpoint) for lod in ("low", "xlo")
    }
    bind = layers["low"].identity().bind_world
    matrices = torch.linalg.matrix_exp(_skew(rotations.double()))
    offsets = {lod: each.correctives(matrices, bind) for lod, each in layers.items()}
    still = torch.tensor(low.vertices)[None]
    expected = transfer(still + offsets["low"]) - transfer(still)
    assert offsets["xlo"].norm(dim=-1).max() > 0.002
    assert (offsets["xlo"] - expected).norm(dim=-1).max() < 0.05 * expected.norm(dim=-1).max()


def _skew(vectors):
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
