"""A motion on one body, posed a few frames at a time when a file asks for it."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from soma_core.animation.engine import Body
from soma_core.animation.kinematics import relative_from_absolute
from soma_core.choices import Contacts, Ground, Translation
from soma_core.correctives.shapes import CorrectiveShapes, corrective_shapes
from soma_core.errors import InputError
from soma_core.io.clip import SkinnedClip, skinned_clip, t_pose_world
from soma_core.io.joint_files import JointFrames, JointPiece, chosen_joints
from soma_core.io.motion import Motion
from soma_core.io.vertex_writers import MeshFrames, canonical_frames
from soma_core.layer import SomaLayer
from soma_core.motion.animated import standing_motion
from soma_core.motion.identities import stored_identity
from soma_core.motion.models import open_layer
from soma_core.options import BackendChoice, ModelOptions
from soma_core.skeleton.identity import Identity
from soma_core.topology.frames import native_to_canonical
from soma_core.view.picture import backend_colour

__all__ = ["MovingBodies", "Played", "placing_of"]

_log = logging.getLogger(__name__)

_CHUNK = 64
"""Frames posed at once: 18,056 vertices of 64 frames in float32 are 14 MB."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Played:
    """A motion on one identity, where it stands.

    Attributes:
        layer, identity: whose body moves.
        motion: how; metres, +Y up.
        up: upward axis of the joints and vertices that are given, ``+y`` or ``+z``.
    """

    layer: SomaLayer
    identity: Identity
    motion: Motion
    up: str = "+y"

    @torch.no_grad()
    def posed(self, frames: slice | np.ndarray) -> Tensor:
        """Canonical vertices (F, v, 3) [m] of some frames, +Y up."""
        return self.layer.pose(*self._body(frames), absolute=self._absolute).vertices

    @torch.no_grad()
    def transforms(self, frames: slice | np.ndarray) -> Tensor:
        """World transforms of the joints (F, J, 4, 4) [m], +Y up; no mesh is posed."""
        return self.layer.animation.transforms(Body(*self._body(frames)), absolute=self._absolute)

    def meshes(self) -> MeshFrames:
        """Vertices of all frames, for the writers of meshes."""
        motion = self.motion
        return canonical_frames(
            self.layer.mesh, self._vertex_pieces, frame_count=motion.frame_count, fps=motion.fps, up=self.up,
            source=motion.source,
        )  # fmt: skip

    def joints(self, names: list[str] | None = None) -> JointFrames:
        """Joints of all frames, or some of them by name, for the writers of joints.

        Raises:
            InputError: a name that is no joint's.
        """
        motion, layer = self.motion, self.layer
        places = chosen_joints(names, layer.joint_names)
        bind = self.identity.bind_world[0].detach().cpu().double().numpy()
        rest = t_pose_world(layer.rig, bind)[None]
        return JointFrames(
            pieces=functools.partial(self._joint_pieces, places), frame_count=motion.frame_count,
            names=tuple(layer.joint_names[place] for place in places), rest=self._piece(rest, places),
            fps=motion.fps, up=self.up, source=motion.source, licence=motion.licence,
        )  # fmt: skip

    def clip(self, metadata: dict[str, str], *, blend_shapes: bool = True) -> SkinnedClip:
        """The skinned animation, for UsdSkel and glTF; +Y up."""
        layer, parts, helpers = self.layer, [], []
        for frames in self._ranges():
            world = self.transforms(frames)
            parts.append(world.cpu().numpy())
            helpers.append(layer.helper_transforms(self.identity, world).cpu().numpy())
        made = skinned_clip(
            layer.mesh, layer.rig, self.identity, np.concatenate(parts), fps=self.motion.fps,
            helpers=np.concatenate(helpers) if layer.procedural else None,
            colour=backend_colour(layer.backend), metadata=metadata,
            shapes=self._shapes() if blend_shapes else None,
        )  # fmt: skip
        limits = made.limits  # poses every frame
        for text in limits.values():
            _log.info("skinned files: %s", text)
        return replace(made, metadata={**made.metadata, **limits})

    def _shapes(self) -> CorrectiveShapes | None:
        """What the correctives add, for files that skin."""
        layer = self.layer
        if layer.correctives is None:
            return None
        identity, rotations, _ = self._body(slice(None))
        if self._absolute:
            axes = layer.animation.kinematics
            rotations = relative_from_absolute(rotations, axes.orient[1:], axes.parent_orient[1:])
        return corrective_shapes(layer.correctives, rotations, identity.bind_world)

    @property
    def _absolute(self) -> bool:
        return self.motion.convention == "absolute_local"

    @property
    def _turn(self) -> np.ndarray:
        """From +Y up to the world that is given: columns of points."""
        return np.eye(3) if self.up == "+y" else native_to_canonical("+z", "-y").T

    def _body(self, frames: slice | np.ndarray) -> tuple[Identity, Tensor, Tensor]:
        values = self.motion.rotations[frames], self.motion.translation[frames]
        rotations, hips = (torch.as_tensor(each).to(self.layer.device, self.layer.dtype) for each in values)
        return self.identity, rotations, hips

    def _ranges(self) -> Iterator[slice]:
        return (slice(start, start + _CHUNK) for start in range(0, self.motion.frame_count, _CHUNK))

    def _vertex_pieces(self) -> Iterator[np.ndarray]:
        for frames in self._ranges():
            yield (self.posed(frames).cpu().numpy() @ self._turn.T.astype(np.float32)).astype(np.float32)

    def _joint_pieces(self, places: list[int]) -> Iterator[JointPiece]:
        for frames in self._ranges():
            yield self._piece(self.transforms(frames).cpu().numpy(), places)

    def _piece(self, world: np.ndarray, places: list[int]) -> JointPiece:
        """Some joints of world transforms (F, J, 4, 4), whose first is the virtual root."""
        shown = self._turn @ world[:, 1:][:, places, :3]
        return JointPiece(shown[..., 3], shown[..., :3])


