"""A backend's own posed meshes as the teacher of correctives (paper, section 3.5.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.cache import content_key
from soma_core.correctives.bind_body import BindBody, pulled_back
from soma_core.correctives.model import skeleton_length
from soma_core.correctives.teacher import Clip, Lesson
from soma_core.errors import InputError
from soma_core.inversion import PoseInversion
from soma_core.layer import SomaLayer
from soma_core.native import NativeFit
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.spec import HasPosed, HasRandomPoses, HasSkinning
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = ["PosedTeacher"]

_VERSION = 1  # raise when lessons come out differently


class PosedTeacher:
    """Lessons from a backend whose generator offers ``posed()``: any model's own skin, such as MHR's.

    The default body is posed by the native model, its mesh brought over by the topology transfer, and the
    pose found by inversion; what twist skinning by that pose leaves over is the lesson. Poses are the
    model's own random ones where it offers them, else those of the clip, fitted to the native skeleton.

    Args:
        backend: its name.
        canonical: mesh and rig; default: the shipped ones.
        registry: where backends are looked up.

    Raises:
        InputError: the generator has no posed(), or no way to be posed.
        BackendError: no such backend, or not usable.
    """

    def __init__(
        self,
        backend: str,
        *,
        canonical: tuple[CanonicalMesh, Rig] | None = None,
        registry: Registry | None = None,
    ) -> None:
        registry = registry or default_registry()
        kind: dict[str, Any] = {"device": torch.device("cpu"), "dtype": torch.float32}
        generator = registry.generator(backend, **kind)
        if not isinstance(generator, HasPosed) or not isinstance(generator, HasRandomPoses | HasSkinning):
            raise InputError(
                "teacher",
                got=f"{backend}, whose generator offers no posed meshes",
                expected="elastic, or a backend with posed(), and random_poses() or skinning()",
                fix="Use teacher=elastic.",
            )
        self.name, self._generator = backend, generator
        self._layer = SomaLayer(backend, correctives=None, canonical=canonical, registry=registry)
        self._identity = self._layer.identity()
        self._inversion = PoseInversion(self._layer, skinning="full")
        self._fit = None
        if not isinstance(generator, HasRandomPoses):
            self._fit = NativeFit(backend, registry=registry)
        rig = self._layer.rig
        self._body = BindBody(rig, self._identity)
        own, standard = self._body.identity.bind_world, torch.as_tensor(rig.bind_world.copy())[None]
        self._size = float(skeleton_length(own, rig) / skeleton_length(standard, rig))
        rest = self._identity.rest.numpy()
        self.key = content_key(_VERSION, backend, rest, self._body.weights.data, rig.revision)
        spec = self._layer.spec
        self.provenance: Mapping[str, Any] = {"teacher": backend, "licence": spec.licence, "url": spec.url}

    @torch.no_grad()
    def teach(self, clip: Clip) -> Lesson:
        """See :class:`~soma_core.correctives.teacher.Teacher`."""
        shown = self._inversion.canonical(self._native(clip), "native")
        found = self._inversion(shown, self._identity)
        rotations = found.rotations[found.valid].double()
        wanted = shown[found.valid].double() - found.translation[found.valid].double()[:, None]
        hips = self._body.identity.bind_world[:, 1, :3, 3]
        transforms = self._body.transforms(rotations)
        moved = wanted + hips - self._body.skin(transforms)
        offsets = pulled_back(moved, self._body.blended(transforms)) / self._size
        return Lesson(rotations=rotations.numpy(), offsets=offsets.float().numpy())

    def _native(self, clip: Clip) -> Tensor:
        """Posed native vertices, native unit and axes."""
        generator = self._generator
        params = self._identity.params
        if isinstance(generator, HasRandomPoses):
            return generator.posed(params, generator.random_poses(len(clip.rotations), clip.seed))
        assert self._fit is not None
        rotations = torch.as_tensor(np.asarray(clip.rotations, np.float32))
        motion = self._fit(self._layer.pose(self._identity, rotations).vertices, params=params)
        return motion.vertices
