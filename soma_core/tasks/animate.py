"""Animate a body: one identity posed by a motion, written as NPZ, UsdSkel, GLB and a contact sheet."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from omegaconf import OmegaConf

from soma_core.errors import InputError
from soma_core.io.clip import skinned_clip
from soma_core.io.gltf import write_gltf
from soma_core.io.usd import write_usd
from soma_core.motion.animated import Animated, animate, load_clip
from soma_core.motion.files import write
from soma_core.motion.identities import backend_of, stored_identity
from soma_core.motion.models import open_layer
from soma_core.motion.questions import of_params, say
from soma_core.view.picture import backend_colour, contact_sheet
from soma_core.view.stage import Body

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from soma_core.config.schema import AnimateConfig
    from soma_core.io.motion import Motion
    from soma_core.layer import SomaLayer
    from soma_core.skeleton.identity import Identity

__all__ = ["run"]

_log = logging.getLogger(__name__)


def run(config: DictConfig, output: Path) -> None:
    """Write what ``config.write`` names into `output`: motion.npz, body.usdc, body.glb, contact_sheet.png.

    With ``backends=all`` the folder holds gallery.png instead: identities of every installed backend in
    one pose.

    Raises:
        SomaError: the backend, its parameters or the motion cannot be used.
    """
    options: AnimateConfig = OmegaConf.to_object(config)
    if options.backends == "all":
        from soma_core.tasks.gallery import draw_gallery

        draw_gallery(options, output / "gallery.png")
        return
    motion = load_clip(
        options.motion, fps=options.motion_fps, unit=options.motion_unit, frames=options.frames
    )
    kept, chosen = options.identity_from == "motion", options.backend
    if kept and chosen.params:
        key, value = next(iter(chosen.params.items()))
        raise InputError(
            f"backend.params.{key}", got=value, expected="none with identity_from=motion",
            fix=f"Leave backend.params.{key} out, or identity_from=motion.",
        )  # fmt: skip
    name, own = chosen.name, chosen.options
    if kept:
        name, own = backend_of(motion), {**motion.identity.get("options", {}), **own}
    layer = open_layer(options, name, own)
    stored = dict(motion.identity) if kept else {"backend": layer.backend, "params": chosen.params}
    _log.info("%s: %d frames at %g fps", motion.source, motion.frame_count, motion.fps)
    say(
        layer.backend,
        of_params(layer.spec, stored.get("params", {}), setting="" if kept else "backend.params."),
    )
    with torch.no_grad():
        identity = stored_identity(layer, stored)
        shown = _shown_frames(motion.frame_count, options.picture.frames)
        result = animate(layer, identity, motion, translation=str(options.translation), keep=shown)
    motion = replace(result.motion, identity=stored)
    _write(options, output, layer, identity, replace(result, motion=motion))


def _shown_frames(frame_count: int, count: int) -> list[int]:
    """Middles of `count` equal parts of the clip: both its ends are often the same pose."""
    return np.unique((np.arange(count) + 0.5) * frame_count / count).astype(int).tolist()


def _write(
    options: AnimateConfig, output: Path, layer: SomaLayer, identity: Identity, result: Animated
) -> None:
    """Write the files that the configuration asks for."""
    products = {str(product) for product in options.write}
    motion = result.motion
    if "npz" in products:
        write(motion, output / "motion.npz")
    if products & {"usd", "glb"}:
        clip = skinned_clip(
            layer.mesh,
            layer.rig,
            identity,
            result.transforms,
            fps=motion.fps,
            helpers=result.helpers if layer.procedural else None,
            colour=backend_colour(layer.backend),
            metadata=_metadata(layer, motion),
        )
        if "usd" in products:
            write_usd(output / "body.usdc", clip)
        if "glb" in products:
            write_gltf(output / "body.glb", clip)
    if "png" in products:
        bodies = [
            Body(
                vertices=vertices,
                triangles=layer.mesh.triangles,
                colour=backend_colour(layer.backend),
                caption=f"{frame / motion.fps:.2f} s",
            )
            for frame, vertices in result.vertices.items()
        ]
        contact_sheet(output / "contact_sheet.png", bodies, width=options.picture.width)
    _log.info("wrote %s", ", ".join(sorted(products)) or "nothing")


def _metadata(layer: SomaLayer, motion: Motion) -> dict[str, str]:
    """Texts that travel with the exported body."""
    return {
        "backend": layer.backend,
        "licence": layer.spec.licence,
        "identity": json.dumps(motion.identity.get("params", {}), sort_keys=True, default=float),
        "rig_revision": layer.rig.revision,
        "motion": motion.source,
        "motion_licence": motion.licence,
    }
