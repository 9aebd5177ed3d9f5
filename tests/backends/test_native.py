"""The native backend: declared from a header, linear, of any number of components."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from soma_core.backends.native import NativeGenerator, component_count, soma_backend
from soma_core.errors import AssetError
from soma_core.paths import assets_dir
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import HasLinearBasis
from soma_core.rig.neutral import load_shape_space

VERTICES = 5
CPU = torch.device("cpu")


def make(count):
    random = np.random.default_rng(0)
    mean, directions = random.normal(size=(VERTICES, 3)), random.normal(size=(count, VERTICES, 3))
    return mean, directions, NativeGenerator(mean, directions, device=CPU, dtype=torch.float64)


@pytest.mark.parametrize("count", [0, 1, 7])
def test_rest_is_the_mean_plus_scaled_directions(count):
    mean, directions, generator = make(count)
    shape = torch.randn(3, count, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    expected = mean + np.einsum("bk,kvc->bvc", shape.numpy(), directions)
    torch.testing.assert_close(generator.rest({"shape": shape}), torch.from_numpy(expected))


@pytest.mark.parametrize("count", [0, 4])
def test_linear_basis_reproduces_rest(count):
    generator = make(count)[2]
    params = {"shape": torch.linspace(-1, 1, 2 * count, dtype=torch.float64).reshape(2, count)}
    basis = generator.linear_basis()
    composed = basis.template + torch.einsum("bk,kvc->bvc", basis.coefficients(params), basis.basis)
    torch.testing.assert_close(composed, generator.rest(params))
    assert isinstance(generator, HasLinearBasis)


def test_gradcheck():
    generator = make(3)[2]
    shape = torch.tensor([[0.3, -0.2, 1.1]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda value: generator.rest({"shape": value}), shape)


def test_declared_count_is_the_files():
    (parameter,) = soma_backend().params
    assert parameter.shape == (load_shape_space().component_count,)


def test_registry_builds_it_on_the_canonical_mesh():
    registry = default_registry()
    (parameter,) = registry.spec("soma").params
    generator = registry.generator("soma", device=CPU, dtype=torch.float32)
    rest = generator.rest({"shape": torch.zeros(2, *parameter.shape)})
    mean = torch.from_numpy(load_shape_space().mean)
    torch.testing.assert_close(rest, mean.expand(2, *mean.shape))


def test_declaring_does_not_import_torch():
    lines = ("import sys", "from soma_core.backends.native import soma_backend", "soma_backend()")
    code = "; ".join((*lines, "print('torch' in sys.modules)"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_unreadable_shape_space_is_named(tmp_path):
    path = tmp_path / "SOMA_neutral.npz"
    with pytest.raises(AssetError, match=r"SOMA_neutral.npz: file is missing.*git checkout -- assets"):
        component_count(path)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1")
    with pytest.raises(AssetError, match="git-LFS pointer"):
        component_count(path)
    np.savez(path, mean=np.zeros(3))
    with pytest.raises(AssetError, match="'eigenvalues'"):
        component_count(path)
    np.savez(path, eigenvalues=np.zeros((2, 2)))
    with pytest.raises(AssetError, match="too many values"):
        component_count(path)


@pytest.mark.parametrize("count", [3, 130])
def test_a_shape_space_from_elsewhere(tmp_path, count):
    """Fewer components are padded, more are cut to the declared ones."""
    shipped = load_shape_space()
    random = np.random.default_rng(4)
    path = tmp_path / "elsewhere.npz"
    directions = random.normal(size=(count, shipped.mean.size)).astype(np.float32)
    eigenvalues = np.full(count, 4.0, np.float32)
    np.savez(path, mean=shipped.mean + 1, shapedirs=directions, eigenvalues=eigenvalues, metadata="{}")
    generator = default_registry().generator(
        "soma", device=CPU, dtype=torch.float64, options={"shape_space": str(path)}
    )
    shape = torch.zeros(1, component_count(assets_dir() / "SOMA_neutral.npz"), dtype=torch.float64)
    shape[0, 2] = 0.5
    expected = (shipped.mean + 1).astype(np.float64) + directions[2].reshape(-1, 3)
    np.testing.assert_allclose(generator.rest({"shape": shape})[0].numpy(), expected, atol=1e-5)
