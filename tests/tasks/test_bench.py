"""The benchmark task: it checks before it times, and writes what it found."""

import json

import pytest
from omegaconf import OmegaConf

from soma_core.config.schema import BenchConfig
from soma_core.errors import SomaError
from soma_core.tasks import bench


def configured(**changes):
    settings = {"backend": {"name": "soma"}, "batches": [1], "repeats": 1, "threads": 2}
    return OmegaConf.merge(OmegaConf.structured(BenchConfig), settings | changes)


@pytest.mark.slow
def test_every_case_is_written(tmp_path):
    bench.run(configured(), tmp_path)
    document = json.loads((tmp_path / "bench.json").read_text(encoding="utf-8"))
    cases = [row["case"].strip() for row in document["rows"]]
    assert cases[0] == "forward"
    assert {"repose to bind", "pose, one identity", "forward + backward"} < set(cases)
    assert all(row["median_ms"] > 0 for row in document["rows"])


def test_nothing_is_timed_when_the_results_differ(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "_AGREEMENT_MM", -1.0)
    with pytest.raises(SomaError, match=r"bench: the timed path is .* mm from the reference, bound -1"):
        bench.run(configured(), tmp_path)
    assert not (tmp_path / "bench.json").exists()
