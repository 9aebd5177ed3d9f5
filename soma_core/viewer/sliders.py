"""Sliders of a body's parameters, as its backend declares them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from soma_core.plugin.spec import BackendSpec, Parameter

__all__ = ["Controls", "ParameterSliders", "entries_of"]

Entry = tuple[Parameter, int | None]
"""A parameter, and which of its entries."""

_OPEN, _FOUND = 10, 12
"""Sliders of one heading that are shown at once; results of a search."""

_STEPS = 200


def entries_of(spec: BackendSpec) -> dict[str, list[Entry]]:
    """All that has a slider, by heading: groups of the spec, and of long ones and vectors what is folded."""
    found: dict[str, list[Entry]] = {}
    for parameter in spec.params:
        count = 1
        for size in parameter.shape:
            count *= size
        heading = parameter.group or (spec.name if count == 1 else parameter.name)
        entries = [(parameter, None if not parameter.shape else index) for index in range(count)]
        found.setdefault(heading, []).extend(entries)
    return found


def _label(entry: Entry) -> str:
    parameter, index = entry
    return parameter.name if index is None else f"{parameter.name} {index}"


def _about(entry: Entry) -> str:
    """What a search looks at."""
    return f"{_label(entry)} {entry[0].group} {entry[0].description}".lower()


class Controls:
    """Ties controls of viser to what they do; what the page itself sets does nothing.

    Args:
        later: takes what is to be done, in the page's own thread.
    """

    def __init__(self, later: Callable[[Callable[[], None]], None]) -> None:
        self._later = later
        self.heard: Callable[[Any], bool] = lambda event: event.client is not None

    def tie(self, handle: Any, act: Callable[[Any, Any], Any], *, queued: bool = True) -> None:
        """Have a control call `act` with its value and who changed it.

        Args:
            handle: of viser.
            act: what is to be done.
            queued: in the page's own thread; otherwise at once, in one of viser's.
        """

        def changed(event: Any) -> None:
            if not self.heard(event):
                return
            value, client = handle.value, event.client
            self._later(lambda: act(value, client)) if queued else act(value, client)

        listen = ("on_click", "on_upload", "on_update")
        next(getattr(handle, name) for name in listen if hasattr(handle, name))(changed)


class ParameterSliders:
    """The sliders of one body, and a search among them.

    Args:
        gui: of viser.
        inside: gives the container that they are made in.
        controls: tie sliders to what they do.
        value, change: of a parameter's entry.
    """

    def __init__(
        self, gui: Any, inside: Callable[[], AbstractContextManager[Any]], controls: Controls,
        value: Callable[[str, int | None], float], change: Callable[[str, float, int | None], None],
    ) -> None:  # fmt: skip
        self._gui, self._inside, self._controls = gui, inside, controls
        self._value, self._change = value, change
        self._spec: BackendSpec | None = None
        self._folders: list[Any] = []
        self._found: list[Any] = []
        self.handles: dict[tuple[str, int | None], list[Any]] = {}

    def show(self, spec: BackendSpec) -> None:
        """Make the sliders of a backend in place of those that are there."""
        for folder in [*self._folders, *self._found]:
            folder.remove()
        self._spec, self._folders, self._found = spec, [], []
        self.handles = {}
        for heading, entries in entries_of(spec).items():
            vector = entries[0][1] is not None
            shown = len(entries) if len(entries) <= _OPEN else _OPEN * vector
            if shown:
                self._folder(heading, entries[:shown], self._folders, opened=True)
            if entries[shown:]:
                self._folder(
                    f"{heading}: {len(entries) - shown} more", entries[shown:], self._folders, opened=False
                )

    def search(self, text: str) -> int:
        """Show the sliders whose name or description has each of some words; return how many there are."""
        for folder in self._found:
            folder.remove()
        kept = {
            key: [each for each in handles if not each._impl.removed] for key, handles in self.handles.items()
        }
        self._found, self.handles = [], kept
        words = text.lower().split()
        if not words or self._spec is None:
            return 0
        found = [
            (parameter, index)
            for entries in entries_of(self._spec).values()
            for parameter, index in entries
            if all(word in _about((parameter, index)) for word in words)
        ]
        title = f"{len(found)} found" + (f", the first {_FOUND}" if len(found) > _FOUND else "")
        self._folder(title, found[:_FOUND], self._found, opened=True, order=-1.0)
        return len(found)

    def refresh(self) -> None:
        """Bring the sliders to the values that the body has."""
        for (name, index), handles in self.handles.items():
            value = self._value(name, index)
            for handle in handles:
                inside = min(max(value, handle.min), handle.max)
                if abs(handle.value - inside) > 1e-9:
                    handle.value = inside

    def _folder(
        self, title: str, entries: list[Entry], into: list[Any], *, opened: bool, order: float | None = None
    ) -> None:
        with self._inside():
            folder = self._gui.add_folder(title, expand_by_default=opened, order=order)
        into.append(folder)
        with folder:
            for entry in entries:
                self._slider(entry)

    def _slider(self, entry: Entry) -> None:
        parameter, index = entry
        low, high = map(float, parameter.range)
        value = self._value(parameter.name, index)
        handle = self._gui.add_slider(
            _label(entry), low, high, round((high - low) / _STEPS, 9), min(max(value, low), high),
            hint=parameter.description or None,
        )  # fmt: skip
        self.handles.setdefault((parameter.name, index), []).append(handle)
        self._controls.tie(handle, lambda value, _: self._change(parameter.name, value, index))
