"""Read a skinned mesh and its skeleton from any UsdSkel file, by names rather than by position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soma_core.errors import AssetError
from soma_core.files import FARTHEST
from soma_core.rig.expansion import public_rig, with_helpers
from soma_core.rig.influences import read_weights
from soma_core.rig.manifest import RESTORE
from soma_core.rig.mesh import Lod
from soma_core.rig.procedural import ProceduralDefinition
from soma_core.rig.skeleton import Rig
from soma_core.rig.stored import StoredRig
from soma_core.rig.transforms import world_transforms
from soma_core.usd_stage import metres_of, open_stage, usd_errors

if TYPE_CHECKING:
    from pxr import Usd, UsdSkel

__all__ = ["MESH_NAMES", "UsdRig", "canonical_rig", "read_usd_rig"]

MESH_NAMES: dict[str, tuple[str, ...]] = {
    "mid": ("c_skin_mid", "c_bodyRig_mid", "c_skin"),
    "low": ("c_skin_lo", "c_bodyRig_lo", "c_skin_low", "c_bodyRig_low"),
    "xlo": (
        "c_skin_xlo",
        "c_bodyRig_xlo",
        "c_skin_extra_low",
        "c_bodyRig_extra_low",
        "c_body_xlo",
        "skin_xlo",
    ),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class UsdRig:
    """A rig with the polygons of its skin.

    Attributes:
        rig: the rig [m], +Y up, rotations projected to SO(3); its revision is `rig_hash` shortened.
        rig_hash: 64 hex digits, from the values of the file before any processing.
        face_vert_indices, face_vert_counts: polygon stream (int32).
        uv, uv_indices: (u, 2) float32 and one id for each corner; empty without faceVarying ``st``.
        mesh_name: name of the skin's prim.
    """

    rig: Rig
    rig_hash: str
    face_vert_indices: np.ndarray
    face_vert_counts: np.ndarray
    uv: np.ndarray
    uv_indices: np.ndarray
    mesh_name: str


@dataclass(frozen=True, kw_only=True, eq=False)
class _Skeleton:
    """A skeleton as stored, in the file's unit and axes, as column-vector matrices."""

    joint_paths: tuple[str, ...]
    joint_names: tuple[str, ...]
    parents: np.ndarray
    bind_world: np.ndarray
    t_pose_world: np.ndarray


def _columns(matrix: object) -> np.ndarray:
    """USD's row-vector matrix (or array of them) as column-vector float64."""
    return np.swapaxes(np.array(matrix, np.float64), -1, -2)


def _choose_mesh(path: Path, stage: Usd.Stage, mesh: str | None, lod: Lod) -> Usd.Prim:
    """Pick the skin: `mesh` by name or path, else the usual names of the LOD, else the only one."""
    from pxr import UsdGeom

    skinned = [
        prim
        for prim in stage.Traverse()
        if prim.IsA(UsdGeom.Mesh) and prim.HasAttribute("primvars:skel:jointIndices")
    ]
    for name in (mesh,) if mesh is not None else MESH_NAMES[lod]:
        for prim in skinned:
            if name in (prim.GetName(), str(prim.GetPath())):
                return prim
    if mesh is None and len(skinned) == 1:
        return skinned[0]
    wanted = mesh if mesh is not None else " or ".join(MESH_NAMES[lod])
    found = ", ".join(str(prim.GetPath()) for prim in skinned) or "none"
    raise AssetError(
        path,
        cause=f"no skinned mesh named {wanted}; skinned meshes in the file: {found}",
        fix="Pass the name of one of them as `mesh`",
    )


def _skeleton_prim(path: Path, stage: Usd.Stage, skin: Usd.Prim) -> UsdSkel.Skeleton:
    """The skeleton the skin is bound to, else the only one in the file."""
    from pxr import UsdSkel

    bound = UsdSkel.BindingAPI(skin).GetInheritedSkeleton()
    if bound:
        return bound
    found = [UsdSkel.Skeleton(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton)]
    if len(found) != 1:
        cause = f"{skin.GetPath()} is bound to no skeleton and the file has {len(found)}"
        raise AssetError(path, cause=cause, fix="Author skel:skeleton on the mesh")
    return found[0]


def _parents(paths: Sequence[str]) -> np.ndarray:
    """Parent of each joint: its nearest ancestor path among `paths`."""
    index = {path: joint for joint, path in enumerate(paths)}
    parents = []
    for path in paths:
        above = path.rpartition("/")[0]
        while above and above not in index:
            above = above.rpartition("/")[0]
        parents.append(index.get(above, -1))
    return np.array(parents, np.int32)


