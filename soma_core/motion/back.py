"""The way back: motions of this skeleton as pose parameters or vertices of another model."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.cache import atomic_text
from soma_core.errors import InputError
from soma_core.io.amass import SMPL_JOINTS
from soma_core.io.motion import Motion
from soma_core.io.motion_files import check_rig
from soma_core.layer import SomaLayer
from soma_core.motion.animated import animate
from soma_core.motion.chunks import FittedChunks
from soma_core.motion.converter import Converted, earlier_report
from soma_core.motion.files import ResultFiles, fingerprint, layout_of, no_motion, read
from soma_core.motion.identities import stored_identity
from soma_core.motion.models import model_settings, open_layer
from soma_core.motion.native_errors import NativeErrors
from soma_core.motion.native_results import NativeTarget, SmplTarget, VertexTarget
from soma_core.motion.options import ConvertOptions
from soma_core.motion.questions import heard, of_motion, of_params, say
from soma_core.native import NativeFit, NativeTransfer
from soma_core.plugin.registry import default_registry
from soma_core.progress import progress
from soma_core.skeleton.identity import Identity

__all__ = ["BackConverter"]

_log = logging.getLogger(__name__)

_SEARCHED = 20
"""Frames, spread over the motion, that a body is found from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _MovingBody:
    """A motion on one identity."""

    layer: SomaLayer
    identity: Identity
    motion: Motion

    def posed(self, frames: slice | np.ndarray) -> Tensor:
        """Canonical vertices (F, v, 3) [m] of some frames."""
        motion, layer = self.motion, self.layer
        rotations, hips = (
            torch.as_tensor(values[frames]).to(layer.device, layer.dtype)
            for values in (motion.rotations, motion.translation)
        )
        absolute = motion.convention == "absolute_local"
        return layer.pose(self.identity, rotations, hips, absolute=absolute).vertices


class BackConverter:
    """Converts one motion after another to a backend's model; layers and fits serve all of them.

    Args:
        options: of the conversion, whose ``to`` names the backend.
    """

    def __init__(self, options: ConvertOptions) -> None:
        self._options = options
        self._layers: dict[str, SomaLayer] = {}
        self._targets: dict[str, NativeFit | NativeTransfer] = {}

    @torch.no_grad()
    def __call__(self, path: Path, files: ResultFiles, chunks: Path) -> Converted:
        """Convert a file; see ``Converter``."""
        layout = layout_of(path)
        if layout is None:
            raise no_motion(path)[0]
        if layout not in ("soma", "kimodo"):
            raise InputError(
                str(path),
                got=f"the layout {layout}",
                expected="a motion on this skeleton, for the way back",
                fix="Convert it with to=soma first.",
            )
        options = self._options
        with heard() as said:
            motion = read(
                path, fps=options.fps, unit=options.unit, angles=options.angles, convention=options.convention
            )
            layer, stored = self._body(path, motion)
            target = self._target(stored)
            own = "" if options.backend is None else "backend.params."
            say(path.name, of_motion(motion) + of_params(layer.spec, stored.get("params", {}), setting=own))
            if isinstance(target, SmplTarget) and options.betas is not None:
                say(path.name, of_params(target.fit.spec, target.params or {}, setting=""))
        settings = {
            "input": str(path.resolve()), "layout": layout, "fps": motion.fps, "body": stored["backend"],
            "body_params": stored.get("params"), "translation": str(self._options.translation),
            **model_settings(layer), **target.facts, "content": fingerprint(path),
        }  # fmt: skip
        vertices = isinstance(target, VertexTarget)
        earlier = earlier_report(files.report, files.vertices if vertices else files.motion, settings)
        if earlier is not None:
            return Converted(report=earlier, files=files, earlier=True, vertices=vertices)
        kept = FittedChunks(chunks, settings, frame_count=motion.frame_count, size=self._options.chunk)
        body = _placed(layer, stored_identity(layer, stored), motion, str(self._options.translation))
        if isinstance(target, SmplTarget) and target.params is None:
            target = replace(target, params=_found_params(kept.folder / "params.json", target, body))
            settings["found"] = target.params
        _convert_missing(body, target, kept)
        figures = target.write(kept, files, fps=motion.fps, source=motion.source)
        report = {"settings": settings, **figures, "warnings": said}
        atomic_text(files.report, json.dumps(report, indent=2, default=float) + "\n")
        kept.remove()
        return Converted(report=report, files=files, vertices=vertices)

    def _body(self, path: Path, motion: Motion) -> tuple[SomaLayer, Mapping[str, Any]]:
        """Whose body moves: that of the configuration, else that of the motion file."""
        chosen, stored = self._options.backend, motion.identity
        if chosen is not None:
            stored = {"backend": chosen.name, "params": chosen.params, "options": chosen.options}
        elif "params" not in stored and "rest" not in stored:
            raise InputError(
                "backend",
                got=f"none, and no body in {path.name}",
                expected="whose body moves",
                fix="Pass backend=NAME and backend.params.KEY=VALUE; backend=soma is a mean body.",
            )
        name, options = str(stored["backend"]), dict(stored.get("options", {}))
        key = f"{name} {sorted(options.items())}"
        if key not in self._layers:
            self._layers[key] = open_layer(self._options, name, options)
        return self._layers[key], stored

    def _target(self, stored: Mapping[str, Any]) -> NativeTarget:
        """What becomes of the body; in the SMPL family it keeps the parameters that it has there."""
        chosen, name = self._options, self._options.to
        kind = {"lod": str(chosen.lod), "device": chosen.device}
        if str(chosen.result or _usual_result(name)) == "vertices":
            _refuse_for_vertices(chosen)
            if name not in self._targets:
                self._targets[name] = NativeTransfer(name, **kind)
            return VertexTarget(transfer=self._targets[name])
        if name not in SMPL_JOINTS:
            raise InputError(
                "result", got=f"poses of {name}", expected=f"poses of one of {', '.join(SMPL_JOINTS)}",
                fix="Pass result=vertices.",
            )  # fmt: skip
        own = stored if stored["backend"] == name and "rest" not in stored else {}
        kept = str(own.get("options", {}).get("gender", "neutral"))
        gender = str(chosen.gender or kept)
        own = own if gender == kept else {}  # its coefficients are another body in another gender's model
        params = {"betas": list(chosen.betas)} if chosen.betas is not None else own.get("params")
        (width,) = default_registry().spec(name).params[0].shape
        if chosen.betas is not None and len(chosen.betas) > width:
            raise InputError(
                "betas", got=f"{len(chosen.betas)} coefficients",
                expected=f"at most {width}, as your {name} model has", fix="Leave the last ones out.",
            )  # fmt: skip
        if gender not in self._targets:
            self._targets[gender] = NativeFit(name, options={"gender": gender}, **kind)
        fit = self._targets[gender]
        errors = NativeErrors(fit.transfer, kind["lod"])
        return SmplTarget(
            fit=fit, errors=errors, model=name, gender=gender, up=chosen.upward or "+z", params=params
        )


