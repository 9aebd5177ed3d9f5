"""Kernels compiled beside other work: those that a body launches, and nothing that runs on afterwards."""

import threading

import pytest
import torch
import warp as wp

from soma_core import SomaLayer
from soma_core.kernels import _runtime
from soma_core.kernels.ahead import _first, kernels_ahead

CPU = torch.device("cpu")


def names(kernels):
    return {kernel.module.name for kernel in kernels}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_they_are_those_that_a_first_body_launches(monkeypatch, dtype):
    layer, launched, load = SomaLayer("soma", lod="low", dtype=dtype), [], _runtime._load
    monkeypatch.setattr(_runtime, "_load", lambda *given: (launched.append(given[1]), load(*given)))
    layer.pose(layer.identity(), torch.zeros(64, 77, 3, dtype=dtype))
    assert names(launched) == names(_first(dtype, wrap=False))


@pytest.fixture
def slow(monkeypatch):
    """Loading waits for the event; what was asked for."""
    event, asked = threading.Event(), []
    monkeypatch.setattr(wp, "load_module", lambda module, **_: (asked.append(module.name), event.wait(60)))
    return event, asked


def test_what_was_not_begun_is_left_to_the_launches(slow):
    event, asked = slow
    with kernels_ahead("auto", CPU, torch.float32, wrap=True):
        while not asked:
            pass
        threading.Timer(0.2, event.set).start()
    assert 1 <= len(asked) < len(_first(torch.float32, wrap=True))
    assert _runtime._compiler(_runtime.os.getpid()).submit(len, asked).result() == len(asked)


def test_an_error_within_comes_out_at_once(slow):
    event, asked = slow
    event.set()
    with pytest.raises(KeyError, match="own"), kernels_ahead("auto", CPU, torch.float32, wrap=False):
        raise KeyError("own")
    assert len(asked) <= len(_first(torch.float32, wrap=False))


def test_an_error_of_the_compiler_is_left_to_the_launch(monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("no compiler")

    monkeypatch.setattr(wp, "load_module", fail)
    with kernels_ahead("auto", CPU, torch.float32, wrap=False):
        pass
    _runtime._load.cache_clear()
    with pytest.raises(RuntimeError, match="no compiler"):
        _runtime.loaded(_first(torch.float32, wrap=False)[0], "cpu")


@pytest.mark.parametrize("given", [("torch", CPU), ("auto", torch.device("meta"))])
def test_nothing_is_compiled_for_others(slow, given):
    with kernels_ahead(*given, torch.float32, wrap=True):
        pass
    assert not slow[1]
