"""Write a UsdSkel rig as text: compact, deterministic, exact to the bit of every float32.

Written by hand rather than through pxr, so that the bytes of the shipped rig depend neither on the
version of that library nor on its padding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["SkinMeshText", "joint_paths", "rig_text"]

_SKELETON = "/OUTPUT/c_skeleton_grp/Root"
_IDENTITY = "( (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1) )"


@dataclass(frozen=True, kw_only=True, eq=False)
class SkinMeshText:
    """One skinned mesh to write.

    Attributes:
        name: prim name.
        points: (v, 3) float32 [cm].
        face_vert_indices, face_vert_counts: polygon stream.
        uv, uv_indices: (u, 2) float32 and one id for each corner.
        joint_indices, joint_weights: (v, k) int and float32 influences, padded with zeros.
    """

    name: str
    points: np.ndarray
    face_vert_indices: np.ndarray
    face_vert_counts: np.ndarray
    uv: np.ndarray
    uv_indices: np.ndarray
    joint_indices: np.ndarray
    joint_weights: np.ndarray


def _float_text(value: np.float32) -> str:
    if value == 0:
        return "-0.0" if np.signbit(value) else "0"
    plain = np.format_float_positional(value, trim="-")
    power = np.format_float_scientific(value, trim="-", exp_digits=1)
    return min(plain, power, key=len)


def _float_texts(values: np.ndarray) -> list[str]:
    """Shortest decimal texts that read back as the same float32, flattened."""
    # Unique by bit pattern: by value, 0.0 and -0.0 would be one.
    bits, which = np.unique(np.ascontiguousarray(values, np.float32).view(np.uint32), return_inverse=True)
    texts = [_float_text(value) for value in bits.view(np.float32)]
    return [texts[index] for index in which.ravel().tolist()]


def _floats(values: np.ndarray) -> str:
    return "[" + ",".join(_float_texts(values)) + "]"


def _tuples(values: np.ndarray) -> str:
    texts, width = _float_texts(values), values.shape[1]
    rows = (",".join(texts[start : start + width]) for start in range(0, len(texts), width))
    return "[" + ",".join(f"({row})" for row in rows) + "]"


def _integers(values: np.ndarray) -> str:
    return "[" + ",".join(map(str, values.ravel().tolist())) + "]"


def _matrices(columns: np.ndarray) -> str:
    """Column-vector (J, 4, 4) matrices as USD's array of row-vector matrix4d."""
    rows = (
        "( " + ", ".join("(" + ", ".join(map(repr, row)) + ")" for row in matrix) + " )"
        for matrix in columns.transpose(0, 2, 1).tolist()
    )
    return "[" + ", ".join(rows) + "]"


def _tokens(names: Sequence[str]) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


def _quaternion(rotation: list[list[float]]) -> str:
    """Unit quaternion of a rotation matrix, USD order (w, x, y, z), by its largest component."""
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in rotation[:3])
    squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i]
    candidates = [
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    ]
    best = candidates[squares.index(max(squares))]
    length = math.sqrt(sum(value * value for value in best))
    return "(" + ", ".join(_float_texts(np.array(best) / length)) + ")"


def joint_paths(joint_names: Sequence[str], parents: np.ndarray) -> list[str]:
    """Slash-separated joint paths: the leaf is the name, the prefix is the parent."""
    paths: list[str] = []
    for name, parent in zip(joint_names, parents.tolist(), strict=True):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    return paths


def _extent(points: np.ndarray) -> str:
    return _tuples(np.stack([points.min(axis=0), points.max(axis=0)]))


def _prim(kind: str, name: str, lines: Sequence[str], *, api: bool = False) -> list[str]:
    """One prim as lines: its properties and its already written children, indented."""
    head = f'def {kind} "{name}"'
    opening = [head + " (", '    prepend apiSchemas = ["SkelBindingAPI"]', ")", "{"] if api else [head, "{"]
    return [*opening, *("    " + line for line in lines), "}"]


