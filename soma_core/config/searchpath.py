"""Where hydra looks for configs: the core's own folder and one in each installed plugin."""

from __future__ import annotations

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

from soma_core.paths import configs_dir
from soma_core.plugin.discovery import CORE_DISTRIBUTION
from soma_core.plugin.registry import default_registry

__all__ = ["SomaSearchPath", "register_search_path"]


class SomaSearchPath(SearchPathPlugin):
    """Append the config folders of the core and of the backends, found without importing a plugin."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Add one entry a distribution; hydra takes the first that holds a config."""
        search_path.append(provider=CORE_DISTRIBUTION, path=f"file://{configs_dir()}")
        for distribution, folder in default_registry().config_dirs():
            search_path.append(provider=distribution, path=f"file://{folder}")


def register_search_path() -> None:
    """Register with hydra by hand; safe to call again.

    hydra 1.3 finds plugins by scanning the hydra_plugins namespace, which misses editable installs
    (https://github.com/hydra-ecosystem/hydra/issues/2359), and there one failing import ends every app.
    """
    Plugins.instance().register(SomaSearchPath)
