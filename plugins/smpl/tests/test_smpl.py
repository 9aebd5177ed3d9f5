"""What every backend must hold, on stand-ins for the three models."""

from __future__ import annotations

import pytest

from soma_core.plugin import Registry
from soma_core.testing import check_backend


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smpl", "smplh", "smplx"])
def test_conformance(data_folder, name):
    report = check_backend(name, registry=Registry())
    assert not report.missing_files
    assert not report.failed, report.text()


@pytest.mark.slow
def test_conformance_with_fewer_components(data_folder):
    report = check_backend("smpl", registry=Registry(), options={"components": 10})
    assert [outcome.check.id for outcome in report.failed] == ["parameters"], report.text()
