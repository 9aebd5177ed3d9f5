"""What to say of a plugin that fails: the cause in its own words, and the fix."""

from __future__ import annotations

from soma_core.errors import AssetError, InputError
from soma_core.plugin.errors import BackendError, PluginError, Stage
from soma_core.plugin.installation import editable_folder, reinstall_command
from soma_core.plugin.spec import FileNeeded

__all__ = ["cause_and_fix", "remedy", "supply"]


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
    elif checkout is None or stage == "import":  # an import often fails for want of another distribution
        todo = f"Run: {reinstall_command(distribution)}"
    else:
        todo = f"Correct the plugin in {checkout}"
    return f"{todo} (SOMA_STRICT=1 shows the whole traceback)"


def cause_and_fix(error: BaseException) -> tuple[str, str]:
    """What an exception says: the core's own errors bring a fix along, others none."""
    if isinstance(error, InputError):
        return f"{error.argument}: got {error.got}, expected {error.expected}", error.fix
    if isinstance(error, AssetError):
        return f"{error.path}: {error.cause}", error.fix
    if isinstance(error, BackendError | PluginError):
        return error.cause, error.fix
    try:
        text = " ".join(str(error).split())
    except Exception:  # an exception of the plugin's own, whose text cannot be made
        text = ""
    return f"{type(error).__name__}: {text}" if text else type(error).__name__, ""
