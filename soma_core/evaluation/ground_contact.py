"""Feet of played motions: how far they slide and hover while they stand, on bodies of other sizes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig

from soma_core.errors import AssetError
from soma_core.evaluation.report import Figure, Report, Table
from soma_core.io.joint_order import CONTACT_JOINTS, USER_JOINTS, nearest_ancestors
from soma_core.io.motion import Motion
from soma_core.layer import SomaLayer
from soma_core.motion.animated import animate
from soma_core.motion.conversion import load_clip
from soma_core.motion.ground import leg_length, rest_offsets
from soma_core.skeleton.identity import Identity

__all__ = ["motion_files", "recorded_joints", "run", "slide_of"]

_AGES = {"infant": 0.0, "adult": 2 / 3, "elder": 1.0}
_NATIVE = "native"
"""Bodies: those of a backend with an age, and the mean of the native shape space."""

_MOST_SLIDE = 1.1
"""Slide over that of the body that was recorded, scaled by the legs."""

_STILL_MM = 3.0
"""A slide below this [mm/s], a tenth of a millimetre a frame, is none: its ratio is held to no bound."""

_MOST_HOVER_MM = 8.0
"""Median distance of soles that stand from the floor."""

_VARIABLE = "SOMA_TEST_DATA"
_MM = 1e3


@dataclass(frozen=True, kw_only=True, eq=False)
class _Clip:
    """A motion, which of its feet stand, how far these slide on the recorded body, and its legs [m]."""

    name: str
    motion: Motion
    contacts: np.ndarray
    slide: float
    leg: float


def slide_of(joints: np.ndarray, contacts: np.ndarray, fps: float) -> float:
    """Mean level speed [m/s] of heels and toes (frames, 4, 3) in contact (frames, 4); 0 without any."""
    both = contacts[1:] & contacts[:-1]
    speeds = fps * np.linalg.norm(np.diff(joints[..., [0, 2]], axis=0), axis=-1)
    return float(speeds[both].mean()) if both.any() else 0.0


def recorded_joints(motion: Motion, offsets: np.ndarray) -> np.ndarray:
    """Places (frames, 4, 3) [m] of ``CONTACT_JOINTS`` of a T-pose-relative motion on a skeleton (77, 3)."""
    above = nearest_ancestors(USER_JOINTS)

    def placed(joint: int) -> tuple[np.ndarray, np.ndarray]:
        own = motion.rotations[:, joint].astype(np.float64)
        if above[joint] < 0:
            return own, motion.translation.astype(np.float64)
        turned, place = placed(above[joint])
        return turned @ own, place + turned @ offsets[joint].astype(np.float64)

    return np.stack([placed(USER_JOINTS.index(name))[1] for name in CONTACT_JOINTS], axis=1)


def motion_files(data: str | None) -> list[Path]:
    """Motion files of a setting; none where there is neither that nor the folder of the environment."""
    usual = Path(os.environ.get(_VARIABLE, "")) / "motions"
    if data is None:
        return sorted(usual.glob("*.npz")) if os.environ.get(_VARIABLE) else []
    path = Path(data).expanduser()
    files = sorted(path.glob("*.npz")) if path.is_dir() else [path]
    if not files:
        fix = "Pass experiment.data=FOLDER, or leave it out for the clip that ships with the project."
        raise AssetError(path, cause="no motion files (*.npz) in the folder", fix=fix)
    return files


def _clips(files: list[Path], layer: SomaLayer) -> Iterator[_Clip]:
    """Each file; contacts that it does not tell are found on the native body, and bones are the rig's."""
    for file in files if files else [None]:
        motion = load_clip(file)
        contacts = motion.contacts
        if contacts is None:
            contacts = animate(layer, layer.identity({}), motion).contacts
        assert contacts is not None
        offsets, leg = motion.skeleton, leg_length(motion.skeleton)
        if offsets is None or leg is None:
            offsets = rest_offsets(layer.rig, layer.rig.bind_world)
            leg = leg_length(offsets)
        assert leg is not None
        slide = slide_of(recorded_joints(motion, offsets), contacts, motion.fps)
        name = file.stem if file else "range of motion"
        yield _Clip(name=name, motion=motion, contacts=contacts, slide=slide, leg=leg)


def _measured(layer: SomaLayer, identity: Identity, clip: _Clip, lock: str) -> tuple[float, float, float]:
    """Slide [mm/s], the same of the recorded body at this size, and median hover [mm]."""
    played = animate(layer, identity, replace(clip.motion, contacts=clip.contacts), contacts=lock)
    assert played.feet is not None
    slide = slide_of(played.feet.joints, clip.contacts, clip.motion.fps)
    own = leg_length(played.motion.skeleton)
    assert own is not None
    scale = own / clip.leg
    hover = np.median(np.abs(played.feet.soles[clip.contacts])) if clip.contacts.any() else 0.0
    return _MM * slide, _MM * scale * clip.slide, _MM * float(hover)


def _bodies(backend: str, native: SomaLayer, device: str) -> Iterator[tuple[str, SomaLayer, Identity]]:
    """The bodies that are measured."""
    layer = native if backend == native.backend else SomaLayer(backend, device=device)
    if any(parameter.name == "age" for parameter in layer.spec.params):
        for name, age in _AGES.items():
            yield name, layer, layer.identity({"age": age})
    elif layer is not native:
        yield backend, layer, layer.identity({})
    yield _NATIVE, native, native.identity({})


def _figures(label: str, slide: float, own: float, hover: float) -> list[Figure]:
    most = _MOST_SLIDE if slide > _STILL_MM else None
    return [
        Figure(name=f"slide over the file's own, {label}", value=slide / max(own, 1e-9), bound=most),
        Figure(name=f"median hover, {label}", value=hover, unit="mm", bound=_MOST_HOVER_MM),
    ]


@torch.no_grad()
def run(config: DictConfig) -> Report:
    """Play motions on an infant, an adult, an elder and the native body, as shipped and with locked feet.

    Raises:
        SomaError: a motion or the backend cannot be used.
    """
    native = SomaLayer("soma", device=config.device)
    clips = list(_clips(motion_files(config.experiment.data), native))
    rows: list[list[str | float]] = []
    figures: list[Figure] = []
    for name, layer, identity in _bodies(config.experiment.backend, native, config.device):
        for clip in clips:
            slide, own, hover = _measured(layer, identity, clip, "free")
            locked, _, _ = _measured(layer, identity, clip, "lock")
            rows.append([f"{clip.name}, {name}", own, slide, locked, hover])
            figures += _figures(f"{clip.name}, {name}", slide, own, hover)
    columns = (
        "motion, body", "the file's own slide at this size, mm/s", "slide, mm/s",
        "slide with contacts=lock, mm/s", "median hover, mm",
    )  # fmt: skip
    table = Table(title="Heels and toes in contact", columns=columns, rows=rows)
    notes = [
        "Slide is the mean level speed of the joints of heels and toes in contact; the file's own is that of "
        "its skeleton, scaled by the length of the legs. Hover is how far the lowest skin there is from the "
        "floor."
    ]
    return Report(title="Feet on the ground", figures=figures, tables=[table], notes=notes)
