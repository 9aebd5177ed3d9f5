"""Vertices of an animated USD mesh: points stored at each time, or skinned by UsdSkel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from soma_core.errors import AssetError, InputError
from soma_core.io.vertex_sequence import VertexSequence, even_rate
from soma_core.usd_stage import metres_of, open_stage, usd_errors

__all__ = ["UsdSequence"]

_FIX = "Export it again."


class UsdSequence(VertexSequence):
    """World positions of the one mesh that moves, frame by frame; USD reads values when asked for them.

    Args:
        path: ``.usd``, ``.usda``, ``.usdc`` or ``.usdz``.
        allow_references: follow references that lead out of the folder of the file.

    Raises:
        AssetError: not a USD file, or one that refers to what may not be opened.
        InputError: no mesh or several that move, blend shapes with inbetweens, or samples at uneven times.
    """

    def __init__(self, path: Path, *, allow_references: bool = False) -> None:
        from pxr import UsdGeom

        self._stage: Any = open_stage(path, fix=_FIX, allow_references=allow_references)
        with usd_errors(path, fix=_FIX):
            self._points, self._skin, times = _moving_mesh(path, self._stage)
            self._shapes = None if self._skin is None else _BlendShapes.of(path, *self._skin)
        self._times = times or [self._stage.GetStartTimeCode()]
        rate = self._stage.GetTimeCodesPerSecond()
        super().__init__(
            path,
            len(self._times),
            len(self._points.GetPointsAttr().Get(self._times[0]) or ()),
            fps=even_rate(path, np.array(self._times) / rate),
            metres=metres_of(path, self._stage),
            up="+z" if UsdGeom.GetStageUpAxis(self._stage) == UsdGeom.Tokens.z else "+y",
        )

    def _read(self, start: int, stop: int) -> np.ndarray:
        with usd_errors(self.path, fix=_FIX):
            return np.stack([self._frame(time) for time in self._times[start:stop]])

    def _frame(self, time: float) -> np.ndarray:
        from pxr import UsdGeom

        points = self._points.GetPointsAttr().Get(time)
        if len(points) != self.vertex_count:
            raise InputError(
                f"{self.path}: points at time {time:g}",
                got=f"{len(points)} vertices",
                expected=f"{self.vertex_count}, as at first",
                fix="Export a mesh whose vertices stay the same.",
            )
        prim = self._points.GetPrim()
        if self._skin is not None:
            query, skeleton = self._skin
            if self._shapes is not None:
                points = self._shapes.added(np.array(points), time)
            if not query.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(time), points, time):
                cause = f"the joint indices or weights of {prim.GetPath()} do not fit its skeleton"
                raise AssetError(self.path, cause=cause, fix="Export the skin again.")
            prim = skeleton.GetPrim()  # skinned points are in the space of the skeleton
        world = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(prim))
        # USD multiplies row vectors from the left.
        return np.array(points, np.float64) @ world[:3, :3] + world[3, :3]

    def close(self) -> None:
        """Let go of the stage."""
        self._skin = self._points = self._stage = None


class _BlendShapes:
    """Offsets that an animation adds to points before they are skinned.

    Args:
        shapes: vertices (n,) and offsets (n, 3) of each.
        animation: query of the animation, and `order`, the place of each shape among its weights.
    """

    def __init__(
        self, path: Path, shapes: list[tuple[np.ndarray, np.ndarray]], animation: Any, order: list[int]
    ) -> None:
        self._path, self._shapes, self._animation, self._order = path, shapes, animation, order

    @classmethod
    def of(cls, path: Path, query: Any, skeleton: Any) -> _BlendShapes | None:
        """Those of a skinned mesh; None where nothing moves any."""
        from pxr import UsdSkel

        animation = skeleton.GetAnimQuery()
        if not (query.HasBlendShapes() and animation):
            return None
        names = list(query.GetBlendShapeOrder())
        known = list(animation.GetBlendShapeOrder())
        places = query.GetBlendShapeTargetsRel().GetTargets()
        shapes, order = [], []
        for name, place in zip(names, places, strict=True):
            shape = UsdSkel.BlendShape(query.GetPrim().GetStage().GetPrimAtPath(place))
            if shape.GetInbetweens():
                raise InputError(
                    f"{path}: {place}", got="inbetweens", expected="plain blend shapes",
                    fix="Bake the deformation into points, one time sample a frame.",
                )  # fmt: skip
            if name in known:
                offsets = np.array(shape.GetOffsetsAttr().Get() or np.zeros((0, 3)), np.float64)
                ids = shape.GetPointIndicesAttr().Get()
                ids = np.arange(len(offsets)) if not ids else np.array(ids, np.int64)
                shapes.append((ids, offsets.reshape(-1, 3)))
                order.append(known.index(name))
        return cls(path, shapes, animation, order) if shapes else None

    def added(self, points: np.ndarray, time: float) -> Any:
        """Points (v, 3) with the offsets of a time code."""
        from pxr import Vt

        weights = np.array(self._animation.ComputeBlendShapeWeights(time), np.float64)
        points = points.astype(np.float64)
        for (ids, offsets), place in zip(self._shapes, self._order, strict=True):
            if len(ids) != len(offsets) or (len(ids) and not 0 <= ids.min() <= ids.max() < len(points)):
                cause = "the points of a blend shape do not fit its mesh"
                raise AssetError(self._path, cause=cause, fix="Export the blend shapes again.")
            if weights[place]:
                np.add.at(points, ids, weights[place] * offsets)
        return Vt.Vec3fArray.FromNumpy(points.astype(np.float32))


def _moving_mesh(path: Path, stage: Any) -> tuple[Any, Any, list[float]]:
    """The mesh, its (skinning query, skeleton query) or None, and its sample times.

    What hangs on one joint, such as an eyeball, is left out where there is more.
    """
    from pxr import UsdGeom

    skins = _skinned(stage)
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    found = []
    for mesh in meshes:
        skin = skins.get(str(mesh.GetPath()))
        times = mesh.GetPointsAttr().GetTimeSamples()
        if skin is not None:
            animation = skin[1].GetAnimQuery()
            times = animation.GetJointTransformTimeSamples() if animation else []
        found.append((mesh, skin, list(times)))
    moving = [row for row in found if row[2]] or found
    moving = [row for row in moving if row[1] is None or not row[1][0].IsRigidlyDeformed()] or moving
    if len(moving) != 1:
        names = ", ".join(str(mesh.GetPath()) for mesh, _, _ in moving)
        raise InputError(
            str(path),
            got=f"{len(moving)} meshes {names}".strip(),
            expected="one",
            fix="Export the body alone.",
        )
    mesh, skin, times = moving[0]
    return mesh, skin, times


def _skinned(stage: Any) -> dict[str, tuple[Any, Any]]:
    """Path of each skinned mesh -> its skinning query and the query of its skeleton."""
    from pxr import Usd, UsdSkel

    found = {}
    for prim in stage.Traverse():
        if not prim.IsA(UsdSkel.Root):
            continue
        cache = UsdSkel.Cache()
        cache.Populate(UsdSkel.Root(prim), Usd.PrimDefaultPredicate)
        for binding in cache.ComputeSkelBindings(UsdSkel.Root(prim), Usd.PrimDefaultPredicate):
            skeleton = cache.GetSkelQuery(binding.GetSkeleton())
            for query in binding.GetSkinningTargets():
                found[str(query.GetPrim().GetPath())] = (query, skeleton)
    return found
