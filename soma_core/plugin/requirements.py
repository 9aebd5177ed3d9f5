"""What is installed, pinned: the lines that a bug report needs to be reproduced."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass

from soma_core.plugin.discovery import CORE_DISTRIBUTION, normalised
from soma_core.plugin.installation import local_source

__all__ = ["Environment", "Pin", "read_environment"]

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(frozen=True, kw_only=True)
class Pin:
    """One installed distribution; `source` is the local folder or file it was installed from, if any."""

    name: str
    version: str
    source: str | None

    @property
    def line(self) -> str:
        """The distribution as a line of a requirements file."""
        return f"{self.name}=={self.version}" + (f"  # from {self.source}" if self.source else "")


@dataclass(frozen=True, kw_only=True)
class Environment:
    """Interpreter, machine, SOMA_* variables, and the distributions that matter."""

    python: str
    platform: str
    variables: dict[str, str]
    distributions: tuple[Pin, ...]

    def text(self) -> str:
        """A requirements file, with the rest as comments."""
        facts = [f"# python {self.python}", f"# {self.platform}"]
        facts += [f"# {key}={value}" for key, value in self.variables.items()]
        return "\n".join([*facts, *(pin.line for pin in self.distributions)])

    def json(self) -> str:
        """The same as one JSON object."""
        return json.dumps(asdict(self), indent=2)


def read_environment(distributions: Iterable[str]) -> Environment:
    """Describe the core, the given distributions and what each of them requires directly, sorted by name.

    Read from metadata; nothing is imported. Optional extras count only where they are installed for
    another reason.
    """
    wanted = {normalised(name): name for name in (CORE_DISTRIBUTION, *distributions)}
    for name in list(wanted.values()):
        for required in _required(name):
            wanted.setdefault(normalised(required), required)
    pins = filter(None, (_pin(wanted[key]) for key in sorted(wanted)))
    return Environment(
        python=platform.python_version(),
        platform=platform.platform(),
        variables={key: value for key, value in sorted(os.environ.items()) if key.startswith("SOMA_")},
        distributions=tuple(pins),
    )


def _required(name: str) -> list[str]:
    try:
        lines = importlib.metadata.requires(name) or []
    except importlib.metadata.PackageNotFoundError:
        return []
    found = (_NAME.match(line) for line in lines if "extra ==" not in line)
    return [match[0] for match in found if match]


def _pin(name: str) -> Pin | None:
    try:
        found = importlib.metadata.distribution(name)
    except importlib.metadata.PackageNotFoundError:
        return None
    source = local_source(name)
    return Pin(name=normalised(found.name), version=found.version, source=source[0] if source else None)
