"""Running checks: order, isolation, selection, expected failures, checks of plugins."""

from __future__ import annotations

import json
import os
import re

import pytest

from soma_core.errors import InputError
from soma_core.plugin.errors import BackendConflictError, BackendDisabledError, UnknownBackendError
from soma_core.plugin.registry import Registry
from soma_core.testing import Check, CheckFailedError, check, check_backend, conformance_suite
from soma_core.testing.checks import CORE_CHECKS
from soma_core.testing.run import ConformanceRun
from soma_core.testing.synthetic import synthetic_canonical
from tests.plugin.fakes import FakeEntryPoint
from tests.testing.packages import check_package, package

IDS = [
    "declares", "licence", "described", "parameter-defaults", "options", "fill-segments", "files-named",
    "own-checks", "import-light", "import-silent", "config-composes", "config-complete", "wrap-reads",
    "wrap-count", "wrap-order", "wrap-faces", "wrap-distance", "wrap-coverage", "wrap-fingers",
    "generator-builds", "generator-shape",
    "generator-dtype", "generator-device", "other-device", "finite", "deterministic", "batch-invariant",
    "inputs-unchanged",
    "no-global-state", "no-own-gradient", "another-process", "parameters", "group-defaults", "gradient",
    "neutral-equals-obj",
    "linear-basis", "upright", "stature", "triangles", "skinning", "posed", "random-poses", "pose-vector",
    "expressions", "motion-formats",
    "transfer-neutral", "transfer-random", "similarity-equivariant", "joints-inside",
    "rotations-so3", "zero-is-t-pose", "inversion-round-trip",
]  # fmt: skip
"""Suites of strangers name these; a change breaks them and needs a line in the changelog."""

NO_LICENCE = ("__init__.py", '"CC0-1.0"', '""')
CANONICAL = synthetic_canonical()


def no_licence(made):
    made.replace(*NO_LICENCE)


def own_checks(text):
    """An edit that gives the plugin other checks; `text` is the body of soma_checks."""

    def edit(made):
        made.replace("__init__.py", "    return [taller]", text)

    return edit


def states(report):
    return {outcome.check.id: outcome.state for outcome in report.outcomes}


# --- the list ---------------------------------------------------------------------------------------------


def test_ids_are_the_published_ones():
    assert [item.id for item in CORE_CHECKS] == IDS


def test_every_check_says_in_one_line_what_holds():
    for item in CORE_CHECKS:
        assert 20 < len(item.summary) < 90, item.id
        assert "\n" not in item.summary


def test_what_a_check_needs_comes_before_it_and_is_no_slower():
    level = {item.id: item.level for item in CORE_CHECKS}
    for place, item in enumerate(CORE_CHECKS):
        for need in item.needs:
            assert IDS.index(need) < place, f"{item.id} needs {need}"
            assert level[need] == "core" or item.level == "full", f"{item.id} needs {need}"


@pytest.mark.parametrize("bad", ["Licence", "a b", "a_b", "", "-a"])
def test_an_id_is_kebab_case(bad):
    with pytest.raises(InputError, match=f"Check.id: got {bad!r}, expected lower-case words"):
        Check(id=bad, level="core", summary="", run=print)


def test_a_level_is_one_of_two():
    with pytest.raises(InputError, match="level of the check a: got 'slow', expected one of core, full"):
        check("a", level="slow")(print)


# --- selection --------------------------------------------------------------------------------------------


def test_level_core_leaves_the_slow_checks_out(tmp_path):
    report = check_package(tmp_path, level="core")
    assert list(states(report)) == [
        *(item.id for item in CORE_CHECKS if item.level == "core"),
        "specimen/taller",
    ]
    assert report.failed == ()


def test_only_names_checks_and_brings_what_they_need(tmp_path):
    report = check_package(tmp_path, only=["wrap-fa*", "licence"])
    assert list(states(report)) == [
        "declares",
        "licence",
        "wrap-reads",
        "wrap-count",
        "wrap-order",
        "wrap-faces",
    ]


def test_only_takes_checks_of_any_level(tmp_path):
    assert "gradient" in states(check_package(tmp_path, only=["gradient"], level="core"))


