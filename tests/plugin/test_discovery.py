"""Discovery from real metadata on disk, laid out as wheels and editable installs leave it."""

from __future__ import annotations

import site as interpreter_site
import sys
from pathlib import Path

import pytest

from soma_core.plugin.discovery import Offer, config_folder, find_offers, installed_versions, normalised
from soma_core.plugin.registry import Registry
from tests.plugin.fakes import FakeEntryPoint
from tests.plugin.installed import Distribution


def _offer(target: str) -> Offer:
    return Offer(name="x", distribution="x", version="1", target=target, load=lambda: None)


def _names() -> tuple[str, ...]:
    return Registry().names()


def test_a_wheel_is_found_without_importing_it(site: Path) -> None:
    package = Distribution(name="acme").install(site)
    registry = Registry()
    assert "acme" in registry.names()
    assert ("soma-backend-acme", package / "configs") in registry.config_dirs()
    assert "soma_backend_acme" not in sys.modules


@pytest.mark.parametrize("src", [False, True], ids=["flat", "src"])
@pytest.mark.parametrize("finder", [False, True], ids=["path entry", "import hook"])
def test_an_editable_install_is_found_without_importing_it(
    site: Path, tmp_path: Path, src: bool, finder: bool
) -> None:
    """hatchling leaves a path entry, setuptools a path entry for src layouts and a hook for flat ones."""
    package = Distribution(name="acme").install_editable(site, tmp_path / "checkout", src=src, finder=finder)
    interpreter_site.addsitedir(str(site))  # reads the .pth files, as the interpreter does when it starts
    registry = Registry()
    assert "acme" in registry.names()
    assert ("soma-backend-acme", package / "configs") in registry.config_dirs()
    assert "soma_backend_acme" not in sys.modules


def test_an_editable_install_beside_a_stale_wheel_counts_once(site: Path, tmp_path: Path) -> None:
    stale = tmp_path / "later-on-the-path"
    Distribution(name="acme", version="1.0").install(stale)
    sys.path.append(str(stale))
    Distribution(name="acme", version="2.0").install_editable(site, tmp_path / "checkout")
    (offer,) = find_offers()["acme"]
    assert offer.version == "2.0"


def test_a_package_is_not_a_backend_by_its_name(site: Path) -> None:
    Distribution(name="stray").write_package(site)
    assert "stray" not in _names()
    assert not any("stray" in str(folder) for _, folder in Registry().config_dirs())


def test_of_two_backends_in_one_distribution_only_the_one_asked_for_is_loaded() -> None:
    points = [FakeEntryPoint(name, distribution="soma-backend-two") for name in ("first", "second")]
    for point in points:
        point.value = f"soma_backend_two.{point.name}"
    offers = find_offers(points)
    offers["first"][0].load()
    assert [point.loads for point in points] == [1, 0]


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("entry_points.txt", "[soma_core.backends]\nno value\n"),
        ("entry_points.txt", "\x00"),
        ("METADATA", ""),
    ],
)
def test_damaged_metadata_hurts_nobody_else(site: Path, file: str, text: str) -> None:
    Distribution(name="acme").install(site)
    (Distribution(name="bad").write_metadata(site) / file).write_text(text)
    registry = Registry()
    assert {"acme", "soma"} <= set(registry.names())
    assert {"soma-backend-acme", "hydra-core"} <= installed_versions().keys()
    damaged = [entry for entry in registry.entries() if entry.name == "-"]
    if "no value" in text:
        (row,) = damaged
        assert (row.distribution, row.state) == ("soma-backend-bad", "broken")
        assert f"soma-backend-bad in {site}: lookup: its metadata is damaged" in str(row.error)


def test_damage_that_hides_a_name_is_told_by_its_folder(site: Path) -> None:
    folder = Distribution(name="bad").write_metadata(site)
    (folder / "METADATA").write_bytes(b"\xff")
    (folder / "entry_points.txt").write_bytes(b"\xff")
    (row,) = [entry for entry in Registry().entries() if entry.name == "-"]
    assert str(row.error).startswith(f"{folder.name} in {site}: lookup")
    assert str(row.error).endswith("Install its package again, or remove it")
    assert installed_versions()["hydra-core"]


def test_blocked_backends_add_no_configs(site: Path) -> None:
    Distribution(name="acme").install(site)
    assert Registry(allowed=["soma"]).config_dirs() == ()


@pytest.mark.parametrize("package", ["no_such_package_at_all", "sys", "__main__"])
def test_a_package_without_configs_has_no_folder(package: str) -> None:
    assert config_folder(_offer(f"{package}:plugin")) is None


def test_the_top_level_package_is_read_from_the_target() -> None:
    targets = ("acme.bodies.first:plugin", "acme:plugin", "acme")
    assert {_offer(target).package for target in targets} == {"acme"}


def test_names_that_pip_takes_for_equal_are_equal() -> None:
    assert normalised("Soma_Backend.Acme") == normalised("soma--backend-acme") == "soma-backend-acme"
