"""Guards: code that runs, readers that hang, and memory."""

from __future__ import annotations

import signal
import sys
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.hostile.corpus import SENTINEL

PATIENCE = 60
"""Seconds after which a reader counts as hanging; none takes more than two."""

MOST_MEMORY = 384 * 2**20
"""Bytes that a reader may hold for a hostile file: below what any of the bombs unfolds to."""

_watched: list[str] = []
_EVENTS = ("os.system", "subprocess.Popen", "os.exec", "pickle.find_class")


def _audit(event: str, _: object) -> None:
    if event in _EVENTS:
        _watched.append(event)


sys.addaudithook(_audit)


@contextmanager
def _guard() -> Iterator[None]:
    def give_up(*_: object) -> None:
        raise TimeoutError(f"still reading after {PATIENCE} s")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(PATIENCE)
    _watched.clear()
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    assert not _watched, f"reading led to {_watched}"
    assert peak < MOST_MEMORY, f"reading took {peak >> 20} MiB"


@pytest.fixture
def guarded(tmp_path, monkeypatch):
    """A context in which nothing may run code, hang or take much memory; the current folder is empty."""
    (tmp_path / "current").mkdir()
    monkeypatch.chdir(tmp_path / "current")
    yield _guard
    assert not (tmp_path / "current" / SENTINEL).exists()
