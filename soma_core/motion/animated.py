"""A motion played on one identity: posed bodies that stand where they should."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from soma_core._derived import kind_of
from soma_core.choices import Contacts, Ground, Translation
from soma_core.errors import InputError
from soma_core.io.motion import Motion, check_motion
from soma_core.io.motion_files import check_rig
from soma_core.layer import SomaLayer
from soma_core.motion.foot_lock import lock_feet
from soma_core.motion.ground import (
    FootTrack,
    Soles,
    contacts_of,
    leg_length,
    planted_path,
    rest_offsets,
    skeleton_of,
    standing,
)
from soma_core.motion.identities import kept_identity
from soma_core.progress import progress

if TYPE_CHECKING:
    from soma_core.animation.posed import Posed
    from soma_core.skeleton.identity import Identity

__all__ = ["Animated", "animate", "check_playable", "standing_motion"]

_log = logging.getLogger(__name__)

_CHUNK = 64
"""Frames posed at once: 18,056 vertices of 64 frames in float32 are 14 MB."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Animated:
    """A motion on one identity.

    Attributes:
        motion: the motion with the translation that was used, and the identity that was posed.
        transforms: (frames, J, 4, 4) float32 world transforms [m].
        helpers: (frames, H, 4, 4) float32 world transforms of the twist joints [m]; H = 0 without them.
        vertices: frame -> posed vertices (v, 3) [m], for the frames asked for.
        feet: where they are in every frame; None for a rig without feet.
        contacts: (frames, 4) which of them stand, as the file says or as was found; None as `feet`.
    """

    motion: Motion
    transforms: np.ndarray
    helpers: np.ndarray
    vertices: Mapping[int, np.ndarray]
    feet: FootTrack | None = None
    contacts: np.ndarray | None = None


def check_playable(layer: SomaLayer, identity: Identity, motion: Motion) -> None:
    """Refuse (InputError) what is no layer, no identity of it or no motion."""
    kind_of(layer)
    check_motion(motion)
    layer.check_identity(identity)


def animate(
    layer: SomaLayer,
    identity: Identity,
    motion: Motion,
    *,
    translation: str = "ground",
    ground: str | None = None,
    contacts: str = "free",
    keep: list[int] | None = None,
) -> Animated:
    """Pose one identity by every frame of a motion.

    Args:
        layer: the forward path.
        identity: one identity.
        motion: rotations and Hips positions [m].
        translation: ``ground`` scales the Hips path by the length of the legs, against those of the
            motion's own skeleton where it has one, and puts the body on y = 0; ``motion`` takes it as
            recorded; ``none`` leaves Hips where the identity rests and puts the body on y = 0.
        ground: what lies on y = 0: ``contacts``, the soles that stand, whose feet the path then follows;
            ``lowest``, the lowest vertex of the clip; ``none``, nothing is moved. None: ``contacts`` for
            ``translation="ground"``, else ``lowest``.
        contacts: ``free``, or ``lock``: heels and toes in contact stay where they are, by the legs.
        keep: frames whose vertices are returned.

    Raises:
        InputError: absolute rotations that were made for another rig; a frame to keep that there is not;
            a choice that there is not, or that does not go with `translation`.
    """
    check_playable(layer, identity, motion)
    _say_rig(layer, motion)
    ground = _ground_choice(translation, ground, contacts)
    wanted = set(keep or ())
    if not wanted <= set(range(motion.frame_count)):
        raise InputError(
            "keep",
            got=keep,
            expected=f"frames from 0 to {motion.frame_count - 1}",
            fix="Correct the numbers.",
        )
    offsets = skeleton_of(layer.rig, identity)
    path = _hips_path(layer, identity, motion, translation, offsets)
    motion = replace(motion, translation=path)
    played = _played(layer, identity, motion, wanted)
    shift, floor = _standing(played, motion, translation, ground)
    played.move(shift)
    motion = replace(motion, translation=motion.translation + shift.astype(np.float32))
    held = None if played.track is None else contacts_of(played.track, motion, floor)
    if contacts == "lock" and held is not None:
        motion = lock_feet(motion, played.transforms, played.track, held, rig=layer.rig, floor=floor)
        played = _played(layer, identity, motion, wanted)
    kept = {"rig_revision": layer.rig.revision, "skeleton": offsets}
    return Animated(
        motion=replace(motion, identity=kept_identity(layer, identity), **kept),
        transforms=played.transforms,
        helpers=played.helpers,
        vertices={frame: played.vertices[frame] for frame in sorted(played.vertices)},
        feet=played.track,
        contacts=held,
    )


def standing_motion(
    layer: SomaLayer, identity: Identity, motion: Motion, placing: Mapping[str, Any]
) -> Motion:
    """The motion that :func:`animate` gives with the arguments of `placing`.

    No frame is posed where it only keeps the recorded path.
    """
    chosen = {"translation": "ground", "ground": None, "contacts": "free", **placing}
    if (chosen["translation"], _ground_choice(**chosen), chosen["contacts"]) != ("motion", "none", "free"):
        return animate(layer, identity, motion, **placing).motion
    _say_rig(layer, motion)
    return replace(motion, rig_revision=layer.rig.revision, skeleton=skeleton_of(layer.rig, identity))


