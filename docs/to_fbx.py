"""Convert a GLB, USD or BVH of this project to FBX, in Blender.

    blender --background --python docs/to_fbx.py -- body.glb body.fbx 30

or, where the package bpy is installed, with python in the place of blender --background --python. The
last argument is the frame rate of the motion, which only a BVH tells Blender itself.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy

__all__ = ["convert"]


def convert(source: Path, target: Path, fps: float) -> None:
    """Import an animated body or skeleton into an empty scene, and export it with one key a frame.

    Args:
        source: ``.glb``, ``.usd``, ``.usda``, ``.usdc`` or ``.bvh`` in centimetres.
        target: the FBX.
        fps: frames per second.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    # Blender places keys by the rate of the scene, and holds it as a whole number over a base.
    scene.render.fps = math.ceil(fps)
    scene.render.fps_base = math.ceil(fps) / fps
    if source.suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=str(source))
    elif source.suffix == ".bvh":
        bpy.ops.import_anim.bvh(filepath=str(source), global_scale=0.01, update_scene_fps=True)
    else:
        bpy.ops.wm.usd_import(filepath=str(source))
    # The reader of glTF adds a ball that it draws bones with.
    for shape in [each for each in bpy.data.objects if each.type == "MESH" and not each.modifiers]:
        bpy.data.objects.remove(shape)
    ranges = [action.frame_range for action in bpy.data.actions]
    scene.frame_start = math.floor(min((first for first, _ in ranges), default=1))
    scene.frame_end = math.ceil(max((last for _, last in ranges), default=1))
    bpy.ops.export_scene.fbx(
        filepath=str(target),
        object_types={"ARMATURE", "MESH"},
        add_leaf_bones=False,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_simplify_factor=0,
    )


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    convert(Path(given[0]).resolve(), Path(given[1]).resolve(), float(given[2]))
