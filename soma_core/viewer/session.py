"""What the page shows and what its controls change; no browser and no server are known here."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from soma_core.animation.kinematics import relative_from_absolute
from soma_core.choices import Lod, Product, Translation
from soma_core.errors import InputError
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.io.joint_order import USER_JOINTS
from soma_core.io.motion import Motion
from soma_core.io.vertex_sequence import VertexSequence
from soma_core.layer import SomaLayer
from soma_core.motion.animated import animate
from soma_core.motion.conversion import convert
from soma_core.motion.identities import stored_identity
from soma_core.motion.models import open_layer
from soma_core.motion.options import ConvertOptions
from soma_core.motion.played import Played
from soma_core.motion.poses import named_pose
from soma_core.motion.products import write_products
from soma_core.options import ViewOptions
from soma_core.rig import load_canonical
from soma_core.shape_space.sampling import sample_parameters
from soma_core.skeleton.identity import Identity
from soma_core.viewer.sources import holds_motion, recorded

__all__ = ["Figure", "Session", "Shape"]

_log = logging.getLogger(__name__)

_AT_ONCE = 64
"""Frames that are brought to the floor while a slider moves; longer clips are when it rests."""

_SPREAD = 1 / 3
"""Of half the range of a coefficient: one standard deviation of a random body."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A body at one instant.

    Attributes:
        vertices: (v, 3) float32 [m].
        triangles: (t, 3).
        joints: (77, 3) [m]; None of recorded vertices.
        turns: (77, 3, 3) how joints are turned against the T-pose, in the world; None likewise.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    joints: np.ndarray | None = None
    turns: np.ndarray | None = None


@dataclass(kw_only=True, eq=False)
class Figure:
    """One body of the page.

    Attributes:
        name: unique.
        backend, options: whose body, and the options of that backend.
        params: every parameter of the backend that is not as usual.
        motion: its own, in place of the session's: of what it is compared with.
        recorded: vertices on the canonical mesh, in place of any motion.
        path: (frames, 3) of the Hips [m], where the body stands; None: to be found.
    """

    name: str
    backend: str
    options: dict[str, Any] = field(default_factory=dict)
    params: dict[str, Any] = field(default_factory=dict)
    motion: Motion | None = None
    recorded: VertexSequence | None = None
    path: np.ndarray | None = None
    settled: bool = False
    identities: dict[tuple[Any, ...], Identity] = field(default_factory=dict)


