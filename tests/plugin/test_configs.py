"""Config files of two plugins that stand in each other's way."""

from __future__ import annotations

from pathlib import Path

from soma_core.plugin.configs import find_configs
from soma_core.plugin.discovery import find_offers
from soma_core.plugin.registry import Registry
from tests.plugin.installed import Distribution


def _clashes() -> dict[str, str]:
    return {file: str(error) for file, error in Registry().config_clashes().items()}


def _searched() -> set[str]:
    return {distribution for distribution, _ in Registry().config_dirs()}


def test_two_plugins_with_one_file_are_both_left_out_and_named(site: Path) -> None:
    Distribution(name="acme", configs={"backend/acme.yaml": "", "experiment/paper.yaml": ""}).install(site)
    Distribution(name="bodies", version="2.0", configs={"experiment/paper.yaml": ""}).install(site)
    Distribution(name="innocent").install(site)
    text = (
        'config "experiment/paper.yaml" (soma-backend-acme 1.0 and soma-backend-bodies 2.0): config: '
        "2 distributions ship this file, so the configs of soma-backend-acme and soma-backend-bodies are "
        "left out. Rename it in one of them, or: pip uninstall soma-backend-bodies"
    )
    assert _clashes() == {"experiment/paper.yaml": text, "backend/acme.yaml": text}
    assert not {"soma-backend-acme", "soma-backend-bodies"} & _searched()
    assert "soma-backend-innocent" in _searched()


def test_a_plugin_that_ships_a_file_of_the_core_is_left_out(site: Path) -> None:
    Distribution(name="acme", configs={"backend/acme.yaml": "", "animate.yaml": ""}).install(site)
    offers = [offer for each in find_offers().values() for offer in each]
    found = find_configs(offers, core="soma-body-core 0.1.0")
    assert str(found.clashes["animate.yaml"]) == (
        'config "animate.yaml" (soma-body-core 0.1.0 and soma-backend-acme 1.0): config: 2 distributions '
        "ship this file, so the configs of soma-backend-acme are left out. "
        "Rename the file in soma-backend-acme"
    )
    assert set(found.clashes) == {"animate.yaml", "backend/acme.yaml"}
    assert "soma-backend-acme" not in [offer.distribution for offer in found.folders.values()]


def test_backends_of_one_package_share_its_folder(site: Path) -> None:
    points = {"acme": "soma_backend_acme.first", "bodies": "soma_backend_acme.second"}
    Distribution(name="acme", points=points).install(site)
    assert _clashes() == {}
    assert [each for each, _ in Registry().config_dirs() if each == "soma-backend-acme"] == [
        "soma-backend-acme"
    ]
