"""Bodies of a backend from a process of its own: in an empty folder, sets in another order, to its end."""

from __future__ import annotations

import gc
import importlib.metadata
import json
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.plugin.discovery import Offer
from soma_core.plugin.errors import BackendError
from soma_core.plugin.hookspecs import ENTRY_POINT_GROUP

__all__ = ["KEPT", "ProcessProbe", "main", "probe_process"]

_MOST_S, _ENDS_S, _LEAVES_S = 300.0, 15.0, 3.0
"""Longest until bodies are there, from then until the process is gone, and until those it started are."""

_WARM, _CALLS, _LOOKS = 4, 12, 5
"""Calls before memory is looked at, until it is looked at again, and how often what has grown is looked at.

An allocator grows by itself now and then; what is kept grows from every look to the next."""

KEPT = 0.5
"""Share of the bytes of its bodies that a call may leave: less is noise."""


@dataclass(frozen=True, kw_only=True)
class ProcessProbe:
    """What became of the process.

    Attributes:
        bodies: (b, n, 3) native; None where there are none.
        ending: how it ended, or what still ran when it should have; empty where all is well.
        growth: bytes of memory that a call leaves, at least.
    """

    bodies: np.ndarray | None
    ending: str
    growth: float = 0.0


def probe_process(offer: Offer, options: Mapping[str, Any], params: Mapping[str, np.ndarray]) -> ProcessProbe:
    """Make bodies of `params` by the backend of `offer` in an interpreter of its own."""
    with tempfile.TemporaryDirectory(prefix="soma-probe-") as name:
        folder, empty = Path(name), Path(name) / "empty"
        empty.mkdir()
        np.savez(folder / "params.npz", **params)  # type: ignore[arg-type]
        (folder / "options.json").write_text(json.dumps(dict(options), default=str))
        seeds = {
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            "PYTHONHASHSEED": str(secrets.randbits(31)),
        }
        process = subprocess.Popen(  # noqa: S603 - this interpreter and this module
            [sys.executable, "-P", "-m", __name__, offer.name, offer.target, name], env=os.environ | seeds,
            cwd=empty, start_new_session=True, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        ending = _ending(process, folder / "result.json")
        try:
            document = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return ProcessProbe(bodies=None, ending=ending or "an end without bodies")
        if document["error"]:
            return ProcessProbe(bodies=None, ending=document["error"])
        if ending and document["threads"]:
            ending = f"a thread that runs on: {', '.join(document['threads'])}"
        bodies = np.load(folder / "bodies.npy", allow_pickle=False)
        return ProcessProbe(bodies=bodies, ending=ending, growth=document["growth"])


def _ending(process: subprocess.Popen[bytes], result: Path) -> str:
    """Wait for the process and what it started, end what is left, and say what that was."""
    latest = time.monotonic() + _MOST_S
    while process.poll() is None and not result.exists() and time.monotonic() < latest:
        time.sleep(0.05)
    try:
        code = process.wait(_ENDS_S if result.exists() else 0)
        told = f"an end with exit code {code}" if code else ""
    except subprocess.TimeoutExpired:
        told = "no end of the process"
    latest = time.monotonic() + _LEAVES_S
    while not told and (left := _group(process.pid)):
        if time.monotonic() > latest:
            told = f"a process that runs on: {', '.join(left)}"
        time.sleep(0.05)
    with suppress(ProcessLookupError, PermissionError, AttributeError):
        os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.wait()
    return told


def _group(leader: int) -> list[str]:
    """Names of the running processes of a group, where the system lists them."""
    found = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            head, _, rest = place.read_text(errors="replace").rpartition(")")
            state, _, group, *_ = rest.split()
            found += [head.partition("(")[2]] * (int(group) == leader and state != "Z")
    return found


def _resident() -> int:
    """Bytes in memory, where the system tells."""
    with suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def main(name: str, target: str, folder: str) -> None:
    """Make bodies of backend `name` at entry point `target`; leave them, and what was seen, in `folder`."""
    place = Path(folder)
    document: dict[str, Any] = {"error": "", "growth": 0.0}
    try:
        bodies, document["growth"] = _made(name, target, place)
        np.save(place / "bodies.npy", bodies)
    except BaseException as error:  # SystemExit too: whatever it is, it is told
        cause = f"{error.stage}: {error.cause}" if isinstance(error, BackendError) else repr(error)
        document["error"] = " ".join(cause.split())
    others = [each for each in threading.enumerate() if each is not threading.main_thread()]
    document["threads"] = [each.name for each in others if not each.daemon]
    (place / "result.part").write_text(json.dumps(document))
    (place / "result.part").rename(place / "result.json")


def _made(name: str, target: str, place: Path) -> tuple[np.ndarray, float]:
    """Bodies (b, n, 3), and the bytes that every further call leaves."""
    import torch

    from soma_core.plugin.registry import Registry

    warnings.simplefilter("ignore")
    point = importlib.metadata.EntryPoint(name=name, value=target, group=ENTRY_POINT_GROUP)
    options = json.loads((place / "options.json").read_text())
    with np.load(place / "params.npz", allow_pickle=False) as file:
        params = {key: torch.from_numpy(file[key]) for key in file.files}
    made = Registry([point], allowed=()).generator(
        name, device=torch.device("cpu"), dtype=torch.float64, options=options
    )

    def rest() -> torch.Tensor:
        with torch.no_grad():
            return made.rest({key: value.clone() for key, value in params.items()})

    bodies = rest().numpy().copy()
    for _ in range(_WARM):
        rest()
    least = float("inf")
    for _ in range(_LOOKS):
        before = _resident()
        for _ in range(_CALLS):
            rest()
        gc.collect()
        least = min(least, (_resident() - before) / _CALLS)
        if least <= KEPT * bodies.nbytes:
            break
    return bodies, least


if __name__ == "__main__":
    main(*sys.argv[1:])
