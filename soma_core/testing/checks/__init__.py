"""The checks of the core, by subject; their order is the order of reports."""

from __future__ import annotations

from soma_core.plugin.checks import Check
from soma_core.testing.checks import (
    agreement,
    behaviour,
    body,
    capabilities,
    declaration,
    generator,
    installation,
    parameters,
    skeleton,
    transfer,
    wrap,
)

__all__ = ["CORE_CHECKS"]

CORE_CHECKS: tuple[Check, ...] = (
    *declaration.CHECKS,
    *installation.CHECKS,
    *wrap.CHECKS,
    *generator.CHECKS,
    *behaviour.CHECKS,
    *parameters.CHECKS,
    *agreement.CHECKS,
    *body.CHECKS,
    *capabilities.CHECKS,
    *transfer.CHECKS,
    *skeleton.CHECKS,
)
"""Every check of the core. Ids are stable: suites name them in ``expected_failures``."""
