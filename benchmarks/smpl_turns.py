"""Converted motions of SMPL stand-ins against the turns of their files: ``python benchmarks/smpl_turns.py``.

The stand-ins' skin is this rig's own under plain skinning, with pose blend shapes that are noise: see
``tests/standins``. Motions are the shipped one and those given as arguments, such as kimodo's.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent.parent))

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


def _model(root: Path, noise: float) -> None:
    """A stand-in of SMPL-H whose blend shapes are that many times as large."""
    from soma_backend_smpl import smplh

    os.environ |= {"SOMA_DATA_DIR": str(root), "SOMA_CACHE_DIR": str(root / "cache")}
    arrays = smpl_files.smpl_arrays("smplh", width=16)
    arrays["posedirs"] = noise * arrays["posedirs"]
    smplh.soma_convert(smpl_files.write_npz(root / "official/neutral/model.npz", arrays), None)
    smpl_files.write_smpl_wrap(root, "smplh")


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


def main() -> None:
    """Print a row for each fit."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("motions", type=Path, nargs="*")
    files: list[Path | None] = [None, *options.parse_args().motions]
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
