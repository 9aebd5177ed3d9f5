"""Fixtures for every test: nothing leaks between tests, and nothing is written outside tmp_path."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

_SWITCHES = ("SOMA_BACKENDS", "SOMA_STRICT", "SOMA_ASSETS")


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A developer's own SOMA_* switches do not change what the tests see; the cache stays shared.

    Nor does a test change the number of threads of those after it, which then wait for each other.
    """
    for name in _SWITCHES:
        if name in os.environ:
            monkeypatch.delenv(name)
    before = _threads()
    yield
    assert before in (None, _threads()), f"left torch with {_threads()} threads, which had {before}"


def _threads() -> int | None:
    """Threads of torch, or None before something has imported it."""
    return sys.modules["torch"].get_num_threads() if "torch" in sys.modules else None


@pytest.fixture(params=[True, pytest.param(False, marks=pytest.mark.slow)], ids=["fast", "full"])
def fast_mode(request: pytest.FixtureRequest) -> bool:
    """For ``torch.autograd.gradcheck``: the Jacobian in a random direction, or, slowly, every entry of it."""
    return bool(request.param)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A site-packages folder at the head of the path; what is imported from it is forgotten again."""
    folder = tmp_path / "site-packages"
    folder.mkdir()
    monkeypatch.setattr(sys, "path", [str(folder), *sys.path])
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    importlib.invalidate_caches()
    yield folder
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]
