"""The lines of a bug report: pinned, complete, and a requirements file."""

from __future__ import annotations

import json
import platform
import re
from pathlib import Path

import pytest

from soma_core import __version__
from soma_core.plugin.requirements import read_environment
from tests.plugin.installed import Distribution


def test_core_and_what_it_requires_are_pinned() -> None:
    lines = read_environment(()).text().splitlines()
    assert lines[0] == f"# python {platform.python_version()}"
    pins = [line for line in lines if not line.startswith("#")]
    assert all(re.match(r"[a-z0-9-]+==\S+(  # from \S.*)?$", line) for line in pins)
    names = [line.partition("==")[0] for line in pins]
    assert names == sorted(names)
    assert {"soma-body-core", "torch", "warp-lang", "pluggy", "hydra-core"} <= set(names)
    assert "pytest" not in names  # required by an extra only
    assert any(line.startswith(f"soma-body-core=={__version__}") for line in pins)


def test_a_backend_is_pinned_with_its_origin_and_what_it_requires(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOMA_BACKENDS", "acme")
    requires = ("Native_Model>=2", "never-installed", 'extra-thing; extra == "dev"')
    Distribution(name="acme", requires=requires).install_editable(site, tmp_path / "checkout")
    for name in ("native-model", "extra-thing"):
        Distribution(name="x", distribution=name, version="2.5").write_metadata(site)
    environment = read_environment(["soma-backend-acme", "not-installed-either"])
    lines = environment.text().splitlines()
    assert f"soma-backend-acme==1.0  # from {tmp_path / 'checkout'}" in lines
    assert "native-model==2.5" in lines
    assert "# SOMA_BACKENDS=acme" in lines
    assert not any("extra-thing" in line or "installed" in line for line in lines)
    document = json.loads(environment.json())
    assert document["variables"]["SOMA_BACKENDS"] == "acme"
    assert {"name": "native-model", "version": "2.5", "source": None} in document["distributions"]
