"""Declaring, building and converting: the same for the three models."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from soma_backend_smpl._files import SUFFIXES, canonical_path, find_models, gender_of, wrap_paths
from soma_backend_smpl._model_file import read_model, shape_width
from soma_backend_smpl.family import FAMILIES, Family
from soma_core import AssetError, InputError
from soma_core.plugin import (
    BackendSpec,
    FileNeeded,
    Generator,
    Parameter,
    WrapPair,
    atomic_arrays,
    file_sha256,
    write_obj,
)

if TYPE_CHECKING:
    import torch

__all__ = ["SmplOptions", "build", "convert", "declare"]

LICENCE = "non-commercial research, by registration (Max Planck); never redistributed"
_USUAL_WIDTH = 10


@dataclass(frozen=True, kw_only=True)
class SmplOptions:
    """Options of the three backends.

    Attributes:
        gender: which of the user's files is used.
        components: leading shape directions that are kept; None keeps all of the file.
    """

    gender: Literal["neutral", "male", "female"] = "neutral"
    components: int | None = None

    def __post_init__(self) -> None:
        """Refuse to keep nothing."""
        if self.components is not None and self.components < 1:
            raise InputError(
                "backend.options.components", got=self.components, expected="at least 1", fix="Leave it out"
            )


def declare(family: Family) -> BackendSpec:
    """Declare a model: as many betas as the user's file has, and the files that are needed."""
    found = find_models(family)
    model = found.get("neutral") or next(iter(found.values()), canonical_path(family, "neutral"))
    width = shape_width(model, family) if model.exists() else None
    native, wrap = wrap_paths(family)
    source = str(model) if model.exists() else "FILE"
    return BackendSpec(
        name=family.name,
        api=2,
        unit="m",
        up="+y",
        forward="+z",
        params=(
            Parameter(
                name="betas",
                shape=(width or _USUAL_WIDTH,),
                description="shape coefficients, in standard deviations; the first ones move a body most",
            ),
        ),
        wrap=WrapPair(native=native, wrap=wrap),
        fill_segments=("mouth_bag", "eye_bags", "between_toes"),
        files=(
            FileNeeded(
                path=model,
                description=f"the {family.title} model",
                url=family.url,
                command=f"soma backends convert {family.name} FILE",
            ),
            FileNeeded(
                path=native,
                description="its mesh as OBJ",
                command=f"soma backends convert {family.name} {source}",
            ),
            FileNeeded(
                path=wrap,
                description="the canonical mesh laid on it",
                command=f"soma wrap native={native} out={wrap.parent}",
            ),
        ),
        options=SmplOptions,
        licence=LICENCE,
        url=family.url,
        description=f"{family.title}, from the user's own file",
    )


def build(
    family: Family, spec: BackendSpec, device: torch.device, dtype: torch.dtype, options: SmplOptions
) -> Generator:
    """Read the model of the gender asked for.

    Raises:
        AssetError: the user has no such model, or the file is refused.
    """
    from soma_backend_smpl._generator import SmplGenerator

    found = find_models(family)
    gender = options.gender
    if gender not in found:
        others = f"; there are {', '.join(found)}" if found else ""
        raise AssetError(
            canonical_path(family, gender),
            cause=f"no {gender} {family.title} model is there{others}",
            fix=f"Get it from {family.url}, then run: soma backends convert {family.name} FILE",
        )
    (count,) = spec.params[0].shape
    return SmplGenerator(
        read_model(found[gender], family),
        device,
        dtype,
        parameter_count=count,
        components=options.components,
    )


def convert(family: Family, source: Path, output: Path | None) -> list[Path]:
    """Write the arrays that are needed as an ``.npz`` without objects, and the mesh as an OBJ.

    The model goes to ``<data folder>/SMPL/SMPL_NEUTRAL.npz`` and the like, or to `output`; the OBJ, which
    ``soma wrap`` needs, where the backend looks for it, if none is there yet.

    Raises:
        AssetError: the file is refused.
        InputError: neither name tells the gender, or `output` is no ``.npz``.
    """
    if source.suffix.lower() not in SUFFIXES or (output and output.suffix.lower() != ".npz"):
        wrong = source if source.suffix.lower() not in SUFFIXES else output
        raise InputError(
            "FILE",
            got=str(wrong),
            expected="an .npz or .pkl, and an .npz to write",
            fix="Give the model's file.",
        )
    gender = gender_of(source, *FAMILIES) or (gender_of(output, *FAMILIES) if output else None)
    if gender is None:
        raise InputError(
            "FILE",
            got=f"the name {source.name}",
            expected=f"a name that tells the gender, such as {canonical_path(family, 'male').name}",
            fix="Rename the file, or give such a name by --output.",
        )
    model = read_model(source, family)
    target = output or canonical_path(family, gender)
    meta = {
        "model": family.title, "gender": gender, "source": source.name, "source_sha256": file_sha256(source),
        "shape_count": model.shapes.shape[2], "expression_count": model.expressions.shape[2],
        "unit": "m", "up_axis": "+y", "forward_axis": "+z", "licence": LICENCE, "url": family.url,
    }  # fmt: skip
    arrays = model.arrays() | {"meta": np.array(json.dumps(meta, sort_keys=True))}
    atomic_arrays(target, arrays, compressed=False)
    native, _ = wrap_paths(family)
    if native.exists():
        return [target]
    write_obj(native, model.template.astype(np.float32), model.faces)  # the precision of the converted model
    return [target, native]