def _placed(layer: SomaLayer, identity: Identity, motion: Motion, translation: str) -> _MovingBody:
    """The body where it is to stand."""
    if not check_rig(motion, layer.rig.revision):
        _log.info("the motion was made for rig %s; its relative rotations carry over", motion.rig_revision)
    if translation != "motion":
        motion = animate(layer, identity, motion, translation=translation).motion
    return _MovingBody(layer=layer, identity=identity, motion=motion)


def _found_params(file: Path, target: SmplTarget, body: _MovingBody) -> dict[str, list[float]]:
    """Parameters of the model's body that comes nearest, or those that an earlier run found."""
    if not file.is_file():
        frames = body.motion.frame_count
        spread = np.unique(np.linspace(0, frames - 1, min(_SEARCHED, frames)).round().astype(int))
        _log.info("finding the body from %d frames", len(spread))
        found = target.fit.fit_params(body.posed(spread))
        atomic_text(file, json.dumps({name: value[0].tolist() for name, value in found.items()}))
    return dict(json.loads(file.read_text(encoding="utf-8")))


def _convert_missing(body: _MovingBody, target: NativeTarget, kept: FittedChunks) -> None:
    """Pose and convert the chunks that are not there yet."""
    missing, total = kept.missing(), len(kept.ranges)
    for number in progress(missing, label="chunk", total=total, done=total - len(missing), after=5.0):
        kept.save(number, target.arrays(body.posed(slice(*kept.ranges[number]))))


def _usual_result(name: str) -> str:
    return "poses" if name in SMPL_JOINTS else "vertices"


def _refuse_for_vertices(options: ConvertOptions) -> None:
    """Refuse what only pose parameters have."""
    for name in ("up", "gender", "betas"):
        if getattr(options, name) is not None:
            raise InputError(
                name,
                got=str(getattr(options, name)),
                expected=f"none: vertices of {options.to} have the axes of that model",
                fix=f"Leave {name} out.",
            )
