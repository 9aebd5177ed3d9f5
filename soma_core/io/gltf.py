"""Write a skinned animation as a binary glTF 2.0 file (GLB)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.cache import atomic_write
from soma_core.errors import InputError
from soma_core.geometry.mesh import following_corners, vertex_normals
from soma_core.io.clip import SkinnedClip, linear_colour
from soma_core.io.eyeballs import Eyeball, eyeball, eyeball_materials, eyeballs
from soma_core.io.glb import GlbBuffer, glb_bytes
from soma_core.rig.mesh import CanonicalMesh

__all__ = ["gltf_bytes", "write_gltf"]

_SET_WIDTH = 4
"""Influences in one JOINTS_n attribute, fixed by glTF."""

_STILL = 1e-7
"""Largest change of a quaternion entry or translation [m] for which a channel is left out as constant."""


def write_gltf(path: str | Path, clip: SkinnedClip) -> None:
    """Write `clip` as a GLB: metres, +Y up, +Z forward, the T-pose as rest, the motion as an animation.

    All influences are kept in as many JOINTS_n / WEIGHTS_n sets as needed, heaviest first, so that a
    viewer that reads only the first set still shows the best four. The first v vertices are the canonical
    ones in canonical order; copies that UV seams need follow. Correctives are morph targets, stored sparsely,
    whose weights the animation moves. Eyeballs are nodes below the joints of the eyes, without a skin.

    Args:
        path: a ``.glb`` file.
        clip: what to write.

    Raises:
        InputError: another suffix, or triangles that do not lie in the mesh's polygons.
    """
    path = Path(path)
    if path.suffix != ".glb":
        raise InputError("path", got=repr(path.name), expected="a .glb file", fix="Change the suffix.")
    content = gltf_bytes(clip)

    def write(temporary: Path) -> None:
        temporary.write_bytes(content)

    atomic_write(path, write)


def gltf_bytes(clip: SkinnedClip) -> bytes:
    """The GLB that :func:`write_gltf` writes."""
    buffer = GlbBuffer()
    return glb_bytes(_document(clip, buffer), buffer)


def _document(clip: SkinnedClip, buffer: GlbBuffer) -> dict[str, Any]:
    """The JSON part; node 0 is the mesh, node j + 1 is joint j; eyeballs follow."""
    joints, eyes = clip.rig.joint_count, eyeballs(clip.rig, clip.t_pose_world)
    roots = [int(j) + 1 for j in np.flatnonzero(clip.rig.parents < 0)]
    asset: dict[str, Any] = {"version": "2.0", "generator": "SOMA Core"}
    if clip.metadata.get("licence"):
        asset["copyright"] = clip.metadata["licence"]
    extras = dict(clip.metadata) | {"canonical_vertex_count": clip.mesh.vertex_count}
    inverse_bind = buffer.add(np.linalg.inv(clip.bind_world).astype(np.float32))
    return {
        "asset": asset | {"extras": extras},
        "scene": 0,
        "scenes": [{"nodes": [0, *roots]}],
        "nodes": [{"name": clip.name, "mesh": 0, "skin": 0}, *_joint_nodes(clip, eyes)],
        "meshes": [_mesh(clip, buffer), *([_eye_mesh(eyes[0].radius, buffer)] if eyes else [])],
        "materials": [
            _material("Skin", clip.colour),
            *(_material(name, colour, 0.2) for name, colour, _ in eyeball_materials() if eyes),
        ],
        "skins": [
            {
                "name": clip.name,
                "inverseBindMatrices": inverse_bind,
                "joints": list(range(1, joints + 1)),
                "skeleton": roots[0],
            }
        ],
        "animations": [_animation(clip, buffer)],
    }


def _material(name: str, colour: tuple[float, float, float], roughness: float = 0.6) -> dict[str, Any]:
    surface = {
        "baseColorFactor": [*linear_colour(colour), 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": roughness,
    }
    return {"name": name, "pbrMetallicRoughness": surface}


def _eye_mesh(radius: float, buffer: GlbBuffer) -> dict[str, Any]:
    """An eyeball that looks along +Z, for both eyes; material 0 is the skin's."""
    ball = eyeball()[0].astype(np.float32)
    attributes = {
        "POSITION": buffer.add(np.float32(radius) * ball, role="attribute", bounds=True),
        "NORMAL": buffer.add(ball, role="attribute"),
    }
    primitives = [
        {
            "attributes": attributes,
            "indices": buffer.add(faces.reshape(-1).astype(np.uint16), role="index"),
            "material": number,
        }
        for number, (_, _, faces) in enumerate(eyeball_materials(), 1)
    ]
    return {"name": "Eyeball", "primitives": primitives}


