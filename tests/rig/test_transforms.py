import numpy as np
import scipy.spatial.transform

from assets.make.local_transforms import local_transforms
from soma_core.geometry.tree import depth_order
from soma_core.rig.transforms import (
    fused_product,
    project_rotations,
    world_transforms,
)

ROUNDING = 1e-12  # a few float64 products of values below 100

PARENTS = np.array([-1, 0, 1, 1, 3], np.int32)


def random_world(seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    world = np.tile(np.eye(4), (len(PARENTS), 1, 1))
    world[:, :3, :3] = scipy.spatial.transform.Rotation.random(len(PARENTS), generator).as_matrix()
    world[:, :3, 3] = generator.normal(scale=50, size=(len(PARENTS), 3))
    return world


def test_world_of_local_is_the_identity_map():
    world = random_world(0)
    np.testing.assert_allclose(
        world_transforms(local_transforms(world, PARENTS), PARENTS), world, atol=ROUNDING
    )


def test_local_agrees_with_a_linear_solve():
    world = random_world(1)
    local = local_transforms(world, PARENTS)
    for joint, parent in enumerate(PARENTS):
        above = np.eye(4) if parent < 0 else world[parent]
        np.testing.assert_allclose(local[joint], np.linalg.solve(above, world[joint]), atol=ROUNDING)


def test_world_does_not_depend_on_the_order_of_joints():
    world = random_world(2)
    local = local_transforms(world, PARENTS)
    shuffle = np.array([4, 2, 0, 3, 1])
    place = np.append(np.argsort(shuffle), -1)
    shuffled = world_transforms(local[shuffle], place[PARENTS[shuffle]])
    np.testing.assert_array_equal(shuffled, world_transforms(local, PARENTS)[shuffle])


def test_fused_product_rounds_each_term_once_and_adds_in_order():
    close = 1 + 2.0**-30  # its square is 1 + 2^-29 + 2^-60, of which float64 drops the last
    found = fused_product(np.array([[-1, close], [close, -1]]), np.array([[1 + 2.0**-29, 1.0], [close, 0.0]]))
    assert found[0, 0] == 2.0**-60
    assert found[1, 0] == close * (1 + 2.0**-29) - close
    assert found[:, 1].tolist() == [-1, close]


def test_fused_product_is_the_matrix_product():
    generator = np.random.default_rng(5)
    left, right = generator.normal(size=(6, 5)), generator.normal(size=(5, 3))
    left[left < 0] = 0
    np.testing.assert_allclose(fused_product(left, right), left @ right, atol=ROUNDING)


def test_depth_order_puts_parents_first():
    parents = np.array([2, -1, 1, 0], np.int32)
    order = depth_order(parents).tolist()
    assert all(
        order.index(parent) < order.index(joint) for joint, parent in enumerate(parents) if parent >= 0
    )


def test_projection_gives_rotations_even_next_to_a_reflection():
    generator = np.random.default_rng(3)
    matrices = np.tile(np.eye(4), (20, 1, 1))
    matrices[:, :3, :3] = generator.normal(size=(20, 3, 3))
    projected = project_rotations(matrices)[:, :3, :3]
    np.testing.assert_allclose(
        projected @ projected.swapaxes(1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=ROUNDING
    )
    np.testing.assert_allclose(np.linalg.det(projected), 1)


def test_projection_keeps_rotations():
    world = random_world(4)
    np.testing.assert_allclose(project_rotations(world), world, atol=ROUNDING)
