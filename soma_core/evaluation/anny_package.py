"""The anny package's own model, an implementation by other people."""

from __future__ import annotations

from typing import Any

import torch

from soma_core._lazy import needed

__all__ = ["anny_package_model"]


def anny_package_model(*, rig: str, topology: str, dtype: torch.dtype) -> Any:
    """The package's model with all phenotypes; the first one built on a machine takes about a minute.

    Args:
        rig, topology: ``anny``, its own, or ``soma``, its copy of the canonical ones.
        dtype: of its tensors.

    Raises:
        InputError: the anny package is not installed.
    """
    anny = needed("anny", setting="experiment.backend", pip="anny==0.6.2")
    options = {"phenotypes": "all", "pose_parameterization": "local-ref"}
    return anny.Anny(rig=rig, topology=topology, **options).to(dtype)
