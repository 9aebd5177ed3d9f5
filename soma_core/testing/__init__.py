"""What backend authors import in their tests: the conformance suite and a synthetic body.

A backend's whole test file::

    from soma_core.testing import conformance_suite

    TestAcme = conformance_suite("acme")

The same checks run as ``soma backends check acme`` and as ``check_backend("acme")``. Importing this package
loads neither torch nor pytest.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from soma_core.plugin.check import Check, CheckFailedError, Level, check
    from soma_core.testing.context import Context
    from soma_core.testing.report import Report
    from soma_core.testing.run import check_backend
    from soma_core.testing.suite import conformance_suite

__all__ = [
    "Check",
    "CheckFailedError",
    "Context",
    "Level",
    "Report",
    "check",
    "check_backend",
    "conformance_suite",
]

_HOME = {
    "Check": "soma_core.plugin.check",
    "CheckFailedError": "soma_core.plugin.check",
    "Context": "soma_core.testing.context",
    "Level": "soma_core.plugin.check",
    "Report": "soma_core.testing.report",
    "check": "soma_core.plugin.check",
    "check_backend": "soma_core.testing.run",
    "conformance_suite": "soma_core.testing.suite",
}


def __getattr__(name: str) -> Any:
    """Load a public name on first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it offers {', '.join(__all__)}")
    return getattr(importlib.import_module(_HOME[name]), name)
