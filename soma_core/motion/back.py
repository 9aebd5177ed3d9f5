"""The way back: motions of this skeleton as pose parameters or vertices of another model."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from soma_core.cache import atomic_text
from soma_core.choices import Product, SmplLayout
from soma_core.errors import InputError
from soma_core.io.amass import SMPL_JOINTS
from soma_core.json_file import read_json
from soma_core.motion.bodies import other_way
from soma_core.motion.chunks import FittedChunks
from soma_core.motion.converter import Converted, earlier_report
from soma_core.motion.files import ResultFiles, fingerprint, layout_of, no_motion, read
from soma_core.motion.models import model_settings
from soma_core.motion.native_errors import NativeErrors
from soma_core.motion.native_results import (
    ModelTarget,
    NativeTarget,
    ParameterTarget,
    SmplTarget,
    VertexTarget,
)
from soma_core.motion.options import ConvertOptions
from soma_core.motion.played import MovingBodies, Played, placing_of
from soma_core.motion.questions import heard, of_motion, of_params, say
from soma_core.native import NativeFit, NativeTransfer, ParameterFit
from soma_core.plugin.errors import BackendError
from soma_core.plugin.registry import default_registry
from soma_core.plugin.spec import HasSkinning, MotionFormat
from soma_core.progress import progress

__all__ = ["BackConverter"]

_log = logging.getLogger(__name__)

_OTHER_RESULT = (
    "Only that file tells what the parameters do, no mesh of the model does. "
    "Or leave result=poses out, for vertices, which need the wrap pair alone"
)


class BackConverter:
    """Converts one motion after another to a backend's model; layers and fits serve all of them.

    Args:
        options: of the conversion, whose ``to`` names the backend.
    """

    def __init__(self, options: ConvertOptions) -> None:
        self._options = options
        self._bodies = MovingBodies(options, options.backend, placing_of(options))
        self._targets: dict[str, NativeFit | NativeTransfer | ParameterFit] = {}

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
                path, fps=options.fps, unit=options.unit, angles=options.angles,
                convention=options.convention, person=options.person,
            )  # fmt: skip
            layer, stored = self._bodies.layer_of(path, motion)
            target, placing = self._target(stored), placing_of(options)
            if isinstance(target, SmplTarget) and (stored["backend"], target.model) == ("smplx", "smplx"):
                target = replace(target, expression=motion.expression)
            own = "" if options.backend is None else "backend.params."
            say(path.name, of_motion(motion) + of_params(layer.spec, stored.get("params", {}), setting=own))
            if isinstance(target, SmplTarget) and options.betas is not None:
                say(path.name, of_params(target.fit.spec, target.params or {}, setting=""))
        settings = {
            "input": str(path.resolve()), "layout": layout, "fps": motion.fps, "body": stored["backend"],
            "body_params": stored.get("params"), **placing, **model_settings(layer), **target.facts,
            "content": fingerprint(path),
        }  # fmt: skip
        vertices = isinstance(target, VertexTarget)
        results = target.results(files)
        earlier = earlier_report(files.report, results, settings)
        if earlier is not None:
            return Converted(report=earlier, files=files, earlier=True, vertices=vertices, written=results)
        kept = FittedChunks(chunks, settings, frame_count=motion.frame_count, size=self._options.chunk)
        body = self._bodies.played(path, layer, stored, motion)
        if not isinstance(target, VertexTarget) and target.params is None:
            target = replace(target, params=_found_params(kept.folder / "params.json", target, body))
            settings["found"] = target.params
        _convert_missing(body, target, kept)
        figures = target.write(kept, files, fps=motion.fps, source=motion.source)
        report = {"settings": settings, **figures, "warnings": said}
        atomic_text(files.report, json.dumps(report, indent=2, default=float) + "\n")
        kept.remove()
        return Converted(report=report, files=files, vertices=vertices, written=results)

    def _target(self, stored: Mapping[str, Any]) -> NativeTarget:
        """What becomes of the body; in the SMPL family it keeps the parameters that it has there."""
        chosen, name = self._options, self._options.to
        kind = {"lod": str(chosen.lod), "device": chosen.device}
        if str(chosen.result or _usual_result(chosen)) == "vertices":
            _refuse_for_vertices(chosen)
            if name not in self._targets:
                self._targets[name] = NativeTransfer(name, **kind)
            products = tuple(chosen.shown or [Product.vertices])
            return VertexTarget(transfer=self._targets[name], products=products)
        own = stored if stored["backend"] == name and "rest" not in stored else {}
        if name not in SMPL_JOINTS:
            form = written_format(name)
            return self._parameter_target(own, kind) if form is None else self._model_target(own, kind, form)
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
        return SmplTarget(
            fit=fit, errors=NativeErrors(fit.transfer, kind["lod"]), model=name, gender=gender,
            up=chosen.upward or "+z", params=params, width=chosen.num_betas,
            layout=str(chosen.layout or SmplLayout.amass), expected=chosen.inversion.priors.expected,
        )  # fmt: skip

    def _model_target(
        self, own: Mapping[str, Any], kind: Mapping[str, Any], form: MotionFormat
    ) -> NativeTarget:
        """What becomes of the body in the model of a plugin that writes motion files."""
        name, options = self._options.to, own.get("options") or {}
        self._refuse_smpl_settings()
        if name not in self._targets:
            generator = default_registry().generator(
                name, options=options, device=torch.device(kind["device"]), dtype=torch.float32
            )
            fit = NativeFit if isinstance(generator, HasSkinning) else ParameterFit
            self._targets[name] = fit(name, options=options, **kind)
        fit = self._targets[name]
        return ModelTarget(
            fit=fit, errors=NativeErrors(fit.transfer, kind["lod"]), model=name, form=form,
            params=own.get("params"), options=options,
        )  # fmt: skip

    def _refuse_smpl_settings(self) -> None:
        """Refuse what only models of the SMPL family have."""
        chosen, name = self._options, self._options.to
        for setting in ("up", "axes", "gender", "betas", "num_betas", "layout"):
            if getattr(chosen, setting) is not None:
                raise InputError(
                    setting, got=str(getattr(chosen, setting)), expected=f"none with to={name}",
                    fix=f"Leave {setting} out.",
                )  # fmt: skip

    def _parameter_target(self, own: Mapping[str, Any], kind: Mapping[str, Any]) -> NativeTarget:
        """What becomes of the body in a model whose pose is one vector."""
        name = self._options.to
        self._refuse_smpl_settings()
        if name not in self._targets:
            try:
                self._targets[name] = ParameterFit(name, options=own.get("options"), **kind)
            except BackendError as error:
                raise other_way(error, _OTHER_RESULT) from error
        fit = self._targets[name]
        return ParameterTarget(
            fit=fit, errors=NativeErrors(fit.transfer, kind["lod"]), model=name, params=own.get("params")
        )


def _found_params(
    file: Path, target: SmplTarget | ParameterTarget | ModelTarget, body: Played
) -> dict[str, list[float]]:
    """Parameters of the model's body that comes nearest, or those that an earlier run found."""
    if not file.is_file():
        found = target.find(body)
        atomic_text(file, json.dumps({name: value[0].tolist() for name, value in found.items()}))
    return dict(read_json(file, fix="Delete it."))


def _convert_missing(body: Played, target: NativeTarget, kept: FittedChunks) -> None:
    """Pose and convert the chunks that are not there yet."""
    missing, total = kept.missing(), len(kept.ranges)
    for number in progress(missing, label="chunk", total=total, done=total - len(missing), after=5.0):
        kept.save(number, target.arrays(body, slice(*kept.ranges[number])))


def _usual_result(options: ConvertOptions) -> str:
    has_files = options.to in SMPL_JOINTS or written_format(options.to) is not None
    return "poses" if has_files and not options.shown else "vertices"


def written_format(name: str) -> MotionFormat | None:
    """The motion files of a backend that its plugin writes; None where there are none."""
    return next((each for each in default_registry().formats(name) if each.write is not None), None)


def _refuse_for_vertices(options: ConvertOptions) -> None:
    """Refuse what only pose parameters have."""
    for name in ("up", "gender", "betas", "num_betas", "layout"):
        if getattr(options, name) is not None:
            raise InputError(
                name,
                got=str(getattr(options, name)),
                expected=f"none: vertices of {options.to} have the axes of that model",
                fix=f"Leave {name} out.",
            )
