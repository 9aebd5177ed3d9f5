"""Bodies of a session as nodes of a viser scene; vertices are posed here and sent as they are."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from soma_core.io.eyeballs import EYES, eyeball, eyeball_places
from soma_core.io.joint_order import PARENT_NAMES, USER_JOINTS
from soma_core.view.error_picture import error_colours, scale_top
from soma_core.view.picture import backend_colour
from soma_core.viewer.session import Figure, Session, Shape

__all__ = ["Scene", "Switches"]

_BONES = np.array([(USER_JOINTS.index(parent), USER_JOINTS.index(joint))
                   for joint, parent in PARENT_NAMES.items() if parent in USER_JOINTS])  # fmt: skip
_BONE, _JOINT = (38, 70, 140), (240, 190, 60)
_GHOST = 0.45
"""Opacity of skin through which bones are seen."""

_BANDS = 7
"""Colours of errors."""

_GIZMO = 0.16
"""Radius of the rings that turn a joint [m]."""

_SECTION, _SINK = 1.0, 0.004
"""Squares of the floor, and how far it lies below soles that stand, which give by some millimetres [m]."""


@dataclass
class Switches:
    """What is drawn of each body."""

    mesh: bool = True
    skeleton: bool = False
    names: bool = False
    errors: bool = True
    gizmo: bool = False
    follow: bool = True
    joint: str = "LeftArm"


class Scene:
    """Draws a session.

    viser's own skinned mesh keeps four influences of a vertex and knows no correctives: up to 14 and 33 mm
    off. So the vertices are posed here, exactly, and sent: 12 bytes a vertex, of the mesh for moving bodies
    while they move and of the whole one when they rest.

    Args:
        server: of viser.
        session: what is shown.
        switches: what of it.
        turned: called with how a joint is turned in the world (3, 3) when its gizmo was.
        chosen: called with the name of a joint that was clicked.
    """

    def __init__(
        self, server: Any, session: Session, switches: Switches,
        turned: Callable[[np.ndarray], None], chosen: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._server, self._session, self.switches = server, session, switches
        self._turned, self._chosen = turned, chosen
        self._nodes: dict[str, Any] = {}
        self._figures: list[Figure] = []
        self.top_mm: float | None = None
        scene = server.scene
        scene.set_up_direction("+y")
        wide = session.spacing * max(len(session.figures) - 1, 0)
        camera = server.initial_camera  # before all that is large: a browser takes it as long as it waits
        camera.position, camera.look_at = (1.6, 1.5, 3.5 + 1.2 * wide), (0.25 + 0.1 * wide, 0.86, 0.0)
        camera.up, camera.fov = (0.0, 1.0, 0.0), np.radians(34)
        scene.world_axes.visible = False
        scene.configure_environment_map("studio", environment_intensity=0.5)
        self._shift = np.zeros(3)
        self._floor = scene.add_grid(
            "/floor", plane="xz", infinite_grid=True, cell_size=_SECTION / 4, section_size=_SECTION,
            fade_distance=14.0,
            cell_color=(226, 226, 222), section_color=(200, 200, 196), shadow_opacity=0.3,
            plane_color=(246, 246, 244), plane_opacity=1.0, position=(0, -_SINK, 0),
        )  # fmt: skip

    def draw(self, *, moving: bool) -> None:
        """Bring the scene to what the session shows.

        Args:
            moving: the bodies move: fewer vertices will do.
        """
        session, switches = self._session, self.switches
        if self._figures != session.figures:
            self._clear()
        shapes = [session.shape(figure, moving=moving) for figure in session.figures]
        errors = self._errors(shapes)
        self._follow(shapes)
        with self._server.atomic():
            for figure, shape in zip(session.figures, shapes, strict=True):
                first = figure is session.figures[0]
                shown = switches.mesh and not (first and errors is not None)
                root = self._root(figure)
                root.position = self._shift + np.array([session.offset(figure), 0, 0])
                self._mesh(figure, shape, visible=shown)
                self._eyes(figure, shape, visible=switches.mesh)
                self._bones(figure, shape)
                self._names(figure, shape, visible=switches.names and first)
                self._title(figure, shape)
            if shapes:
                self._painted(session.figures[0], shapes[0], errors)
                self._gizmo(session.figures[0], shapes[0])

    def _follow(self, shapes: list[Shape]) -> None:
        """Keep the first body in the middle, and let the floor pass under it."""
        hips = shapes[0].joints[0] if shapes and shapes[0].joints is not None else np.zeros(3)
        self._shift = -hips * [1, 0, 1] if self.switches.follow else np.zeros(3)
        self._floor.position = np.fmod(self._shift, _SECTION) - np.array([0, _SINK, 0])

    def _node(self, key: str, make: Callable[[], Any]) -> Any:
        if key not in self._nodes:
            self._nodes[key] = make()
        return self._nodes[key]

    def _clear(self) -> None:
        for key in [key for key in self._nodes if key != "gizmo"]:
            node = self._nodes.pop(key)
            if not getattr(node, "_impl").removed:  # noqa: B009 - a parent takes its children along
                node.remove()
        self._figures = list(self._session.figures)

    def _path(self, figure: Figure, part: str = "") -> str:
        return f"/body{self._session.figures.index(figure)}{part}"

    def _root(self, figure: Figure) -> Any:
        path = self._path(figure)
        return self._node(path, lambda: self._server.scene.add_frame(path, show_axes=False))

    def _mesh(self, figure: Figure, shape: Shape, *, visible: bool) -> None:
        """One node for each level of detail: vertices and triangles of one change together."""
        own = self._path(figure, f"/skin{len(shape.vertices)}")
        for path, node in self._nodes.items():
            if path.startswith(self._path(figure, "/skin")) and path != own:
                node.visible = False
        compared = figure.recorded is not None or figure.motion is not None
        colour = (0.62, 0.70, 0.80) if compared else backend_colour(figure.backend)
        node = self._node(own, lambda: self._server.scene.add_mesh_simple(
            own, shape.vertices, shape.triangles, color=tuple(round(255 * each) for each in colour),
        ))  # fmt: skip
        node.visible = visible
        if visible:
            node.vertices = shape.vertices
            node.opacity = _GHOST if self.switches.skeleton or self.switches.names or compared else None

    def _eyes(self, figure: Figure, shape: Shape, *, visible: bool) -> None:
        """Eyeballs, which the mesh has not: no vertex hangs on the joints of the eyes, which turn unseen."""
        if shape.joints is None or shape.turns is None:
            return
        radius, centres = eyeball_places(shape.joints, shape.turns)
        for index, centre in zip(EYES, centres, strict=True):
            path = self._path(figure, f"/eye{index}")
            make = functools.partial(self._server.scene.add_mesh_trimesh, path)
            node = self._node(path, lambda make=make: make(_coloured_ball()))
            node.visible = visible
            if visible:
                node.scale, node.position = radius, centre
                node.wxyz = _wxyz(shape.turns[index])

    def _bones(self, figure: Figure, shape: Shape) -> None:
        if shape.joints is None:
            return
        lines, dots = self._path(figure, "/bones"), self._path(figure, "/joints")
        visible = self.switches.skeleton
        if not visible and lines not in self._nodes:
            return
        scene = self._server.scene
        segments = shape.joints[_BONES]
        bones = self._node(lines, lambda: scene.add_line_segments(
            lines, segments, _BONE, thickness=3.0, thickness_units="screen"))  # fmt: skip
        joints = self._node(dots, lambda: self._dots(dots, shape.joints))
        bones.visible = joints.visible = visible
        if visible:
            bones.points, joints.batched_positions = segments, shape.joints

    def _dots(self, path: str, joints: np.ndarray) -> Any:
        """Joints that can be clicked: small octahedra, smaller in hands and face."""
        corners = 0.012 * np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
        faces = np.array(
            [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
        )
        small = [0.4 if "Hand" in name and name[-1] in "1234d" else 1.0 for name in USER_JOINTS]
        node = self._server.scene.add_batched_meshes_simple(
            path, corners, faces, np.tile([1.0, 0, 0, 0], (len(joints), 1)), joints, lod="off",
            batched_scales=np.array(small, np.float32), batched_colors=_JOINT, flat_shading=True,
            cast_shadow=False,
        )  # fmt: skip

        @node.on_click
        def _(event: Any) -> None:
            if event.instance_index is not None:
                self._chosen(USER_JOINTS[event.instance_index])

        return node

    def _names(self, figure: Figure, shape: Shape, *, visible: bool) -> None:
        if shape.joints is None or (not visible and self._path(figure, "/name0") not in self._nodes):
            return
        for index, name in enumerate(USER_JOINTS):
            path = self._path(figure, f"/name{index}")
            node = self._node(path, lambda path=path, name=name: self._server.scene.add_label(
                path, name, font_screen_scale=0.62, anchor="center-left"))  # fmt: skip
            node.visible = visible
            if visible:
                node.position = shape.joints[index]

    def _title(self, figure: Figure, shape: Shape) -> None:
        """Whose body it is, above the head, where there are several."""
        path = self._path(figure, "/title")
        node = self._node(
            path, lambda: self._server.scene.add_label(path, figure.name, anchor="bottom-center")
        )
        node.visible = len(self._session.figures) > 1 and self._session.spacing > 0
        if node.visible:
            top = shape.vertices[shape.vertices[:, 1].argmax()]
            node.position = (shape.vertices[:, 0].mean(), top[1] + 0.06, shape.vertices[:, 2].mean())

    def _errors(self, shapes: list[Shape]) -> np.ndarray | None:
        """Errors [mm] of the first body, where it is compared with another."""
        if self._session.compared is None or not self.switches.errors:
            return None
        errors = self._session.errors_mm(*shapes[:2])
        if self.top_mm is None:
            self.top_mm = scale_top(errors)
        return errors

    def _painted(self, figure: Figure, shape: Shape, errors: np.ndarray | None) -> None:
        """The first body in the colours of its errors: a mesh for each, since one has one colour."""
        steps = np.zeros(len(shape.triangles))
        shown = errors is not None and self.switches.mesh
        if errors is not None and self.top_mm is not None:
            steps = np.minimum(errors[shape.triangles].mean(axis=1) / self.top_mm, 1) * (_BANDS - 1)
        for band in range(_BANDS):
            path = self._path(figure, f"/errors{band}")
            chosen = shape.triangles[np.round(steps) == band] if shown else shape.triangles[:0]
            if not len(chosen):
                if path in self._nodes:
                    self._nodes[path].visible = False
                continue
            kept, ids = np.unique(chosen, return_inverse=True)
            vertices, triangles = shape.vertices[kept], ids.reshape(-1, 3).astype(np.uint32)
            colour = tuple(
                np.round(255 * error_colours(np.array([float(band)]), _BANDS - 1)[0]).astype(int).tolist()
            )
            node = self._node(path, lambda path=path, v=vertices, t=triangles, colour=colour: (
                self._server.scene.add_mesh_simple(path, v, t, color=colour, side="double")))  # fmt: skip
            node.vertices, node.faces, node.visible = vertices, triangles, True

    def _gizmo(self, figure: Figure, shape: Shape) -> None:
        if "gizmo" not in self._nodes:
            node = self._server.scene.add_transform_controls(
                "/gizmo",
                scale=_GIZMO,
                disable_axes=True,
                disable_sliders=True,
                depth_test=False,
                visible=False,
            )
            node.on_update(lambda event: self._turned(_matrix(event.target.wxyz)))
            self._nodes["gizmo"] = node
        node, visible = self._nodes["gizmo"], self.switches.gizmo and shape.joints is not None
        node.visible = visible
        if not visible:
            return
        index = USER_JOINTS.index(self.switches.joint)
        place = shape.joints[index] + self._shift + [self._session.offset(figure), 0, 0]
        if np.abs(_matrix(node.wxyz) - shape.turns[index]).max() > 1e-3:
            node.wxyz = _wxyz(shape.turns[index])
        if np.abs(np.asarray(node.position) - place).max() > 1e-4:
            node.position = place


def _coloured_ball() -> Any:
    import trimesh

    vertices, faces, shades = eyeball()
    colours = np.column_stack([shades, np.full(len(shades), 255, np.uint8)])
    return trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)


def _wxyz(turn: np.ndarray) -> tuple[float, ...]:
    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    return float(w), float(x), float(y), float(z)


def _matrix(wxyz: Any) -> np.ndarray:
    w, x, y, z = wxyz
    return Rotation.from_quat((x, y, z, w)).as_matrix()
