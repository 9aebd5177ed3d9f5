"""Which command a message names, after how the distribution was installed."""

from __future__ import annotations

from pathlib import Path

import pytest

from soma_core.plugin.installation import core_requirement, editable_folder, local_source, reinstall_command
from tests.plugin.installed import Distribution

NAME = "soma-backend-acme"


def test_from_an_index(site: Path) -> None:
    Distribution(name="acme").install(site)
    assert local_source(NAME) is None
    assert editable_folder(NAME) is None
    assert reinstall_command(NAME) == "Run: pip install --upgrade soma-backend-acme"


def test_from_a_checkout(site: Path, tmp_path: Path) -> None:
    checkout = tmp_path / "my checkout"
    Distribution(name="acme").install_editable(site, checkout)
    assert editable_folder(NAME) == str(checkout)
    assert reinstall_command(NAME) == f"Run: pip install -e '{checkout}'"


def test_from_a_local_folder_or_file(site: Path, tmp_path: Path) -> None:
    Distribution(name="acme").write_metadata(site, source=tmp_path)
    assert editable_folder(NAME) is None
    assert reinstall_command(NAME) == f"Run: pip install --upgrade {tmp_path}"


@pytest.mark.parametrize("text", ["", "{", "[]", '{"url": "https://example.org/acme.whl"}', '{"url": 3}'])
def test_what_says_nothing_of_use_counts_as_an_index(site: Path, text: str) -> None:
    (Distribution(name="acme").write_metadata(site) / "direct_url.json").write_text(text)
    assert reinstall_command(NAME) == "Run: pip install --upgrade soma-backend-acme"


def test_of_a_distribution_that_is_not_installed() -> None:
    assert reinstall_command("soma-backend-nowhere") == "Run: pip install --upgrade soma-backend-nowhere"
    assert core_requirement("soma-backend-nowhere") == "soma-body-core"


@pytest.mark.parametrize(
    ("required", "found"),
    [
        ("soma-body-core>=0.3", "soma-body-core>=0.3"),
        ("Soma_Body.Core[all] (<2,>=1.5) ; python_version > '3'", "soma-body-core<2,>=1.5"),
        ("soma-body-core", "soma-body-core"),
        ("soma-body-core-extras>=9", "soma-body-core"),
    ],
)
def test_the_core_that_a_plugin_asks_for(site: Path, required: str, found: str) -> None:
    Distribution(name="acme", requires=("numpy>=1.26", required)).install(site)
    assert core_requirement(NAME) == found
