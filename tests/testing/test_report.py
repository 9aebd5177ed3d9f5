"""The report as text and as JSON."""

from __future__ import annotations

import json
from pathlib import Path

from soma_core.testing import check
from soma_core.testing.report import Outcome, Report

TRUE = check("true", level="core")(lambda context: None)
NAMED = check("well-named")(lambda context: None)
OUTCOMES = (
    Outcome(check=TRUE, state="passed", seconds=0.25),
    Outcome(
        check=NAMED, state="failed", where="vertex 7", got="1 mm", expected="0 mm", fix="Move it.", seconds=1
    ),
)


def report(*outcomes, missing=()):
    return Report(
        backend="acme", distribution="soma-backend-acme 1.0", level="full", outcomes=outcomes,
        missing_files=missing,
    )  # fmt: skip


def test_text_is_a_line_a_check_then_the_sentences_then_the_count():
    assert report(*OUTCOMES).text().splitlines() == [
        'backend "acme" (soma-backend-acme 1.0), level full',
        "",
        "  passed          true",
        "  FAILED          well-named",
        "",
        "well-named:",
        "  vertex 7: got 1 mm, expected 0 mm. Move it.",
        "",
        "1 passed, 1 failed in 1.2 s",
    ]


def test_reasons_stand_in_the_line_of_the_check():
    text = report(
        Outcome(check=TRUE, state="not run", reason="needs wrap-reads"),
        Outcome(check=NAMED, state="expected", reason="the model is a robot"),
    ).text()
    assert "  not run         true        needs wrap-reads" in text
    assert "  expected        well-named  the model is a robot" in text
    assert text.endswith("1 not run, 1 failed as expected in 0.0 s")


def test_json_says_the_same():
    document = json.loads(report(*OUTCOMES).json())
    assert (document["backend"], document["level"], document["passed"]) == ("acme", "full", False)
    assert document["checks"][1] == {
        "id": "well-named", "level": "full", "summary": "", "state": "failed", "where": "vertex 7",
        "got": "1 mm", "expected": "0 mm", "fix": "Move it.", "reason": "", "seconds": 1,
    }  # fmt: skip


def test_missing_files_are_no_pass():
    document = json.loads(report(OUTCOMES[0], missing=(Path("/models/acme.npz"),)).json())
    assert document["missing_files"] == ["/models/acme.npz"]
    assert not document["passed"]
    assert json.loads(report(OUTCOMES[0]).json())["passed"]
