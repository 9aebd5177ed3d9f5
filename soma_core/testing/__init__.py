"""What backend authors import in their tests: the conformance suite and a synthetic body.

A backend's whole test file::

    from soma_core.testing import conformance_suite

    TestAcme = conformance_suite("acme")

The same checks run as ``soma backends check acme`` and as ``check_backend("acme")``. Importing this package
loads neither torch nor pytest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from soma_core._lazy import lazy_names

if TYPE_CHECKING:
    from soma_core.testing.context import Context
    from soma_core.testing.report import Report
    from soma_core.testing.run import check_backend
    from soma_core.testing.suite import conformance_suite

__all__ = [
    "Context",
    "Report",
    "check_backend",
    "conformance_suite",
]

_HOMES = {
    "soma_core.testing.context": ["Context"],
    "soma_core.testing.report": ["Report"],
    "soma_core.testing.run": ["check_backend"],
    "soma_core.testing.suite": ["conformance_suite"],
    # In `soma_core.plugin` now; plugins that were written before go on
    "soma_core.plugin.checks": ["Check", "CheckFailedError", "Level", "check"],
}

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
