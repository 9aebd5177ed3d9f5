"""Checks of what a generator offers besides rest bodies: each is called, and its result looked at."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core.native.skinned import pose_skinned
from soma_core.plugin.checks import CheckFailedError, CheckNotRunError, check
from soma_core.plugin.declaration import (
    expressions_problem,
    refuse_posed,
    skinned_problem,
    tensor_problem,
)
from soma_core.plugin.errors import PluginError
from soma_core.plugin.spec import (
    HasExpressions,
    HasPosed,
    HasPoseVector,
    HasRandomPoses,
    HasSkinning,
    HasTriangles,
    ModelMotion,
    MotionFormat,
)
from soma_core.testing.context import Context
from soma_core.testing.global_state import changes, snapshot

__all__ = ["CHECKS"]

_POSED_M = 1e-4
"""Metres. Models keep their weights and joints in float32, and round on the way."""

_TURN, _POSES, _FRAMES = 0.3, 3, 3
"""Size of the rotations that are tried [rad], poses that are drawn, and frames of a file."""

_EXPLODED = 4.0
"""Times the extent of the rest body that no pose of a person exceeds."""

_KEPT = 1e-5
"""What a file may lose of a rotation [rad], a length in native units, or a frame rate [1/s]: float32."""


def _lacks(kind: type, what: str) -> Callable[[Context], str]:
    def reason(context: Context) -> str:
        return "" if isinstance(context.generator, kind) else f"the generator offers no {what}"

    return reason


def _refuse(where: str, problem: str | None, fix: str) -> None:
    if problem is not None:
        got, _, expected = problem.partition(", expected ")
        raise CheckFailedError(where, got=got, expected=expected or "what the capability promises", fix=fix)


def _params(context: Context, count: int) -> dict[str, Tensor]:
    return context.random_params(count) or context.default_params(count)


def _distance(context: Context, where: str, found: Tensor, expected: Tensor, fix: str) -> None:
    _refuse(where, tensor_problem(found, tuple(expected.shape), like=expected), fix)
    distance = context.metres * (found - expected).norm(dim=-1)
    if not distance.max() <= _POSED_M:
        row, vertex = divmod(int(distance.argmax()), distance.shape[1])
        raise CheckFailedError(
            f"{where}, native vertex {vertex} of body {row}",
            got=f"{1000 * float(distance.max()):.3g} mm away",
            expected=f"at most {1000 * _POSED_M:g} mm",
            fix=fix,
        )


@check(
    "triangles",
    level="core",
    needs=("finite", "upright"),
    unless=_lacks(HasTriangles, "triangles"),
    mend="return vertex ids (t, 3), counter-clockwise from outside",
)
def triangles(context: Context) -> None:
    """The triangles are those of a surface whose outside is outside."""
    with torch.no_grad():
        faces: Any = context.generator.triangles()  # type: ignore[attr-defined]
        rest = context.generator.rest(context.default_params())[0] @ torch.tensor(context.native_frame).T
    shape = getattr(faces, "shape", ())
    whole = isinstance(faces, Tensor) and not faces.is_floating_point() and faces.dtype != torch.bool
    if not whole or not len(faces) or tuple(shape[1:]) != (3,):
        kind = f"{faces.dtype} {tuple(shape)}" if isinstance(faces, Tensor) else type(faces).__name__
        _refuse("triangles()", f"{kind}, expected whole numbers (t, 3)", "Return a tensor of vertex ids.")
    if faces.min() < 0 or faces.max() >= len(rest):
        problem = f"ids from {int(faces.min())} to {int(faces.max())}, expected 0 to {len(rest) - 1}"
        _refuse("triangles()", problem, "Count native vertices from 0.")
    a, b, c = rest[faces.long()].unbind(1)
    if not (torch.linalg.cross(a, b) * c).sum() > 0:
        _refuse(
            "triangles()", "faces that look inward, expected counter-clockwise seen from outside",
            "Exchange two columns.",
        )  # fmt: skip


@check(
    "skinning",
    level="core",
    needs=("inputs-unchanged", "batch-invariant"),
    unless=_lacks(HasSkinning, "skinning"),
    mend="return a `SkinnedModel` of the rest bodies: parents first, weights that sum to 1",
)
def skinning(context: Context) -> None:
    """The skeleton that the generator tells is one, of the bodies that it generates."""
    params = _params(context, 2)
    with torch.no_grad():
        model: Any = context.generator.skinning(params)  # type: ignore[attr-defined]
        rest = context.generator.rest(params)
    fix = "Return soma_core.plugin.SkinnedModel for the params given."
    _refuse("skinning()", skinned_problem(model, len(rest), context.native_count), fix)
    _distance(
        context, "skinning().rest", model.rest, rest, "Return the bodies of rest() for the same params."
    )
    still = torch.eye(3, dtype=torch.float64).expand(*model.joints.shape[:2], 3, 3)
    if model.pose_offsets is not None:
        with torch.no_grad():
            moved = model.pose_offsets(still)
        _distance(
            context, "skinning().pose_offsets of no rotation", moved, torch.zeros_like(rest),
            "Let the rest pose add nothing.",
        )  # fmt: skip
    low, high = torch.aminmax(rest, dim=1, keepdim=True)
    margin = 0.25 * (high - low).amax()
    outside = ((model.joints < low - margin) | (model.joints > high + margin)).any(-1).any(0)
    if outside.any():
        name = model.joint_names[int(outside.nonzero()[0])]
        _refuse("skinning().joints", f"{name} far outside the body, expected inside", "Check unit and axes.")


@check(
    "posed",
    level="core",
    needs=("inputs-unchanged", "batch-invariant", "skinning"),
    unless=_lacks(HasPosed, "posed"),
    mend="return (batch, n, 3); zeros are the rest mesh, other poses what `skinning` says",
)
def posed(context: Context) -> None:
    """Posed bodies are those of the model: rest at zero, skinned as it tells elsewhere."""
    generator: Any = context.generator
    any_generator: Any = generator  # not narrowed by what is asked below
    params = _params(context, 2)
    with torch.no_grad():
        rest = generator.rest(params)
        if isinstance(generator, HasSkinning):
            _compare_skinned(context, generator, params)
            return
        if isinstance(generator, HasPoseVector):
            still = torch.zeros(len(rest), generator.pose_size, dtype=torch.float64)
            found = generator.posed(params, {"parameters": still})
            _distance(context, "posed() at zero", found, rest, "Zero is the rest mesh.")
            return
        if not isinstance(generator, HasRandomPoses):
            _refuse_no_mesh(any_generator, params, len(rest))
            raise CheckNotRunError(
                "nothing tells the form of a pose: offer skinning(), a pose vector or random_poses()"
            )
        found = any_generator.posed(params, generator.random_poses(len(rest), 0))
    _refuse("posed()", tensor_problem(found, tuple(rest.shape), like=rest), "Return every native vertex.")


def _refuse_no_mesh(generator: Any, params: Mapping[str, Tensor], count: int) -> None:
    """Refuse what is no mesh of `count` bodies, where a pose of a usual form brings any."""
    still = torch.zeros(count, 3, dtype=torch.float64)
    pose = {"rotations": still[:, None], "translation": still, "parameters": still}
    try:
        found = generator.posed(params, pose)
    except Exception:  # it takes another form
        return
    try:
        refuse_posed(found, count)
    except PluginError as error:
        _refuse("posed()", str(error.cause).removeprefix("posed returned "), "Return every native vertex.")


def _compare_skinned(context: Context, generator: Any, params: Mapping[str, Tensor]) -> None:
    model = generator.skinning(params)
    count, joints = model.joints.shape[:2]
    random = torch.Generator(device="cpu").manual_seed(0)
    turns = _TURN * torch.randn(count, joints, 3, generator=random, dtype=torch.float64, device="cpu")
    shift = 0.5 / context.metres * torch.ones(count, 3, dtype=torch.float64)
    for label, size in (("at zero", 0.0), ("with every joint turned", 1.0)):
        pose = {"rotations": size * turns, "translation": size * shift}
        expected = pose_skinned(model, pose["rotations"], pose["translation"])
        fix = "posed() takes rotations (b, J, 3) [rad] and translation (b, 3), and skins as skinning() tells."
        _distance(context, f"posed() {label}", generator.posed(params, pose), expected, fix)


@check(
    "random-poses",
    needs=("posed", "no-global-state"),
    unless=_lacks(HasRandomPoses, "random poses"),
    mend="draw from the seed given, poses that a person could take, in the form of `posed`",
)
def random_poses(context: Context) -> None:
    """Random poses are poses, the same for the same seed, others for another."""
    generator: Any = context.generator
    params = context.default_params(_POSES)
    before = snapshot()
    with torch.no_grad():
        rest = generator.rest(params)
        drawn = [generator.posed(params, generator.random_poses(_POSES, seed)) for seed in (0, 0, 1)]
    if changes(before):
        _refuse(
            "random_poses()", f"a change of {', '.join(changes(before))}, expected none",
            "Draw from a generator of your own, made from the seed.",
        )  # fmt: skip
    for found in drawn:
        _refuse(
            "posed() of random_poses()", tensor_problem(found, tuple(rest.shape), like=rest), "Mend either."
        )
    extent = float((rest.amax((0, 1)) - rest.amin((0, 1))).norm())
    if not float((drawn[0].amax(1) - drawn[0].amin(1)).norm(dim=-1).max()) <= _EXPLODED * extent:
        _refuse("random_poses()", "a body torn apart, expected a person's pose", "Draw smaller rotations.")
    if not torch.equal(drawn[0], drawn[1]) or torch.equal(drawn[0], drawn[2]):
        got = (
            "other poses for the same seed"
            if not torch.equal(drawn[0], drawn[1])
            else "one pose for all seeds"
        )
        _refuse("random_poses()", f"{got}, expected what the seed decides", "Draw from the seed.")


@check(
    "pose-vector",
    needs=("posed", "upright"),
    unless=_lacks(HasPoseVector, "pose vector"),
    mend="`heading` turns the body about the vertical, in radians; `own_arrays` has a row a frame",
)
def pose_vector(context: Context) -> None:
    """The pose vector has the root that it says, and own arrays for each frame."""
    generator: Any = context.generator
    sizes = (generator.pose_size, generator.root_size, generator.heading)
    if not all(isinstance(size, int) for size in sizes) or not 0 <= sizes[2] < sizes[1] <= sizes[0]:
        problem = f"{sizes}, expected whole numbers with heading < root_size <= pose_size"
        _refuse("pose_size, root_size, heading", problem, "Correct them.")
    params = context.default_params(2)
    turned = torch.zeros(2, sizes[0], dtype=torch.float64)
    turned[1, sizes[2]] = np.pi / 2
    frame = torch.tensor(context.native_frame)
    with torch.no_grad():
        still, there = (generator.posed(params, {"parameters": turned}) @ frame.T).unbind(0)
        arrays = generator.own_arrays(context.default_params(), turned)
    if not (still - there)[:, 1].abs().max() <= 10 * _POSED_M or not (still - there).norm(dim=1).max() > 0.01:
        _refuse(
            "heading", "another motion than a turn about the vertical, expected a body turned in place",
            "Name the entry that turns the root about the vertical.",
        )  # fmt: skip
    for name, value in dict(arrays).items():
        if not isinstance(value, Tensor) or value.ndim < 1 or len(value) != len(turned):
            kind = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            _refuse(
                f"own_arrays()[{name!r}]", f"{kind}, expected a row for each frame", "Return (frames, ...)."
            )


@check(
    "expressions",
    level="core",
    needs=("finite",),
    unless=_lacks(HasExpressions, "expressions"),
    mend="return `Expressions`: a name and a direction (n, 3) for each coefficient",
)
def expressions(context: Context) -> None:
    """Expressions are named directions of the rest mesh."""
    with torch.no_grad():
        found: Any = context.generator.expressions()  # type: ignore[attr-defined]
    _refuse("expressions()", expressions_problem(found, context.native_count), "Return Expressions.")


def _no_formats(context: Context) -> str:
    return "" if context.registry.formats(context.name) else "the plugin names no motion files"


@check(
    "motion-formats",
    needs=("posed", "pose-vector", "own-checks"),
    unless=_no_formats,
    mend="`read` gives back the poses, the frame rate and the body that `write` was given",
)
def motion_formats(context: Context) -> None:
    """Motion files that are written and read keep the motion."""
    for each in context.registry.formats(context.name):
        if each.read is None or each.write is None:
            continue
        with tempfile.TemporaryDirectory() as folder:
            _round_trip(context, each, Path(folder) / f"motion{each.suffixes[0]}")


def _round_trip(context: Context, each: MotionFormat, path: Path) -> None:
    generator: Any = context.generator
    random = np.random.default_rng(0)
    params = {name: value[0].numpy() for name, value in context.random_params(1).items()}
    if isinstance(generator, HasSkinning):
        joints = len(generator.skinning(context.default_params()).joint_names)
        pose = {
            "rotations": random.normal(0, _TURN, (_FRAMES, joints, 3)),
            "translation": random.normal(0, 1, (_FRAMES, 3)),
        }
    elif isinstance(generator, HasPoseVector):
        pose = {"parameters": random.normal(0, _TURN, (_FRAMES, generator.pose_size))}
    else:
        raise CheckNotRunError("only a model that tells its skinning, or a pose vector, can be written")
    assert each.read is not None
    assert each.write is not None
    given = ModelMotion(params=params, pose=pose, fps=24.0, up=context.spec.up, source="a check")
    each.write(path, given)
    found = each.read(path)
    where = f"motion format {each.name}"
    if not isinstance(found, ModelMotion):
        _refuse(where, f"{type(found).__name__} from read, expected a ModelMotion", "Return one.")
    same: dict[str, Any] = {"fps": (found.fps, given.fps)} | {
        name: (found.pose.get(name), pose[name]) for name in pose
    }
    for name, (value, wanted) in same.items():
        near = value is not None and np.shape(value) == np.shape(wanted)
        if not near or not np.abs(np.asarray(value) - np.asarray(wanted)).max() <= _KEPT:
            problem = f"{name} of {np.shape(value)} from read, expected what write was given"
            _refuse(where, problem, "Write and read one layout.")


CHECKS = (
    triangles, skinning, posed, random_poses, pose_vector, expressions, motion_formats,
)  # fmt: skip
