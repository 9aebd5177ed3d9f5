"""The canonical mesh on the neutral body of MHR, registered once for all tests that need it."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from soma_core.registration.register import Registration, register

__all__ = ["NEUTRAL", "needs_mhr", "registered_mhr"]

NEUTRAL = Path(os.environ.get("SOMA_TEST_DATA", "")) / "mhr" / "mhr_neutral_lod1.ply"
"""SOMA_TEST_DATA names the folder that holds mhr/, of files that are not part of the project."""

needs_mhr = pytest.mark.skipif(not NEUTRAL.is_file(), reason=f"needs SOMA_TEST_DATA with {NEUTRAL}")


@functools.cache
def registered_mhr() -> Registration:
    """What ``soma wrap`` makes of it; a minute of one core."""
    native = trimesh.load(NEUTRAL, process=False, maintain_order=True)
    return register(np.asarray(native.vertices, np.float64), np.asarray(native.faces, np.int64))
