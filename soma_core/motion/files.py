"""Files of motions: which layout a file has, motions on this skeleton read and written, where results go."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from soma_core.choices import LengthUnit, Product, RotationLayout
from soma_core.errors import InputError, SomaError
from soma_core.io.data_files import DATA_SUFFIXES, open_data
from soma_core.io.gem_x import gem_x_parts, gem_x_result
from soma_core.io.joint_order import other_sides
from soma_core.io.json_frames import holds_pose_frames
from soma_core.io.motion import Convention, Motion
from soma_core.io.motion_files import read_motion, write_motion
from soma_core.io.npz_fields import open_npz
from soma_core.io.sam3d import SAM3D_SUFFIXES
from soma_core.io.skeleton_files import SKELETON_SUFFIXES
from soma_core.io.smpl_bodies import shown_names
from soma_core.io.smpl_files import smpl_layout
from soma_core.motion.writers import WRITERS
from soma_core.parquet_file import look_through
from soma_core.paths import expanded, fitting
from soma_core.plugin.declaration import motion_problem
from soma_core.plugin.errors import PluginError
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import ModelMotion
from soma_core.rig import load_canonical
from soma_core.topology.frames import METRES

__all__ = [
    "SUFFIXES",
    "Layout",
    "ResultFiles",
    "fingerprint",
    "layout_of",
    "motion_suffixes",
    "no_motion",
    "read",
    "read_model_motion",
    "turn_settings",
    "write",
]

Layout = Literal["soma", "kimodo", "amass", "smpl", "sam3d", "skeleton"]

SUFFIXES = tuple(dict.fromkeys((*DATA_SUFFIXES, *SAM3D_SUFFIXES, *SKELETON_SUFFIXES)))
"""Files that may hold a motion."""


@dataclass(frozen=True, kw_only=True)
class ResultFiles:
    """Where results go: motions, reports and what shows how good a fit is.

    Other products go into `folder`, or for the file `name` of a folder into ``folder/PRODUCT/name``.
    """

    folder: Path
    name: str | None = None
    motion: Path
    frames: Path
    report: Path
    picture: Path

    @classmethod
    def of_folder(cls, folder: Path) -> ResultFiles:
        """The usual names in a folder of their own."""
        return cls(
            folder=folder,
            motion=folder / "motion.npz",
            frames=folder / "frames.npz",
            report=folder / "report.json",
            picture=folder / "errors.png",
        )

    @classmethod
    def mirrored(cls, folder: Path, name: str) -> ResultFiles:
        """Those of the file `name` of a folder: ``motions``, ``reports`` and so on mirror it.

        A name that leaves no room for what is added to it is cut.
        """
        name = fitting(name)
        if not name.lower().endswith(".npz"):
            name = f"{name}.npz"
        report = folder / "reports" / name
        return cls(
            folder=folder,
            name=name[:-4],
            motion=folder / "motions" / name,
            frames=report.with_suffix(".frames.npz"),
            report=report.with_suffix(".json"),
            picture=report.with_suffix(".png"),
        )

    def product(self, product: Product) -> Path:
        """Where a product goes."""
        file = Path(WRITERS[product].file)
        return self.folder / file if self.name is None else self.folder / product / (self.name + file.suffix)


def motion_suffixes() -> tuple[str, ...]:
    """Suffixes of files that may hold a motion, of those that plugins read too."""
    formats = [each for _, each in default_registry().motion_formats().values() if each.read is not None]
    return tuple(dict.fromkeys((*SUFFIXES, *(suffix for each in formats for suffix in each.suffixes))))


def layout_of(path: str | Path) -> Layout | str | None:
    """Which motion a file holds, told by its keys; None where it holds none.

    What the core does not know may be of a format that a plugin names.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or not what its suffix says.
    """
    path = expanded(path)
    if path.is_dir():
        return "smpl" if holds_pose_frames(path) else None
    known = path.suffix.lower() in SUFFIXES
    return (_known_layout(path) if known else None) or _plugin_format(path) or _known_layout(path)


def _plugin_format(path: Path) -> str | None:
    """Name of the format of a plugin that a file has."""
    suffix = path.suffix.lower()
    for name, (_, each) in default_registry().motion_formats().items():
        if each.read is not None and suffix in each.suffixes and {*each.keys} <= _keys(path, each.keys):
            return name
    return None


def read_model_motion(path: Path, layout: str) -> tuple[str, ModelMotion]:
    """A file of a plugin's format: the backend, and the motion that the plugin reads.

    Raises:
        SomaError: the plugin refuses the file.
        BackendError: it fails, or what it gives is no motion.
    """
    name, form = default_registry().motion_formats()[layout]
    assert form.read is not None
    try:
        motion = form.read(path)
    except Exception as error:
        if isinstance(error, SomaError):
            raise
        with default_registry().isolated(name, "hooks"):
            raise
    with default_registry().isolated(name, "hooks"):
        problem = motion_problem(motion)
        if problem is not None:
            raise PluginError(f"motion format {layout}: {problem}")
    return name, motion


def _keys(path: Path, wanted: tuple[str, ...]) -> set[str]:
    """Names that a file holds, where any are wanted of it."""
    if not wanted or path.suffix.lower() not in DATA_SUFFIXES:
        return set()
    with open_data(path) as file:
        return {str(name) for name in file.content} if isinstance(file.content, dict) else set()


def _known_layout(path: Path) -> Layout | None:
    """The layout of those that the core knows."""
    suffix = path.suffix.lower()
    if suffix == ".parquet":
        look_through(path)
        return "sam3d"
    if suffix in SKELETON_SUFFIXES:
        return "skeleton"
    if suffix in DATA_SUFFIXES and suffix != ".npz":
        with open_data(path) as file:
            if gem_x_result(file) is not None:
                return "soma"
        return smpl_layout(path)
    with open_npz(path) as fields:
        if "global_rot_mats" in fields or "local_rot_mats" in fields:
            return "kimodo"
        if "pred_vertices" in fields:
            return "sam3d"
        if "schema_version" in fields or gem_x_parts(fields) is not None:
            return "soma"
        soma = {"poses", "transl"} <= {*fields.names}
    return smpl_layout(path, readable=soma) or ("soma" if soma else None)


_POSE_KEY = re.compile(
    r"(^|_)(full)?poses?(_|$)|orient|thetas?$|rot_?mats?|quat|axis_?angle|rotvec|(^|_)joints(_3d|_pos|$)|smpl",
    re.IGNORECASE,
)
_CAMERA_KEY = re.compile(r"(^|_)cam", re.IGNORECASE)
_WANTED = (
    "poses, or root_orient and pose_body, beside trans (AMASS); global_orient and body_pose beside transl "
    "(SMPL-X and video estimators); pred_vertices (SAM 3D Body); "
    "local_rot_mats or global_rot_mats (kimodo); or poses beside transl (SOMA)"
)


def no_motion(path: Path) -> tuple[InputError, bool]:
    """Why a file of no known layout is none, by its keys; and whether they are those of poses all the same.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or not what its suffix says.
    """
    with open_data(path) as file:
        top = file.content if isinstance(file.content, dict) else {}
        names, shown = [str(name) for name in top], shown_names(file)
    if path.suffix.lower() == ".npz":
        shown = ", ".join(names)
    array = not names and shown.strip().startswith("(")  # a shape without a name
    vertices = array or any(name == "vertices" or name.endswith("_vertices") for name in names)
    takes = "vertices over time are what soma invert input=FILE takes; points, what points=NAME is for"
    return InputError(
        str(path),
        got=f"one array {shown.strip()}" if array else f"the keys {shown or '(none)'}",
        expected=_WANTED,
        fix=f"{takes[0].upper()}{takes[1:]}." if vertices else f"Rename the keys in it; {takes}.",
    ), any(_POSE_KEY.search(name) and not _CAMERA_KEY.search(name) for name in names)


def read(
    path: str | Path,
    *,
    fps: float | None = None,
    unit: LengthUnit | str | None = None,
    person: str | None = None,
    angles: Literal["rad", "deg"] | None = None,
    convention: Convention | None = None,
    rotation_layout: RotationLayout | str | None = None,
    swap_sides: bool = False,
) -> Motion:
    """Read a motion on this skeleton: a file of this project, of the SOMA tools or of kimodo.

    Args:
        path: the file. What other skeletons move in is for :func:`convert`.
        fps: frame rate, where the file has none.
        unit: ``m``, ``cm`` or ``mm``; overrides the file's own.
        person: which of the samples of kimodo or the people of GEM-X, from ``0``.
        angles: unit of rotation vectors; None for radians.
        convention: what zero means; overrides the file's own.
        rotation_layout: ``columns`` where matrices are stored column by column; None for ``rows``.
        swap_sides: whether what the file calls left is right.

    Raises:
        AssetError: the file is missing, damaged, a git-LFS pointer or no NPZ.
        InputError: the layout is unknown, or a key is missing or holds what a motion cannot have.
    """
    if unit is not None and str(unit) not in METRES:
        raise InputError(
            "unit", got=repr(unit), expected=f"one of {', '.join(METRES)}", fix="Correct the name."
        )
    name = None if unit is None else str(unit)
    if rotation_layout is not None and rotation_layout not in ("rows", "columns"):
        raise InputError(
            "rotation_layout", got=str(rotation_layout), expected="rows or columns, of matrices",
            fix="Leave rotation_layout out.",
        )  # fmt: skip
    motion = read_motion(
        path, fps=fps, unit=name, angles=angles, convention=convention, person=person,
        columns=rotation_layout == "columns",
    )  # fmt: skip
    return _with_sides_swapped(motion) if swap_sides else motion


def turn_settings(layout: str) -> tuple[str, ...]:
    """Settings of :func:`read` that read the rotations of a layout otherwise."""
    return ("rotation_layout", "swap_sides", *(("convention",) if layout == "soma" else ()))


def _with_sides_swapped(motion: Motion) -> Motion:
    """A motion whose joints of the left are those that it calls right; nothing is mirrored."""
    other = other_sides(motion.joint_names)
    return replace(
        motion,
        rotations=motion.rotations[:, other],
        contacts=None if motion.contacts is None else motion.contacts[:, [2, 3, 0, 1]],
        skeleton=None if motion.skeleton is None else motion.skeleton[other],
    )


def write(motion: Motion, path: str | Path) -> None:
    """Write a motion in this project's schema, atomically; the SOMA tools read it as well.

    Args:
        motion: what to write; metres, +Y up.
        path: the NPZ file. :func:`write_bvh` and :func:`write_body` write others.

    Raises:
        InputError: another suffix, other joints than the 77 user joints in order, or a matrix is no rotation.
    """
    if Path(path).suffix != ".npz":
        others = "write_bvh and write_body of soma_core.motion write BVH, GLB, USD and HTML"
        raise InputError("path", got=repr(Path(path).name), expected=".npz", fix=f"Name it so; {others}.")
    write_motion(motion, path, joint_orient=load_canonical("mid")[1].t_pose_world[1:, :3, :3])


def fingerprint(path: Path) -> str:
    """Names, sizes and times of change of a file, or of each file in a folder."""
    digest = hashlib.sha256()
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        state = file.stat()
        digest.update(f"{file.name} {state.st_size} {state.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]
