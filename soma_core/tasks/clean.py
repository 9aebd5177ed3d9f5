"""``soma clean``: a motion without spikes and jitter, at another rate, mirrored; and what that changed."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from soma_core.cache import atomic_text
from soma_core.errors import InputError
from soma_core.motion.cleaning import clean
from soma_core.motion.conversion import load_clip
from soma_core.motion.files import write

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from soma_core.config.schema import CleanConfig

__all__ = ["run"]

_log = logging.getLogger(__name__)

_SHOWN = 4
"""Joints that a line names; the report has all."""


def run(config: DictConfig, output: Path) -> None:
    """Clean the motion of ``config.input``; write motion.npz and report.json.

    Raises:
        SomaError: the motion cannot be read.
    """
    options: CleanConfig = OmegaConf.to_object(config)  # type: ignore[assignment]
    if not options.input:
        raise InputError("input", got="none", expected="a motion file", fix="Pass input=FILE.")
    motion = load_clip(
        options.input, fps=options.motion_fps, unit=options.motion_unit, person=options.person,
        frames=options.frames, model=options,
    )  # fmt: skip
    _log.info("%s: %d frames at %g fps", motion.source, motion.frame_count, motion.fps)
    found = clean(motion, options=options)
    write(found.motion, output / "motion.npz")
    atomic_text(output / "report.json", json.dumps(found.report, indent=2) + "\n")
    for line in _lines(found.report):
        _log.info("%s", line)
    _log.info("wrote motion.npz, report.json")


def _lines(report: dict[str, Any]) -> list[str]:
    """What was done and what came of it."""
    before, after, spikes = report["before"], report["after"], report["spikes"]
    count = sum(map(len, spikes.values()))
    shown = ", ".join([*list(spikes)[:_SHOWN], *(["..."] if len(spikes) > _SHOWN else [])])
    lines = [f"spikes: {count} replaced, of {shown}" if count else "spikes: none replaced"]
    done = report["smoothed"]
    lines.append(f"smoothed by {done['degrees']:.3g} degrees and {done['path_mm']:.3g} mm of path at most")
    if report["fps"]["before"] != report["fps"]["after"]:
        lines.append(f"{report['frames']['after']} frames at {report['fps']['after']:g} fps")
    lines.append(f"jitter: {before['jitter_m_s3']:.3g} m/s^3 before, {after['jitter_m_s3']:.3g} after")
    slides = [state["foot_slide_mm_s"] for state in (before, after)]
    if None not in slides:
        lines.append(f"feet that stand slide at {slides[0]:.3g} mm/s before, {slides[1]:.3g} after")
    ranges = [len(state["joint_range"]) for state in (before, after)]
    lines.append(f"joints beyond their range: {ranges[0]} before, {ranges[1]} after")
    return lines
