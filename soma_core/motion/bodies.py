"""Bodies that files show in a model of their own: what they are fitted with, and what is known of them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from soma_core.errors import AssetError, InputError
from soma_core.io.amass import SmplMotion
from soma_core.io.sam3d import Sam3dFrames, read_sam3d
from soma_core.io.vertex_files import open_vertex_sequence
from soma_core.motion.files import read_model_motion
from soma_core.motion.models import (
    FitBackend,
    FitBackends,
    HeldSequence,
    ModelSequence,
    TransferredSequence,
)
from soma_core.motion.options import ConvertOptions, FitOptions, InvertOptions
from soma_core.motion.posed_input import PosedInput
from soma_core.motion.questions import of_params, of_rate, of_smpl
from soma_core.motion.smpl_input import chosen_reading, smpl_choices, smpl_motion
from soma_core.motion.smpl_turns import turns_from_smpl
from soma_core.plugin.errors import BackendError, BrokenBackendError
from soma_core.plugin.registry import default_registry

if TYPE_CHECKING:
    from soma_core.plugin.spec import BackendSpec

__all__ = ["FITTED", "ShownBody", "is_fitted", "open_body", "other_way"]

_log = logging.getLogger(__name__)

_MHR, _DEFAULT = "mhr", "soma"
_BONE_LENGTHS, _SCALES = slice(130, 136), slice(136, 204)
"""Of the model parameters of MHR, those that belong to the body."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownBody:
    """One body over time, and how to fit it.

    Attributes:
        backend: layer and fit.
        posed: the vertices.
        params: the identity, or where the search for it begins.
        search: choices of the search for an identity that is not known; empty if it is.
        facts: what else decides the result, for the report.
        licence: of the motion.
        doubts: what is doubtful about it, for the log and the report.
        expression: (frames, k) coefficients of its face, which no fit of this skeleton finds; None without.
        expected: (frames, 77, 3, 3) about how its joints turn; None where the file does not tell.
    """

    backend: FitBackend
    posed: PosedInput
    params: Mapping[str, Any]
    search: Mapping[str, Any]
    facts: Mapping[str, Any]
    licence: str = ""
    doubts: tuple[str, ...] = ()
    expression: np.ndarray | None = None
    expected: np.ndarray | None = None


def open_body(path: Path, layout: str, options: FitOptions, backends: FitBackends | None = None) -> ShownBody:
    """The body that a file shows, ready to be fitted.

    Args:
        path: the file, or a folder of meshes.
        layout: one of `FITTED`.
        options: of the fit.
        backends: layers and fits, to share them between files.

    Raises:
        SomaError: the file, or the backend that it needs, cannot be used.
    """
    backends = backends or FitBackends(options)
    if layout in FITTED:
        return FITTED[layout](path, options, backends)
    return _model_body(path, layout, options, backends)


def is_fitted(layout: str) -> bool:
    """Whether files of a layout show bodies of a model, which are fitted: of the core's or of a plugin's."""
    return layout in FITTED or layout in default_registry().motion_formats()


def _model_body(path: Path, layout: str, options: FitOptions, backends: FitBackends) -> ShownBody:
    """The body of a file that a plugin reads, posed by the plugin's own model; see `read_model_motion`."""
    name, motion = read_model_motion(path, layout)
    backend = backends.get(name, motion.options)
    spec, params = backend.layer.spec, {key: np.asarray(each).tolist() for key, each in motion.params.items()}
    pose = {key: np.asarray(value) for key, value in motion.pose.items()}
    up = options.upward or motion.up or spec.up
    sequence = ModelSequence(path, backend, params, pose, fps=options.fps or motion.fps, up=up)
    return ShownBody(
        backend=backend,
        posed=PosedInput(sequence, backend.layer, topology="native"),
        params=params,
        search={},
        facts={"up": up},
        licence=f"that of {path.name}; body model: {spec.licence}",
        doubts=tuple(of_rate(sequence.fps or 0) + of_params(spec, params, setting="")),
    )


def _vertex_body(path: Path, options: InvertOptions, backends: FitBackends) -> ShownBody:
    """Vertices over time, of the canonical mesh or of a backend's.

    Raises:
        SomaError: the file cannot be read, or is none of the backend's.
        InputError: no frame rate.
    """
    sequence = open_vertex_sequence(
        path,
        fps=options.fps,
        unit=options.unit_name,
        up=options.upward,
        allow_references=options.allow_references,
    )
    try:
        if sequence.fps is None:
            raise InputError(
                "fps", got=f"none in {path.name}", expected="frames per second", fix="Pass fps=30."
            )
        backend = backends.get(options.backend.name, options.backend.options)
        posed = PosedInput(sequence, backend.layer, topology=options.topology)
    except BaseException:
        sequence.close()
        raise
    return ShownBody(
        backend=backend,
        posed=posed,
        params=options.backend.params,
        search=_search(options),
        doubts=tuple(of_rate(sequence.fps) + of_params(backend.layer.spec, options.backend.params)),
        facts={"unit_m": sequence.metres, "up": sequence.up, "topology": str(posed.topology)},
    )


