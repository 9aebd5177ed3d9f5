"""Write a skinned animation as UsdSkel, or vertices over time as a point cache."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.cache import atomic_write
from soma_core.errors import InputError
from soma_core.geometry.mesh import vertex_normals
from soma_core.io.clip import SkinnedClip, linear_colour
from soma_core.io.eyeballs import Eyeball, eyeball, eyeball_materials, eyeballs
from soma_core.io.vertex_writers import MeshFrames

__all__ = ["write_usd", "write_usd_points"]

_SUFFIXES = (".usdc", ".usda", ".usd")

_SAVED_FRAMES = 64
"""Frames in memory before they go to the file: 14 MB of the mid mesh."""


def write_usd(path: str | Path, clip: SkinnedClip) -> None:
    """Write `clip` as UsdSkel: metres, +Y up, one time code a frame, the T-pose as rest.

    The skeleton holds the identity's bind and T-pose transforms, the animation is separate from them, and
    the mesh keeps every skin influence and its UVs; correctives are blend shapes, eyeballs meshes that hang
    on one joint each. `clip.metadata` goes to the layer's custom data.

    Args:
        path: ``.usdc`` (binary, a third of the size), ``.usda`` (text) or ``.usd``.
        clip: what to write.

    Raises:
        InputError: the suffix is none of these.
    """
    path = Path(path)
    if path.suffix not in _SUFFIXES:
        raise InputError(
            "path", got=repr(path.name), expected=" or ".join(_SUFFIXES), fix="Change the suffix."
        )
    stage = _stage(clip)
    atomic_write(path, lambda temporary: _export(stage, temporary))


def _export(stage: Any, path: Path) -> None:
    if not stage.Export(str(path)):
        raise OSError(f"usd-core could not write {path}")


def write_usd_points(path: Path, mesh: MeshFrames) -> None:
    """Write a mesh whose points and extent have a sample at each time code, one a frame; ``.usdc``.

    Frames are saved as they come: the file grows, memory does not.

    Raises:
        InputError: an upward axis that USD has no name for.
    """
    from pxr import Usd, UsdGeom, Vt

    if mesh.up not in ("+y", "+z"):
        raise InputError("up", got=mesh.up, expected="+y or +z, which USD has names for", fix="Turn it.")

    def write(temporary: Path) -> None:
        temporary.unlink()  # USD makes a layer only where no file is
        stage = Usd.Stage.CreateNew(str(temporary))
        _set_up(stage, frame_count=mesh.frame_count, fps=mesh.fps, metres=mesh.metres, up=mesh.up)
        stage.GetRootLayer().customLayerData = {"soma_core": {"source": mesh.source}}
        shown = UsdGeom.Mesh.Define(stage, "/Mesh")
        stage.SetDefaultPrim(shown.GetPrim())
        _set_faces(shown, mesh.counts, mesh.indices, mesh.uv, mesh.uv_indices)
        points, extent = shown.CreatePointsAttr(), shown.CreateExtentAttr()
        for number, frame in mesh.numbered():
            points.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(frame)), number)
            extent.Set(Vt.Vec3fArray.FromNumpy(np.stack([frame.min(axis=0), frame.max(axis=0)])), number)
            if number % _SAVED_FRAMES == _SAVED_FRAMES - 1:
                stage.Save()
        stage.Save()

    atomic_write(path, write)


def _set_up(stage: Any, *, frame_count: int, fps: float, metres: float = 1.0, up: str = "+y") -> None:
    """Axes, unit and the range of time codes."""
    from pxr import UsdGeom

    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if up == "+z" else UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(frame_count - 1)


def _stage(clip: SkinnedClip) -> Any:
    """Build the stage in memory."""
    from pxr import Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.CreateInMemory()
    _set_up(stage, frame_count=clip.frame_count, fps=clip.fps)
    stage.GetRootLayer().customLayerData = {"soma_core": dict(clip.metadata)}
    root = UsdSkel.Root.Define(stage, f"/{_identifier(clip.name)}")
    stage.SetDefaultPrim(root.GetPrim())
    scope = str(root.GetPath())
    _add_skeleton(stage, f"{scope}/Skeleton", clip)
    mesh = _add_mesh(stage, f"{scope}/Mesh", clip)
    _bind(mesh, f"{scope}/Skeleton", clip)
    if clip.shapes is not None:
        _add_shapes(stage, mesh, f"{scope}/Skeleton/Animation", clip)
    material = _material(stage, f"{scope}/Material", clip.colour)
    mesh.CreateDisplayColorAttr([linear_colour(clip.colour)])
    _bind_material(mesh.GetPrim(), material)
    eyes = eyeballs(clip.rig, clip.t_pose_world)
    if eyes:
        shades = [_material(stage, f"{scope}/{name}", colour, 0.2) for name, colour, _ in eyeball_materials()]
    for eye in eyes:
        _add_eyeball(stage, f"{scope}/{eye.name}", clip, eye, shades)
    extent = root.CreateExtentAttr()
    for frame in range(clip.frame_count):
        extent.Set(UsdGeom.Boundable.ComputeExtentFromPlugins(root, frame), frame)
    return stage


def _identifier(name: str) -> str:
    from pxr import Tf

    return Tf.MakeValidIdentifier(name)


def _joint_paths(clip: SkinnedClip) -> list[str]:
    """UsdSkel names a joint by its path from the root joint."""
    paths: list[str] = []
    for name, parent in zip(clip.rig.joint_names, clip.rig.parents, strict=True):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    return paths


def _matrices(transforms: Iterable[np.ndarray]) -> Any:
    """USD matrices of column-vector transforms: USD multiplies row vectors, hence the transpose."""
    from pxr import Gf, Vt

    return Vt.Matrix4dArray([Gf.Matrix4d(*matrix.T.reshape(-1).tolist()) for matrix in transforms])


def _add_skeleton(stage: Any, path: str, clip: SkinnedClip) -> None:
    from pxr import Gf, UsdSkel, Vt

    skeleton = UsdSkel.Skeleton.Define(stage, path)
    joints = _joint_paths(clip)
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateBindTransformsAttr(_matrices(clip.bind_world))
    skeleton.CreateRestTransformsAttr(_matrices(clip.t_pose_local()))
    animation = UsdSkel.Animation.Define(stage, f"{path}/Animation")
    animation.CreateJointsAttr(joints)
    animation.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1, 1, 1)] * len(joints)))
    translations = animation.CreateTranslationsAttr()
    rotations = animation.CreateRotationsAttr()
    for frame in range(clip.frame_count):
        translations.Set(Vt.Vec3fArray.FromNumpy(clip.translations[frame].astype(np.float32)), frame)
        quaternions = [Gf.Quatf(w, x, y, z) for x, y, z, w in clip.quaternions[frame].tolist()]
        rotations.Set(Vt.QuatfArray(quaternions), frame)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])


def _add_mesh(stage: Any, path: str, clip: SkinnedClip) -> Any:
    from pxr import UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    points = clip.rest.astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    shown = clip.mesh
    _set_faces(mesh, shown.face_vert_counts, shown.face_vert_indices, shown.uv, shown.uv_indices)
    normals = vertex_normals(clip.rest, clip.mesh.triangles).astype(np.float32)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return mesh


def _set_faces(
    mesh: Any, counts: np.ndarray, indices: np.ndarray, uv: np.ndarray, uv_indices: np.ndarray
) -> None:
    """Polygons, drawn as they are, and their texture coordinates where there are any."""
    from pxr import Sdf, UsdGeom, Vt

    mesh.CreateFaceVertexCountsAttr(_ints(counts))
    mesh.CreateFaceVertexIndicesAttr(_ints(indices))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    if not len(uv):
        return
    primvars = UsdGeom.PrimvarsAPI(mesh)
    st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uv, np.float32)))
    st.SetIndices(_ints(uv_indices))


def _ints(values: np.ndarray) -> Any:
    from pxr import Vt

    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, np.int32))


def _bind(mesh: Any, skeleton: str, clip: SkinnedClip) -> None:
    """Tie the mesh to the skeleton with every influence."""
    from pxr import Gf, UsdSkel, Vt

    joint_ids, weights = clip.influences()
    width = joint_ids.shape[1]
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton])
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    binding.CreateJointIndicesPrimvar(constant=False, elementSize=width).Set(_ints(joint_ids.reshape(-1)))
    binding.CreateJointWeightsPrimvar(constant=False, elementSize=width).Set(
        Vt.FloatArray.FromNumpy(weights.reshape(-1))
    )


def _add_shapes(stage: Any, mesh: Any, animation: str, clip: SkinnedClip) -> None:
    """Correctives as blend shapes, whose weights the animation moves."""
    from pxr import UsdSkel, Vt

    assert clip.shapes is not None
    names = [f"Corrective{index:03d}" for index in range(len(clip.shapes))]
    for index, name in enumerate(names):
        ids, offsets = clip.shapes.target(index)
        shape = UsdSkel.BlendShape.Define(stage, f"{mesh.GetPath()}/{name}")
        shape.CreateOffsetsAttr(Vt.Vec3fArray.FromNumpy(offsets))
        shape.CreatePointIndicesAttr(_ints(ids))
    binding = UsdSkel.BindingAPI(mesh.GetPrim())
    binding.CreateBlendShapesAttr(names)
    binding.CreateBlendShapeTargetsRel().SetTargets([f"{mesh.GetPath()}/{name}" for name in names])
    moved = UsdSkel.Animation.Get(stage, animation)
    moved.CreateBlendShapesAttr(names)
    weights = moved.CreateBlendShapeWeightsAttr()
    for frame, row in enumerate(clip.shapes.weights):
        weights.Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(row)), frame)


def _add_eyeball(stage: Any, path: str, clip: SkinnedClip, eye: Eyeball, materials: Sequence[Any]) -> None:
    """A mesh that moves with one joint, white, iris and pupil as its subsets."""
    from pxr import UsdGeom, UsdShade, UsdSkel, Vt

    mesh, ball = UsdGeom.Mesh.Define(stage, path), eyeball()[0]
    points, parts = (eye.radius * ball).astype(np.float32), eyeball_materials()
    faces = np.concatenate([part for _, _, part in parts])
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    _set_faces(mesh, np.full(len(faces), 3), faces.ravel(), np.empty((0, 2)), np.empty(0))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(ball.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([mesh.GetPath().GetParentPath().AppendChild("Skeleton")])
    binding.CreateGeomBindTransformAttr(_matrices([clip.bind_world[eye.joint] @ eye.local])[0])
    binding.SetRigidJointInfluence(eye.joint, 1.0)
    first = 0
    for (name, _, part), material in zip(parts, materials, strict=True):
        subset = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).CreateMaterialBindSubset(
            name, _ints(np.arange(first, first + len(part)))
        )
        _bind_material(subset.GetPrim(), material)
        first += len(part)


def _material(stage: Any, path: str, colour: tuple[float, float, float], roughness: float = 0.6) -> Any:
    from pxr import Gf, Sdf, UsdShade

    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*linear_colour(colour)))
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(roughness)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


def _bind_material(prim: Any, material: Any) -> None:
    from pxr import UsdShade

    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