def _joint_nodes(clip: SkinnedClip, eyes: Sequence[Eyeball]) -> list[dict[str, Any]]:
    """One node per joint, resting in the T-pose, then one per eyeball."""
    local = clip.t_pose_local()
    rotations = Rotation.from_matrix(local[:, :3, :3]).as_quat(canonical=True)
    nodes = []
    for joint, name in enumerate(clip.rig.joint_names):
        node = {
            "name": name,
            "translation": local[joint, :3, 3].tolist(),
            "rotation": rotations[joint].tolist(),
        }
        children = np.flatnonzero(clip.rig.parents == joint)
        if len(children):
            node["children"] = (children + 1).tolist()
        nodes.append(node)
    for eye in eyes:
        turn = Rotation.from_matrix(eye.local[:3, :3]).as_quat(canonical=True).tolist()
        place = {"translation": eye.local[:3, 3].tolist(), "rotation": turn}
        nodes.append({"name": eye.name, "mesh": 1, **place})
        nodes[eye.joint].setdefault("children", []).append(len(nodes))
    return nodes


def _mesh(clip: SkinnedClip, buffer: GlbBuffer) -> dict[str, Any]:
    """The mesh at rest, and its morph targets."""
    sources, uv, triangles = _split_at_seams(clip.mesh)
    primitive = _primitive(clip, buffer, sources, uv, triangles)
    mesh: dict[str, Any] = {"name": clip.name, "primitives": [primitive]}
    if clip.shapes is None:
        return mesh
    primitive["targets"], dense = [], np.zeros((clip.mesh.vertex_count, 3), np.float32)
    for index in range(len(clip.shapes)):
        ids, offsets = clip.shapes.target(index)
        dense[ids] = offsets
        moved = np.flatnonzero(np.isin(sources, ids))
        added = buffer.add_sparse(moved, dense[sources[moved]], count=len(sources))
        primitive["targets"].append({"POSITION": added})
    names = [f"Corrective{index:03d}" for index in range(len(clip.shapes))]
    return mesh | {"weights": [0.0] * len(names), "extras": {"targetNames": names}}


