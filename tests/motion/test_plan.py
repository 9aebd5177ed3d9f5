"""A fit whose chunks are done by other processes, from plain values that are pickled."""

from __future__ import annotations

import functools
import multiprocessing
import pickle

import numpy as np
import pytest
import torch

from soma_core.errors import InputError
from soma_core.io import read_motion
from soma_core.layer import SomaLayer
from soma_core.motion import (
    BackendChoice,
    ConvertOptions,
    IdentityChoice,
    InvertOptions,
    finish_fit,
    fit_chunks,
    invert,
    plan_fit,
)
from tests.bodies import randn
from tests.motion.test_converter import motion, write_motion

FRAMES = 5
SETTINGS = {"lod": "low", "fps": 24, "unit": "m", "topology": "canonical", "chunk": 2}


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    """A moving mesh as a file."""
    layer = SomaLayer("soma", lod="low")
    with torch.no_grad():
        turns = 0.2 * randn(FRAMES, 77, 3, seed=1).float()
        vertices = layer.pose(layer.identity(), turns).vertices.numpy()
    file = tmp_path_factory.mktemp("body") / "body.npz"
    np.savez(file, vertices=vertices)
    return file


@pytest.mark.slow
def test_chunks_of_a_plan_are_fitted_in_another_process(body, tmp_path):
    options = InvertOptions(**SETTINGS)
    plan = plan_fit(body, tmp_path / "plan", options=options)
    assert plan.missing() == [0, 1, 2]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        pool.map(functools.partial(fit_chunks, plan), [[0], [2]])
    assert plan.missing() == [1]
    fit_chunks(pickle.loads(pickle.dumps(plan)), [1])
    found = finish_fit(plan)
    assert not (tmp_path / "plan/chunks").exists()
    whole = invert(body, tmp_path / "whole", options=options)
    np.testing.assert_array_equal(found.motion().rotations, whole.motion().rotations)
    assert found.report == whole.report


def test_a_plan_keeps_the_body_that_was_found(body, tmp_path):
    search = IdentityChoice(method="backend", frames=1, iterations=1)
    begin = BackendChoice(name="soma", params={"shape": [1.0]})
    options = InvertOptions(**SETTINGS | {"chunk": FRAMES}, identity=search, backend=begin)
    plan = pickle.loads(pickle.dumps(plan_fit(body, tmp_path, options=options)))
    shape = plan.stored["params"]["shape"]
    assert 0 < abs(shape[0]) < 0.5
    finish_fit(plan)
    assert read_motion(tmp_path / "motion.npz").identity["params"]["shape"] == shape


def test_what_needs_no_fit_has_no_plan(tmp_path):
    write_motion(motion(), tmp_path / "m.npz")
    with pytest.raises(InputError, match="got the layout soma, expected a body to fit"):
        plan_fit(tmp_path / "m.npz", tmp_path, options=ConvertOptions())


def test_a_finished_plan_and_chunks_of_nowhere_are_refused(body, tmp_path):
    options = InvertOptions(**SETTINGS)
    plan = plan_fit(body, tmp_path / "plan", options=options)
    with pytest.raises(InputError, match=r"numbers: got \[3\], expected 0 to 2"):
        fit_chunks(plan, 3)
    fit_chunks(plan, 0)
    finish_fit(plan)
    with pytest.raises(InputError, match="plan: got one that is finished"):
        fit_chunks(plan, 0)


def test_chunks_without_their_settings_are_made_again(body, tmp_path):
    options = InvertOptions(**SETTINGS)
    plan = plan_fit(body, tmp_path / "plan", options=options)
    fit_chunks(plan, 1)
    (tmp_path / "plan/chunks/settings.json").unlink()
    assert plan_fit(body, tmp_path / "plan", options=options).missing() == [0, 1, 2]


def test_a_file_that_was_changed_since_is_refused_by_name_in_another_process(body, tmp_path):
    file = tmp_path / "body.npz"
    file.write_bytes(body.read_bytes())
    plan = plan_fit(file, tmp_path / "plan", options=InvertOptions(**SETTINGS))
    np.savez(file, vertices=np.load(body)["vertices"][::-1])
    refused = pytest.raises(InputError, match="another file than when the fit was planned")
    with multiprocessing.get_context("spawn").Pool(1) as pool, refused:
        pool.apply(fit_chunks, (plan, 0))


def test_a_finished_fit_is_left_alone_and_not_overwritten_with_other_settings(body, tmp_path):
    options = InvertOptions(**SETTINGS)
    invert(body, tmp_path / "out", options=options)
    before = (tmp_path / "out/motion.npz").read_bytes()
    assert invert(body, tmp_path / "out", options=options).earlier
    with pytest.raises(InputError, match="fps"):
        invert(body, tmp_path / "out", options=InvertOptions(**SETTINGS | {"fps": 30}))
    assert (tmp_path / "out/motion.npz").read_bytes() == before
