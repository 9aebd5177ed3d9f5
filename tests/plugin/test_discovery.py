"""Discovery from real metadata on disk, laid out as wheels and editable installs leave it."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from soma_core.plugin.discovery import Offer, config_folder, find_offers
from soma_core.plugin.registry import Registry


def install(
    site: Path, name: str, *, package_root: Path | None = None, version: str = "1.0", body: str = ""
) -> None:
    """Write a distribution into `site`; its package lies there too (a wheel) or elsewhere (editable)."""
    package = f"soma_backend_{name}"
    root = package_root or site
    configs = root / package / "configs" / "backend"
    configs.mkdir(parents=True, exist_ok=True)
    (root / package / "__init__.py").write_text(body or "raise RuntimeError('imported')\n")
    (configs / f"{name}.yaml").write_text(f"name: {name}\nparams: {{size: null}}\noptions: {{}}\n")
    info = site / f"{package}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: soma-backend-{name}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(f"[soma_core.backends]\n{name} = {package}\n")
    if package_root is not None:
        (site / f"_{package}.pth").write_text(f"{package_root}\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "site-packages"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    importlib.invalidate_caches()
    return folder


def test_a_wheel_is_found_without_importing_it(site: Path) -> None:
    install(site, "acme")
    importlib.invalidate_caches()
    registry = Registry()
    assert "acme" in registry.names()
    assert ("soma-backend-acme", site / "soma_backend_acme" / "configs") in registry.config_dirs()
    assert "soma_backend_acme" not in sys.modules


def test_an_editable_install_is_found_without_importing_it(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "checkout" / "src"
    install(site, "acme", package_root=source)
    monkeypatch.syspath_prepend(str(source))  # what the interpreter does with the .pth file at start
    assert ("soma-backend-acme", source / "soma_backend_acme" / "configs") in Registry().config_dirs()
    assert "soma_backend_acme" not in sys.modules


def test_an_editable_install_beside_a_stale_wheel_counts_once(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(site, "acme", version="1.0")
    newer = tmp_path / "newer"
    newer.mkdir()
    install(newer, "acme", version="2.0")
    monkeypatch.syspath_prepend(str(newer))
    (offer,) = find_offers()["acme"]
    assert offer.version == "2.0"


def test_blocked_and_conflicting_backends_add_no_configs(site: Path) -> None:
    install(site, "acme")
    assert Registry(allowed=["soma"]).config_dirs() == ()


@pytest.mark.parametrize("package", ["no_such_package_at_all", "sys", "__main__"])
def test_a_package_without_configs_has_no_folder(package: str) -> None:
    offer = Offer(name="x", distribution="x", version="1", target=f"{package}:plugin", load=lambda: None)
    assert config_folder(offer) is None


def test_the_top_level_package_is_read_from_the_target() -> None:
    def package(target: str) -> str:
        return Offer(name="x", distribution="x", version="1", target=target, load=lambda: None).package

    assert package("acme.bodies.first:plugin") == package("acme:plugin") == package("acme") == "acme"
