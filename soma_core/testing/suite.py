"""The conformance checks as a pytest class: a backend's whole test file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from soma_core.errors import SomaError
from soma_core.plugin.checks import CheckFailedError, Level
from soma_core.plugin.registry import Registry
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.testing.report import Outcome
from soma_core.testing.run import ConformanceRun

__all__ = ["conformance_suite"]


def conformance_suite(
    name: str,
    expected_failures: Mapping[str, str] | None = None,
    *,
    level: Level = "full",
    options: Mapping[str, Any] | None = None,
    registry: Registry | None = None,
    canonical: tuple[CanonicalMesh, Rig] | None = None,
) -> type:
    """Return a class for pytest with one test for each check.

    A backend's whole test file is ``TestAcme = conformance_suite("acme")``.

    A check whose failure is expected shows as xfail and, once it passes, as a failure; one that does not
    apply, or that needs what is broken or missing, shows as skipped. For the arguments and what they raise
    see :func:`soma_core.testing.check_backend`.
    """
    import pytest

    run = ConformanceRun(
        name, level=level, expected_failures=expected_failures, options=options, registry=registry,
        canonical=canonical,
    )  # fmt: skip

    class Conformance:
        """The checks of one backend."""

        @pytest.mark.parametrize("check_id", list(run.checks))
        def test_check(self, check_id: str) -> None:
            """Pass, fail, or say why not."""
            _settle(run.outcome(check_id))

        @classmethod
        def teardown_class(cls) -> None:
            """Free the models."""
            run.close()

    Conformance.__doc__ = f"The conformance checks of backend {name!r}."
    return Conformance


def _settle(outcome: Outcome) -> None:
    """Tell pytest how a check ended."""
    import pytest

    if outcome.state == "expected":
        pytest.xfail(outcome.reason)
    if outcome.state in ("not run", "not applicable"):
        pytest.skip(f"{outcome.state}: {outcome.reason}")
    if outcome.state == "fixed" or isinstance(outcome.error, SomaError):
        pytest.fail(outcome.sentence, pytrace=False)
    if outcome.error is not None:
        raise CheckFailedError(
            outcome.where, got=outcome.got, expected=outcome.expected, fix=outcome.fix
        ) from outcome.error