def _search(options: FitOptions) -> dict[str, Any]:
    """Choices of the search for an identity, of which nothing matters where it is known."""
    return {} if options.identity.method == "known" else asdict(options.identity)


def _smpl_body(path: Path, options: ConvertOptions, backends: FitBackends) -> ShownBody:
    """The body of an SMPL motion: its model, posed with its betas and gender.

    Raises:
        SomaError: the file cannot be read, or the user's model of that gender is not there.
    """
    motion = smpl_motion(path, options, smpl_choices(options))
    backend = _with_way_out(
        backends, motion.model, {"gender": motion.gender}, "carry=skeleton, which needs no model"
    )
    params = {"betas": _usable_betas(path, motion, backend.layer.spec, options.most_betas)}
    pose = _model_pose(path, motion, backend, params)
    sequence = ModelSequence(path, backend, params, pose, fps=motion.fps, up=motion.up)
    return ShownBody(
        backend=backend,
        posed=PosedInput(sequence, backend.layer, topology="native"),
        params=params,
        search={},
        facts={"up": motion.up, **chosen_reading(options), **_units(options)},
        licence=f"that of {path.name}; body model: {backend.layer.spec.licence}",
        doubts=tuple(of_smpl(motion) + of_params(backend.layer.spec, params, setting="")),
        expression=motion.expression,
        expected=turns_from_smpl(motion, pose["rotations"]),
    )


def _model_pose(
    path: Path, motion: SmplMotion, backend: FitBackend, params: Mapping[str, Any]
) -> dict[str, np.ndarray]:
    """The pose as the model takes it: fingers from flat hands, the root turning about the pelvis.

    Raises:
        InputError: the user's model file does not hold its mean hands.
    """
    rotations, translation = motion.rotations, motion.translation
    fingers, flat = _fingers(path, motion, backend)
    if fingers is not None:
        rotations = np.concatenate([rotations[:, :-30], rotations[:, -30:] + fingers], axis=1)
    if not flat and motion.model != "smpl":
        mean = backend.mean_hands
        if mean is None:
            raise InputError(
                f"{path}: flat_hand_mean",
                got=f"false, and a {motion.model} model without hands_meanl, hands_meanr",
                expected="the official model file, which holds the mean hands",
                fix=f"Run: soma backends convert {motion.model} FILE. Or pass flat_hand_mean=true.",
            )  # fmt: skip
        rotations = rotations.copy()
        rotations[:, -30:] += mean
    if motion.about == "origin" or motion.camera_turns is not None:
        translation = motion.about_pelvis(backend.rest_joints(params)[0])
    return {"rotations": rotations, "translation": translation}


def _fingers(path: Path, motion: SmplMotion, backend: FitBackend) -> tuple[np.ndarray | None, bool]:
    """What the fingers (frames, 30, 3) turn by components of the hands, and whether zero is a flat hand."""
    values = motion.hand_components
    if values is None or not values.size or motion.model == "smpl":
        return None, motion.flat_hands
    directions = backend.hand_components
    if directions is None or values.shape[1] > 2 * directions.shape[1]:
        _log.warning(
            "%s: hands are %d components of the model's own, which your %s file does not hold: the fingers "
            "stay straight; `soma backends convert %s FILE` keeps them",
            path.name, values.shape[1] // 2, motion.model, motion.model,
        )  # fmt: skip
        return None, True
    coefficients = values.reshape(len(values), 2, -1)
    turned = np.einsum("fsn,snk->fsk", coefficients, directions[:, : coefficients.shape[2]])
    return turned.reshape(len(values), 30, 3).astype(np.float32), motion.flat_hands


def _usable_betas(path: Path, motion: SmplMotion, spec: BackendSpec, most: int | None) -> list[float]:
    """Shape coefficients for the user's model file, as many as the file has; zeros that it has not are cut.

    Raises:
        InputError: the model file has fewer shape directions.
    """
    betas = motion.betas[:most].astype(np.float64)
    (width,) = spec.params[0].shape
    betas = betas[: max(width, len(np.trim_zeros(betas, "b")))]
    if len(betas) > width:
        raise InputError(
            f"{path}: betas",
            got=f"{len(betas)} coefficients",
            expected=f"at most {width}, as your {spec.name} model has",
            fix=f"Pass most_betas={width} to leave the others out, or get a model file with more of them.",
        )
    return [float(value) for value in betas]


def _units(options: ConvertOptions) -> dict[str, str]:
    """Units that a person gave for a file, for the report."""
    given = {"unit": options.unit, "angles": options.angles}
    return {name: str(value) for name, value in given.items() if value is not None}


