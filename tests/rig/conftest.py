"""Tiny USD rigs, and a cache folder that no other test shares."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (0.0, 2.0) for z in (-1.0, 1.0)])
CUBE_FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def shifted(x: float, y: float, z: float) -> np.ndarray:
    """Column-vector translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


@dataclass(frozen=True)
class TinyRig:
    """A cube on three joints (Root, Hips, Spine1), in file units; None leaves an attribute out."""

    joints: tuple[str, ...] = ("Root", "Root/Hips", "Root/Hips/Spine1")
    bind: tuple[np.ndarray, ...] | None = (np.eye(4), shifted(0, 1, 0), shifted(0, 2, 0))
    rest: tuple[np.ndarray, ...] | None = (np.eye(4), shifted(0, 1, 0), shifted(0, 1, 0))
    points: np.ndarray | None = None
    faces: tuple[tuple[int, ...], ...] = tuple(map(tuple, CUBE_FACES))
    influences: tuple[tuple[int, ...], ...] = ((1, 2),) * 8
    weights: tuple[tuple[float, ...], ...] = ((0.75, 0.25),) * 8
    element_size: int = 2
    mesh_joints: tuple[str, ...] | None = None
    geom_bind: np.ndarray | None = None
    mesh_transform: np.ndarray | None = None
    skeleton_transform: np.ndarray | None = None
    names: tuple[str, ...] = ("c_skin_mid",)
    bound: bool = True
    unit: float = 0.01
    up: str = "Y"


def _write(path: Path, tiny: TinyRig) -> Path:
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

    def row(matrix: np.ndarray) -> Gf.Matrix4d:
        return Gf.Matrix4d(*np.asarray(matrix).T.ravel().tolist())

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, tiny.unit)
    UsdGeom.SetStageUpAxis(stage, tiny.up)
    UsdSkel.Root.Define(stage, "/Body")
    skeleton = UsdSkel.Skeleton.Define(stage, "/Body/Skeleton")
    skeleton.CreateJointsAttr(list(tiny.joints))
    if tiny.bind is not None:
        skeleton.CreateBindTransformsAttr([row(matrix) for matrix in tiny.bind])
    if tiny.rest is not None:
        skeleton.CreateRestTransformsAttr([row(matrix) for matrix in tiny.rest])
    if tiny.skeleton_transform is not None:
        UsdGeom.Xformable(skeleton).AddTransformOp().Set(row(tiny.skeleton_transform))
    points = CUBE if tiny.points is None else tiny.points
    for name in tiny.names:
        mesh = UsdGeom.Mesh.Define(stage, f"/Body/{name}")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
        mesh.CreateFaceVertexCountsAttr([len(face) for face in tiny.faces])
        mesh.CreateFaceVertexIndicesAttr([corner for face in tiny.faces for corner in face])
        binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        size = tiny.element_size
        binding.CreateJointIndicesPrimvar(constant=False, elementSize=size).Set(
            [i for row_ in tiny.influences for i in row_]
        )
        binding.CreateJointWeightsPrimvar(constant=False, elementSize=size).Set(
            [w for row_ in tiny.weights for w in row_]
        )
        if tiny.mesh_joints is not None:
            binding.CreateJointsAttr(list(tiny.mesh_joints))
        if tiny.geom_bind is not None:
            binding.CreateGeomBindTransformAttr(row(tiny.geom_bind))
        if tiny.mesh_transform is not None:
            mesh.AddTransformOp().Set(row(tiny.mesh_transform))
        if tiny.bound:
            binding.CreateSkeletonRel().SetTargets([Sdf.Path("/Body/Skeleton")])
    stage.GetRootLayer().Save()
    return path


@pytest.fixture
def tiny_usd(tmp_path: Path) -> Callable[..., Path]:
    """Write a tiny rig with some of its fields changed; return the file, a new one each time."""
    numbers = count()

    def write(**changes: object) -> Path:
        return _write(tmp_path / f"tiny{next(numbers)}.usda", replace(TinyRig(), **changes))

    return write


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    before = os.environ.get("SOMA_CACHE_DIR")
    os.environ["SOMA_CACHE_DIR"] = str(tmp_path_factory.mktemp("cache"))
    yield
    if before is None:
        del os.environ["SOMA_CACHE_DIR"]
    else:
        os.environ["SOMA_CACHE_DIR"] = before
