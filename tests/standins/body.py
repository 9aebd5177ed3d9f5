"""A body with any number of vertices, made of the canonical mesh and the shape space of this project."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from soma_core import SomaLayer, load_canonical
from soma_core.geometry.barycentric import closest_point_on_triangle
from soma_core.obj import write_obj
from soma_core.topology.closest import ClosestFaces

__all__ = ["Body", "make_body", "surface_wrap", "write_wrap"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """The canonical mesh of a LOD with the centroids of its first faces added, so as to have more vertices.

    Attributes:
        vertices: (n, 3) the mean body [m], +Y up, facing +Z, in the T-pose.
        faces: (t, 3).
        directions: (k, n, 3) shape directions [m], of one standard deviation.
        weights: (n, J) skinning weights for the canonical joints, dense.
        joints: (J, 3) T-pose positions of the canonical joints.
        joint_names: their names.
    """

    vertices: np.ndarray
    faces: np.ndarray
    directions: np.ndarray
    weights: np.ndarray
    joints: np.ndarray
    joint_names: tuple[str, ...]


@functools.cache
def make_body(count: int, face_count: int, components: int = 16) -> Body:
    """Make a body of `count` vertices and `face_count` faces; the last faces go where there are too many."""
    lod = "mid" if count >= 18056 else "low" if count >= 4505 else "xlo"
    layer = SomaLayer("soma", lod=lod, dtype=torch.float64, kernels="torch", procedural=False)
    coefficients = torch.zeros(components + 1, 128, dtype=torch.float64)
    coefficients[1:, :components] = torch.eye(components, dtype=torch.float64)
    still = torch.zeros(1, len(layer.joint_names), 3, dtype=torch.float64)
    with torch.no_grad():
        identity = layer.identity({"shape": coefficients})
        posed = layer.pose(identity, still)
    points = posed.vertices.numpy()
    mesh, rig = load_canonical(lod)
    triangles = mesh.triangles.astype(np.int64)
    split = count - mesh.vertex_count
    assert 0 <= split <= len(triangles), "no such body can be made"
    a, b, c = triangles[:split].T
    centre = mesh.vertex_count + np.arange(split)
    faces = np.concatenate([np.stack(three, 1) for three in ((a, b, centre), (b, c, centre), (c, a, centre))])
    faces = np.concatenate([faces, triangles[split:]])[:face_count]
    assert len(faces) == face_count, "no such body can be made"

    def refined(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, values[..., triangles[:split], :].mean(-2)], axis=-2)

    vertices = refined(points)
    joints = np.concatenate([np.zeros((1, 3)), posed.joints[0].numpy()])  # the root, then the user's joints
    return Body(
        vertices=vertices[0],
        faces=faces,
        directions=vertices[1:] - vertices[0],
        weights=refined(rig.weights.toarray()),
        joints=joints,
        joint_names=rig.joint_names,
    )


def surface_wrap(body: Body) -> np.ndarray:
    """The canonical mid mesh on the facets of the body, bags and between toes apart, (v, 3) [m]."""
    layer = SomaLayer("soma", dtype=torch.float64, kernels="torch", procedural=False)
    with torch.no_grad():
        still = torch.zeros(1, len(layer.joint_names), 3, dtype=torch.float64)
        ideal = layer.pose(layer.identity(), still).vertices[0].numpy()
    face = ClosestFaces(body.vertices, body.faces).query(ideal)
    wrap = closest_point_on_triangle(ideal, body.vertices[body.faces[face]])
    apart = np.union1d(layer.mesh.face_interior, layer.mesh.segments["between_toes"])
    wrap[apart] = ideal[apart]
    return wrap


def write_wrap(folder: Path, body: Body, scale: float = 1.0) -> None:
    """Write it as ``SOMA_wrap.obj``."""
    folder.mkdir(parents=True, exist_ok=True)
    write_obj(folder / "SOMA_wrap.obj", scale * surface_wrap(body), load_canonical("mid")[0].triangles)
