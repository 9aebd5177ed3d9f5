"""What people see of a run: texts that hold no orders for their terminal, and progress of long work."""

from __future__ import annotations

import logging
import re
import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

__all__ = ["PrintableFormatter", "printable", "progress"]

_log = logging.getLogger(__name__)
_Step = TypeVar("_Step")
_ORDERS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """The text with what a terminal obeys written out; names in files of strangers may hold such letters."""
    return _ORDERS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class PrintableFormatter(logging.Formatter):
    """Records of a log as :func:`printable` texts."""

    def format(self, record: logging.LogRecord) -> str:
        """The text of a record."""
        return printable(super().format(record))


def progress(
    steps: Iterable[_Step], *, label: str, total: int, done: int = 0, lines: int = 20, after: float = 0.0
) -> Iterator[_Step]:
    """Pass `steps` on and show how far they are.

    Args:
        steps: the work that is left.
        label: what is being done.
        total: number of steps, those done before included.
        done: number of steps done before.
        lines: how many lines at most where there is no terminal.
        after: seconds before the first of them: short work needs none.
    """
    if sys.stderr.isatty():
        from tqdm import tqdm

        yield from tqdm(steps, desc=printable(label), total=total, initial=done, file=sys.stderr)
        return
    every, begin = max(1, total // lines), time.monotonic()
    for number, step in enumerate(steps, start=done + 1):
        yield step
        if (number % every == 0 or number == total) and time.monotonic() - begin >= after:
            _log.info("%s: %d of %d", label, number, total)
