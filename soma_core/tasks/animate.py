"""Animate a body: one identity posed by a motion, written as what other programs read."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from omegaconf import OmegaConf

from soma_core.choices import Product
from soma_core.errors import InputError
from soma_core.motion.animated import standing_motion
from soma_core.motion.conversion import load_clip
from soma_core.motion.identities import backend_of, stored_identity
from soma_core.motion.models import open_layer
from soma_core.motion.played import Played, placing_of
from soma_core.motion.products import write_products
from soma_core.motion.questions import of_params, say
from soma_core.motion.writers import WRITERS

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from soma_core.config.schema import AnimateConfig

__all__ = ["run"]

_log = logging.getLogger(__name__)


def run(config: DictConfig, output: Path) -> None:
    """Write what ``config.write`` names into `output`, see ``soma_core.motion.writers``.

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
    options.refuse_unused(options.write)
    motion = load_clip(
        options.motion, fps=options.motion_fps, unit=options.motion_unit, person=options.person,
        frames=options.frames, model=options,
    )  # fmt: skip
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
    stored |= {"options": layer.options} if layer.options else {}
    _log.info("%s: %d frames at %g fps", motion.source, motion.frame_count, motion.fps)
    say(
        layer.backend,
        of_params(layer.spec, stored.get("params", {}), setting="" if kept else "backend.params."),
    )
    with torch.no_grad():
        identity = stored_identity(layer, stored)
        placed = standing_motion(layer, identity, motion, placing_of(options))
    played = Played(layer=layer, identity=identity, motion=replace(placed, identity=stored))
    wanted = [each for each in options.write if each is not Product.png or options.picture.frames]
    written = write_products(
        played, wanted, lambda product: output / WRITERS[product].file,
        options=options, picture=options.picture,
    )  # fmt: skip
    _log.info("wrote %s", ", ".join(place.name for place in written.values()) or "nothing")