@pytest.mark.parametrize("pattern", ["licens", "wrapp-*", "x"])
def test_an_unknown_id_is_refused(tmp_path, pattern):
    with pytest.raises(InputError, match=re.escape(f"only: got {pattern!r}, expected the id of a check")):
        check_package(tmp_path, only=[pattern])


def test_an_unknown_level_is_refused(tmp_path):
    with pytest.raises(InputError, match="level: got 'fast', expected 'core' or 'full'"):
        check_package(tmp_path, level="fast")


# --- what cannot be checked -------------------------------------------------------------------------------


def test_a_backend_that_is_not_there_is_refused():
    with pytest.raises(UnknownBackendError, match='backend "gone": lookup: no installed distribution'):
        check_backend("gone", registry=Registry([]))


def test_a_backend_that_is_blocked_or_offered_twice_is_refused():
    points = [FakeEntryPoint("twice", distribution="acme"), FakeEntryPoint("twice", distribution="bodies")]
    with pytest.raises(BackendConflictError, match="acme 1.0 and bodies 1.0"):
        check_backend("twice", registry=Registry(points))
    with pytest.raises(BackendDisabledError, match="SOMA_BACKENDS allows only other"):
        check_backend("once", registry=Registry([FakeEntryPoint("once")], allowed=["other"]))


def test_a_missing_file_of_the_user_is_no_failure(tmp_path):
    report = check_package(tmp_path, lambda made: made.delete("model.txt"))
    assert report.failed == ()
    assert [path.name for path in report.missing_files] == ["model.txt"]
    (outcome,) = [each for each in report.outcomes if each.check.id == "generator-builds"]
    assert outcome.state == "not run"
    assert "the model is missing at" in outcome.reason
    assert "Get it from https://example.org/model" in outcome.reason
    assert not json.loads(report.json())["passed"]
    assert states(report)["stature"] == "not run"


# --- isolation --------------------------------------------------------------------------------------------


def test_what_depends_on_a_failure_is_not_run_and_the_rest_is(tmp_path):
    report = check_package(
        tmp_path,
        lambda made: made.replace("__init__.py", "(\n            Parameter", "(\n            Parametr"),
    )
    found = states(report)
    assert found.pop("declares") == "failed"
    assert set(found.values()) == {"not run"}
    assert report.outcomes[1].reason == "needs declares"


def test_global_state_is_put_back_after_each_check(tmp_path):
    old, new = (
        "        size = params",
        "        import os; os.environ['SPECIMEN'] = '1'\n        size = params",
    )
    report = check_package(tmp_path, lambda made: made.replace("_generator.py", old, new))
    assert [outcome.check.id for outcome in report.failed] == ["no-global-state"]
    assert "SPECIMEN" not in os.environ


def test_ctrl_c_ends_the_run(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        check_package(
            tmp_path,
            lambda made: made.replace(
                "_generator.py",
                "        size = params",
                "        raise KeyboardInterrupt\n        size = params",
            ),
            only=["generator-builds"],
        )


def test_a_check_runs_once(tmp_path):
    with package(tmp_path) as registry:
        run = ConformanceRun("specimen", registry=registry, canonical=CANONICAL, only=["wrap-faces"])
        first = run.outcome("wrap-reads")
        run.report()
        assert run.outcome("wrap-reads") is first
        run.close()
        assert run.outcome("wrap-reads") is first


def test_options_reach_the_generator(tmp_path):
    report = check_package(tmp_path, options={"strength": "much"}, only=["generator-builds"])
    assert [outcome.where for outcome in report.failed] == ["backend.options.strength"]
    assert "'much' (str)" in report.failed[0].got


# --- expected failures ------------------------------------------------------------------------------------


def test_an_expected_failure_does_not_fail_the_run(tmp_path):
    report = check_package(tmp_path, no_licence, only=["licence"], expected_failures={"licence": "a test"})
    assert states(report)["licence"] == "expected"
    assert report.failed == ()
    assert "failed as expected" in report.text()


def test_an_expected_failure_that_passes_fails_the_run(tmp_path):
    report = check_package(tmp_path, only=["licence"], expected_failures={"licence": "once upon a time"})
    assert [outcome.state for outcome in report.failed] == ["fixed"]
    assert report.failed[0].sentence == (
        "licence: got a pass, expected a failure (once upon a time). Take the id out of expected_failures."
    )


def test_an_unknown_expected_failure_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"expected_failures: got 'licens'.* Did you mean \"licence\"\?"):
        check_package(tmp_path, expected_failures={"licens": "a test"})


