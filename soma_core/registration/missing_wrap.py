"""The wrap pair of a backend that its user has yet to make, made once, where the backend looks for it."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from soma_core.errors import InputError
from soma_core.obj import read_obj
from soma_core.plugin.registry import Registry, default_registry
from soma_core.registration.native_mesh import NativeMesh, neutral_mesh
from soma_core.registration.pair_files import WRAP_FILE, write_pair, write_report
from soma_core.registration.quality import measure
from soma_core.registration.register import WrapOptions, register
from soma_core.rig import load_canonical

__all__ = ["make_missing_wrap"]

_log = logging.getLogger(__name__)


def make_missing_wrap(name: str, options: Mapping[str, Any], *, registry: Registry | None = None) -> None:
    """Lay the canonical mesh on a backend's neutral mesh, and write the pair where its declaration says.

    A native mesh that is there already is taken as it is: a pair must be of one mesh. The report
    ``report.json`` goes beside the pair. Says before it starts that it takes minutes; shows its progress.

    Args:
        name: of a backend whose declaration names a pair.
        options: the backend's own, for the model that makes the neutral mesh.
        registry: where it is looked up.

    Raises:
        SomaError: the mesh cannot be had, is broken, or shows no human body; faults of the wrap.
    """
    registry = registry or default_registry()
    spec = registry.spec(name)
    pair = spec.wrap
    assert pair is not None
    if pair.wrap.name != WRAP_FILE or pair.native.parent != pair.wrap.parent:
        return  # a published pair is expected; what is missing is named by who asked
    _log.info(
        "%s has no wrap yet: laying the canonical mesh on its own mesh, which takes a few minutes, once. "
        "It is kept in %s",
        name, pair.wrap.parent,
    )  # fmt: skip
    if pair.native.is_file():
        vertices, triangles = read_obj(pair.native)
        up, forward = spec.wrap_up or spec.up, spec.wrap_forward or spec.forward
        native = NativeMesh(
            vertices=vertices, triangles=triangles, name=pair.native.name, file=pair.native,
            known={"unit": spec.unit, "up": up, "forward": forward},
        )  # fmt: skip
    else:
        native = replace(neutral_mesh(registry, name, options=options, params={}), name=pair.native.name)
    mesh, _ = load_canonical("mid")
    found = register(
        native.vertices,
        native.triangles,
        options=WrapOptions(**(native.known or {}), fill=spec.fill_segments),
    )
    quality = measure(found, mesh)
    write_report(pair.wrap.parent, found, quality, native=native.name)
    if quality.faults:
        raise InputError(
            "the wrap that was made",
            got=quality.told(),
            expected="a body that is covered, fingers one to one",
            fix=f"Name points in a file: soma wrap backend={name} landmarks=FILE out={pair.wrap.parent}",
        )
    write_pair(pair.wrap.parent, found, mesh, vertices=native.vertices, triangles=native.triangles,
               name=native.name, source=native.file)  # fmt: skip
    distance = quality.as_dict()["surface_distance_mm"]
    _log.info("%s: wrap made, %.3f mm from its mesh on average", name, distance["mean"])
