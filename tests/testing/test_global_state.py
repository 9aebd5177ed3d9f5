"""The guard sees every part of the global state that changes, and puts it back."""

from __future__ import annotations

import builtins
import gc
import locale
import logging
import os
import random
import signal
import socket
import sys
import warnings

import numpy as np
import pytest
import torch

from soma_core.testing.global_state import changes, kept, snapshot


def _another_locale() -> str:
    """One that every system has and this process does not use."""
    return "C" if locale.setlocale(locale.LC_ALL) != "C" else "C.UTF-8"


CHANGES = {
    "torch's default dtype": lambda: torch.set_default_dtype(torch.float64),
    "torch's default device": lambda: torch.set_default_device("meta"),
    "torch's random state": lambda: torch.manual_seed(torch.initial_seed() + 1),
    "torch's gradient mode": lambda: torch.set_grad_enabled(not torch.is_grad_enabled()),
    "torch's number of threads": lambda: torch.set_num_threads(torch.get_num_threads() + 1),
    "torch's deterministic mode": lambda: torch.use_deterministic_algorithms(mode=True),
    "torch's matmul precision": lambda: torch.set_float32_matmul_precision("medium"),
    "torch's print options": lambda: torch.set_printoptions(precision=2),
    "torch's anomaly mode": lambda: torch.autograd.set_detect_anomaly(mode=True),
    "torch's use of TF32": lambda: setattr(torch.backends.cudnn, "allow_tf32", False),
    "torch's treatment of denormal numbers": lambda: torch.set_flush_denormal(True),
    "functions of torch": lambda: setattr(torch, "einsum", lambda *given: given),
    "functions of NumPy": lambda: setattr(np.linalg, "norm", abs),
    "NumPy's print options": lambda: np.set_printoptions(precision=2),
    "NumPy's random state": lambda: np.random.seed(7),  # noqa: NPY002
    "NumPy's error handling": lambda: np.seterr(over="print"),
    "Python's random state": lambda: random.seed(7),
    "the current folder": lambda: os.chdir(".."),
    "the environment variables": lambda: os.environ.update(SPECIMEN="1"),
    "the import path": lambda: sys.path.append("/nowhere"),
    "the warning filters": lambda: warnings.simplefilter("once"),
    "the root logger": lambda: logging.disable(logging.CRITICAL),
    "handlers of signals": lambda: signal.signal(signal.SIGTERM, signal.SIG_IGN),
    "standard streams or hooks of uncaught errors": lambda: setattr(sys, "excepthook", max),
    "the limit of recursion": lambda: sys.setrecursionlimit(sys.getrecursionlimit() + 1),
    "garbage collection": gc.disable,
    "the locale": lambda: locale.setlocale(locale.LC_ALL, _another_locale()),
    "the time limit of sockets": lambda: socket.setdefaulttimeout(7),
    "built-in functions": lambda: setattr(builtins, "open", max),
}


def test_every_part_has_a_test():
    assert list(snapshot()) == list(CHANGES)


@pytest.mark.parametrize("part", CHANGES)
def test_a_change_is_seen_and_undone(part):
    before = snapshot()
    assert changes(before) == []
    with kept():
        CHANGES[part]()
        assert part in changes(before)  # torch may load more of itself, and change more
    assert changes(before) == []


def test_it_is_undone_after_an_exception_too():
    def spoil() -> None:
        with kept():
            os.environ["SPECIMEN"] = "1"
            raise SystemExit

    with pytest.raises(SystemExit):
        spoil()
    assert "SPECIMEN" not in os.environ
