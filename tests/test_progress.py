"""Progress: steps pass through unchanged; plain lines where there is no terminal, a bar where there is."""

import io
import logging

from soma_core.progress import PrintableFormatter, printable, progress


def test_plain_lines_count_every_step(caplog, monkeypatch):
    monkeypatch.setattr("sys.stderr", io.StringIO())
    with caplog.at_level(logging.INFO):
        assert list(progress(range(2, 6), label="work", total=6, done=2)) == [2, 3, 4, 5]
    assert [record.message for record in caplog.records] == [
        f"work: {number} of 6" for number in (3, 4, 5, 6)
    ]


def test_long_work_prints_a_bounded_number_of_lines(caplog, monkeypatch):
    monkeypatch.setattr("sys.stderr", io.StringIO())
    with caplog.at_level(logging.INFO):
        list(progress(range(1000), label="work", total=1000, lines=10))
    assert len(caplog.records) == 10


def test_a_terminal_gets_a_bar(caplog, monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", terminal)
    with caplog.at_level(logging.INFO):
        assert list(progress("abc", label="work", total=3)) == ["a", "b", "c"]
    assert "work: 100%" in terminal.getvalue()
    assert not caplog.records


def test_short_work_says_nothing(caplog, monkeypatch):
    monkeypatch.setattr("sys.stderr", io.StringIO())
    with caplog.at_level(logging.INFO):
        assert list(progress(range(3), label="work", total=3, after=60.0)) == [0, 1, 2]
    assert not caplog.records


def test_orders_to_a_terminal_are_written_out():
    owned = "a\x1b]0;owned\x07\x9b31m\u202ename\r.bvh"
    shown = r"a\x1b]0;owned\x07\x9b31m\u202ename\r.bvh"
    assert printable(owned) == shown
    assert printable("Ägypten\t数据\n") == "Ägypten\t数据\n"
    record = logging.LogRecord("soma_core", logging.WARNING, "", 0, "%s: odd", (owned,), None)
    assert PrintableFormatter("%(message)s").format(record) == f"{shown}: odd"
