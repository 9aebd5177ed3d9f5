"""GarmentMeasurements for SOMA Core: bodies of a shape space of scans, read from the user's own file.

The model (https://github.com/mbotsch/GarmentMeasurements) is under the GPL-3.0. Nothing of it is part of this
package; ``soma backends convert garment point.pca`` makes what is read.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from soma_core import InputError
from soma_core.plugin import (
    BackendSpec,
    FileNeeded,
    Generator,
    Parameter,
    WrapPair,
    atomic_write,
    hookimpl,
    model_folders,
)

if TYPE_CHECKING:
    import torch

__all__ = ["soma_backend", "soma_convert", "soma_generator"]

_URL = "https://github.com/mbotsch/GarmentMeasurements"


def _place(*names: str) -> Path:
    """The first folder that holds all of these files, or where they go."""
    folders = model_folders("GarmentMeasurements")
    return next((one for one in folders if all((one / name).is_file() for name in names)), folders[0])


def _model() -> Path:
    return _place("point.npz") / "point.npz"


def _convert() -> str:
    """The command that makes what is read, of the published file where a folder of assets holds it."""
    found = _place("point.pca") / "point.pca"
    return f"soma backends convert garment {shlex.quote(str(found)) if found.is_file() else found.name}"


@hookimpl
def soma_backend() -> BackendSpec:
    """Declare the model and the files that only the user can supply."""
    pair = _place("mean.obj", "SOMA_wrap.obj")
    native, wrap = pair / "mean.obj", pair / "SOMA_wrap.obj"
    return BackendSpec(
        name="garment",
        api=2,
        unit="m",
        up="+y",
        forward="+z",
        params=(
            Parameter(
                name="coefficients",
                shape=(15,),
                description="of the principal components, in standard deviations; the first move a body most",
            ),
        ),
        wrap=WrapPair(native=native, wrap=wrap),
        fill_segments=("mouth_bag", "eye_bags", "between_toes"),
        files=(
            FileNeeded(path=_model(), description="the converted shape space", url=_URL, command=_convert()),
            FileNeeded(path=native, description="its mean body, mean.obj beside point.pca", url=_URL),
            FileNeeded(
                path=wrap,
                description="the canonical mesh laid on it",
                command=f"soma wrap native={native} out={wrap.parent}",
            ),
        ),
        licence="GPL-3.0",
        url=_URL,
        description="GarmentMeasurements, from the user's own file",
    )


@hookimpl
def soma_generator(device: torch.device, dtype: torch.dtype) -> Generator:
    """Build the generator from the converted file."""
    from soma_backend_garment._generator import GarmentGenerator
    from soma_backend_garment._point_pca import read_npz

    return GarmentGenerator(read_npz(_model()), device, dtype)


@hookimpl
def soma_convert(source: Path, output: Path | None) -> Sequence[Path]:
    """Write ``point.npz`` of ``point.pca``, and copy ``mean.obj`` from beside it, where the backend looks."""
    from soma_backend_garment._point_pca import read_pca, write_npz

    native, mean = _place("mean.obj") / "mean.obj", source.with_name("mean.obj")
    target = output or _model()
    if target.suffix.lower() != ".npz":
        raise InputError("--output", got=str(target), expected="an .npz", fix="Leave it out.")
    write_npz(target, read_pca(source), source=source)
    if native.exists() or not mean.is_file():
        return [target]
    atomic_write(native, lambda temporary: shutil.copyfile(mean, temporary))
    return [target, native]
