"""What to say of a plugin that fails: the cause in its own words, and the fix."""

from __future__ import annotations

import dataclasses
import re
import shlex

from soma_core.errors import AssetError, InputError
from soma_core.plugin import checks, spec
from soma_core.plugin.declaration import did_you_mean
from soma_core.plugin.discovery import CORE_PACKAGE, Offer
from soma_core.plugin.errors import BackendError, PluginError, Stage
from soma_core.plugin.installation import (
    editable_folder,
    newer_core,
    reinstall_command,
    requirement_of_module,
)
from soma_core.plugin.spec import FileNeeded

__all__ = ["cause_and_fix", "remedy", "supply"]

_UNKNOWN_FIELD = re.compile(r"(\w+)\.__init__\(\) got an unexpected keyword argument '(\w+)'")


def supply(needed: FileNeeded) -> str:
    """How to come by a file that is missing."""
    source = f"Get it from {needed.url}" if needed.url else ""
    if needed.command:
        return f"{source}, then run: {needed.command}" if source else f"Run: {needed.command}"
    return f"Put the file there. {source}".strip()


def remedy(name: str, distribution: str, stage: Stage) -> str:
    """What to do about a plugin that says nothing better itself."""
    checkout = editable_folder(distribution)
    if stage == "rest":
        todo = f"Compare the parameters with: soma backends show {name}"
    elif checkout is None:
        todo = reinstall_command(distribution)
    else:
        todo = f"Correct the plugin in {checkout}"
    return f"{todo} (SOMA_STRICT=1 shows the whole traceback)"


def cause_and_fix(error: BaseException, offer: Offer) -> tuple[str, str]:
    """What an exception says, and the fix where that is plain; the core's own errors bring one along."""
    if isinstance(error, InputError):
        return f"{error.argument}: got {error.got}, expected {error.expected}", str(error.fix)
    if isinstance(error, AssetError):
        return f"{error.path}: {error.cause}", str(error.fix)
    if isinstance(error, BackendError | PluginError):
        return str(error.cause), str(error.fix)
    try:
        text = " ".join(str(error).split())
    except Exception:  # an exception of the plugin's own, whose text cannot be made
        text = ""
    fix = _import_fix(error, offer) if isinstance(error, ImportError) else _field_fix(text, offer)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__, fix


def _import_fix(error: ImportError, offer: Offer) -> str:
    """What brings a module that is missing, or a newer one."""
    package = (error.name or "").partition(".")[0]
    if package == CORE_PACKAGE:
        return newer_core(offer.distribution)
    if package in ("", offer.package):
        return ""
    requirement = requirement_of_module(package, offer.distribution)
    newer = "" if isinstance(error, ModuleNotFoundError) else "--upgrade "
    return f"Run: pip install {newer}{shlex.quote(requirement)}"


def _field_fix(text: str, offer: Offer) -> str:
    """What to do about a field that this core's contract does not have: misspelt, or of a later one."""
    found = _UNKNOWN_FIELD.match(text)
    if found is None:
        return ""
    kind, newer = {**vars(spec), **vars(checks)}.get(found[1]), newer_core(offer.distribution)
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        return ""
    meant = did_you_mean(found[2], [each.name for each in dataclasses.fields(kind)])
    return f"{meant} Or, if it is new: {newer}" if meant else newer
