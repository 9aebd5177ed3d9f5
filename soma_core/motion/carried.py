"""Motions that come over by their joints: skeletons of other tools, and SMPL's without its model."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from soma_core.io.joint_names import read_mapping
from soma_core.io.skeleton_files import read_skeleton
from soma_core.io.smpl_files import read_smpl
from soma_core.io.smpl_skeleton import smpl_skeleton
from soma_core.motion.bodies import SMPL_LAYOUTS, smpl_choices
from soma_core.motion.options import ConvertOptions
from soma_core.motion.retarget import Retargeted, retarget
from soma_core.options import BoneMatch
from soma_core.rig import load_canonical

__all__ = ["carried"]

_log = logging.getLogger(__name__)

_SHOWN = 12


def carried(path: Path, layout: str, options: ConvertOptions) -> Retargeted:
    """Read the skeleton of a file and carry its motion over to this one.

    Raises:
        SomaError: the file cannot be read, or its joints are not known.
    """
    up, match = options.upward, options.match
    if layout in SMPL_LAYOUTS:
        motion = read_smpl(path, replace(smpl_choices(options), gender="neutral", betas=(0.0,) * 10))
        _log.warning("%s: betas are not read: joints are carried over, no body is fitted", path.name)
        source, up, match = smpl_skeleton(motion, load_canonical("mid")[1]), None, match or BoneMatch.limbs
    else:
        source = read_skeleton(path, fps=options.fps, root=options.root)
    mapping = read_mapping(options.mapping) if options.mapping else None
    found = retarget(
        source,
        mapping=mapping,
        unit=str(options.unit) if options.unit else None,
        up=up,
        match=str(match or BoneMatch.soles),
    )
    left = found.report["not_carried"]
    if left:
        more = " ..." if len(left) > _SHOWN else ""
        _log.info("%s: not carried over: %s%s", path.name, ", ".join(left[:_SHOWN]), more)
    scale = found.report["path_scale"]
    if scale != 1:
        _log.info(
            "%s: its legs are %.3f m; the path is scaled by %.3f to those of the rig, %.3f m",
            path.name,
            found.report["legs_metres"],
            scale,
            scale * found.report["legs_metres"],
        )
    return found
