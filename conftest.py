"""How a whole run is spread over the cores: a process for each, and one thread in each of them."""

from __future__ import annotations

import os

import pytest

_MOST = 8
"""Processes; each holds its own body models, about 1.5 GB."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Count the processes: one for each core, none of them where files are named, which start at once so."""
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = min(cores, _MOST)
    if not whole or count == 1:
        return 0
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # what the processes inherit, or each would take every core
    return count
