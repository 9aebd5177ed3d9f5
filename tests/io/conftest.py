"""A small skinned body: a bent tube with five joints, six influences a vertex and a UV seam."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse
from scipy.spatial.transform import Rotation

from soma_core.correctives.shapes import CorrectiveShapes
from soma_core.io.clip import skinned_clip
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

NAMES = ("Root", "Hips", "Spine1", "Chest", "Head", "LeftArm", "LeftHand")
PARENTS = np.array([-1, 0, 1, 2, 3, 3, 5], np.int32)
AROUND, ALONG = 8, 12


def forward(parents, local):
    """World transforms of local transforms (frames, J, 4, 4)."""
    world = local.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ local[:, joint]
    return world


def skin(clip, world):
    """Linear blend skinning, (frames, v, 3)."""
    matrices = world @ np.linalg.inv(clip.bind_world)
    moved = clip.rest + (clip.shapes.weights @ clip.shapes.targets).reshape(len(world), -1, 3)
    rest = np.concatenate([moved, np.ones((*moved.shape[:2], 1))], axis=2)
    weights = clip.rig.weights.toarray()
    return np.einsum("vj,fjab,fvb->fva", weights, matrices, rest)[..., :3]


def _tube():
    """Vertices (v, 3), quads and their UV corners; one UV seam runs along the tube."""
    angle = np.arange(AROUND) * 2 * np.pi / AROUND
    height = np.linspace(0, 1.7, ALONG)
    ring = np.stack([0.2 * np.sin(angle), 0 * angle, 0.15 * np.cos(angle)], axis=1)
    vertices = (ring[None] + height[:, None, None] * np.array([0, 1, 0])).reshape(-1, 3)
    quads, corners = [], []
    for i in range(ALONG - 1):
        for j in range(AROUND):
            k = (j + 1) % AROUND
            quads.append([i * AROUND + j, i * AROUND + k, (i + 1) * AROUND + k, (i + 1) * AROUND + j])
            low, high = i * (AROUND + 1), (i + 1) * (AROUND + 1)
            corners.append([low + j, low + j + 1, high + j + 1, high + j])
    u, v = np.meshgrid(np.linspace(0, 1, AROUND + 1), np.linspace(0, 1, ALONG))
    return vertices, np.array(quads), np.array(corners), np.stack([u.ravel(), v.ravel()], axis=1)


def _mesh(vertices, quads, corners, uv):
    # the diagonals alternate, as the shorter diagonal does on a real mesh
    triangles = [
        ((q[0], q[1], q[2]), (q[0], q[2], q[3])) if i % 2 else ((q[1], q[2], q[3]), (q[1], q[3], q[0]))
        for i, q in enumerate(quads)
    ]
    return CanonicalMesh(
        vertices=vertices,
        triangles=np.array(triangles, np.int32).reshape(-1, 3),
        face_vert_indices=quads.reshape(-1).astype(np.int32),
        face_vert_counts=np.full(len(quads), 4, np.int32),
        uv=uv.astype(np.float32),
        uv_indices=corners.reshape(-1).astype(np.int32),
        segments={},
        mirror=np.arange(len(vertices), dtype=np.int32),
        mid_ids=np.arange(len(vertices), dtype=np.int32),
        lod="mid",
        revision="0123456789abcdef",
    )


def _transforms(rotvecs, positions):
    world = np.tile(np.eye(4), (len(NAMES), 1, 1))
    world[1:, :3, :3] = Rotation.from_rotvec(rotvecs).as_matrix()
    world[1:, :3, 3] = positions
    return world


def _rig(mesh, generator):
    positions = np.array(
        [[0, 0.9, -0.05], [0, 1.1, 0], [0, 1.3, 0], [0, 1.6, 0], [0.2, 1.4, 0], [0.5, 1.2, 0.1]], float
    )
    weights = generator.uniform(size=(mesh.vertex_count, len(NAMES))) ** 4
    weights[:, 0] = 0  # Root carries no skin
    weights /= weights.sum(axis=1, keepdims=True)
    return Rig(
        joint_names=NAMES,
        parents=PARENTS,
        bind_world=_transforms(generator.normal(size=(6, 3)), positions),
        t_pose_world=_transforms(generator.normal(size=(6, 3)), positions + 0.05),
        bind_shape=mesh.vertices,
        weights=scipy.sparse.csr_array(weights),
        revision=mesh.revision,
    )


@pytest.fixture(scope="session")
def clip():
    """Nine frames of an identity that is not the template, far from the origin."""
    generator = np.random.default_rng(3)
    mesh = _mesh(*_tube())
    rig = _rig(mesh, generator)
    bind = rig.bind_world.copy()
    bind[1:, :3, 3] *= 1.1
    local = np.tile(np.eye(4), (9, len(NAMES), 1, 1))
    angles = np.linspace(0, 1, 9)[:, None, None] * generator.normal(size=(6, 3))
    local[:, 1:, :3, :3] = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(9, 6, 3, 3)
    inverse = np.linalg.inv(bind[PARENTS[1:]])
    local[:, 1:, :3, 3] = (inverse @ bind[1:])[:, :3, 3]
    local[:, 1, :3, 3] = [3.0, 0.9, -2.0] + np.linspace(0, 1, 9)[:, None] * [0.4, 0.1, 1.0]
    identity = SimpleNamespace(rest=1.1 * mesh.vertices[None], bind_world=bind[None])
    targets = generator.normal(scale=0.02, size=(3, mesh.vertex_count, 3))
    targets[generator.uniform(size=targets.shape[:2]) < 0.6] = 0  # shapes move some of the vertices
    shapes = CorrectiveShapes(
        targets=scipy.sparse.csr_array(targets.reshape(3, -1)),
        weights=generator.uniform(-1, 1, size=(9, 3)).astype(np.float32),
        worst=0.0,
    )
    return skinned_clip(
        mesh,
        rig,
        identity,
        forward(PARENTS, local).astype(np.float32),
        fps=30,
        name="Toy body",
        metadata={"licence": "CC0-1.0", "backend": "toy"},
        shapes=shapes,
    )


@pytest.fixture(scope="session")
def posed(clip):
    """Vertices (frames, v, 3) that every exported file must give."""
    local = np.tile(np.eye(4), (*clip.translations.shape[:2], 1, 1))
    local[..., :3, 3] = clip.translations
    flat = Rotation.from_quat(clip.quaternions.reshape(-1, 4)).as_matrix()
    local[..., :3, :3] = flat.reshape(*clip.translations.shape[:2], 3, 3)
    return skin(clip, forward(clip.rig.parents, local))
