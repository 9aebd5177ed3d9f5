"""Converted motions of SMPL stand-ins against the turns of their files: ``python benchmarks/smpl_turns.py``.

The stand-ins' skin is this rig's own under plain skinning, with pose blend shapes that are noise: see
``tests/standins``. Motions are the shipped one and those given as arguments, such as kimodo's. With
``--back`` motions of this skeleton go to each model and back again: vertices, rotations, and how smoothly the
model's own joints turn.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent.parent))

from soma_core import Motion, SomaLayer, read_amass, write_motion
from soma_core.choices import Skinning
from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.skeleton_motion import soma_skeleton
from soma_core.motion import ConvertOptions, FrameRange, convert_file, load_clip
from soma_core.options import InversionChoice, PriorChoice
from soma_core.rig import load_canonical
from tests.standins import smpl_files

_FITS = {
    "auto": (Skinning.auto, 0.0), "plain": (Skinning.plain, 0.0),
    "full, expected=0": (Skinning.full, 0.0), "full": (Skinning.full, 1.0),
}  # fmt: skip
_NOISES = (0.0, 1.0)
_FRAMES, _STEP, _FAR = 24, 3, 30.0
_BODY = ("Arm", "ForeArm", "Hand", "Leg", "Shin", "Foot", "Shoulder")


_BACK = (("smplx", 20, 10), ("smplx", 400, 16), ("smplh", 16, 16))
"""Models of the way there and back: shape directions of the file, and betas of the body."""

_SELECTED, _APART = 16, 5
_GROUPS = {
    "trunk": ("Hips", "Spine1", "Spine2", "Chest"), "neck": ("Neck1", "Neck2", "Head"), "jaw": ("Jaw",),
    "shoulders": ("Shoulder",), "upper arms": ("Arm",), "forearms": ("ForeArm",), "hands": ("Hand",),
    "fingers": tuple(f"Hand{finger}{k}" for finger in ("Thumb", "Index", "Middle", "Ring", "Pinky")
                     for k in (1, 2, 3, 4) if (finger, k) != ("Thumb", 4)),
    "thighs": ("Leg",), "shins": ("Shin",), "feet": ("Foot", "ToeBase"),
}  # fmt: skip


def _model(root: Path, noise: float, name: str = "smplh", width: int = 16) -> None:
    """A stand-in whose blend shapes are that many times as large."""
    from soma_backend_smpl import smplh, smplx

    os.environ |= {"SOMA_DATA_DIR": str(root), "SOMA_CACHE_DIR": str(root / "cache")}
    arrays = smpl_files.smpl_arrays(name, width=width)
    arrays["posedirs"] = noise * arrays["posedirs"]
    module, file = (smplx, "SMPLX_NEUTRAL.npz") if name == "smplx" else (smplh, "neutral/model.npz")
    module.soma_convert(smpl_files.write_npz(root / "official" / file, arrays), None)
    smpl_files.write_smpl_wrap(root, name)


def _write(path: Path, turns: np.ndarray, places: np.ndarray, seed: int, fps: float) -> None:
    """World turns (frames, 77, 3, 3) as a file of AMASS."""
    family = smpl_files.FAMILIES["smplh"]
    own = turns[:, [USER_JOINTS.index(smpl_files._canonical_name(name)) for name in family.joint_names]]
    local = own.copy()
    for joint, parent in enumerate(family.parents):
        if parent >= 0:
            local[:, joint] = np.swapaxes(own[:, parent], -1, -2) @ own[:, joint]
    poses = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(turns), -1)
    betas = np.random.default_rng(seed).normal(size=10)
    np.savez(path, poses=poses, trans=places, betas=betas, gender="neutral", mocap_framerate=fps)


def _degrees(rotations: np.ndarray) -> np.ndarray:
    return np.degrees(Rotation.from_matrix(rotations.reshape(-1, 3, 3)).magnitude()).reshape(
        rotations.shape[:2]
    )


def _joints(*parts: str) -> list[int]:
    return [USER_JOINTS.index(side + part) for side in ("Left", "Right") for part in parts]


def _row(found: list[tuple[np.ndarray, np.ndarray, float]]) -> str:
    """Angles, twists and jumps of all motions of one fit."""
    apart = [_degrees(np.swapaxes(true, -1, -2) @ turns) for true, turns, _ in found]
    angles = np.concatenate(apart)
    arms, twisted = angles[:, _joints("Arm")], angles[:, _joints("Arm", "Leg")].max(1)
    jumps = [np.abs(np.diff(each[:, _joints("Arm", "Leg")], axis=0)).max() for each in apart]
    error = np.mean([error for *_, error in found])
    return (
        f"{angles[:, _joints(*_BODY)].mean():.1f} | {arms.mean():.1f} | {arms.max():.0f} | "
        f"{(twisted > _FAR).sum()} of {len(twisted)} | {max(jumps):.0f} | {error:.2f}"
    )


def _selected(file: Path | None, seed: int) -> Motion:
    """Frames of a motion, a few apart, from a place that the seed draws."""
    clip = load_clip(file)
    start = np.random.default_rng(seed).integers(max(clip.frame_count - _SELECTED * _APART, 1))
    part = clip.cut(slice(int(start), int(start) + _SELECTED * _APART, _APART))
    return replace(part, fps=clip.fps / _APART)


def _steps(local: np.ndarray) -> np.ndarray:
    """Degrees (frames - 1, J) that local rotations turn by from frame to frame."""
    return _degrees(np.swapaxes(local[:-1], -1, -2) @ local[1:])


def _leaps(name: str, file: Path, true: np.ndarray) -> np.ndarray:
    """Degrees by which joints of a file turn further from frame to frame than they do here."""
    family, found = smpl_files.FAMILIES[name], read_amass(file).rotations
    own = true[:, [USER_JOINTS.index(smpl_files._canonical_name(joint)) for joint in family.joint_names]]
    local = np.swapaxes(own[:, np.maximum(family.parents, 0)], -1, -2) @ own
    local[:, 0] = own[:, 0]
    there = Rotation.from_rotvec(found.reshape(-1, 3)).as_matrix().reshape(*found.shape, 3)
    told = [number for number, joint in enumerate(family.joint_names) if "eye" not in joint]
    return (_steps(there) - _steps(local))[:, told]


def _there_and_back(root: Path, name: str, motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (frames, v) [mm] of the skin, (frames, 77) of world turns [degrees], and leaps on the way."""
    write_motion(motion, root / "motion.npz")
    convert_file(root / "motion.npz", root / "there", options=ConvertOptions(to=name, up="y"))
    done = convert_file(root / "there/motion.npz", root / "back", options=ConvertOptions(up="y"))
    layer, rig = SomaLayer(name), load_canonical("mid")[1]
    body = layer.identity(motion.identity["params"])
    with torch.no_grad():
        skins = [
            layer.pose(body, torch.as_tensor(one.rotations), torch.as_tensor(one.translation)).vertices
            for one in (motion, done.motion())
        ]
    seen = np.setdiff1d(np.arange(layer.mesh.vertex_count), layer.mesh.face_interior)
    true, turns = (soma_skeleton(one, rig).turns() for one in (motion, done.motion()))
    return (
        1e3 * (skins[1] - skins[0]).norm(dim=-1)[:, seen].numpy(),
        _degrees(np.swapaxes(true, -1, -2) @ turns),
        _leaps(name, root / "there/motion.npz", true),
    )


