"""How a whole run is spread over the cores: a process for each, and one thread in each of them."""

from __future__ import annotations

import os
from collections import Counter

import pytest

_MOST = 8
"""Processes; each holds its own body models, about 1.5 GB."""


_LONGEST = (
    "tests/tasks/test_killed.py", "tests/test_writing_a_backend.py", "tests/plugin/test_child.py",
    "tests/test_gpu_benchmark.py",
)  # fmt: skip
"""Files whose few tests take minutes: begun first, so that no process is left with one of them in the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files of processes: the longest, then those of most tests."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    files = [item.nodeid.partition("::")[0] for item in items]
    count = Counter(files)
    order = sorted(range(len(items)), key=lambda at: (files[at] not in _LONGEST, -count[files[at]]))
    items[:] = [items[at] for at in order]


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Count the processes: one for each core, none of them where files are named, which start at once so."""
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = min(cores, _MOST)
    if not whole or count == 1:
        return 0
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # what the processes inherit, or each would take every core
    return count