def _primitive(
    clip: SkinnedClip, buffer: GlbBuffer, sources: np.ndarray, uv: np.ndarray, triangles: np.ndarray
) -> dict[str, Any]:
    normals = vertex_normals(clip.rest, clip.mesh.triangles)
    attributes = {
        "POSITION": buffer.add(clip.rest[sources].astype(np.float32), role="attribute", bounds=True),
        "NORMAL": buffer.add(normals[sources].astype(np.float32), role="attribute"),
    }
    if len(uv):
        # glTF puts the origin of textures at the top left, USD and OBJ at the bottom left.
        flipped = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1).astype(np.float32)
        attributes["TEXCOORD_0"] = buffer.add(flipped, role="attribute")
    joint_ids, weights = clip.influences()
    padding = ((0, 0), (0, -joint_ids.shape[1] % _SET_WIDTH))
    joint_ids, weights = np.pad(joint_ids, padding)[sources], np.pad(weights, padding)[sources]
    small = np.uint8 if clip.rig.joint_count <= 256 else np.uint16
    for index in range(joint_ids.shape[1] // _SET_WIDTH):
        part = slice(index * _SET_WIDTH, (index + 1) * _SET_WIDTH)
        attributes[f"JOINTS_{index}"] = buffer.add(joint_ids[:, part].astype(small), role="attribute")
        attributes[f"WEIGHTS_{index}"] = buffer.add(weights[:, part], role="attribute")
    index_type = np.uint16 if len(sources) < 65535 else np.uint32
    indices = buffer.add(triangles.reshape(-1).astype(index_type), role="index")
    return {"attributes": attributes, "indices": indices, "material": 0}


def _split_at_seams(mesh: CanonicalMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give every (vertex, UV) pair its own vertex; the first pair of each vertex keeps its canonical id.

    Returns:
        The canonical id of each vertex (n,), its UV (n, 2) or none, and the triangles (t, 3).
    """
    count = mesh.vertex_count
    if not len(mesh.uv):
        return np.arange(count), np.empty((0, 2)), mesh.triangles
    corner_uv = mesh.uv_indices[_triangle_corners(mesh)]
    used, first = np.unique(mesh.face_vert_indices, return_index=True)
    home = np.zeros(count, np.int64)
    home[used] = mesh.uv_indices[first]
    keys = mesh.triangles.astype(np.int64) * len(mesh.uv) + corner_uv
    away = corner_uv != home[mesh.triangles]
    copies, slot = np.unique(keys[away], return_inverse=True)
    triangles = mesh.triangles.astype(np.int64)
    triangles[away] = count + slot
    sources = np.concatenate([np.arange(count), copies // len(mesh.uv)])
    return sources, mesh.uv[np.concatenate([home, copies % len(mesh.uv)])], triangles


def _triangle_corners(mesh: CanonicalMesh) -> np.ndarray:
    """Position in the polygon stream of each triangle corner, (t, 3).

    A triangle lies in the polygon that owns one of its directed edges; in a consistently wound mesh a
    directed edge belongs to one polygon, so the order of the triangles does not matter.
    """
    stream, counts = mesh.face_vert_indices.astype(np.int64), mesh.face_vert_counts
    face = np.repeat(np.arange(len(counts)), counts)
    size = mesh.vertex_count
    edge_face = dict(
        zip((stream * size + stream[following_corners(counts)]).tolist(), face.tolist(), strict=True)
    )
    corner_of = dict(zip((face * size + stream).tolist(), range(len(stream)), strict=True))
    corners = np.empty(mesh.triangles.shape, np.int64)
    for row, (a, b, c) in enumerate(mesh.triangles.tolist()):
        owners = [edge_face.get(edge) for edge in (a * size + b, b * size + c, c * size + a)]
        owner = next((found for found in owners if found is not None), None)
        places = [-1 if owner is None else corner_of.get(owner * size + v, -1) for v in (a, b, c)]
        if min(places) < 0:
            raise InputError(
                "mesh.triangles",
                got=f"triangle {row} ({a}, {b}, {c})",
                expected="triangles that tile the polygons of face_vert_indices",
                fix="Use the triangulation that belongs to the polygons.",
            )
        corners[row] = places
    return corners


def _animation(clip: SkinnedClip, buffer: GlbBuffer) -> dict[str, Any]:
    """Channels for what moves; joints that keep their rest transform need none."""
    times = buffer.add((np.arange(clip.frame_count) / clip.fps).astype(np.float32), bounds=True)
    rest = clip.t_pose_local()
    rest_quaternions = Rotation.from_matrix(rest[:, :3, :3]).as_quat(canonical=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    tracks = (
        ("translation", clip.translations, rest[:, :3, 3]),
        ("rotation", clip.quaternions, rest_quaternions),
    )
    for kind, values, still in tracks:
        for joint in np.flatnonzero(np.abs(values - still).max(axis=(0, 2)) > _STILL):
            channels.append({"sampler": len(samplers), "target": {"node": int(joint) + 1, "path": kind}})
            output = buffer.add(np.ascontiguousarray(values[:, joint], np.float32))
            samplers.append({"input": times, "interpolation": "LINEAR", "output": output})
    if clip.shapes is not None:
        channels.append({"sampler": len(samplers), "target": {"node": 0, "path": "weights"}})
        output = buffer.add(np.ascontiguousarray(clip.shapes.weights.ravel(), np.float32))
        samplers.append({"input": times, "interpolation": "LINEAR", "output": output})
    if not channels:  # glTF forbids an empty animation: say explicitly that Hips rest.
        output = buffer.add(np.ascontiguousarray(clip.quaternions[:, 0], np.float32))
        channels = [{"sampler": 0, "target": {"node": 1, "path": "rotation"}}]
        samplers = [{"input": times, "interpolation": "LINEAR", "output": output}]
    return {"name": "motion", "channels": channels, "samplers": samplers}
