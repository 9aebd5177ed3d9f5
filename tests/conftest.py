"""Fixtures for every test: nothing leaks between tests, and nothing is written outside tmp_path."""

from __future__ import annotations

import os

import pytest

_SWITCHES = ("SOMA_BACKENDS", "SOMA_STRICT", "SOMA_ASSETS")


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """A developer's own SOMA_* switches do not change what the tests see; the cache stays shared."""
    for name in _SWITCHES:
        if name in os.environ:
            monkeypatch.delenv(name)
