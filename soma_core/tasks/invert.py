"""``soma invert``: the pose of every frame of a moving mesh, with a report and a picture of errors."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import OmegaConf

from soma_core.errors import InputError
from soma_core.motion.converter import invert

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from soma_core.config.schema import InvertConfig

__all__ = ["run"]

_log = logging.getLogger(__name__)


def run(config: DictConfig, output: Path) -> None:
    """Fit every frame of ``config.input``; write motion.npz, frames.npz, report.json and errors.png.

    Raises:
        SomaError: the backend or the input cannot be used, or the fit is none; what there is of it is
            written all the same.
    """
    options: InvertConfig = OmegaConf.to_object(config)
    if not options.input:
        raise InputError(
            "input",
            got="none",
            expected="an .npz or .npy of vertices, a folder of meshes, a .usd or a .glb",
            fix="Pass input=FILE.",
        )
    try:
        invert(options.input, output, options=options)
    except KeyboardInterrupt:
        _log.warning("stopped; the same command with hydra.run.dir=%s goes on from here", output)
        raise
