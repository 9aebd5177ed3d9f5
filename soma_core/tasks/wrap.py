"""``soma wrap``: the OBJ pair of a new backend from its neutral mesh, without an artist."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from soma_core.errors import AssetError, InputError, SomaError
from soma_core.json_file import read_json
from soma_core.options import BackendChoice
from soma_core.paths import expanded, shipped_assets
from soma_core.plugin.declaration import did_you_mean
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import WrapPair
from soma_core.registration.native_mesh import NativeMesh, neutral_mesh, read_native_mesh
from soma_core.registration.pair_files import write_pair, write_report
from soma_core.registration.quality import Quality, measure
from soma_core.registration.register import Registration, WrapOptions, register
from soma_core.rig import load_canonical
from soma_core.rig.landmarks import canonical_landmarks

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["run"]

_log = logging.getLogger(__name__)

_DIGITS = 19
"""Of a vertex id."""

_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")


def run(config: DictConfig, output: Path) -> Path:
    """Register the canonical mesh; write the pair, ``report.json`` and ``wrap.png``; return their folder.

    Raises:
        SomaError: the mesh cannot be read, is broken, or shows no human body; or a part of it is not covered,
            or a finger lies on another one, once all is written.
    """
    mesh, _ = load_canonical("mid", shipped_assets())
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
    if quality.faults:
        raise SomaError(_refusal(folder, quality, picture=config.picture))
    return folder


def _refusal(folder: Path, quality: Quality, *, picture: bool) -> str:
    shown = folder / ("wrap.png" if picture else "report.json")
    return (
        f"{folder}: this wrap is not fit for use. {quality.told()}. Look at {shown}; then pass a body with "
        'open hands that touch nothing, name points in landmarks=FILE, JSON such as {"LeftIndexTip": 1234} '
        "(soma assets landmarks lists the names), or what is no skin in mask=FILE."
    )


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
    """Canonical vertex id -> native vertex id, of a JSON file whose keys are ids or names of landmarks.

    Raises:
        AssetError: missing, or something else.
        InputError: an unknown name.
    """
    expected = '{"LeftIndexTip or a canonical vertex id": native vertex id}'
    found = _json(name, dict, expected)
    names = canonical_landmarks()
    unknown = [key for key in found if key not in names and not (key.isdecimal() and len(key) < _DIGITS)]
    if unknown:
        raise InputError(
            f"landmarks {name}",
            got=unknown[0],
            expected="a canonical vertex id or a name that soma assets landmarks lists",
            fix=did_you_mean(unknown[0], list(names)) or "Correct the name.",
        )
    return {names[key] if key in names else int(key): int(value) for key, value in found.items()}


def _json(name: str | Path | None, kind: type, expected: str) -> Any:
    """Content of a JSON file of integers, empty where none is named; keys may be anything."""
    if name is None:
        return kind()
    path = expanded(name)
    content = read_json(path, fix=f"Write {expected} as JSON.")
    try:
        items = content.values() if isinstance(content, dict) else content
        whole = isinstance(content, kind) and all(int(item) == float(item) for item in items)
    except (ValueError, TypeError, OverflowError):
        whole = False
    if not whole:
        raise AssetError(path, cause=f"does not hold {expected}", fix="Write it as JSON.")
    return content
