"""Every check catches a backend that is broken in its way alone, and no other check complains."""

from __future__ import annotations

import re

import pytest

from soma_core.testing.checks import CORE_CHECKS
from tests.testing.mutants import MUTANTS, Mutant
from tests.testing.packages import check_package


def _label(mutant: Mutant) -> str:
    return f"{mutant.check}: {mutant.says:.40}"


FIRST = {mutant.check: mutant for mutant in reversed(MUTANTS)}
CASES = [
    pytest.param(mutant, id=_label(mutant), marks=() if FIRST[mutant.check] is mutant else pytest.mark.slow)
    for mutant in MUTANTS
]
"""One mutant of each check in every run, all of them in the slow one."""


def test_the_specimen_passes_every_check(tmp_path):
    report = check_package(tmp_path)
    assert {outcome.check.id: outcome.state for outcome in report.outcomes if outcome.state != "passed"} == {
        "wrap-fingers": "not applicable"
    }  # its hands are not the shipped ones
    assert [outcome.check.id for outcome in report.outcomes] == [
        *(check.id for check in CORE_CHECKS),
        "specimen/taller",
    ]


@pytest.mark.parametrize("mutant", CASES)
def test_a_mutant_fails_its_check_and_no_other(tmp_path, mutant):
    report = check_package(tmp_path, mutant.edit, apart=mutant.check == "another-process")
    assert [outcome.check.id for outcome in report.failed] == [mutant.check], report.text()
    (failure,) = report.failed
    assert re.search(mutant.says, failure.sentence)
    assert all((failure.where, failure.got, failure.expected, failure.fix))
    others = {outcome.state for outcome in report.outcomes if outcome is not failure}
    assert others <= {"passed", "not run", "not applicable"}


def test_no_check_is_without_a_mutant():
    wanted = {check.id for check in CORE_CHECKS} - {"wrap-fingers"}  # see tests/registration/test_digits.py
    assert wanted == {mutant.check for mutant in MUTANTS}