def _print_back(files: list[Path | None], seeds: int) -> None:
    """A row for each model and motion, and the angles of all motions of a model."""
    for name, width, count in _BACK:
        angles, leaps, frames = [], [], []
        for number, file in enumerate(files):
            for seed in range(seeds):
                betas = np.random.default_rng(100 * number + seed).normal(size=count).tolist()
                identity = {"backend": name, "params": {"betas": betas}}
                with tempfile.TemporaryDirectory() as where:
                    _model(Path(where), 1.0, name, width)
                    motion = replace(_selected(file, seed), identity=identity)
                    skin, turned, leapt = _there_and_back(Path(where), name, motion)
                angles.append(turned)
                leaps.append(leapt)
                frames.append(skin.mean(1))
                source = "shipped" if file is None else file.stem
                sys.stdout.write(
                    f"| {name}, {count} betas | {source} | {seed} | {skin.mean():.2f} | "
                    f"{skin.mean(1).max():.2f} |\n"
                )
        every, leapt = np.concatenate(angles), np.concatenate([each.ravel() for each in leaps])
        sys.stdout.write(f"{name}: {np.concatenate(frames).mean():.2f} mm; degrees, mean and P95: ")
        told = []
        for group, parts in _GROUPS.items():
            joints = (
                [USER_JOINTS.index(part) for part in parts] if parts[0] in USER_JOINTS else _joints(*parts)
            )
            found = every[:, joints]
            told.append(f"{group} {found.mean():.1f} {np.percentile(found, 95):.1f}")
        sys.stdout.write(
            f"{', '.join(told)}; leaps of its joints beyond the true ones, P95 and largest: "
            f"{np.percentile(leapt, 95):.1f} {leapt.max():.1f}\n"
        )


def main() -> None:
    """Print a row for each fit."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("motions", type=Path, nargs="*")
    options.add_argument("--back", action="store_true", help="to each model and back again")
    options.add_argument("--seeds", type=int, default=2, help="selections of frames and bodies, with --back")
    given = options.parse_args()
    files: list[Path | None] = [None, *given.motions]
    if given.back:
        _print_back(files, given.seeds)
        return
    rows: dict[str, list[tuple[np.ndarray, np.ndarray, float]]] = {name: [] for name in _FITS}
    rig = load_canonical("mid")[1]
    for seed, noise in enumerate(_NOISES):
        with tempfile.TemporaryDirectory() as where:
            root = Path(where)
            _model(root, noise)
            for number, file in enumerate(files):
                clip = load_clip(file, frames=FrameRange(stop=_FRAMES * _STEP, step=_STEP))
                true = soma_skeleton(clip, rig).turns()
                _write(root / f"{number}.npz", true, clip.translation, seed, clip.fps)
                for name, (skinning, expected) in _FITS.items():
                    inversion = InversionChoice(skinning=skinning, priors=PriorChoice(expected=expected))
                    chosen = ConvertOptions(lod="low", up="y", inversion=inversion)
                    done = convert_file(root / f"{number}.npz", root / f"{number} {name}", options=chosen)
                    turns = soma_skeleton(done.motion(), rig).turns()
                    rows[name].append((true, turns, done.error_mm["mean"]))
    for name, found in rows.items():
        sys.stdout.write(f"| {name} | {_row(found)} |\n")


if __name__ == "__main__":
    main()
