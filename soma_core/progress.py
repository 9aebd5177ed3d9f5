"""Progress of long work: a bar on a terminal, plain log lines elsewhere."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

__all__ = ["progress"]

_log = logging.getLogger(__name__)
_Step = TypeVar("_Step")


def progress(
    steps: Iterable[_Step], *, label: str, total: int, done: int = 0, lines: int = 20
) -> Iterator[_Step]:
    """Pass `steps` on and show how far they are.

    Args:
        steps: the work that is left.
        label: what is being done.
        total: number of steps, those done before included.
        done: number of steps done before.
        lines: how many lines at most where there is no terminal.
    """
    if sys.stderr.isatty():
        from tqdm import tqdm

        yield from tqdm(steps, desc=label, total=total, initial=done, file=sys.stderr)
        return
    every = max(1, total // lines)
    for number, step in enumerate(steps, start=done + 1):
        yield step
        if number % every == 0 or number == total:
            _log.info("%s: %d of %d", label, number, total)
