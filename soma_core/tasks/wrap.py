"""``soma wrap``: the OBJ pair of a new backend from its neutral mesh, without an artist."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from soma_core.errors import AssetError, InputError
from soma_core.json_file import read_json
from soma_core.options import BackendChoice
from soma_core.paths import expanded
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import WrapPair
from soma_core.registration.native_mesh import NativeMesh, neutral_mesh, read_native_mesh
from soma_core.registration.pair_files import write_pair, write_report
from soma_core.registration.quality import Quality, measure
from soma_core.registration.register import Registration, WrapOptions, register
from soma_core.rig import load_canonical

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["run"]

_log = logging.getLogger(__name__)

_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")


def run(config: DictConfig, output: Path) -> None:
    """Register the canonical mesh; write the pair, ``report.json`` and ``wrap.png``.

    Raises:
        SomaError: the mesh cannot be read, is broken, or shows no human body.
    """
    mesh, _ = load_canonical("mid")
    folder = expanded(config.out) if config.out else output
    if folder.exists() and not folder.is_dir():
        raise InputError(
            "out", got=f"{folder}, a file", expected="a folder, or a new name", fix="Pass out=DIR."
        )
    native = _read_native(config)
    found = register(native.vertices, native.triangles, options=_options(config, native))
    quality = measure(found, mesh)
    pair = write_pair(folder, found, mesh, vertices=native.vertices, triangles=native.triangles,
                      name=native.name, source=native.file)  # fmt: skip
    write_report(folder, found, quality, native=pair.native.name)
    _say(found, quality, pair, config.fill)
    if config.picture:
        from soma_core.view.wrap_picture import draw_wrap

        draw_wrap(folder / "wrap.png", found, quality, mesh)


def _say(found: Registration, quality: Quality, pair: WrapPair, fill: Sequence[str]) -> None:
    numbers = quality.as_dict()
    for note in found.notes:
        _log.info("found: %s", note)
    distance, back = numbers["surface_distance_mm"], numbers["native_to_wrap_mm"]
    _log.info(
        "wrap to surface: mean %.3f, P95 %.3f, max %.2f mm; back: mean %.3f, P95 %.3f, max %.2f mm",
        distance["mean"], distance["p95"], distance["max"], back["mean"], back["p95"], back["max"],
    )  # fmt: skip
    _log.info(
        "flipped triangles: %d (%.3f %%); %d vertices filled",
        numbers["flipped_triangles"], numbers["flipped_percent"], numbers["filled_vertices"],
    )  # fmt: skip
    frame = found.frame
    _log.info(
        'for the declaration: wrap=WrapPair(native=folder / "%s", wrap=folder / "%s"), unit="%s", up="%s", '
        'forward="%s", fill_segments=%s',
        pair.native.name, pair.wrap.name, frame.unit, frame.up, frame.forward, tuple(fill),
    )  # fmt: skip


def _read_native(config: DictConfig) -> NativeMesh:
    chosen = config.backend is not None
    if chosen == (config.native is not None):
        raise InputError(
            "native",
            got="a mesh and a backend" if chosen else "none, and no backend",
            expected="one of the two",
            fix="Pass native=BODY.obj or backend=NAME.",
        )
    if chosen:
        backend: BackendChoice = OmegaConf.to_object(config.backend)
        return neutral_mesh(default_registry(), backend.name, options=backend.options, params=backend.params)
    return read_native_mesh(expanded(config.native))


def _options(config: DictConfig, native: NativeMesh) -> WrapOptions:
    known = dict(native.known or {})
    for key in ("up", "forward"):
        value = getattr(config, key)
        if value is not None and value not in _AXES:
            raise InputError(
                key, got=repr(value), expected=" ".join(_AXES), fix=f"Pass {key}=+y or the like."
            )
        known[key] = value or known.get(key)
    known["unit"] = str(config.unit) if config.unit else known.get("unit")
    landmarks = {} if config.landmarks is None else read_landmarks(config.landmarks)
    masked = _json(config.mask, list, "a list of native vertex ids")
    return WrapOptions(
        **known,
        fill=tuple(config.fill),
        symmetric=config.symmetric,
        landmarks=landmarks,
        masked=[int(value) for value in masked],
    )


def read_landmarks(name: str | Path) -> dict[int, int]:
    """Canonical vertex id -> native vertex id, of a JSON file.

    Raises:
        AssetError: missing, or something else.
    """
    found = _json(name, dict, '{"canonical vertex id": native vertex id}')
    return {int(key): int(value) for key, value in found.items()}


def _json(name: str | Path | None, kind: type, expected: str) -> Any:
    """Content of a JSON file of integers, empty where none is named."""
    if name is None:
        return kind()
    path = expanded(name)
    content = read_json(path, fix=f"Write {expected} as JSON.")
    try:
        items = [*content, *content.values()] if isinstance(content, dict) else content
        whole = isinstance(content, kind) and all(int(item) == float(item) for item in items)
    except (ValueError, TypeError, OverflowError):
        whole = False
    if not whole:
        raise AssetError(path, cause=f"does not hold {expected}", fix="Write it as JSON.")
    return content
