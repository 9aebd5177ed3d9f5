"""Small FBX files as text: bones, curves of their turns, and a skin that tells where they were bound."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from soma_core.geometry.euler import euler_from_matrices
from soma_core.io.skeleton_motion import SkeletonMotion

__all__ = ["write_fbx"]

_TICKS = 46186158000
"""Parts of a second that FBX counts time in."""

_TYPE = {"T": "Lcl Translation", "R": "Lcl Rotation"}


def write_fbx(motion: SkeletonMotion, path: Path, *, skin: bool = False, told: bool = True) -> None:
    """Write a motion as ASCII FBX 7.4, in centimetres, keys at each frame.

    With a skin, bones stand in another pose than that of rest. Some programs leave out where the animation
    starts: `told` false.
    """
    objects, links, curves = [], [], []
    bones = motion.rest.copy()
    bones[1:] -= motion.rest[motion.parents[1:]]
    still = 30.0 if skin else 0.0  # [degrees] the root stands turned: only the skin tells the rest pose
    for joint, name in enumerate(motion.names):
        turn = still if joint == 0 else 0
        place = 100 * bones[joint]
        objects.append(f"""Model: {_model(joint)}, "Model::{name}", "LimbNode" {{
  Version: 232
  Properties70: {{
    P: "Lcl Translation", "Lcl Translation", "", "A",{place[0]:.9f},{place[1]:.9f},{place[2]:.9f}
    P: "Lcl Rotation", "Lcl Rotation", "", "A",0,{turn},0
  }}
}}
NodeAttribute: {_model(joint) + 1}, "NodeAttribute::{name}", "LimbNode" {{
  TypeFlags: "Skeleton"
}}""")
        above = _model(motion.parents[joint]) if joint else 0
        links += [f'"OO",{_model(joint)},{above}', f'"OO",{_model(joint) + 1},{_model(joint)}']
        angles = np.degrees(euler_from_matrices(motion.rotations[:, joint], "ZYX"))[:, ::-1]
        curves.append((joint, "R", angles))
        if joint == 0:
            curves.append((joint, "T", 100 * motion.root))
    times = ",".join(str(round(frame * _TICKS / motion.fps)) for frame in range(motion.frame_count))
    for number, (joint, kind, values) in enumerate(curves):
        node = 500_000 + 10 * number
        objects.append(f"""AnimationCurveNode: {node}, "AnimCurveNode::{kind}", "" {{
  Properties70: {{
    P: "d|X", "Number", "", "A",0
    P: "d|Y", "Number", "", "A",0
    P: "d|Z", "Number", "", "A",0
  }}
}}""")
        links += [f'"OO",{node},400001', f'"OP",{node},{_model(joint)}, "{_TYPE[kind]}"']
        for axis in range(3):
            objects.append(f"""AnimationCurve: {node + 1 + axis}, "AnimCurve::", "" {{
  KeyVer: 4008
  KeyTime: *{motion.frame_count} {{
    a: {times}
  }}
  KeyValueFloat: *{motion.frame_count} {{
    a: {",".join(f"{value:.9f}" for value in values[:, axis])}
  }}
  KeyAttrFlags: *1 {{
    a: 4
  }}
  KeyAttrDataFloat: *4 {{
    a: 0,0,0,0
  }}
  KeyAttrRefCount: *1 {{
    a: {motion.frame_count}
  }}
}}""")
            links.append(f'"OP",{node + 1 + axis},{node}, "d|{"XYZ"[axis]}"')
    start = 'P: "LocalStart", "KTime", "Time", "",0' if told else ""
    span = f'{start}\n    P: "LocalStop", "KTime", "Time", "",{times.rpartition(",")[2]}'
    objects += [
        f'AnimationStack: 400000, "AnimStack::Take 001", "" {{\n  Properties70: {{\n    {span}\n  }}\n}}',
        'AnimationLayer: 400001, "AnimLayer::BaseLayer", "" {\n}',
    ]
    links.append('"OO",400001,400000')
    if skin:
        _add_skin(motion, objects, links)
    body, joined = "\n".join(objects), "\n".join("C: " + link for link in links)
    path.write_text(f"""; FBX 7.4.0 project file
FBXHeaderExtension:  {{
  FBXHeaderVersion: 1003
  FBXVersion: 7400
}}
GlobalSettings:  {{
  Version: 1000
  Properties70: {{
    P: "UpAxis", "int", "Integer", "",1
    P: "UpAxisSign", "int", "Integer", "",1
    P: "FrontAxis", "int", "Integer", "",2
    P: "FrontAxisSign", "int", "Integer", "",1
    P: "CoordAxis", "int", "Integer", "",0
    P: "CoordAxisSign", "int", "Integer", "",1
    P: "UnitScaleFactor", "double", "Number", "",1
    P: "TimeMode", "enum", "", "",14
    P: "CustomFrameRate", "double", "Number", "",{motion.fps}
  }}
}}
Objects:  {{
{body}
}}
Connections:  {{
{joined}
}}
""")


def _model(joint: int) -> int:
    return 1000 + 10 * int(joint)


def _add_skin(motion: SkeletonMotion, objects: list[str], links: list[str]) -> None:
    """A triangle that hangs on every bone, as it stands at rest."""
    objects.append("""Geometry: 900000, "Geometry::skin", "Mesh" {
  Vertices: *9 {
    a: 0,0,0,1,0,0,0,1,0
  }
  PolygonVertexIndex: *3 {
    a: 0,1,-3
  }
}
Model: 900001, "Model::skin", "Mesh" {
  Version: 232
}
Deformer: 900002, "Deformer::", "Skin" {
  Version: 101
}""")
    links += ['"OO",900001,0', '"OO",900000,900001', '"OO",900002,900000']
    for joint, place in enumerate(motion.rest):
        number = 900_010 + joint
        bound = np.eye(4)
        bound[3, :3] = 100 * place  # row vectors
        objects.append(f"""Deformer: {number}, "SubDeformer::", "Cluster" {{
  Version: 100
  Indexes: *1 {{
    a: 0
  }}
  Weights: *1 {{
    a: 1
  }}
  Transform: *16 {{
    a: {",".join(f"{value:.9f}" for value in np.linalg.inv(bound).ravel())}
  }}
  TransformLink: *16 {{
    a: {",".join(f"{value:.9f}" for value in bound.ravel())}
  }}
}}""")
        links += [f'"OO",{number},900002', f'"OO",{_model(joint)},{number}']