@pytest.mark.parametrize("reason", ["", "  ", None])
def test_an_expected_failure_needs_a_reason(tmp_path, reason):
    with pytest.raises(
        InputError, match=rf"expected_failures\['licence'\]: got {reason!r}, expected the physical"
    ):
        check_package(tmp_path, expected_failures={"licence": reason})


# --- checks of plugins ------------------------------------------------------------------------------------


def test_a_failing_check_of_the_plugin_is_reported_under_its_name(tmp_path):
    report = check_package(
        tmp_path,
        lambda made: made.replace("_checks.py", "large > small", "large < small"),
        only=["specimen/*"],
    )
    assert [outcome.check.id for outcome in report.failed] == ["specimen/taller"]
    assert report.failed[0].sentence.startswith("size=1.1: got 1")


def test_a_check_of_the_plugin_may_need_another(tmp_path):
    edit = own_checks(
        "    from soma_core.testing import check\n"
        "    again = check('again', needs=('taller',))(lambda context: None)\n"
        "    return [again, taller]"
    )
    report = check_package(tmp_path, edit, only=["specimen/again"])
    assert report.outcomes[-1].check.needs == ("finite",)
    assert states(report)["specimen/again"] == "passed"


def test_two_checks_of_one_name_are_refused(tmp_path):
    with pytest.raises(
        InputError, match="soma_checks of backend 'specimen': got taller 2 times, expected each id"
    ):
        check_package(tmp_path, own_checks("    return [taller, taller]"))


def test_a_check_that_needs_what_is_not_there_is_refused(tmp_path):
    edit = own_checks("    import dataclasses\n    return [dataclasses.replace(taller, needs=('finit',))]")
    with pytest.raises(
        InputError, match="needs of the check specimen/taller: got 'finit'.*Did you mean \"finite\""
    ):
        check_package(tmp_path, edit)


# --- pytest -----------------------------------------------------------------------------------------------


def outcome_of(suite, check_id):
    """How the test of one check ends: its exception's name and text, or passed."""
    try:
        suite().test_check(check_id)
    except BaseException as error:
        return type(error).__name__, str(error)
    return "passed", ""


@pytest.fixture
def suite(tmp_path):
    def edit(made):
        no_licence(made)
        made.replace("__init__.py", "    return Specimen(", "    1 / 0\n    return Specimen(")
        made.replace("_generator.py", "        size = params", "        1 / 0\n        size = params")
        made.replace("__init__.py", "        options=Options,\n", "")

    with package(tmp_path, edit) as registry:
        expected = {"licence": "a test", "described": "another"}
        yield conformance_suite("specimen", expected, registry=registry, canonical=CANONICAL)


def test_each_state_has_its_place_in_pytest(suite):
    assert outcome_of(suite, "declares") == ("passed", "")
    assert outcome_of(suite, "licence") == ("XFailed", "a test")
    name, text = outcome_of(suite, "described")
    assert name == "Failed"
    assert "got a pass" in text
    assert outcome_of(suite, "options") == ("Skipped", "not applicable: the backend has no options")
    name, text = outcome_of(suite, "generator-builds")
    assert name == "Failed"
    assert "build: KeyError: 'strength'" in text or "ZeroDivisionError" in text
    assert outcome_of(suite, "finite") == ("Skipped", "not run: needs generator-device")
    suite.teardown_class()


def test_the_author_gets_the_traceback_of_an_exception(tmp_path):
    def edit(made):
        made.replace("_generator.py", "        size = params", "        1 / 0\n        size = params")

    with package(tmp_path, edit) as registry:
        suite = conformance_suite("specimen", registry=registry, canonical=CANONICAL)
        with pytest.raises(CheckFailedError, match=r"_generator.py:\d+: got ZeroDivisionError") as caught:
            suite().test_check("generator-builds")
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_the_suite_refuses_what_the_function_refuses(tmp_path):
    with package(tmp_path) as registry, pytest.raises(InputError, match="got 'licens'"):
        conformance_suite("specimen", {"licens": "a test"}, registry=registry)
    with pytest.raises(UnknownBackendError, match='"gone"'):
        conformance_suite("gone", registry=Registry([]))