def _matrices(path: Path, attribute: Usd.Attribute, joint_count: int, fix: str) -> np.ndarray:
    value = attribute.Get()
    got = 0 if value is None else len(value)
    if got != joint_count:
        cause = f"{attribute.GetName()} holds {got} matrices for {joint_count} joints"
        raise AssetError(path, cause=cause, fix=fix)
    matrices = _columns(value)
    if not np.isfinite(matrices).all():
        raise AssetError(path, cause=f"{attribute.GetName()} holds NaN or infinity", fix="Export it again")
    return matrices


def _read_skeleton(path: Path, skeleton: UsdSkel.Skeleton) -> _Skeleton:
    from pxr import UsdGeom

    paths = tuple(skeleton.GetJointsAttr().Get() or ())
    names = tuple(joint.rpartition("/")[2] for joint in paths)
    repeated = sorted({name for name in names if names.count(name) > 1})
    if not names or repeated:
        cause = f"the skeleton repeats the joint names {repeated}" if names else "the skeleton has no joints"
        raise AssetError(path, cause=cause, fix="Give every joint its own name")
    rest = _matrices(
        path,
        skeleton.GetRestTransformsAttr(),
        len(paths),
        "Export restTransforms (local, one for each joint): they are the T-pose and cannot be guessed",
    )
    bind = _matrices(
        path, skeleton.GetBindTransformsAttr(), len(paths), "Export bindTransforms, one for each joint"
    )
    parents = _parents(paths)
    t_pose = world_transforms(rest, parents)
    # bindTransforms are in world space, restTransforms in the skeleton's own space.
    placement = _columns(UsdGeom.Xformable(skeleton).ComputeLocalToWorldTransform(0))
    if not np.array_equal(placement, np.eye(4)):
        t_pose = placement @ t_pose
    return _Skeleton(
        joint_paths=paths, joint_names=names, parents=parents, bind_world=bind, t_pose_world=t_pose
    )


def _bind_points(path: Path, skin: Usd.Prim) -> np.ndarray:
    """Points where the skin was bound, in the file's unit and axes: (v, 3) float64."""
    from pxr import UsdGeom, UsdSkel

    values = UsdGeom.Mesh(skin).GetPointsAttr().Get()
    points = np.array(values if values is not None else [], np.float64).reshape(-1, 3)
    if not len(points) or not (np.abs(points) <= FARTHEST).all():
        cause = (
            f"{skin.GetPath()} holds {'NaN or infinity, or places far away' if len(points) else 'no points'}"
        )
        raise AssetError(path, cause=cause, fix="Export the mesh again")
    authored = UsdSkel.BindingAPI(skin).GetGeomBindTransformAttr()
    # geomBindTransform is the mesh's world transform at bind time; UsdSkel ignores the mesh's own
    # transform where it is authored, and so do we. Without it, that transform is all there is.
    placement = _columns(
        authored.Get()
        if authored.HasAuthoredValue()
        else UsdGeom.Xformable(skin).ComputeLocalToWorldTransform(0)
    )
    if np.array_equal(placement, np.eye(4)):
        return points
    return points @ placement[:3, :3].T + placement[:3, 3]


def _polygons(path: Path, skin: Usd.Prim, vertex_count: int) -> tuple[np.ndarray, np.ndarray]:
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh(skin)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [], np.int32)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [], np.int32)
    broken = counts.sum() != len(indices) or (len(counts) and counts.min() < 3)
    if broken or (len(indices) and not 0 <= indices.min() <= indices.max() < vertex_count):
        cause = f"{skin.GetPath()} has faces that do not fit its {vertex_count} points"
        raise AssetError(path, cause=cause, fix="Export the mesh again")
    return indices, counts


def _texture(skin: Usd.Prim, corner_count: int) -> tuple[np.ndarray, np.ndarray]:
    """The faceVarying ``st`` primvar, or two empty arrays."""
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(skin).GetPrimvar("st")
    if not primvar or primvar.GetInterpolation() != "faceVarying" or primvar.Get() is None:
        return np.empty((0, 2), np.float32), np.empty(0, np.int32)
    uv = np.array(primvar.Get(), np.float32).reshape(-1, 2)
    if not primvar.IsIndexed():
        return uv, np.arange(corner_count, dtype=np.int32)
    return uv, np.array(primvar.GetIndices(), np.int32)


