"""Evaluate the nodes of an FBX file in this process, which has limits and may die: run by `fbx`.

ufbx 0.0.5 frees what it gave of a scene when nobody holds it, and gives it again when it is asked a second
time: the process dies. Everything is asked for once here and held to the end.
"""

from __future__ import annotations

import io
import json
import os
import sys
from typing import Any

import numpy as np

from soma_core.apart import limit_process

__all__: list[str] = []

_MOST = 4_000_000
"""Nodes times frames that are evaluated at most."""

_MOST_NODES = 100_000


class _RefusedError(Exception):
    """Why the file is not read."""


class _Scene:
    """Nodes of a file and what is asked of them."""

    def __init__(self, path: str) -> None:
        import ufbx

        self.held: list[Any] = []
        self.native = ufbx.load_file(
            path, ignore_geometry=True, ignore_embedded=True, load_external_files=False,
            target_axes=ufbx.axes_right_handed_y_up, target_unit_meters=1.0,
        )  # fmt: skip
        self.nodes = self.each(self.native.nodes)
        if len(self.nodes) > _MOST_NODES:
            raise _RefusedError(f"holds {len(self.nodes)} nodes, more than {_MOST_NODES}")
        above = [None if node.is_root else self.hold(node.parent) for node in self.nodes]
        self.parents = np.array([-1 if node is None else node.typed_id for node in above])
        self.bones = np.array([self.hold(node.bone) is not None for node in self.nodes])
        self.meshes = np.array([self.hold(node.mesh) is not None for node in self.nodes])

    def hold(self, value: Any) -> Any:
        self.held.append(value)
        return value

    def each(self, listed: Any) -> list[Any]:
        """Entries of a list of ufbx."""
        self.hold(listed)
        return [self.hold(listed[index]) for index in range(len(listed))]

    def joints(self) -> np.ndarray:
        """Bones, or where there are none what is no mesh; and what lies above them."""
        kept = self.bones.copy() if self.bones.any() else ~self.meshes
        for node in np.flatnonzero(kept):
            above = self.parents[node]
            while above >= 0 and not kept[above]:
                kept[above], above = True, self.parents[above]
        return np.flatnonzero(kept)

    def rest(self) -> tuple[np.ndarray, np.ndarray]:
        """World transforms (nodes, 4, 4) where they stand, and where skins were bound, else NaN."""
        worlds = np.array([_matrix(node.node_to_world) for node in self.nodes]).reshape(-1, 4, 4)
        bound = np.full_like(worlds, np.nan)
        for cluster in self.each(self.native.skin_clusters):
            bone = self.hold(cluster.bone_node)
            if bone is not None:
                bound[bone.typed_id] = _matrix(cluster.bind_to_world)
        return worlds, bound

    def sampled(self, joints: np.ndarray, fps: float | None) -> tuple[np.ndarray, float, list[str]]:
        """Transforms (frames, joints, 10) of the longest animation: translation, quaternion xyzw, scale."""
        stacks = self.each(self.native.anim_stacks)
        spans = [float(stack.time_end - stack.time_begin) for stack in stacks]
        rate = float(fps or self.hold(self.native.settings).frames_per_second or 30.0)
        chosen = max(range(len(stacks)), key=lambda index: spans[index], default=None)
        begin, span = (0.0, 0.0) if chosen is None else (float(stacks[chosen].time_begin), spans[chosen])
        if span <= 0:  # some programs leave out how long it is
            curves = self.each(self.native.anim_curves)
            begin = min((float(curve.min_time) for curve in curves), default=0.0)
            span = max((float(curve.max_time) for curve in curves), default=0.0) - begin
        frames = span * rate + 1
        if not 0 < frames * len(joints) <= _MOST:
            raise _RefusedError(f"{frames:.3g} frames of {len(joints)} nodes are more than {_MOST} places")
        animation = self.hold(self.native.anim if chosen is None else stacks[chosen].anim)
        found = np.empty((int(frames + 1e-3), len(joints), 10))
        for place, joint in enumerate(joints):
            node = self.nodes[joint]
            for frame in range(len(found)):
                found[frame, place] = _numbers(node.evaluate_transform(animation, begin + frame / rate))
        moving = [str(stacks[index].name) for index, length in enumerate(spans) if length > 0]
        return found, rate, moving if chosen is None else [str(stacks[chosen].name), *moving]


def _numbers(transform: Any) -> tuple[float, ...]:
    place, turn, scale = transform.translation, transform.rotation, transform.scale
    return (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w, scale.x, scale.y, scale.z)


def _matrix(matrix: Any) -> np.ndarray:
    """(4, 4) of the columns of ufbx."""
    found = np.eye(4)
    columns = (matrix.c0, matrix.c1, matrix.c2, matrix.c3)
    found[:3] = np.stack([[column.x, column.y, column.z] for column in columns], -1)
    return found


def _read(path: str, fps: float | None) -> dict[str, Any]:
    import ufbx

    try:
        scene = _Scene(path)
        joints = scene.joints()
        values, rate, takes = scene.sampled(joints, fps)
        worlds, bound = scene.rest()
    except _RefusedError as error:
        return {"refused": str(error)}
    except MemoryError:
        return {"refused": "it takes more memory than a file of its size can mean"}
    except (ufbx.UfbxError, RuntimeError, ValueError, TypeError, OverflowError) as error:
        return {"refused": f"not a readable FBX file ({str(error)[:200]})"}
    place = np.full(len(scene.nodes) + 1, -1)
    place[joints] = np.arange(len(joints))
    told = {"names": [scene.nodes[joint].name for joint in joints], "fps": rate, "takes": takes}
    return {
        "told": told, "values": values, "parents": place[scene.parents[joints]],
        "bones": scene.bones[joints], "worlds": worlds[joints], "bound": bound[joints],
    }  # fmt: skip


def _main() -> None:
    path, fps, seconds, memory = sys.argv[1:]
    import ufbx  # noqa: F401 - before the limits: what is missing is said by an error of its own

    limit_process(int(seconds), int(memory))
    found = _read(path, None if fps == "None" else float(fps))
    texts = {key: np.array(json.dumps(found.pop(key))) for key in ("told", "refused") if key in found}
    stream = io.BytesIO()
    np.savez(stream, **texts, **found)
    sys.stdout.buffer.write(stream.getvalue())
    sys.stdout.flush()
    os._exit(0)  # what the library left behind may not survive an orderly end


if __name__ == "__main__":
    _main()
