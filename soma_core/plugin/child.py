"""A plugin's code in a process of its own: whatever it does there, the caller is told and goes on.

A function of a module of this project runs in the child and says JSON documents; nothing that comes from
there is unpickled or run. Output of the child, that of C code too, goes to stderr.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any

from soma_core.plugin.discovery import hide_damaged

__all__ = ["EndedError", "Say", "run_in_child"]

Say = Callable[[Any], None]
"""Takes what can be written as JSON."""

_MOST_BYTES = 2**26
_STARTS_S = 600.0
"""Time that a child has until it is ready: what it does before is none of the plugin's."""

_LEAVES_S = 5.0
"""Time that a process has to be gone once it closed its pipe."""


class EndedError(Exception):
    """The child ended before its function did; the text says how."""


def run_in_child(
    function: str, *arguments: Any, seconds: float, prepare: str = "", preload: Sequence[str] = ()
) -> Iterator[Any]:
    """Run ``module:function`` as ``function(say, *arguments)`` in a child, and yield what it says.

    Args:
        function: the module and the name in it.
        arguments: texts, numbers and lists of them.
        seconds: longest time to the first document, once the child is ready, and between two.
        prepare: another ``module:function``, called without arguments before the child is ready.
        preload: modules that the children of one call after the other share, where the system can fork.

    Raises:
        EndedError: the child died, raised, or was silent for longer; nothing of it is left.
    """
    given = (function, arguments, prepare, [*preload], dict(os.environ))
    methods = [name for name in ("forkserver", "spawn") if name in multiprocessing.get_all_start_methods()]
    try:
        receiving, process = _started(methods[0], given, preload)
    except (EOFError, OSError):  # what is loaded before ended the process that was to fork
        receiving, process = _started(methods[-1], given, ())
    try:
        _received(receiving, process, _STARTS_S, "not ready")
        while (document := _received(receiving, process, seconds, "no answer")) is not None:
            yield document[0]
    finally:
        receiving.close()
        _end(process)


def _started(method: str, given: tuple[Any, ...], preload: Sequence[str]) -> tuple[Any, Any]:
    """The pipe from a child, and the child."""
    context: Any = multiprocessing.get_context(method)
    if preload:
        context.set_forkserver_preload(list(preload))
    receiving, sending = context.Pipe(duplex=False)
    with sending:
        process = context.Process(target=_child, args=(sending, *given))
        process.start()
    return receiving, process


def _received(receiving: Any, process: Any, seconds: float, silence: str) -> list[Any] | None:
    """The next document, wrapped; None at the end."""
    if not receiving.poll(seconds):
        raise EndedError(f"{silence} within {seconds:g} s")
    try:
        document = json.loads(receiving.recv_bytes(_MOST_BYTES))
    except (EOFError, OSError):
        process.join(_LEAVES_S)
        raise EndedError(_ending(process.exitcode)) from None
    if "raised" in document:
        raise EndedError(document["raised"])
    return document.get("said")


def _ending(code: int | None) -> str:
    if code is None:
        return "a process that closed its pipe"
    if code >= 0:
        return f"an end of the process with exit code {code}"
    with suppress(ValueError):
        return f"an end of the process by {signal.Signals(-code).name}"
    return f"an end of the process by signal {-code}"


def _end(process: Any) -> None:
    """Kill what is left: the child, and what it started."""
    with suppress(ProcessLookupError, PermissionError, AttributeError):
        os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.join(_LEAVES_S)


def _named(function: str) -> Callable[..., Any]:
    module, _, name = function.partition(":")
    found: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return found


def _child(
    connection: Any,
    function: str,
    arguments: Sequence[Any],
    prepare: str,
    preload: Sequence[str],
    variables: dict[str, str],
) -> None:
    """Run the function; end without asking what a plugin left behind."""
    os.environ.clear()
    os.environ.update(variables)
    with suppress(AttributeError, OSError):
        os.setsid()  # Ctrl-C is the caller's to hear, and whatever starts here can be ended with it
    os.dup2(2, 1)

    def send(document: dict[str, Any], dumps: Any = json.dumps) -> None:
        connection.send_bytes(dumps(document).encode())

    try:
        hide_damaged()
        for module in preload:
            importlib.import_module(module)
        run = _named(function)
        if prepare:
            _named(prepare)()
        send({"said": []})  # ready: the caller's limit counts from here
        run(lambda said: send({"said": [said]}), *arguments)
        _flush()  # the caller ends this process once it has the last document
        send({"said": None})
    except BaseException as error:
        if os.environ.get("SOMA_STRICT") == "1":
            traceback.print_exc()
        _flush()
        with suppress(Exception):
            send({"raised": f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")})
    connection.close()
    os._exit(0)


def _flush() -> None:
    """Show what is printed so far, by C as well."""
    with suppress(Exception):
        sys.stdout.flush()
    with suppress(Exception):
        sys.stderr.flush()
    with suppress(Exception):
        ctypes.CDLL(None).fflush(None)
