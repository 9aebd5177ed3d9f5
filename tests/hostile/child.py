"""Read hostile files in this process, which has limits and may die; say what became of each.

Run as ``python -m tests.hostile.child FOLDER``, with a request a line on stdin and an answer each on stdout:
the reader, a tab, and a name of the corpus, ``mutation SEED`` or ``number SEED``.
"""

from __future__ import annotations

import functools
import json
import os
import random
import re
import resource
import sys
import time
import warnings
from pathlib import Path

from soma_core.errors import SomaError
from tests.hostile.corpus import FILES, LINKS, SENTINEL
from tests.hostile.readers import READERS

_PROBES = {f"soma_core.{kind}_probe" for kind in ("usd", "fbx", "parquet")}
_EVENTS = ("os.system", "os.exec", "pickle.find_class")
BY_NAME = {reader.name: reader for reader in READERS}
_watched: list[str] = []


def _audit(event: str, arguments: tuple) -> None:
    ours = event == "subprocess.Popen" and _PROBES & {*arguments[1]}
    if event in _EVENTS or (event == "subprocess.Popen" and not ours):
        _watched.append(event)


def mutated(content: bytes, seed: int) -> bytes:
    """The content with one to six edits of eight bytes at the most."""
    chance, data = random.Random(seed), bytearray(content)
    for _ in range(chance.randint(1, 6)):
        at, extra = chance.randrange(len(data) + 1), chance.randbytes(chance.randint(1, 8))
        stop = at + len(extra)
        kind = chance.choice(["flip", "flip", "drop", "repeat", "insert", "zero", "ones"])
        if kind == "flip":
            data[at:stop] = bytes(a ^ b for a, b in zip(data[at:stop], extra, strict=False))
        elif kind == "drop":
            del data[at:]
        elif kind == "insert":
            data[at:at] = extra
        else:
            data[at:stop] = {"repeat": bytes(data[at:stop]) * 3, "zero": bytes(4), "ones": b"\xff" * 4}[kind]
    return bytes(data)


_NUMBERS = re.compile(rb"(?<![\w.])-?\d+(?:\.\d*)?(?![\w.])")
_STRANGE = (b"1e300", b"-1e300", b"5e-324", b"9" * 400, b"-" + b"9" * 4000, b"1e999", b"1e-400")


def swollen(content: bytes, seed: int) -> bytes:
    """A text with another number in place of one of its own."""
    chance, found = random.Random(seed), [*_NUMBERS.finditer(content)]
    place, number = chance.choice(found), chance.choice(_STRANGE)
    return content[: place.start()] + number + content[place.end() :]


def _peak() -> int:
    """Most bytes in memory since the last reset."""
    text = Path("/proc/self/status").read_text()
    return 1024 * int(text.partition("VmHWM:")[2].split()[0])


def _reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _spent() -> float:
    """Seconds of computing, those of finished processes of ours included."""
    return time.process_time() + sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


def _outcome(reader, path: Path) -> dict:
    _watched.clear()
    _reset_peak()
    before, start = _peak(), _spent()
    try:
        reader.read(path)
        told = None
    except SomaError as error:
        told = str(error)
    except BaseException as error:  # whatever is raised is the finding
        told = f"FOREIGN {type(error).__name__}: {error}"[:500]
    return {
        "told": told, "seconds": _spent() - start, "bytes": _peak() - before, "events": list(_watched),
        "executed": Path(SENTINEL).exists(),
    }  # fmt: skip


def _make(name: str, path: Path, good: bytes) -> None:
    kind, _, seed = name.partition(" ")
    if kind in ("mutation", "number"):
        path.write_bytes({"mutation": mutated, "number": swollen}[kind](good, int(seed)))
    elif name in LINKS:
        LINKS[name](path)
    else:
        content = FILES[name]
        path.write_bytes(content if isinstance(content, bytes) else content())


@functools.cache
def _good(name: str, folder: Path) -> bytes:
    """A sound file of a reader, which it reads; nothing where there is none that is small."""
    reader, path = BY_NAME[name], folder / f"good{BY_NAME[name].suffix}"
    if reader.good is None:
        return b""
    reader.good(path)
    reader.read(path)
    return path.read_bytes()


def _main(folder: Path) -> None:
    os.chdir(folder)
    warnings.simplefilter("ignore")  # numpy and scipy warn of damaged numbers, which is no refusal
    for name in BY_NAME:  # what is imported and compiled at first is no harm of a file
        _good(name, folder)
    sys.addaudithook(_audit)
    most = resource.getrlimit(resource.RLIMIT_DATA)[1]
    resource.setrlimit(resource.RLIMIT_DATA, (4 * 2**30, most))
    for count, line in enumerate(sys.stdin):
        reader, _, name = line.rstrip("\n").partition("\t")
        path = folder / f"hostile{count}{BY_NAME[reader].suffix}"
        _make(name, path, _good(reader, folder))
        sys.stdout.write(json.dumps(_outcome(BY_NAME[reader], path)) + "\n")
        sys.stdout.flush()
        if not path.is_dir():
            path.unlink(missing_ok=True)


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
