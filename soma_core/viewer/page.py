"""The page: its controls, and the loop that lets time pass."""

from __future__ import annotations

import contextlib
import io
import logging
import queue
import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.cache import atomic_write
from soma_core.choices import Product, Translation
from soma_core.errors import InputError, SomaError
from soma_core.io.joint_order import USER_JOINTS
from soma_core.motion.poses import POSES, named_pose
from soma_core.motion.questions import heard
from soma_core.motion.writers import WRITERS
from soma_core.plugin.registry import default_registry
from soma_core.viewer.scene import Scene, Switches
from soma_core.viewer.session import Figure, Session
from soma_core.viewer.sliders import Controls, ParameterSliders
from soma_core.viewer.sources import escaped, settings_of

__all__ = ["Page"]

_log = logging.getLogger(__name__)

_Act = Callable[..., None] | None

_REST = 0.35
"""Seconds without a change after which bodies are drawn, and brought to the floor, in full."""

_TOLD = 0.2
"""Seconds between two changes of the slider of time while it plays."""

_PICTURE, _SPEEDS = (1080, 1920), {"0.25x": 0.25, "0.5x": 0.5, "1x": 1.0, "2x": 2.0}


class Page:
    """The controls of a session on a viser server.

    What a person does is queued and done by :meth:`step`, in one thread: controls that move fast are drawn
    once for all that they did meanwhile.

    Args:
        server: of viser.
        session: what is shown.
        output: folder of what is saved.
        settings: that files are read with.
    """

    def __init__(self, server: Any, session: Session, output: Path, settings: str = "") -> None:
        self.server, self.session, self.output, self.settings = server, session, output, settings
        self.switches, self.watched = Switches(), True
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.controls = Controls(self._todo.put)
        self._changed, self._full, self._last, self._told = time.monotonic(), False, time.monotonic(), 0.0
        self.scene = Scene(
            server, session, self.switches,
            turned=lambda turn: self._todo.put(lambda: self._turn_gizmo(turn)),
            chosen=lambda joint: self._todo.put(lambda: self._choose_joint(joint)),
        )  # fmt: skip
        gui = server.gui
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.set_panel_label("SOMA")
        self.handles: dict[str, Any] = {}
        self._make_timeline()
        tabs = gui.add_tab_group()
        for title, make in (
            ("Body", self._make_body), ("Pose", self._make_pose), ("Motion", self._make_motion),
            ("View", self._make_view), ("Save", self._make_save),
        ):  # fmt: skip
            with tabs.add_tab(title) as tab:
                make(tab)
        self._show_figures()
        self._show_motion()

    # What is in the panel

    def _add(self, name: str, kind: str, *args: Any, act: _Act = None, **more: Any) -> Any:
        handle = getattr(self.server.gui, f"add_{kind}")(*args, **more)
        self.handles[name] = handle
        if act is not None:
            self.controls.tie(handle, act)
        return handle

    def _make_timeline(self) -> None:
        with self.server.gui.add_folder("Time"):
            self._add("play", "button", "Play", act=lambda *_: self.play(on=not self.session.playing))
            self._add("frame", "slider", "frame", 0, 1, 1, 0, act=lambda value, _: self.seek(value))
            self._add("speed", "dropdown", "speed", tuple(_SPEEDS), initial_value="1x",
                      act=lambda value, _: self._set("speed", _SPEEDS[value]))  # fmt: skip
            self._add("loop", "checkbox", "loop", self.session.loop, act=lambda on, _: self._set("loop", on))

    def _make_body(self, tab: Any) -> None:
        names = default_registry().names()
        self._add("figure", "dropdown", "body", ("none",), act=lambda *_: self._show_parameters())
        self._add("backend", "dropdown", "backend", names, initial_value=names[0])
        self._add("bodies", "button_group", "", ("add", "remove"), act=self._add_or_remove)
        self._add("usual", "button_group", "", ("usual", "random", "of motion"), act=self._reshape)
        self._add("search", "text", "search", "", act=lambda value, _: self.sliders.search(value),
                  hint="words in the name of a parameter")  # fmt: skip
        self.sliders = ParameterSliders(
            self.server.gui, lambda: tab, self.controls, self._value, self._change
        )

    def _make_pose(self, _: Any) -> None:
        self._add("preset", "dropdown", "pose", tuple(POSES), initial_value="arms lowered",
                  act=lambda value, _: self._preset(value))  # fmt: skip
        self._add("joint", "dropdown", "joint", USER_JOINTS, initial_value=self.switches.joint,
                  act=lambda value, _: self._choose_joint(value))  # fmt: skip
        self._add("gizmo", "checkbox", "rings on the joint", self.switches.gizmo,
                  act=lambda value, _: self._switch("gizmo", value))  # fmt: skip
        for axis in "xyz":
            self._add(f"turn_{axis}", "slider", f"about {axis}, °", -180.0, 180.0, 1.0, 0.0,
                      act=lambda *_: self._turn())  # fmt: skip
        self._add("straight", "button", "joint as in the T-pose", act=lambda *_: self._turn(np.zeros(3)))
        self.server.gui.add_markdown("Turns it in the frame that is shown; with the skeleton on, click one.")

    def _make_motion(self, _: Any) -> None:
        self.handles["about"] = self.server.gui.add_markdown("")
        self._add("path", "text", "file", "", hint="on the machine where soma view runs")
        self._add("settings", "text", "settings", self.settings,
                  hint="of soma convert, where the file does not say: fps=30 unit=cm up=z")  # fmt: skip
        self._add("load", "button_group", "", ("load", "compare"), act=lambda what, _: self.load(
            Path(self.handles["path"].value), compare=what == "compare"))  # fmt: skip
        self._add("upload", "upload_button", "Upload a motion", act=lambda file, _: self._upload(file))
        self._add("translation", "dropdown", "stands", tuple(map(str, Translation)),
                  initial_value=str(self.session.translation), act=lambda value, _: self._stand(value),
                  hint="ground: feet on the floor; motion: as recorded; none: hips stay")  # fmt: skip

    def _make_view(self, _: Any) -> None:
        for name, title in (("mesh", "mesh"), ("skeleton", "skeleton"), ("names", "names of joints"),
                            ("errors", "colours of errors"), ("follow", "follow the body")):  # fmt: skip
            self._add(name, "checkbox", title, getattr(self.switches, name),
                      act=lambda value, _, name=name: self._switch(name, value))  # fmt: skip
        for name, title in (("correctives", "correctives"), ("procedural", "twist joints")):
            self._add(name, "checkbox", title, getattr(self.session, name),
                      act=lambda value, _, name=name: self._set(name, value))  # fmt: skip
        self._add("spacing", "slider", "apart, m", 0.0, 2.5, 0.05, self.session.spacing,
                  act=lambda value, _: self._set("spacing", value))  # fmt: skip
        self.handles["scale"] = self.server.gui.add_markdown("")

    def _make_save(self, _: Any) -> None:
        self._add("picture", "button", "Picture (PNG)")
        self.controls.tie(self.handles["picture"], self._picture, queued=False)
        for product in (Product.npz, Product.glb):
            self._add(str(product), "button", f"{WRITERS[product].file} of this body",
                      act=lambda _, client, product=product: self._save(product, client))  # fmt: skip

    # What the controls do

    def play(self, *, on: bool) -> None:
        """Start or stop the time."""
        session = self.session
        if on and session.frame >= session.frame_count - 1:
            session.place = 0.0
        session.playing = on and session.frame_count > 1

    def seek(self, frame: float) -> None:
        """Show a frame."""
        self.session.playing, self.session.place = False, float(frame)

    def _set(self, name: str, value: Any) -> None:
        setattr(self.session, name, value)

    def _switch(self, name: str, value: Any) -> None:
        setattr(self.switches, name, value)

    @property
    def figure(self) -> Figure | None:
        """The body that the controls are for."""
        named = {figure.name: figure for figure in self.session.figures}
        return named.get(self.handles["figure"].value) or next(iter(named.values()), None)

    def _value(self, name: str, index: int | None) -> float:
        assert self.figure is not None
        return self.session.value(self.figure, name, index)

    def _change(self, name: str, value: float, index: int | None) -> None:
        if self.figure is not None:
            self.session.change(self.figure, name, value, index)

    def _add_or_remove(self, what: str, _: Any) -> None:
        added = None
        if what == "add":
            backend = self.handles["backend"].value
            with self._busy(f"opening {backend}"):
                added = self.session.add(backend)
        elif self.figure is not None and len(self.session.figures) > 1:
            self.session.remove(self.figure)
        self._show_figures(added)

    def _reshape(self, what: str, _: Any) -> None:
        figure = self.figure
        if figure is None:
            return
        if what == "of motion":
            self.session.own_body(figure)
            self._show_parameters()
        else:
            self.session.usual(figure, seed=None if what == "usual" else time.monotonic_ns() % 2**32)
            self.sliders.refresh()

    def _preset(self, name: str) -> None:
        self.session.show(named_pose(name))
        self._show_figures()
        self._show_motion()

    def _choose_joint(self, joint: str) -> None:
        self.switches.joint = self.handles["joint"].value = joint

    def _turn(self, vector: np.ndarray | None = None) -> None:
        """Turn the joint, without a vector as the sliders say."""
        told = np.array([self.handles[f"turn_{axis}"].value for axis in "xyz"])
        self.session.turn(self.switches.joint, told if vector is None else vector)

    def _turn_gizmo(self, turn: np.ndarray) -> None:
        self.session.turn_in_world(self.session.figures[0], self.switches.joint, turn)

    def _stand(self, translation: str) -> None:
        self.session.translation = Translation(translation)
        for figure in self.session.figures:
            figure.path = None

    def load(self, path: Path, *, compare: bool = False) -> None:
        """Move the bodies by a file, or compare the first with it.

        Raises:
            SomaError: it cannot be used.
        """
        if path == Path():
            raise InputError("file", got="nothing", expected="the path of a motion", fix="Type it above.")
        settings = settings_of(self.handles["settings"].value)
        with self._busy(f"reading {path.name}"), heard() as said:
            (self.session.compare if compare else self.session.load)(path, settings)
        for warning in said:
            self.tell(path.name, warning, colour="yellow")
        self.scene.top_mm = None
        self.handles["translation"].value = str(self.session.translation)
        self.handles["spacing"].value = self.session.spacing
        self._show_figures()
        self._show_motion()

    def _upload(self, file: Any) -> None:
        name = re.sub(r"[^\w.-]+", "_", Path(file.name).name) or "motion"
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(file.content)
            self.load(path)

    def _free(self, stem: str, suffix: str) -> Path:
        """A path in the folder that is not taken yet."""
        number = 1
        while (path := self.output / f"{stem}{'' if number == 1 else f'_{number}'}.{suffix}").exists():
            number += 1
        return path

    def _save(self, product: Product, client: Any) -> Path | None:
        if self.figure is None or self.figure.recorded is not None:
            return None
        path = self._free(*WRITERS[product].file.rsplit("."))
        with self._busy(f"writing {path.name}"):
            self.session.write(self.figure, product, path)
        self._hand(path, client)
        return path

    def _picture(self, _: Any, client: Any) -> None:
        from PIL import Image

        pixels = client.get_render(*_PICTURE)
        path = self._free("picture", "png")
        stream = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels[..., :3])).save(stream, "PNG")
        atomic_write(path, lambda target: target.write_bytes(stream.getvalue()))
        self._hand(path, client)

    def _hand(self, path: Path, client: Any) -> None:
        _log.info("wrote %s", path)
        self.tell("Saved", str(path), seconds=6.0)
        if client is not None:
            client.send_file_download(path.name, path.read_bytes())

    # What the panel says

    def tell(self, title: str, text: str, *, colour: str | None = None, seconds: float | None = None) -> None:
        """Say something to everybody who looks."""
        for client in self.server.get_clients().values():
            client.add_notification(title, text, color=colour, auto_close_seconds=seconds)

    @contextlib.contextmanager
    def _busy(self, what: str) -> Any:
        _log.info("%s", what)
        shown = [client.add_notification(f"{what} …", "", loading=True, with_close_button=False)
                 for client in self.server.get_clients().values()]  # fmt: skip
        self.server.flush()
        try:
            yield
        finally:
            for each in shown:
                each.remove()

    def _show_figures(self, chosen: Figure | None = None) -> None:
        """Bring the list of bodies to the session's, and choose one."""
        chosen = chosen or self.figure
        names = tuple(figure.name for figure in self.session.figures) or ("none",)
        self.handles["figure"].options = names
        if chosen is not None:
            self.handles["figure"].value = chosen.name
        self._show_parameters()

    def _show_parameters(self) -> None:
        if self.figure is not None and "rest" not in self.figure.params and self.figure.recorded is None:
            self.sliders.show(self.session.layer(self.figure).spec)
            self.sliders.search(self.handles["search"].value)

    def _show_motion(self) -> None:
        motion, count = self.session.motion, self.session.frame_count
        self.handles["play"].disabled = self.handles["frame"].disabled = count < 2
        self.handles["frame"].max = max(count - 1, 1)
        told = f"**{escaped(motion.source or 'a motion')}**"
        if count > 1:
            told += f": {count} frames, {motion.fps:g} fps, {count / motion.fps:.1f} s"
        self.handles["about"].content = told

    def _show_values(self) -> None:
        """Bring what moves with time to where it is."""
        handles, session = self.handles, self.session
        label = "Pause" if session.playing else "Play"
        if handles["play"].label != label:
            handles["play"].label = label
        if handles["frame"].value != session.frame:
            handles["frame"].value = session.frame
        for axis, value in zip("xyz", session.rotation(self.switches.joint), strict=True):
            if abs(handles[f"turn_{axis}"].value - value) > 0.5:
                handles[f"turn_{axis}"].value = float(value)
        top = self.scene.top_mm
        known = top is not None and session.compared is not None and self.switches.errors
        handles["scale"].content = f"Colours of errors: grey is 0, dark {top:g} mm and more." if known else ""

    # Time

    def step(self, wait: float = 0.5) -> None:
        """Do what was asked for, let time pass, and draw what changed.

        Args:
            wait: for the next thing to do, at most [s].
        """
        session, now = self.session, time.monotonic()
        playing = session.playing and self.watched
        if playing:
            wait = max(self._last + 1 / session.options.rate - now, 0)
        elif not self._full:
            wait = min(wait, max(self._changed + _REST - now, 0))
        changed = self._do(wait)
        now = time.monotonic()
        if playing:
            session.advance(now - self._last)
        self._last = now
        if changed or playing:
            self._changed, self._full = now, False
            self._attempt(lambda: self._draw(moving=True))
        elif not self._full and now - self._changed >= _REST:
            self._full = True
            self._attempt(lambda: self._draw(moving=False))

    def _draw(self, *, moving: bool) -> None:
        self.session.settle(rest=not moving)
        self.scene.draw(moving=moving)
        if not moving or time.monotonic() - self._told > _TOLD:
            self._told = time.monotonic()
            self._show_values()

    def _do(self, wait: float) -> bool:
        """Do all that is queued; whether there was anything."""
        found = False
        with contextlib.suppress(queue.Empty):
            while True:
                action = self._todo.get(timeout=0 if found else wait)
                found = True
                self._attempt(action)
        return found

    def _attempt(self, action: Callable[[], Any]) -> None:
        """Do something; what goes wrong is said on the page, which goes on."""
        try:
            action()
        except (SomaError, OSError) as error:
            _log.warning("%s", error)
            self.tell("That did not work", str(error), colour="red")
        except Exception as error:  # a defect: the page that someone works in goes on
            _log.exception("a defect")
            self.tell("A defect", f"{type(error).__name__}: {error}", colour="red")
