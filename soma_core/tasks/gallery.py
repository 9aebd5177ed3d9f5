"""Draw identities of every installed backend in one pose (the paper's first figure)."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from soma_core.errors import SomaError
from soma_core.motion.animated import animate
from soma_core.motion.conversion import load_clip
from soma_core.motion.models import open_layer
from soma_core.plugin.errors import BackendError
from soma_core.plugin.registry import default_registry
from soma_core.shape_space.sampling import sample_parameters
from soma_core.view.picture import backend_colour, gallery, with_eyes
from soma_core.view.stage import Body

if TYPE_CHECKING:
    from soma_core.config.schema import AnimateConfig
    from soma_core.io.motion import Motion
    from soma_core.plugin.spec import BackendSpec

__all__ = ["draw_gallery"]

_log = logging.getLogger(__name__)

_IDENTITIES = 3
"""Bodies a backend: its default and two random ones."""

_DEVIATION = 1 / 3
"""Of half the range of a coefficient: one standard deviation where the range is three of them."""

_FIRST, _LATER = 0.7, 1.2
"""Most that a coefficient departs from zero, in standard deviations. The first is size, and bodies of one and
a half are giants that no model has seen."""

_POSE_SECOND = 10.75
"""Second of the shipped clip that shows a pose with depth: a lifted knee, the arms swinging."""


def draw_gallery(options: AnimateConfig, path: Path) -> None:
    """Write one picture with identities of every usable backend in the same pose.

    A backend that does not build is reported and left out.

    Raises:
        SomaError: no backend is usable, or pyvista is not installed.
    """
    motion = load_clip(
        options.motion, fps=options.motion_fps, unit=options.motion_unit, person=options.person,
        frames=options.frames, model=options,
    )  # fmt: skip
    frame = motion.frame_count // 2 if options.motion else round(_POSE_SECOND * motion.fps)
    frame = min(frame, motion.frame_count - 1)
    pose = motion.cut(slice(frame, frame + 1))
    bodies = []
    for name in default_registry().names():
        try:
            bodies += _bodies(name, options, pose)
        except BackendError as error:
            _log.warning("%s", error)
    if not bodies:
        raise SomaError("no backend is usable. Run: soma backends")
    gallery(path, bodies, width=options.picture.width)
    _log.info("wrote %d bodies", len(bodies))


def _random_parameters(spec: BackendSpec, count: int, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw `count` identities that differ visibly in build and stay believable."""
    groups = {parameter.group for parameter in spec.params} - {""}  # hundreds of details: left alone
    drawn = sample_parameters(spec, count, random, spread=_DEVIATION, skip_groups=groups)
    for parameter in spec.params:
        if parameter.name in drawn and parameter.shape and parameter.default == 0:
            low, high = parameter.range
            limits = np.full(parameter.shape, _LATER * _DEVIATION * (high - low) / 2)
            limits.flat[:1] *= _FIRST / _LATER
            drawn[parameter.name] = np.clip(drawn[parameter.name], -limits, limits)
    return drawn


def _bodies(name: str, options: AnimateConfig, pose: Motion) -> list[Body]:
    """The default identity of a backend, then random ones, posed and standing on the floor."""
    layer = open_layer(options, name, {})
    generator = np.random.default_rng(options.seed)
    random = _random_parameters(layer.spec, _IDENTITIES - 1, generator)
    choices = [{}, *({key: rows[i] for key, rows in random.items()} for i in range(_IDENTITIES - 1))]
    found = []
    for params in choices:
        with torch.no_grad():
            identity = layer.identity(params)
            posed = animate(layer, identity, pose, keep=[0])
        height = float(np.ptp(identity.rest[0, :, 1].cpu().numpy()))
        caption = f"{name}\n{height:.2f} m"
        body = Body(
            vertices=posed.vertices[0],
            triangles=layer.mesh.triangles,
            colour=backend_colour(name),
            caption=caption,
        )
        found.append(with_eyes(body, posed.transforms[0], layer.rig))
    return found