def _fan_triangles(indices: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Triangulate polygons as fans from their first corner: (t, 3) int32."""
    starts = np.cumsum(counts) - counts
    triangles = [
        (indices[start], indices[start + step], indices[start + step + 1])
        for start, count in zip(starts.tolist(), counts.tolist(), strict=True)
        for step in range(1, count - 1)
    ]
    return np.array(triangles, np.int32).reshape(-1, 3)


def _read_stored(path: Path, stage: Usd.Stage, skin: Usd.Prim) -> StoredRig:
    """The skeleton with the points and weights of a skin, in the unit and axes of the file."""
    from pxr import UsdGeom

    up = UsdGeom.GetStageUpAxis(stage)
    if up not in ("Y", "Z"):
        raise AssetError(path, cause=f"upAxis is {up}, expected Y or Z", fix="Export it again with +Y up")
    skeleton = _read_skeleton(path, _skeleton_prim(path, stage, skin))
    points = _bind_points(path, skin)
    return StoredRig(
        joint_names=skeleton.joint_names,
        parents=skeleton.parents,
        bind_world=skeleton.bind_world,
        t_pose_world=skeleton.t_pose_world,
        bind_shape=points,
        weights=read_weights(path, skin, skeleton.joint_paths, len(points)),
        unit=metres_of(path, stage),
        up=up,
    )


def read_usd_rig(
    path: Path,
    *,
    mesh: str | None = None,
    lod: Lod = "mid",
    triangles: np.ndarray | None = None,
    definition: ProceduralDefinition | None = None,
    keep: Sequence[str] | None = None,
) -> UsdRig:
    """Read a rig from a UsdSkel file, converted to metres and +Y up.

    Any number of joints; parents come from the joint paths. Rotations are projected to SO(3),
    weights normalised, and joints put in parent-first order when the file's is another.

    Args:
        path: a .usd, .usda or .usdc file.
        mesh: name or path of the skin; default: the usual names of `lod`, else the only skin.
        lod: which names to look for.
        triangles: (t, 3) canonical triangulation for the rig hash; default: fans of the polygons.
        definition: which joints a pose controls and which are twist joints; the others are folded into
            their ancestors, and so are the twist joints for all but `Rig.procedural`. The hash is that of
            the folded rig. Default: every joint is one that a pose controls.
        keep: the joints that a pose controls, where there is no definition; the others are folded likewise.

    Raises:
        AssetError: unreadable file, unknown mesh, missing restTransforms, unsupported up axis,
            weights that are negative, not finite, do not sum to 1 or name unknown joints, or a skeleton
            without a joint of the definition.
    """
    fix = f"{RESTORE}; a text layer that ends early was truncated"
    stage = open_stage(path, fix=fix)
    with usd_errors(path, fix=fix):
        skin = _choose_mesh(path, stage, mesh, lod)
        stored = _read_stored(path, stage, skin)
        indices, counts = _polygons(path, skin, len(stored.bind_shape))
        uv, uv_indices = _texture(skin, len(indices))
    polygons = indices, counts, uv, uv_indices
    triangles = _fan_triangles(indices, counts) if triangles is None else triangles
    return canonical_rig(path, stored, polygons, triangles, definition, keep, skin.GetName())


def canonical_rig(
    path: Path,
    stored: StoredRig,
    polygons: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    triangles: np.ndarray,
    definition: ProceduralDefinition | None = None,
    keep: Sequence[str] | None = None,
    mesh_name: str = "",
) -> UsdRig:
    """The rig of a file in metres, with the joints that a pose controls, as :func:`read_usd_rig` has it."""
    missing = sorted({*(keep or ())} - {*stored.joint_names})
    if definition is not None:
        public = public_rig(path, stored, definition)
    elif missing:
        cause = f"the skeleton lacks {len(missing)} joints that a pose controls, first {missing[0]}"
        raise AssetError(path, cause=cause, fix="Take a template of the SOMA rig")
    else:
        public = stored if keep is None else stored.keep(keep)
    digest = public.digest(triangles)
    rig = public.metric(digest)
    return UsdRig(
        rig=rig if definition is None else with_helpers(rig, stored, definition),
        rig_hash=digest,
        face_vert_indices=polygons[0],
        face_vert_counts=polygons[1],
        uv=polygons[2],
        uv_indices=polygons[3],
        mesh_name=mesh_name,
    )
