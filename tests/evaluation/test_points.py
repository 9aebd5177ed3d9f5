"""The experiment of points: every figure on a short clip, and the clip that ships where no data is given."""

from __future__ import annotations

import pytest
from omegaconf import OmegaConf

from soma_core.evaluation import points


@pytest.mark.slow
def test_figures_pass_on_the_clip_that_ships(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SOMA_TEST_DATA", raising=False)
    monkeypatch.setattr(points, "_SECONDS", 1)
    monkeypatch.setattr(points, "_PEOPLE", {"small": {"size": 0.7, "arms": 1.1}})
    config = OmegaConf.create(
        {"seed": 0, "device": "cpu", "experiment": {"backend": "toy", "count": 20, "data": None}}
    )
    report = points.run(config)
    assert [row[0] for row in report.tables[0].rows] == ["range of motion"]
    told = {figure.name: figure for figure in report.figures}
    assert "range of motion: given joints, max" in told
    # one second of one motion is too little for the mean angle under noise
    assert {figure.name for figure in report.failed} <= {name for name in told if "of noise, turns" in name}
