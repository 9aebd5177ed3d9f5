"""What the first body of a layer launches on a CPU, compiled beside the other work that it takes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

__all__ = ["kernels_ahead"]


@contextmanager
def kernels_ahead(kernels: str, device: torch.device, dtype: torch.dtype, *, wrap: bool) -> Iterator[None]:
    """Compile what a first body needs while something else is done.

    At the end what was not begun is left to the launches, and nothing runs on: a process may fork. A kernel
    that does not compile says so when it is launched.

    Args:
        kernels: of the layer; nothing is done for ``torch``.
        device, dtype: of the layer; nothing is done beside a CPU.
        wrap: whether a mesh is laid over another.
    """
    if kernels == "torch" or device.type != "cpu":
        yield
        return
    from soma_core.kernels._runtime import begin_loading

    begun = begin_loading(_first(dtype, wrap=wrap))
    try:
        yield
    finally:
        for one in reversed(begun):
            if not one.cancel():
                one.exception()


def _first(dtype: torch.dtype, *, wrap: bool) -> list[Any]:
    """Kernels in the order in which they are launched."""
    from soma_core.kernels._runtime import scalar_name
    from soma_core.kernels.body_skin_wp import WIDTHS, skinning
    from soma_core.kernels.closest_point_wp import closest
    from soma_core.kernels.fused_pose_wp import posing
    from soma_core.kernels.identity_wp import identity_kernels
    from soma_core.kernels.skeleton_fit_wp import displacing

    scalar, widths = scalar_name(dtype), WIDTHS[dtype]
    identity = [displacing(scalar), identity_kernels(scalar).assemble, skinning(scalar, widths[0])]
    return [*([closest] if wrap else []), *identity, posing(scalar), skinning(scalar, widths[-1])]
