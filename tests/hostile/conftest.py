"""One process, which answers for one file after the other: a crash is a finding, no end."""

from __future__ import annotations

import json
import select
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

PATIENCE = 120
"""Seconds on the clock after which a reader counts as hanging; the machine may be busy with others."""

MOST_SECONDS = 5
"""Of computing, for any file."""

MOST_MEMORY = 2**30
"""Bytes that a reader may take for a hostile file."""

MOST_LETTERS = 2000
"""Of a message."""


class _Child:
    """One process; it is started again after it died."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._process = folder, None

    def ask(self, reader: str, name: str) -> dict:
        """What became of a file, by its name in the corpus or as a mutation."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.hostile.child", str(self._folder)], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, bufsize=1,
            )  # fmt: skip
        self._process.stdin.write(f"{reader}\t{name}\n")
        self._process.stdin.flush()
        if not select.select([self._process.stdout], [], [], PATIENCE)[0]:
            self.stop()
            pytest.fail(f"still reading after {PATIENCE} s")
        line = self._process.stdout.readline()
        if not line:
            code = self._process.wait()
            self.stop()
            pytest.fail(f"the process ended with code {code}")
        return json.loads(line)

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process.stdin.close()
            self._process.stdout.close()
        self._process = None


@pytest.fixture(scope="package")
def ask(tmp_path_factory) -> Iterator[Callable[[str, str], str | None]]:
    """Let a reader read a file: what it said, None for a value; anything else fails the test."""
    child = _Child(tmp_path_factory.mktemp("hostile"))

    def asked(reader: str, name: str) -> str | None:
        found = child.ask(reader, name)
        assert not found["executed"], f"{name} ran code"
        assert not found["events"], f"{name} led to {found['events']}"
        told = found["told"]
        assert not (told or "").startswith("FOREIGN"), f"{name}: {told}"
        assert (told or "").replace("\n", "").isprintable(), f"{name} reaches the terminal: {told!a}"
        assert len(told or "") < MOST_LETTERS, f"{name} is told in {len(told)} letters"
        assert found["seconds"] < MOST_SECONDS, f"{name} took {found['seconds']:.1f} s of computing"
        assert found["bytes"] < MOST_MEMORY, f"{name} took {found['bytes'] >> 20} MiB"
        return told

    yield asked
    child.stop()