def _mesh(mesh: SkinMeshText, paths: Sequence[str]) -> list[str]:
    width = mesh.joint_indices.shape[1]
    vertex = f'(elementSize = {width}; interpolation = "vertex")'
    lines = [
        f"float3[] extent = {_extent(mesh.points)}",
        f"int[] faceVertexCounts = {_integers(mesh.face_vert_counts)}",
        f"int[] faceVertexIndices = {_integers(mesh.face_vert_indices)}",
        f"point3f[] points = {_tuples(mesh.points)}",
        f"matrix4d primvars:skel:geomBindTransform = {_IDENTITY}",
        f"int[] primvars:skel:jointIndices = {_integers(mesh.joint_indices)} {vertex}",
        f"float[] primvars:skel:jointWeights = {_floats(mesh.joint_weights)} {vertex}",
        f'texCoord2f[] primvars:st = {_tuples(mesh.uv)} (interpolation = "faceVarying")',
        f"int[] primvars:st:indices = {_integers(mesh.uv_indices)}",
        f"uniform token[] skel:joints = {_tokens(paths)}",
        f"rel skel:skeleton = <{_SKELETON}>",
        'uniform token subdivisionScheme = "none"',
    ]
    return _prim("Mesh", mesh.name, lines, api=True)


def _skeleton(paths: Sequence[str], bind_world: np.ndarray, rest_local: np.ndarray) -> list[str]:
    """The Skeleton with its Animation, which holds the T-pose for viewers."""
    rest = rest_local.tolist()
    animation = [
        f"uniform token[] joints = {_tokens(paths)}",
        "quatf[] rotations = [" + ", ".join(_quaternion(matrix) for matrix in rest) + "]",
        "half3[] scales = [" + ", ".join("(1, 1, 1)" for _ in rest) + "]",
        f"float3[] translations = {_tuples(rest_local[:, :3, 3])}",
    ]
    lines = [
        f"uniform matrix4d[] bindTransforms = {_matrices(bind_world)}",
        f"uniform token[] jointNames = {_tokens([path.rpartition('/')[2] for path in paths])}",
        f"uniform token[] joints = {_tokens(paths)}",
        f"uniform matrix4d[] restTransforms = {_matrices(rest_local)}",
        f"rel skel:animationSource = <{_SKELETON}/Animation>",
        "",
        *_prim("SkelAnimation", "Animation", animation),
    ]
    return _prim("Skeleton", "Root", lines, api=True)


def rig_text(
    *,
    joint_names: Sequence[str],
    parents: np.ndarray,
    bind_world: np.ndarray,
    rest_local: np.ndarray,
    meshes: Sequence[SkinMeshText],
    notes: Mapping[str, str],
    comment: str,
) -> str:
    """Return a UsdSkel layer in centimetres, +Y up, with the prim paths of the SOMA template.

    Args:
        joint_names: J names, parents before children.
        parents: (J,) int, -1 for the root.
        bind_world: (J, 4, 4) world bind transforms, column vectors [cm].
        rest_local: (J, 4, 4) local T-pose transforms, column vectors [cm].
        meshes: written under ``/OUTPUT/c_geometry_grp/MainMesh/Meshes``.
        notes: becomes customLayerData.
        comment: documentation of the layer.
    """
    paths = joint_paths(joint_names, parents)
    children = [line for mesh in meshes for line in _mesh(mesh, paths)]
    geometry = _prim("Xform", "MainMesh", _prim("Scope", "Meshes", children))
    root = [
        f"float3[] extent = {_extent(np.concatenate([mesh.points for mesh in meshes]))}",
        "",
        *_prim("Xform", "c_skeleton_grp", _skeleton(paths, bind_world, rest_local)),
        "",
        *_prim("Xform", "c_geometry_grp", geometry),
    ]
    header = [
        "#usda 1.0",
        "(",
        "    customLayerData = {",
        *(f'        string {key} = "{value}"' for key, value in sorted(notes.items())),
        "    }",
        '    defaultPrim = "OUTPUT"',
        f'    doc = "{comment}"',
        "    metersPerUnit = 0.01",
        '    upAxis = "Y"',
        ")",
        "",
    ]
    return "\n".join([*header, *_prim("SkelRoot", "OUTPUT", root, api=True)]) + "\n"
