"""The report of a shape space: a plot that people can read."""

import importlib.util

import pytest

from soma_core.shape_space import report


@pytest.fixture
def rows():
    errors = {"mean_mm": 0.6, "p95_mm": 1.7, "max_mm": 126.5}
    return [{"components": count, **errors} for count in (1, 8, 96)]


def test_axes_of_the_plot_carry_plain_numbers(rows, tmp_path, monkeypatch):
    figures = pytest.importorskip("matplotlib.figure", reason="the plot needs matplotlib")
    drawn = []
    save = figures.Figure.savefig

    def keep(figure, *arguments, **options):
        drawn.append(figure)
        save(figure, *arguments, **options)

    monkeypatch.setattr(figures.Figure, "savefig", keep)
    assert report.plot_errors(rows, tmp_path / "plot.png")
    (axes,) = drawn[0].axes
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1", "8", "96"]
    assert {"0.5", "1", "10", "100"} <= {label.get_text() for label in axes.get_yticklabels()}
    assert not any(label.get_text() for label in axes.get_xticklabels(minor=True))


def test_without_matplotlib_there_is_no_plot(rows, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert not report.plot_errors(rows, tmp_path / "plot.png")
    assert not list(tmp_path.iterdir())
