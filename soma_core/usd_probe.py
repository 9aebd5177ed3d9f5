"""Open a USD file of a stranger in this process, which has limits and may die: run by `usd_stage`.

USD follows references to any path, waits for pipes, and overflows its stack where prims or brackets nest
too deep; damaged binary files can make it read outside of its memory. What dies here dies alone.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from soma_core.apart import limit_process

__all__: list[str] = []

_MOST_LAYERS, _MOST_PRIMS = 1000, 200_000
_TOUCHING_S = 1.0


class _RefusedError(Exception):
    """Why the file is not opened."""


def _layers(path: Path, *, anywhere: bool) -> None:
    """Open the layer and all that it refers to, each of which must be a file in its folder."""
    from pxr import Sdf

    folder, waiting, known = os.path.realpath(path.parent), [str(path)], set[str]()
    while waiting:
        name = waiting.pop()
        layer = Sdf.Layer.FindOrOpen(name)
        if layer is None:
            raise _RefusedError("USD cannot read it")
        if not anywhere:
            _refuse_clips(layer)
        for written in layer.GetCompositionAssetDependencies():
            found = _checked(layer, written, folder, anywhere=anywhere)
            if found and found not in known:
                known.add(found)
                waiting.append(found)
        if len(known) > _MOST_LAYERS:
            raise _RefusedError(f"refers to more than {_MOST_LAYERS} files")


def _checked(layer: Any, written: str, folder: str, *, anywhere: bool) -> str | None:
    """Identifier of a layer that may be opened; None where there is no such file."""
    from pxr import Ar, Sdf

    if not written:
        return None
    name = Sdf.ComputeAssetPathRelativeToLayer(layer, written)
    outer = name.partition(":SDF_FORMAT_ARGS:")[0]
    while Ar.IsPackageRelativePath(outer):
        outer = Ar.SplitPackageRelativePathOuter(outer)[0]
    real = os.path.realpath(str(Ar.GetResolver().Resolve(outer)) or outer)
    if not anywhere and ("://" in written or not Path(real).is_relative_to(folder)):
        raise _RefusedError(f"refers to {written[:200]}, which is outside of its folder")
    if os.path.exists(real) and not os.path.isfile(real):
        raise _RefusedError(f"refers to {written[:200]}, which is no file")
    return name if os.path.exists(real) else None


def _refuse_clips(layer: Any) -> None:
    """Value clips name their files by patterns, and are opened when values are asked for."""

    def look(place: Any) -> None:
        spec = layer.GetObjectAtPath(place) if place.IsPrimPath() else None
        if spec is not None and spec.HasInfo("clips"):
            raise _RefusedError(f"reads the values of {place} from other files (clips)")

    layer.Traverse("/", look)


def _prims(stage: Any) -> Iterator[Any]:
    for count, prim in enumerate(stage.TraverseAll()):
        if count > _MOST_PRIMS:
            raise _RefusedError(f"unfolds to more than {_MOST_PRIMS} prims")
        yield prim


def _touch(stage: Any) -> None:
    """Read values, so that damage is met here: as many as a second allows."""
    end = time.monotonic() + _TOUCHING_S
    for prim in _prims(stage):
        for attribute in prim.GetAuthoredAttributes() if time.monotonic() < end else ():
            _touch_samples(attribute, end)


def _touch_samples(attribute: Any, end: float) -> None:
    attribute.Get()
    for sample in attribute.GetTimeSamples():
        if time.monotonic() > end:
            return
        attribute.Get(sample)


def _probe(path: Path, *, anywhere: bool) -> str | None:
    """Why the file is refused; None where it may be opened."""
    from pxr import Usd

    try:
        _layers(path, anywhere=anywhere)
        _touch(Usd.Stage.Open(str(path)))
    except _RefusedError as error:
        return str(error)
    except MemoryError:
        return "unfolds to more memory than its size can mean"
    except RuntimeError:  # Tf.ErrorException, with lines of C++
        return "USD cannot read it"
    return None


if __name__ == "__main__":
    _path, _anywhere, _seconds, _size = sys.argv[1:]
    limit_process(int(_seconds), int(_size))
    sys.stdout.write("\n" + json.dumps({"refused": _probe(Path(_path), anywhere=_anywhere == "True")}) + "\n")
    sys.stdout.flush()
    os._exit(0)  # what a damaged file left behind may not survive an orderly end
