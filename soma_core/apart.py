"""Read a file of a stranger in a process of its own, with limits; what dies there dies alone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

__all__ = ["limit_process", "read_apart"]


def read_apart(module: str, path: Path, *arguments: object, seconds: int, memory: int) -> bytes | None:
    """Run a module of this project on a file, and return what it writes to its output; None where it died.

    Args:
        module: its name; it calls :func:`limit_process` first, with the last two of its arguments.
        path: the file, its first argument.
        arguments: further ones.
        seconds: of computing that it may take.
        memory: bytes that it may take.
    """
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "PXR_WORK_THREAD_LIMIT": "1"}
    words = [str(word) for word in (path.resolve(), *arguments, seconds, memory)]
    try:
        ended = subprocess.run(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-m", module, *words],
            stdin=subprocess.DEVNULL, capture_output=True, timeout=20 + 3 * seconds, env=environment,
            check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return None
    return ended.stdout if ended.returncode == 0 else None


def limit_process(seconds: int, memory: int) -> None:
    """Limit this process from now on, where the system can."""
    try:
        import resource
    except ImportError:  # Windows knows no such limits; the time on the clock is limited all the same
        return
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
