"""What correctives are taught by: a teacher turns clips of poses into offsets of the rest shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from soma_core.correctives.bind_body import pulled_back
from soma_core.correctives.elastic import ElasticSurface
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig

__all__ = ["Clip", "ElasticTeacher", "Lesson", "Teacher"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Clip:
    """Poses that belong together, and stay together when data is split.

    Attributes:
        name: unique; where the poses come from.
        rotations: T-pose-relative (n, J - 1, 3, 3).
        seed: of a teacher that draws poses of its own model instead, as many as there are rotations.
        part_of: name of the longer clip that it is a piece of; empty where it is whole.
    """

    name: str
    rotations: np.ndarray
    seed: int = 0
    part_of: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lesson:
    """What a teacher says about a clip.

    Attributes:
        rotations: (n, J - 1, 3, 3) T-pose-relative; those of the clip, unless the teacher drew its own.
        offsets: (n, v, 3) [m] that the rest shape takes before skinning, on the mid LOD at canonical size.
    """

    rotations: np.ndarray
    offsets: np.ndarray


class Teacher(Protocol):
    """Anything that knows how skin should look.

    Attributes:
        name: ``elastic``, or the backend whose own posed meshes it shows.
        key: changes whenever its lessons would; names cached lessons.
        provenance: what to write into a checkpoint about it.
    """

    name: str
    key: str
    provenance: Mapping[str, Any]

    def teach(self, clip: Clip) -> Lesson:
        """Offsets of every pose of a clip; the same clip, the same lesson."""
        ...


class ElasticTeacher:
    """Offsets that turn twist skinning of the canonical body into the elastic surface's equilibrium.

    Args:
        mesh, rig: the canonical body at the mid LOD.
        surface: default: one of this mesh and rig.
        bones: the default surface has bone under the skin of knees and elbows.
    """

    def __init__(
        self, mesh: CanonicalMesh, rig: Rig, surface: ElasticSurface | None = None, *, bones: bool = False
    ) -> None:
        self.name = "bone" if bones else "elastic"
        self._surface = surface or ElasticSurface(mesh, rig, bones=bones)
        self.key = self._surface.key
        self.provenance: Mapping[str, Any] = {
            "teacher": self.name,
            "surface": self.key,
            "licence": "Apache-2.0",
        }

    def teach(self, clip: Clip) -> Lesson:
        """See :class:`Teacher`."""
        rotations = torch.as_tensor(np.asarray(clip.rotations, np.float64))
        offsets = [self._offsets(part).float().numpy() for part in rotations.split(8)]
        return Lesson(rotations=clip.rotations, offsets=np.concatenate(offsets))

    def _offsets(self, rotations: Tensor) -> Tensor:
        body = self._surface.body
        transforms = body.transforms(rotations)
        moved = self._surface(rotations) - body.skin(transforms)
        return pulled_back(moved, body.blended(transforms))