class Placed(Protocol):
    """Options that tell where a body is to stand."""

    translation: Translation
    ground: Ground | None
    contacts: Contacts


def placing_of(options: Placed) -> dict[str, str]:
    """Where a body is to stand: arguments of ``animate``, as far as they are not the usual ones."""
    chosen = {"translation": options.translation, "ground": options.ground, "contacts": options.contacts}
    usual = {"ground": None, "contacts": "free"}
    return {name: str(value) for name, value in chosen.items() if value != usual.get(name, "")}


class MovingBodies:
    """Bodies that motions move; layers that are made once serve all of them.

    Args:
        options: of the model.
        chosen: whose body moves; None: that of each motion file.
        placing: where it stands: arguments of ``animate``.
    """

    def __init__(
        self, options: ModelOptions, chosen: BackendChoice | None, placing: Mapping[str, str]
    ) -> None:
        self._options, self._chosen, self._placing = options, chosen, placing
        self._layers: dict[str, SomaLayer] = {}

    def layer_of(self, path: Path, motion: Motion) -> tuple[SomaLayer, Mapping[str, Any]]:
        """The layer, and the identity as a motion file keeps it.

        Args:
            path: the motion's file, for messages.
            motion: whose identity moves, unless one was chosen.

        Raises:
            InputError: none was chosen, and the file keeps none.
        """
        chosen, stored = self._chosen, motion.identity
        own = chosen is not None and chosen.name == stored.get("backend") and "params" in stored
        if chosen is not None and own and chosen.options and not chosen.params:
            # How the file's own backend is opened, as whether its model is trusted; the body stays.
            stored = {**stored, "options": {**dict(stored.get("options", {})), **chosen.options}}
        elif chosen is not None:
            stored = {"backend": chosen.name, "params": chosen.params, "options": chosen.options}
        elif "params" not in stored and "rest" not in stored:
            raise InputError(
                "backend",
                got=f"none, and no body in {path.name}",
                expected="whose body moves",
                fix="Pass backend=NAME and backend.params.KEY=VALUE; backend=soma is a mean body.",
            )
        name, options = str(stored["backend"]), dict(stored.get("options", {}))
        key = f"{name} {sorted(options.items())}"
        if key not in self._layers:
            self._layers[key] = open_layer(self._options, name, options)
        return self._layers[key], stored

    def played(self, path: Path, layer: SomaLayer, stored: Mapping[str, Any], motion: Motion) -> Played:
        """The motion of a file on that body, where it is to stand."""
        with torch.no_grad():
            try:
                identity = stored_identity(layer, stored)
            except InputError as error:
                if self._chosen is not None:
                    raise
                name = f"{path}: identity, {error.argument}"
                raise InputError(name, got=error.got, expected=error.expected, fix=error.fix) from error
            motion = standing_motion(layer, identity, motion, self._placing)
        return Played(layer=layer, identity=identity, motion=replace(motion, identity=stored))
