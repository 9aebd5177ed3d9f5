"""Experiments: the reports are written, and a figure outside its bound fails the run."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from omegaconf import OmegaConf

from soma_core.errors import InputError, SomaError
from soma_core.evaluation.random_poses import joint_spread, random_axis_angles
from soma_core.evaluation.report import Figure, Report, ShownBody, distance_figures
from soma_core.rig import load_canonical
from soma_core.tasks import evaluate
from soma_core.view import error_picture


def configured(name, count=2):
    return OmegaConf.create({"experiment": {"name": name, "backend": "soma", "count": count}, "seed": 0})


def test_the_native_backend_passes_the_forward_path(tmp_path):
    evaluate.run(configured("forward_path"), tmp_path)
    figures = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["figures"]
    assert any(figure["bound"] is not None for figure in figures)
    assert all(figure["passed"] for figure in figures)
    assert "T-pose" in (tmp_path / "report.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("value", [2.0, float("nan")])
def test_a_figure_outside_its_bound_fails_after_the_reports(tmp_path, monkeypatch, value):
    report = Report(title="Made up", figures=[Figure(name="drift", value=value, unit="mm", bound=1.0)])
    fake = SimpleNamespace(run=lambda config: report)
    monkeypatch.setattr(evaluate.importlib, "import_module", lambda name: fake)
    with pytest.raises(SomaError, match=r"forward_path: drift is (2|nan) mm, bound 1"):
        evaluate.run(configured("forward_path"), tmp_path)
    assert "FAILED" in (tmp_path / "report.md").read_text(encoding="utf-8")


def shown():
    corners = np.eye(3)
    return ShownBody(caption="one", vertices=corners, triangles=np.array([[0, 1, 2]]), errors_mm=np.ones(3))


@pytest.mark.parametrize("drawable", [True, False])
def test_the_bodies_of_a_report_are_drawn_where_they_can_be(tmp_path, monkeypatch, caplog, drawable):
    def sheet(path, bodies, errors):
        if not drawable:
            raise SomaError("pictures need pyvista")
        path.write_text(f"{bodies[0].caption} {errors[0].tolist()}")

    report = Report(title="Made up", figures=[], bodies=[shown()])
    monkeypatch.setattr(
        evaluate.importlib, "import_module", lambda name: SimpleNamespace(run=lambda _: report)
    )
    monkeypatch.setattr(error_picture, "error_sheet", sheet)
    evaluate.run(configured("forward_path"), tmp_path)
    picture = tmp_path / "errors.png"
    assert picture.exists() == drawable
    assert ("no picture: pictures need pyvista" in caplog.text) != drawable
    assert not drawable or picture.read_text() == "one [1.0, 1.0, 1.0]"


def test_an_unknown_experiment_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"experiment.name: got 'table9', expected one of table1_topology"):
        evaluate.run(configured("table9"), tmp_path)


def test_distances_become_millimetres():
    mean, std, p95, largest = distance_figures("x", np.array([0.001, 0.003]), mean=2.5)
    assert (mean.value, mean.passed) == (2.0, True)
    assert (std.value, largest.value) == (1.0, 3.0)
    assert p95.bound is None


def test_random_poses_turn_every_moving_joint_and_stay_short():
    names = load_canonical("low")[1].user_joint_names
    spread = joint_spread(names)
    resting = {name for name, value in zip(names, spread, strict=True) if value == 0}
    assert all(name.endswith("End") for name in resting)
    drawn = random_axis_angles(names, 50, np.random.default_rng(0))
    lengths = np.linalg.norm(drawn, axis=-1)
    assert lengths.max() <= 1.6 + 1e-12
    assert (lengths[:, spread > 0] > 0).all()
