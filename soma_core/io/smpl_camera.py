"""Motions before a camera in the world, by the path of the camera that a tool writes beside them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.errors import InputError, SomaError
from soma_core.io.data_files import DataFile, open_data
from soma_core.io.npz_fields import check_rotations
from soma_core.io.smpl_bodies import FoundBody

__all__ = ["camera_beside", "in_world"]

_KEYS = ("pred_cam_R", "pred_cam_T")
"""Turns and places of a camera in the world of its first frame, as TRAM has them."""


def camera_beside(file: DataFile, bodies: Sequence[FoundBody]) -> Path | None:
    """The file with the path of the camera, beside a file or its folder, where the file's tool writes one."""
    name = bodies[0].tool.camera if bodies[0].tool else ""
    folders = file.path.absolute().parents[:2]
    return next((folder / name for folder in folders if name and (folder / name).is_file()), None)


def in_world(
    camera: Path, rotations: np.ndarray, translation: np.ndarray, frames: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (n, J + 1, 3) and translation (n, 3) [m] in the world; the camera's turns stand last.

    The translation is that of a model whose pelvis rests at the origin, see ``SmplMotion.about_pelvis``.

    Args:
        camera: the file.
        rotations: (n, J, 3) axis-angle vectors before the camera, the root first.
        translation: (n, 3) before the camera [m].
        frames: (n,) their numbers in the video.

    Raises:
        AssetError: no such file as its suffix says.
        InputError: other arrays, or not so many frames.
    """
    turns, places = _path(camera, frames.astype(np.int64))
    root = (turns * Rotation.from_rotvec(rotations[:, 0])).as_rotvec()
    turned = np.concatenate([root[:, None], rotations[:, 1:], turns.as_rotvec()[:, None]], axis=1)
    return turned, turns.apply(translation) + places


def _path(path: Path, frames: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Turns and places (n, 3) [m] of the camera in some frames."""
    with open_data(path) as file:
        try:
            found = [file.array(file.content[key]).astype(np.float64) for key in _KEYS]
            if found[0].shape != (len(found[1]), 3, 3) or found[1].shape[1:] != (3,):
                raise ValueError(f"shapes {found[0].shape} and {found[1].shape}")
            if frames.min() < 0 or frames.max() >= len(found[1]):
                raise ValueError(f"{len(found[1])} frames, and a motion up to frame {frames.max()}")
            turns, places = found[0][frames], found[1][frames]
            if not np.isfinite(places).all():
                raise ValueError("NaN or infinity")
            check_rotations(_KEYS[0], turns[:, None])
        except (KeyError, TypeError, ValueError, SomaError) as error:
            raise InputError(
                str(path), got=str(error)[:200], expected=f"{' and '.join(_KEYS)} of every frame",
                fix="Pass coordinates=camera for the motion before the camera.",
            ) from error  # fmt: skip
    return Rotation.from_matrix(turns), places