def _sam3d_body(path: Path, options: ConvertOptions, backends: FitBackends) -> ShownBody:
    """The body of a SAM 3D Body output: MHR with the file's parameters, or one that is yet to be found.

    Raises:
        SomaError: the file cannot be read, or the user's MHR model or its wrap pair is not there.
        InputError: no frame rate, or no parameters in the file.
    """
    if options.fps is None:
        raise InputError(
            f"{path}: fps", got="none: SAM 3D Body sees pictures", expected="frames per second",
            fix="Pass fps=30 (or the true rate).",
        )  # fmt: skip
    frames = read_sam3d(path, axes=_sam3d_axes(options), unit=options.unit_name or "m")
    vertices = frames.vertices
    if frames.placement is not None:
        vertices = vertices + frames.placement[:, None]
    sequence = HeldSequence(path, vertices, fps=float(options.fps))
    known = options.identity.method == "known"
    backend, params = _known_mhr(frames, options, backends) if known else _sought(options, backends)
    if known:
        posed = PosedInput(sequence, backend.layer, topology="native")
    else:
        _check_mhr_pair()
        posed = PosedInput(TransferredSequence(sequence, _MHR), backend.layer, topology="canonical")
    return ShownBody(
        backend=backend, posed=posed, params=params, search=_search(options), facts={"up": "+y"},
        licence=f"that of {path.name}",
        doubts=tuple(of_rate(options.fps) + ([] if known else of_params(backend.layer.spec, params))),
    )  # fmt: skip


def _sam3d_axes(options: ConvertOptions) -> Literal["camera", "model"]:
    """Axes of a SAM 3D Body file: the camera's, unless its vertices were turned upright already.

    Raises:
        InputError: another axis than these two.
    """
    if options.upward not in (None, "+y", "-y"):
        raise InputError(
            "up", got=str(options.up), expected="-y, as SAM 3D Body writes, or y for vertices turned back",
            fix="Leave up out.",
        )  # fmt: skip
    return "model" if options.upward == "+y" else "camera"


def _check_mhr_pair() -> None:
    """Refuse a missing wrap pair, which can be made without the model.

    Raises:
        AssetError: it is not there.
    """
    pair = default_registry().spec(_MHR).wrap
    for file in () if pair is None else (pair.native, pair.wrap):
        if not file.is_file():
            mesh, folder = f"{file.with_name(pair.native.name).stem}.ply", file.parent
            raise AssetError(
                file,
                cause="the wrap of MHR is missing",
                fix=f"Make it from any neutral MHR mesh of LOD 1: soma wrap native={mesh} out={folder}",
            )


def _known_mhr(
    frames: Sam3dFrames, options: ConvertOptions, backends: FitBackends
) -> tuple[FitBackend, dict[str, Any]]:
    """The user's MHR model, and the body that the file describes."""
    chosen = options.backend
    own = chosen.options if chosen is not None and chosen.name == _MHR else {}
    backend = _with_way_out(backends, _MHR, own, "identity=unknown, which needs the wrap pair alone")
    return backend, _mhr_params(frames)


def _with_way_out(backends: FitBackends, name: str, options: Mapping[str, Any], other: str) -> FitBackend:
    """A backend, or the refusal with another way to go.

    Raises:
        BackendError: it cannot be used.
    """
    try:
        return backends.get(name, options)
    except BackendError as error:
        raise other_way(error, f"Or pass {other}") from error


def other_way(error: BackendError, other: str) -> BackendError:
    """The refusal of a backend, with another way to go."""
    fix = f"{error.fix.rstrip('.')}. {other}"
    return BrokenBackendError(who=error.who, stage=error.stage, cause=error.cause, fix=fix)


def _sought(options: ConvertOptions, backends: FitBackends) -> tuple[FitBackend, dict[str, Any]]:
    """The backend in whose shapes a body is sought, and where the search begins."""
    chosen = options.backend
    if chosen is None:
        return backends.get(_DEFAULT, {}), {}
    return backends.get(chosen.name, chosen.options), chosen.params


def _mhr_params(frames: Sam3dFrames) -> dict[str, list[float]]:
    """One body for all frames: the mean of what was seen in each.

    Raises:
        InputError: outputs of early releases, which lack the model parameters.
    """
    missing = [key for key in ("shape_params", "mhr_model_params") if key not in frames.parameters]
    if missing:
        raise InputError(
            f"{frames.path}: {missing[0]}",
            got="none, as in the first releases of SAM 3D Body",
            expected="the parameters of the body",
            fix="Pass identity=unknown to find the body from its vertices.",
        )
    shape, model = (frames.parameters[key].astype(np.float64) for key in ("shape_params", "mhr_model_params"))
    seen = {"identity": shape, "bone_lengths": model[:, _BONE_LENGTHS], "scales": model[:, _SCALES]}
    return {name: values.mean(axis=0).tolist() for name, values in seen.items()}


FITTED: dict[str, Callable[[Path, Any, FitBackends], ShownBody]] = {
    "vertices": _vertex_body, "amass": _smpl_body, "smpl": _smpl_body, "sam3d": _sam3d_body,
}  # fmt: skip
"""Layouts whose bodies are fitted, and their readers."""