class Session:
    """Bodies side by side that one motion moves, at one instant of it.

    Args:
        options: of the model and the viewer.
        translation: where bodies stand, as for ``animate``.
    """

    def __init__(self, options: ViewOptions, *, translation: Translation = Translation.ground) -> None:
        self.options, self.translation = options, translation
        self.figures: list[Figure] = []
        self.motion = named_pose("arms lowered")
        self.place = 0.0
        self.playing, self.loop, self.speed = False, True, 1.0
        self.procedural, self.correctives = options.procedural, options.correctives is not None
        self.spacing = 1.1
        self._layers: dict[tuple[Any, ...], SomaLayer] = {}

    # Bodies

    def add(
        self, backend: str, *, params: dict[str, Any] | None = None, options: dict[str, Any] | None = None
    ) -> Figure:
        """Show another body.

        Raises:
            BackendError: its backend is not usable.
            InputError: parameters that it has not.
        """
        same = sum(figure.backend == backend for figure in self.figures)
        name = backend if not same else f"{backend} {same + 1}"
        while name in {figure.name for figure in self.figures}:
            name += "'"
        made = Figure(name=name, backend=backend, options=dict(options or {}), params=dict(params or {}))
        self.identity(made, self.layer(made))
        self.figures.append(made)
        return made

    def remove(self, figure: Figure) -> None:
        """Show a body no longer."""
        self.figures.remove(figure)

    def offset(self, figure: Figure) -> float:
        """Where a body stands on the x axis [m]; bodies that are compared stand where they were recorded."""
        place = self.figures.index(figure) - (len(self.figures) - 1) / 2
        return place * self.spacing

    def layer(self, figure: Figure, lod: Lod | None = None) -> SomaLayer:
        """The layer of a body, as the switches say."""
        lod = lod or self.options.lod
        key = (figure.backend, repr(sorted(figure.options.items())), lod, self.procedural, self.correctives)
        if key not in self._layers:
            chosen = self.options.correctives or "auto"
            model = replace(
                self.options, lod=lod, procedural=self.procedural,
                correctives=chosen if self.correctives and self.procedural else None,
            )  # fmt: skip
            self._layers[key] = open_layer(model, figure.backend, figure.options)
        return self._layers[key]

    def identity(self, figure: Figure, layer: SomaLayer) -> Identity:
        """The body of a figure."""
        key = (layer.mesh.lod, layer.procedural)
        if key not in figure.identities:
            stored = figure.params if "rest" in figure.params else {"params": figure.params}
            with torch.no_grad():
                figure.identities[key] = stored_identity(layer, stored)
        return figure.identities[key]

    def value(self, figure: Figure, name: str, index: int | None = None) -> float:
        """A parameter of a body, or one entry of it."""
        values = self._values(figure, name)
        return float(values if index is None else values[index])

    def change(self, figure: Figure, name: str, value: float, index: int | None = None) -> None:
        """Give a parameter of a body another value."""
        values = self._values(figure, name)
        if index is None:
            figure.params[name] = float(value)
        else:
            values[index] = value
            figure.params[name] = values.tolist()
        self._reshaped(figure)

    def _values(self, figure: Figure, name: str) -> np.ndarray:
        declared = next(each for each in self.layer(figure).spec.params if each.name == name)
        given = np.asarray(figure.params.get(name, declared.default), np.float64)
        values = np.full(declared.shape, declared.default, np.float64)
        values[tuple(slice(size) for size in given.shape)] = given
        return values

    def usual(self, figure: Figure, seed: int | None = None) -> None:
        """Give a body its backend's usual parameters, or random ones."""
        spec = self.layer(figure).spec
        drawn: dict[str, np.ndarray] = {}
        if seed is not None:
            details = {each.group for each in spec.params} - {""}
            generator = np.random.default_rng(seed)
            drawn = sample_parameters(spec, 1, generator, spread=_SPREAD, skip_groups=details)
        figure.params = {name: values[0].tolist() for name, values in drawn.items()}
        self._reshaped(figure)

    def _reshaped(self, figure: Figure) -> None:
        figure.identities.clear()
        figure.settled = False

    # Motion

    @property
    def frame(self) -> int:
        """Number of the frame that is shown."""
        return min(int(self.place), self.frame_count - 1)

    @property
    def frame_count(self) -> int:
        """Frames of the motion."""
        return self.motion.frame_count

    def show(self, motion: Motion) -> None:
        """Move all bodies by another motion."""
        self.motion = self._relative(motion)
        self.figures = [figure for figure in self.figures if figure is not self.compared]
        for figure in self.figures:
            figure.path, figure.settled = None, False
        self.place = 0.0
        self.playing = motion.frame_count > 1

    def load(self, path: str | Path, settings: ConvertOptions | None = None) -> None:
        """Move all bodies by the motion of a file, of any kind that ``soma convert`` reads.

        Raises:
            SomaError: the file, or what it needs, cannot be used.
        """
        self.show(convert(path, options=settings))

    def compare(self, path: str | Path, settings: ConvertOptions | None = None) -> Figure:
        """Show another result beside the first body: a motion on its own body, or vertices over time.

        Both stand as they were recorded, so that the first body is coloured by its distance to the other.

        Raises:
            SomaError: the file, or what it needs, cannot be used.
            InputError: it has other vertices than the first body.
        """
        if not self.figures:
            raise InputError("compare", got="no body", expected="one", fix="Add a body.")
        first = self.figures[0]
        other = Figure(name="compared", backend=first.backend, options=first.options, params=first.params)
        if holds_motion(Path(path)):
            other.motion = self._relative(convert(path, options=settings))
            self._own_body(other, other.motion)
        else:
            other.recorded = recorded(Path(path), self.layer(first), settings or ConvertOptions())
        self.figures, self.translation, self.spacing = [first, other], Translation.motion, 0.0
        first.path, first.settled = None, False
        return other

    def _own_body(self, figure: Figure, motion: Motion) -> None:
        """Take the body that a motion keeps, if it does."""
        stored = dict(motion.identity)
        if "params" not in stored and "rest" not in stored:
            return
        figure.backend = str(stored["backend"])
        figure.options = dict(stored.get("options", {}))
        figure.params = {"rest": stored["rest"]} if "rest" in stored else dict(stored["params"])
        self._reshaped(figure)

    def own_body(self, figure: Figure) -> None:
        """Show a body as the one that the motion keeps.

        Raises:
            InputError: it keeps none.
        """
        if not self.motion.identity:
            raise InputError(
                "identity", got=f"{self.motion.source or 'a motion'} without a body",
                expected="one that keeps its body", fix="Move the sliders instead.",
            )  # fmt: skip
        self._own_body(figure, self.motion)
        figure.path = None

    def _relative(self, motion: Motion) -> Motion:
        """The motion with rotations against the T-pose, in arrays of its own that a pose changes."""
        rotations = np.array(motion.rotations)
        if motion.convention == "absolute_local":
            rig = load_canonical("low")[1]
            axes = torch.as_tensor(rig.t_pose_world[:, :3, :3])
            axes[0] = torch.eye(3)
            given = torch.as_tensor(rotations).double()
            rotations = relative_from_absolute(given, axes[1:], axes[rig.parents[1:]]).float().numpy()
        return replace(
            motion, rotations=rotations, translation=np.array(motion.translation),
            convention="t_pose_relative",
        )  # fmt: skip

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        if not self.playing or self.frame_count < 2:
            return
        place = self.place + seconds * self.speed * self.motion.fps
        if place >= self.frame_count:
            place = place % self.frame_count if self.loop else self.frame_count - 1
            self.playing = self.loop
        self.place = place

    # Pose

    def rotation(self, joint: str) -> np.ndarray:
        """Rotation vector (3,) [degrees] of a joint in this frame, from the T-pose in world axes."""
        turn = self.motion.rotations[self.frame, USER_JOINTS.index(joint)]
        return np.degrees(Rotation.from_matrix(turn).as_rotvec())

    def turn(self, joint: str, vector: np.ndarray) -> None:
        """Turn a joint in this frame by a rotation vector [degrees], in place of the one that it has."""
        turn = axis_angle_to_matrix(torch.as_tensor(np.radians(vector)[None]).double())[0].numpy()
        self.motion.rotations[self.frame, USER_JOINTS.index(joint)] = turn
        for figure in self.figures:
            figure.settled = figure.settled and self.frame_count > _AT_ONCE

    def turn_in_world(self, figure: Figure, joint: str, turn: np.ndarray) -> None:
        """Turn a joint so that it is turned by (3, 3) against the T-pose in the world."""
        index = USER_JOINTS.index(joint)
        parent = int(self.layer(figure).rig.parents[index + 1]) - 1
        above = np.eye(3) if parent < 0 else self.shape(figure).turns[parent]
        self.turn(joint, np.degrees(Rotation.from_matrix(above.T @ turn).as_rotvec()))

    # What is seen

    @property
    def compared(self) -> Figure | None:
        """The body that the first is compared with."""
        return next((each for each in self.figures if each.motion or each.recorded), None)

    def settle(self, *, rest: bool) -> None:
        """Bring bodies to where they stand, those of long clips where the sliders rest."""
        short = self.frame_count <= _AT_ONCE
        for figure in self.figures:
            stale = figure.path is None or (not figure.settled and (rest or short))
            if stale and figure.recorded is None:
                self._settle(figure)

    def _settle(self, figure: Figure) -> None:
        layer = self.layer(figure, Lod.low)
        with torch.no_grad():
            placed = animate(
                layer, self.identity(figure, layer), figure.motion or self.motion,
                translation=str(self.translation),
            )  # fmt: skip
        figure.path, figure.settled = placed.motion.translation, True

    def played(self, figure: Figure, lod: Lod | None = None) -> Played:
        """The motion on a body, where it stands."""
        layer, motion = self.layer(figure, lod), figure.motion or self.motion
        if figure.path is None:
            self._settle(figure)
        body = figure.params if "rest" in figure.params else {"params": figure.params}
        own = {"options": figure.options} if figure.options else {}
        stored = {"backend": figure.backend, "params": {}, **own, **body}
        placed = replace(motion, translation=figure.path, identity=stored)
        return Played(layer=layer, identity=self.identity(figure, layer), motion=placed)

    @torch.no_grad()
    def shape(self, figure: Figure, *, moving: bool = False) -> Shape:
        """A body in the frame that is shown.

        Args:
            figure: which.
            moving: with the vertices of moving bodies. Those of ``low`` are some of those of ``mid``.
        """
        options, compared = self.options, self.compared is not None
        lod = options.playing if moving and not (compared and options.playing == Lod.xlo) else options.lod
        if figure.recorded is not None:
            frame = min(self.frame, figure.recorded.frame_count - 1)
            return _of_lod(figure.recorded.read(frame, frame + 1)[0].astype(np.float32), str(lod))
        whole = Lod.mid if lod == Lod.low and options.lod == Lod.mid else lod
        played = self.played(figure, whole)
        layer, frame = played.layer, min(self.frame, played.motion.frame_count - 1)
        pose = [torch.as_tensor(each[frame : frame + 1]).to(layer.device, layer.dtype)
                for each in (played.motion.rotations, played.motion.translation)]  # fmt: skip
        posed = layer.pose(played.identity, *pose)
        world = posed.transforms[0, 1:, :3, :3].cpu().numpy()
        return replace(
            _of_lod(posed.vertices[0].cpu().numpy(), str(lod)),
            joints=posed.joints[0].cpu().numpy(),
            turns=world @ np.swapaxes(layer.rig.t_pose_world[1:, :3, :3], -1, -2),
        )  # fmt: skip

    def errors_mm(self, first: Shape, other: Shape) -> np.ndarray:
        """Distance (v,) of each vertex of two bodies [mm]."""
        return 1000 * np.linalg.norm(first.vertices - other.vertices, axis=1)

    def write(self, figure: Figure, product: Product, path: Path) -> None:
        """Write the motion on a body as one of the products of ``soma animate``."""
        write_products(self.played(figure), [product], lambda _: path)


def _of_lod(vertices: np.ndarray, lod: str) -> Shape:
    """Vertices on the mesh of a level of detail, which takes some of those of mid."""
    mesh = load_canonical(lod)[0]
    kept = vertices if len(vertices) == mesh.vertex_count else vertices[mesh.mid_ids]
    return Shape(vertices=np.ascontiguousarray(kept), triangles=mesh.triangles)
