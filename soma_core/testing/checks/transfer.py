"""Checks of the transfer to the canonical mesh: complete, sound for every identity, free of slivers."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from soma_core.plugin.checks import CheckFailedError, check
from soma_core.testing.context import Context

__all__ = ["CHECKS"]

_WRAP_M = 2e-4
"""Metres: what the default body may differ from the native OBJ, twice: its face may turn too."""

_STRETCH = 6.0
"""Times that an edge may be longer or shorter than on the default body, for bodies of equal size: newborns
and giants stay within two, and another vertex order exceeds it everywhere."""
_STRETCH_SHARE = 0.98
"""Part of the edges that must keep to it; nostrils and lips rarely do."""

_EQUIVARIANT_M = 1e-4
"""Metres. float32 on a body of two metres turned and moved by as much is exact to a few thousandths of a
millimetre; a vertex that rides on a sliver multiplies that."""


def _no_wrap(context: Context) -> str:
    return "the native topology is the canonical one" if context.spec.wrap is None else ""


@check(
    "transfer-neutral",
    mend="register the missing part, or leave its faces out of `native.obj`",
    needs=("stature",),
    unless=_no_wrap,
)
def transfer_neutral(context: Context) -> None:
    """The transferred default body is the wrap."""
    body = context.bodies.identity.fitted_rest[0].numpy()
    native = context.bodies.native[0].numpy() @ context.native_frame.T
    wrap = context.wrap.vertices @ context.wrap_frame.T
    wrap += native.mean(0) - (context.wrap.native @ context.wrap_frame.T).mean(0)
    distance = np.where(context.covered, np.linalg.norm(body - wrap, axis=1), 0)
    worst = int(distance.argmax())
    if not distance[worst] <= _WRAP_M:
        raise CheckFailedError(
            f"{context.vertex(worst)} of the transferred default body",
            got=f"{1000 * distance[worst]:.2f} mm from the wrap",
            expected=f"at most {1000 * _WRAP_M:.1f} mm",
            fix="Make native OBJ and wrap from the same default body.",
        )


@check(
    "transfer-random",
    mend="one vertex order whatever the parameters; ranges of human bodies",
    level="core",
    needs=("stature",),
)
def transfer_random(context: Context) -> None:
    """Random bodies keep the neighbourhoods of the default body."""
    start, end = context.mesh.edges().T
    bodies = context.bodies.identity.fitted_rest.numpy()
    length = np.linalg.norm(bodies[:, start] - bodies[:, end], axis=-1)
    length /= np.median(length, axis=1, keepdims=True)
    ratio = np.abs(np.log(np.maximum(length[1:], 1e-12) / np.maximum(length[0], 1e-12)))
    for row, stretch in enumerate(ratio, 1):
        most = float(np.exp(np.quantile(stretch, _STRETCH_SHARE)))
        if most > _STRETCH:
            raise CheckFailedError(
                f"{context.bodies.label(row)}, {context.vertex(int(start[stretch.argmax()]))}",
                got=f"{1 - _STRETCH_SHARE:.0%} of the edges over {most:.1f} times longer or shorter",
                expected=f"at most {_STRETCH:g} times, against the default body",
                fix="Return the vertices in one order whatever the parameters, in ranges of human bodies.",
            )


@check(
    "similarity-equivariant", mend="clean faces without area", needs=("transfer-neutral", "transfer-random")
)
def similarity_equivariant(context: Context) -> None:
    """Turning, scaling and moving the native body does the same to the canonical one."""
    transfer: Any = copy.deepcopy(context.layer.rest_shape.transfer).float()
    frame = context.native_frame
    turn = torch.as_tensor(Rotation.from_rotvec([0.9, -0.5, 0.7]).as_matrix())
    native_turn = torch.as_tensor(np.linalg.inv(frame)) @ turn @ torch.as_tensor(frame)
    shift = torch.tensor([0.4, -0.7, 1.1], dtype=torch.float64)
    native_shift = torch.as_tensor(np.linalg.inv(frame)) @ shift
    native = context.bodies.native
    moved = 0.8 * native @ native_turn.T + native_shift
    straight = transfer(native.float()).double()
    distance = (transfer(moved.float()).double() - (0.8 * straight @ turn.T + shift)).norm(dim=-1)
    if not distance.max() <= _EQUIVARIANT_M:
        row, vertex = divmod(int(distance.argmax()), distance.shape[1])
        raise CheckFailedError(
            f"{context.bodies.label(row)}, {context.vertex(vertex)}",
            got=f"{1000 * float(distance.max()):.3f} mm of difference after a similarity",
            expected=f"at most {1000 * _EQUIVARIANT_M:g} mm",
            fix="The native face that carries it has no area: clean the OBJ there, or move the vertex.",
        )


CHECKS = (transfer_neutral, transfer_random, similarity_equivariant)
