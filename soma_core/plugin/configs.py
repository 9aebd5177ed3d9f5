"""The hydra configs that plugins ship: where they are, and which of them stand in each other's way."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from soma_core.paths import configs_dir
from soma_core.plugin.discovery import CORE_PACKAGE, Offer, config_folder
from soma_core.plugin.errors import BackendConflictError

__all__ = ["PluginConfigs", "find_configs"]


@dataclass(frozen=True, kw_only=True)
class PluginConfigs:
    """Config folders of the installed plugins.

    Attributes:
        folders: those that hydra may search, and who ships each.
        clashes: file in the search path, such as ``backend/acme.yaml`` -> why the folders that hold it are
            left out. A file in such a folder that clashes with nothing is listed too.
    """

    folders: dict[Path, Offer]
    clashes: dict[str, BackendConflictError]


def find_configs(offers: Iterable[Offer], *, core: str) -> PluginConfigs:
    """Look for the config folder of each plugin, importing none of them.

    hydra takes the first file of a name and is silent about the others. Where two plugins ship the same
    file, the folders of both are left out; where a plugin ships a file of the core, the plugin's is.

    Args:
        offers: the usable offers.
        core: the core's distribution and version, for messages.
    """
    owners: dict[Path, Offer] = {}
    for offer in offers:
        folder = None if offer.package == CORE_PACKAGE else config_folder(offer)
        if folder is not None:
            owners.setdefault(folder, offer)
    shipped: dict[str, list[Path]] = {}
    for folder in owners:
        for file in _files(folder):
            shipped.setdefault(file, []).append(folder)
    reasons: dict[Path, BackendConflictError] = {}
    own = _files(configs_dir())
    for file, folders in sorted(shipped.items()):
        if file in own or len(folders) > 1:
            error = _clash(file, [owners[folder] for folder in folders], core if file in own else "")
            for folder in folders:
                reasons.setdefault(folder, error)
    return PluginConfigs(
        folders={folder: offer for folder, offer in owners.items() if folder not in reasons},
        clashes={file: reasons[folders[0]] for file, folders in shipped.items() if folders[0] in reasons},
    )


def _files(folder: Path) -> set[str]:
    return {
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.suffix in (".yaml", ".json")
    }


def _clash(file: str, offers: list[Offer], core: str) -> BackendConflictError:
    last = offers[-1].distribution
    sources = ([core] if core else []) + [offer.source for offer in offers]
    rename = f"Rename the file in {last}" if core else f"Rename it in one of them, or: pip uninstall {last}"
    left_out = " and ".join(offer.distribution for offer in offers)
    return BackendConflictError(
        who=f'config "{file}" ({" and ".join(sources)})',
        stage="config",
        cause=f"{len(sources)} distributions ship this file, so the configs of {left_out} are left out",
        fix=rename,
    )
