"""A motion played on one identity: posed bodies that stand where they should."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from soma_core.errors import InputError
from soma_core.io.motion import Motion
from soma_core.io.motion_files import check_rig
from soma_core.layer import SomaLayer
from soma_core.motion.files import read
from soma_core.motion.questions import Names, of_motion, say
from soma_core.options import FrameRange, LengthUnit
from soma_core.paths import assets_dir, expanded
from soma_core.progress import progress

if TYPE_CHECKING:
    from soma_core.animation.posed import Posed
    from soma_core.skeleton.identity import Identity

__all__ = ["Animated", "animate", "load_clip"]

_log = logging.getLogger(__name__)

_CHUNK = 64
"""Frames posed at once: 18,056 vertices of 64 frames in float32 are 14 MB."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Animated:
    """A motion on one identity.

    Attributes:
        motion: the motion with the translation that was used.
        transforms: (frames, J, 4, 4) float32 world transforms [m].
        helpers: (frames, H, 4, 4) float32 world transforms of the twist joints [m]; H = 0 without them.
        vertices: frame -> posed vertices (v, 3) [m], for the frames asked for.
    """

    motion: Motion
    transforms: np.ndarray
    helpers: np.ndarray
    vertices: Mapping[int, np.ndarray]


def load_clip(
    path: str | Path | None = None,
    *,
    fps: float | None = None,
    unit: LengthUnit | str | None = None,
    frames: FrameRange | None = None,
) -> Motion:
    """Some frames of a motion file.

    Args:
        path: a motion on this skeleton; None for the clip that ships with the project.
        fps: frame rate, where the file has none.
        unit: ``m``, ``cm`` or ``mm``, where the file does not say or is wrong.
        frames: which; None for all.

    Raises:
        SomaError: the file cannot be read.
        InputError: no frame is left.
    """
    path = expanded(path) if path else assets_dir() / "motions/range_of_motion.npz"
    motion, frames = read(path, fps=fps, unit=unit), frames or FrameRange()
    say(path.name, of_motion(motion, Names(unit="motion_unit", fps="motion_fps", ups=())))
    part = slice(frames.start, frames.stop, frames.step)
    if part.step < 1 or not len(range(motion.frame_count)[part]):
        raise InputError(
            "frames",
            got=f"start={part.start}, stop={part.stop}, step={part.step}",
            expected=f"a step of at least 1 and a range inside the {motion.frame_count} frames",
            fix="Give frames.start, frames.stop and frames.step inside the motion.",
        )
    return replace(
        motion,
        rotations=motion.rotations[part],
        translation=motion.translation[part],
        fps=motion.fps / part.step,
    )


def animate(
    layer: SomaLayer,
    identity: Identity,
    motion: Motion,
    *,
    translation: str = "ground",
    keep: list[int] | None = None,
) -> Animated:
    """Pose one identity by every frame of a motion.

    Args:
        layer: the forward path.
        identity: one identity.
        motion: rotations and Hips positions [m].
        translation: ``ground`` scales the Hips path by the length of the legs and puts the lowest vertex
            of the clip on y = 0; ``motion`` takes it as recorded; ``none`` leaves Hips where the identity
            rests and puts the lowest vertex on y = 0.
        keep: frames whose vertices are returned.

    Raises:
        InputError: absolute rotations that were made for another rig; a frame to keep that there is not.
    """
    if not check_rig(motion, layer.rig.revision):
        _log.info("the motion was made for rig %s; its relative rotations carry over", motion.rig_revision)
    path = _hips_path(layer, identity, motion, translation)
    transforms, helpers, vertices, lowest = [], [], {}, np.inf
    wanted = set(keep or ())
    if not wanted <= set(range(motion.frame_count)):
        raise InputError(
            "keep",
            got=keep,
            expected=f"frames from 0 to {motion.frame_count - 1}",
            fix="Correct the numbers.",
        )
    for start, posed in _posed_chunks(layer, identity, motion, path):
        transforms.append(posed.transforms.cpu().numpy())
        helpers.append(layer.helper_transforms(identity, posed.transforms).cpu().numpy())
        lowest = min(lowest, float(posed.vertices[..., 1].min()))
        for frame in wanted & set(range(start, start + len(posed.vertices))):
            vertices[frame] = posed.vertices[frame - start].cpu().numpy().copy()
    shift = np.array([0, 0 if translation == "motion" else -lowest, 0], np.float32)
    world, carried = np.concatenate(transforms), np.concatenate(helpers)
    world[:, 1:, :3, 3] += shift  # Root, which is virtual, stays at the origin
    carried[..., :3, 3] += shift
    return Animated(
        motion=replace(motion, translation=path + shift, rig_revision=layer.rig.revision),
        transforms=world,
        helpers=carried,
        vertices={frame: vertices[frame] + shift for frame in sorted(vertices)},
    )


def _posed_chunks(
    layer: SomaLayer, identity: Identity, motion: Motion, path: np.ndarray
) -> Iterator[tuple[int, Posed]]:
    """First frame and posed body of each chunk."""
    absolute = motion.convention == "absolute_local"
    starts = range(0, motion.frame_count, _CHUNK)
    shown = (
        progress(starts, label="posing", total=len(starts), lines=4, after=5.0) if len(starts) > 1 else starts
    )
    for start in shown:
        part = slice(start, start + _CHUNK)
        rotations = torch.as_tensor(motion.rotations[part], dtype=layer.dtype, device=layer.device)
        hips = torch.as_tensor(path[part], dtype=layer.dtype, device=layer.device)
        yield start, layer.pose(identity, rotations, hips, absolute=absolute)


def _leg_length(world: np.ndarray, names: tuple[str, ...]) -> float:
    """Mean length of thigh and shin together [m]."""
    place = {name: world[index, :3, 3] for index, name in enumerate(names)}
    chains = [
        (f"{side}{a}", f"{side}{b}")
        for side in ("Left", "Right")
        for a, b in (("Leg", "Shin"), ("Shin", "Foot"))
    ]
    return float(sum(np.linalg.norm(place[a] - place[b]) for a, b in chains) / 2)


def _hips_path(layer: SomaLayer, identity: Identity, motion: Motion, translation: str) -> np.ndarray:
    """Hips positions [m] before the body is put on the ground, (frames, 3) float32."""
    if translation == "motion":
        return motion.translation
    bind = identity.bind_world[0].detach().cpu().double().numpy()
    names = layer.rig.joint_names
    if translation == "none":
        hips = bind[names.index("Hips"), :3, 3].astype(np.float32)
        return np.tile(hips, (motion.frame_count, 1))
    if translation != "ground":
        raise InputError(
            "translation",
            got=repr(translation),
            expected="'ground', 'motion' or 'none'",
            fix="Choose where the body stands.",
        )
    ratio = _leg_length(bind, names) / _leg_length(layer.rig.bind_world, names)
    return (motion.translation * ratio).astype(np.float32)
