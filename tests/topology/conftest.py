"""The wrap pair of the small body on disk, and a cache folder of the test's own."""

from pathlib import Path

import pytest

from soma_core.plugin.spec import WrapPair
from tests.bodies import write_pair


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv("SOMA_CACHE_DIR", str(folder))
    return folder


@pytest.fixture(scope="session")
def pair(tmp_path_factory: pytest.TempPathFactory) -> WrapPair:
    return write_pair(tmp_path_factory.mktemp("pair"))