def _say_rig(layer: SomaLayer, motion: Motion) -> None:
    if not check_rig(motion, layer.rig.revision):
        _log.info("the motion was made for rig %s; its relative rotations carry over", motion.rig_revision)


@dataclass(kw_only=True, eq=False)
class _Played:
    """A motion as it was posed; `track` is None for a rig without feet."""

    transforms: np.ndarray
    helpers: np.ndarray
    vertices: dict[int, np.ndarray]
    lowest: np.ndarray
    track: FootTrack | None

    def move(self, shift: np.ndarray) -> None:
        """Put every body elsewhere, by (frames, 3) [m]."""
        step = shift.astype(np.float32)
        self.transforms[:, 1:, :3, 3] += step[:, None]  # Root, which is virtual, stays at the origin
        self.helpers[..., :3, 3] += step[:, None]
        self.vertices = {frame: vertices + step[frame] for frame, vertices in self.vertices.items()}
        self.lowest = self.lowest + shift[:, 1]
        self.track = self.track.moved(shift) if self.track else None


def _played(layer: SomaLayer, identity: Identity, motion: Motion, wanted: set[int]) -> _Played:
    """Pose every frame; keep the vertices of those that are wanted."""
    soles = Soles(layer.rig)
    transforms, helpers, vertices, lowest, heights = [], [], {}, [], []
    for start, posed in _posed_chunks(layer, identity, motion, motion.translation):
        transforms.append(posed.transforms.cpu().numpy())
        helpers.append(layer.helper_transforms(identity, posed.transforms).cpu().numpy())
        lowest.append(posed.vertices[..., 1].amin(1).cpu().double().numpy())
        heights += [soles.heights(posed.vertices)] if soles.known else []
        for frame in wanted & set(range(start, start + len(posed.vertices))):
            vertices[frame] = posed.vertices[frame - start].cpu().numpy().copy()
    world, low = np.concatenate(transforms), np.concatenate(lowest)
    track = None
    if soles.known:
        track = FootTrack(
            joints=world[:, soles.joints][..., :3, 3].astype(np.float64),
            soles=np.concatenate(heights),
            lowest=low,
            height=float(np.ptp(identity.rest[0, :, 1].detach().cpu().numpy())),
        )
    return _Played(
        transforms=world, helpers=np.concatenate(helpers), vertices=vertices, lowest=low, track=track
    )


def _ground_choice(translation: str, ground: str | None, contacts: str) -> str:
    """What lies on y = 0, for a translation.

    Raises:
        InputError: no such choice, or one that does not go with the translation.
    """
    for name, value, choices in (
        ("translation", translation, Translation),
        ("ground", ground, Ground),
        ("contacts", contacts, Contacts),
    ):
        if value is not None and value not in list(choices):
            expected = " or ".join(map(repr, map(str, choices)))
            raise InputError(name, got=repr(value), expected=expected, fix="Choose where the body stands.")
    if translation == "motion" and ground not in (None, "none"):
        raise InputError(
            "ground", got=ground, expected="none with translation=motion, which keeps the recorded path",
            fix="Pass translation=ground, or leave ground out.",
        )  # fmt: skip
    if translation == "none" and contacts == "lock":
        raise InputError(
            "contacts", got="lock", expected="free with translation=none, where the Hips do not move",
            fix="Pass translation=ground, or leave contacts out.",
        )  # fmt: skip
    usual = {"ground": "contacts", "none": "lowest", "motion": "none"}
    return ground or usual[translation]


def _standing(played: _Played, motion: Motion, translation: str, ground: str) -> tuple[np.ndarray, float]:
    """Shift (frames, 3) [m] that brings the body to where it stands, and the height of the floor then."""
    still, track = np.zeros((motion.frame_count, 3)), played.track
    if ground == "lowest" or (ground == "contacts" and track is None):
        return still - [0, played.lowest.min(), 0], 0.0
    held, floor = standing(track, motion) if track is not None else (None, 0.0)
    if ground == "none" or held is None:
        return still, floor
    path = planted_path(track, held, motion.fps) if translation == "ground" else still
    return path - [0, floor, 0], 0.0


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


def _hips_path(
    layer: SomaLayer, identity: Identity, motion: Motion, translation: str, offsets: np.ndarray
) -> np.ndarray:
    """Hips positions [m] before the body is put on the ground, (frames, 3) float32."""
    if translation == "motion":
        return motion.translation
    rig = layer.rig
    if translation == "none":
        hips = identity.bind_world[0, rig.joint_names.index("Hips"), :3, 3].detach().cpu().numpy()
        return np.tile(hips.astype(np.float32), (motion.frame_count, 1))
    recorded = leg_length(motion.skeleton) or leg_length(rest_offsets(rig, rig.bind_world))
    own = leg_length(offsets)
    ratio = own / recorded if own and recorded else 1.0
    return (motion.translation * ratio).astype(np.float32)
