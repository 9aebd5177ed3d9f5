"""The model's own pose, against a reference written vertex by vertex, and the generator's refusals."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from soma_backend_smpl import smpl
from soma_backend_smpl._generator import SmplGenerator
from soma_backend_smpl._model_file import read_model

from soma_core import AssetError, InputError
from soma_core.plugin import Registry
from tests.standins.smpl_files import FAMILIES, smpl_arrays, write_npz

ROUNDING = 1e-10
"""Metres: float64 through a chain of a dozen joints."""
CPU = torch.device("cpu")


@pytest.fixture(scope="module", params=["smpl", "smplh", "smplx"])
def generator(request, tmp_path_factory):
    name = request.param
    arrays = smpl_arrays(name, width={"smplx": 20}.get(name, 10))
    path = write_npz(tmp_path_factory.mktemp(name) / "model.npz", arrays)
    return SmplGenerator(read_model(path, FAMILIES[name]), CPU, torch.float64, parameter_count=10)


def random_pose(generator, count=2):
    turns = 0.5 * torch.randn(
        count,
        generator.family.joint_count,
        3,
        generator=torch.Generator().manual_seed(1),
        dtype=torch.float64,
    )
    return {"rotations": turns, "translation": torch.tensor([[0.1, 0.2, 0.3]]).double().expand(count, 3)}


def betas(count=2):
    return {"betas": torch.randn(count, 10, generator=torch.Generator().manual_seed(2), dtype=torch.float64)}


def reference(generator, beta, turns, translation):
    """One body, joint by joint, as the paper writes it."""
    model = generator._model
    rest = model.template + model.shapes @ beta
    joints = model.regressor @ rest
    matrices = Rotation.from_rotvec(turns).as_matrix()
    shaped = rest + model.pose_directions @ (matrices[1:] - np.eye(3)).ravel()
    world = []
    for joint, parent in enumerate(model.family.parents):
        local = np.eye(4)
        local[:3, :3] = matrices[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        world.append(local if parent < 0 else world[parent] @ local)
    posed = np.zeros_like(rest)
    for joint, transform in enumerate(world):
        moved = (shaped - joints[joint]) @ transform[:3, :3].T + transform[:3, 3]
        posed += model.weights[:, joint, None] * moved
    return posed + translation


def test_posed_agrees_with_the_reference(generator):
    pose, params = random_pose(generator), betas()
    posed = generator.posed(params, pose).numpy()
    for row in range(2):
        expected = reference(
            generator,
            params["betas"][row].numpy(),
            pose["rotations"][row].numpy(),
            pose["translation"][row].numpy(),
        )
        np.testing.assert_allclose(posed[row], expected, atol=ROUNDING, rtol=0)


def test_its_skinning_is_the_whole_of_posed(generator):
    pose, params = random_pose(generator), betas()
    model = generator.skinning(params)
    rotations = torch.as_tensor(Rotation.from_rotvec(pose["rotations"].reshape(-1, 3).numpy()).as_matrix())
    rotations = rotations.unflatten(0, (2, -1))
    shaped = model.rest + model.pose_offsets(rotations)
    turns, places = [rotations[:, 0]], [model.joints[:, 0]]
    for joint, parent in enumerate(model.parents[1:], start=1):
        step = model.joints[:, joint] - model.joints[:, parent]
        places.append(places[parent] + (turns[parent] @ step[..., None]).squeeze(-1))
        turns.append(turns[parent] @ rotations[:, joint])
    posed = pose["translation"][:, None]
    for joint, (turn, place) in enumerate(zip(turns, places, strict=True)):
        moved = (shaped - model.joints[:, joint, None]) @ turn.transpose(-1, -2) + place[:, None]
        posed = posed + model.weights[:, joint, None] * moved
    torch.testing.assert_close(posed, generator.posed(params, pose), atol=ROUNDING, rtol=0)
    assert model.joint_names == generator.family.joint_names


def test_its_triangles_are_those_of_the_file(generator):
    np.testing.assert_array_equal(generator.triangles().numpy(), generator._model.faces)


def test_zero_pose_is_the_rest_mesh(generator):
    still = {"rotations": torch.zeros(1, generator.family.joint_count, 3, dtype=torch.float64)}
    torch.testing.assert_close(
        generator.posed(betas(), still), generator.rest(betas()), atol=ROUNDING, rtol=0
    )


def test_turning_the_pelvis_turns_the_body_about_it(generator):
    turns = torch.zeros(1, generator.family.joint_count, 3, dtype=torch.float64)
    turns[0, 0] = torch.tensor([0.4, -1.2, 0.3])
    rest, pelvis = generator.rest(betas()), generator.rest_joints(betas())[:, :1]
    turn = torch.as_tensor(Rotation.from_rotvec(turns[0, 0].numpy()).as_matrix())
    expected = (rest - pelvis) @ turn.T + pelvis
    torch.testing.assert_close(
        generator.posed(betas(), {"rotations": turns}), expected, atol=ROUNDING, rtol=0
    )


def test_poses_and_bodies_are_shared(generator):
    pose, params = random_pose(generator), betas()
    one = {"betas": params["betas"][:1]}
    torch.testing.assert_close(generator.posed(one, pose)[0], generator.posed(params, pose)[0])
    three = {"betas": params["betas"][:1].expand(3, -1)}
    with pytest.raises(InputError, match="pose: got 2 poses for 3 bodies"):
        generator.posed(three, pose)


def test_posed_is_differentiable(generator):
    pose = random_pose(generator)
    turns = pose["rotations"].clone().requires_grad_()
    generator.posed(betas(), {"rotations": turns}).square().sum().backward()
    assert bool((turns.grad.abs().sum(-1) > 0).all())


def test_a_pose_of_another_layout_is_refused(generator):
    with pytest.raises(InputError, match="pose: got rotations of shape none"):
        generator.posed(betas(), {})
    with pytest.raises(InputError, match=r"pose: got rotations of shape torch.Size\(\[1, 7, 3\]\)"):
        generator.posed(betas(), {"rotations": torch.zeros(1, 7, 3)})
    with pytest.raises(InputError, match="pose: got the key hands"):
        generator.posed(betas(), random_pose(generator) | {"hands": torch.zeros(1)})
    count = generator._model.expressions.shape[2]
    with pytest.raises(
        InputError, match=rf"pose\['expression'\]: got {count + 1} values, expected at most {count}"
    ):
        generator.posed(betas(), random_pose(generator) | {"expression": torch.zeros(1, count + 1).double()})


def test_expressions_move_the_face_of_smplx(generator):
    if generator.family.name != "smplx":
        return
    values = torch.ones(1, 3, dtype=torch.float64)
    still = {"rotations": torch.zeros(1, 55, 3, dtype=torch.float64), "expression": values}
    moved = generator.posed(betas(1), still)[0] - generator.rest(betas(1))[0]
    expected = torch.as_tensor(generator._model.expressions[:, :, :3].sum(2))
    torch.testing.assert_close(moved, expected, atol=ROUNDING, rtol=0)


def test_betas_that_the_file_lacks_are_refused(generator):
    wide = SmplGenerator(generator._model, CPU, torch.float64, parameter_count=16)
    params = torch.zeros(1, 16, dtype=torch.float64)
    torch.testing.assert_close(wide.rest({"betas": params}), generator.rest({"betas": params[:, :10]}))
    params[0, 12] = 1
    with pytest.raises(
        InputError, match=r"params\['betas'\]: got values beyond the first 10, expected at most 10"
    ):
        wide.rest({"betas": params})


def test_a_gender_that_is_not_there_is_named(data_folder):
    registry = Registry()
    build = {"device": CPU, "dtype": torch.float32}
    assert (
        registry.generator("smpl", options={"gender": "male"}, **build)
        .rest({"betas": torch.zeros(1, 24)})
        .isfinite()
        .all()
    )
    with pytest.raises(
        Exception, match="no female SMPL model is there; there are .*male.*soma backends convert smpl"
    ):
        registry.generator("smpl", options={"gender": "female"}, **build)
    with pytest.raises(InputError, match="components: got 0, expected at least 1"):
        registry.generator("smpl", options={"components": 0}, **build)


def test_hostile_files_do_not_declare(tmp_path, monkeypatch):
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path))
    (tmp_path / "SMPL").mkdir()
    (tmp_path / "SMPL" / "SMPL_NEUTRAL.pkl").write_bytes(b"cos\nsystem\n(S'touch owned'\ntR.")
    assert smpl.soma_backend().params[0].shape == (10,)
    with pytest.raises(AssetError, match="asks for os.system"):
        read_model(tmp_path / "SMPL" / "SMPL_NEUTRAL.pkl", FAMILIES["smpl"])
