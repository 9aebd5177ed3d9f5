"""Motion files of the specimen."""

from __future__ import annotations

import numpy as np

from soma_core.plugin import ModelMotion, MotionFormat, atomic_arrays, open_npz_file


def read(path):
    """A file that write wrote."""
    with open_npz_file(path, fix="Write it again.") as file:
        arrays = {name: file.read(name) for name in file.names}
    return ModelMotion(
        params={"size": float(arrays["size"])},
        pose={"rotations": arrays["specimen_turns"], "translation": arrays["shift"]},
        fps=float(arrays["fps"]),
    )


def write(path, motion):
    """Rotations, translation and size."""
    arrays = {"specimen_turns": motion.pose["rotations"], "shift": motion.pose["translation"]}
    atomic_arrays(
        path, {**arrays, "fps": np.array(motion.fps), "size": np.array(motion.params.get("size", 1))}
    )


FORMAT = MotionFormat(
    name="specimen", suffixes=(".npz",), keys=("specimen_turns", "shift"), read=read, write=write
)
