"""From a mesh sequence to a motion: the round trip, chunks, interruptions, and what is refused."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from soma_core.cli import EXIT_FAILED, EXIT_OK, main
from soma_core.config.schema import InvertConfig
from soma_core.errors import InputError, SomaError
from soma_core.io import open_vertex_sequence, read_motion
from soma_core.layer import SomaLayer
from soma_core.motion import animate, converter, load_clip, models
from soma_core.motion.chunks import FittedChunks
from soma_core.motion.fit_results import worst_frames
from soma_core.options import FrameRange
from soma_core.tasks import animate as animate_task
from soma_core.tasks import invert

ROUND_TRIP_MM = 0.1
"""Largest distance between the input and what soma animate makes of the fitted motion."""

CHUNK_TOLERANCE = 1e-5
"""Metres: frames are fitted in groups, and a group decides together when it is done."""

FRAMES = 8

CASES = Path(os.environ.get("SOMA_TEST_DATA", "")) / "cases"
"""SOMA_TEST_DATA names the folder that holds cases/, of files that are not part of the project."""


def configured(**changes):
    settings = {
        "backend": {"name": "soma", "params": {"shape": [1.0, -0.5]}}, "lod": "low",
        "picture": {"frames": 0}, "fps": 24.0, "unit": "m", "topology": "canonical", "procedural": False,
    }  # fmt: skip
    return OmegaConf.merge(OmegaConf.structured(InvertConfig), settings | changes)


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="low", procedural=False)


@pytest.fixture(scope="module")
def vertices(layer):
    """Eight frames of the shipped clip, spread over it, on a body that is not the default."""
    motion = load_clip(frames=FrameRange(stop=440, step=55))
    identity = layer.identity({"shape": [1.0, -0.5]})
    with torch.no_grad():
        posed = layer.pose(identity, torch.as_tensor(motion.rotations), torch.as_tensor(motion.translation))
    return posed.vertices.numpy()


@pytest.fixture
def source(vertices, tmp_path):
    np.savez(tmp_path / "body.npz", vertices=vertices)
    return tmp_path / "body.npz"


def reposed(layer, folder):
    """Vertices of the fitted motion."""
    motion = read_motion(folder / "motion.npz")
    identity = layer.identity(motion.identity["params"])
    rotations, hips = torch.as_tensor(motion.rotations), torch.as_tensor(motion.translation)
    with torch.no_grad():
        return layer.pose(identity, rotations, hips).vertices.numpy()


def test_invert_then_animate_reproduces_the_input(layer, vertices, source, tmp_path):
    invert.run(configured(input=str(source)), tmp_path / "fit")
    assert sorted(path.name for path in (tmp_path / "fit").iterdir()) == [
        "frames.npz",
        "motion.npz",
        "report.json",
    ]
    motion = read_motion(tmp_path / "fit/motion.npz")
    assert (motion.fps, motion.rig_revision, motion.convention) == (
        24.0,
        layer.rig.revision,
        "t_pose_relative",
    )
    assert motion.identity == {"backend": "soma", "params": {"shape": [1.0, -0.5]}}
    identity = layer.identity(motion.identity["params"])
    with torch.no_grad():
        found = animate(layer, identity, motion, translation="motion", keep=list(range(FRAMES)))
    for frame, expected in enumerate(vertices):
        assert 1e3 * np.abs(found.vertices[frame] - expected).max() < ROUND_TRIP_MM


def test_the_report_says_what_was_fitted_and_how_well(source, tmp_path):
    invert.run(configured(input=str(source)), tmp_path / "fit")
    report = json.loads((tmp_path / "fit/report.json").read_text(encoding="utf-8"))
    assert report["settings"]["input"] == str(source)
    assert report["settings"]["params"] == {"shape": [1.0, -0.5]}
    assert report["frames"] == FRAMES
    assert report["converged_share"] == 1
    assert report["error_mm"]["all"]["max"] < ROUND_TRIP_MM
    with np.load(tmp_path / "fit/frames.npz") as frames:
        assert frames["valid"].all()
        found = report["error_mm"]["all"]
        assert 1e3 * frames["largest_error"].max() == pytest.approx(found["max"], rel=1e-5)
        assert 1e3 * frames["mean_error"].mean() == pytest.approx(found["mean"], rel=1e-5)


@pytest.mark.slow
def test_twist_and_correctives_are_fitted_unless_told_otherwise(layer, source, tmp_path):
    """To a body of plain skinning, the full model comes near; the report says which model it is about.

    Left to choose, a fit of the full model tells such a body by plain skinning, and says so.
    """
    full = {"input": str(source), "procedural": True}
    invert.run(configured(**full, inversion={"skinning": "full"}), tmp_path / "full")
    invert.run(configured(**full), tmp_path / "auto")
    invert.run(configured(input=str(source)), tmp_path / "plain")
    reports = [
        json.loads((tmp_path / name / "report.json").read_text(encoding="utf-8"))
        for name in ("full", "plain", "auto")
    ]
    settings, plain, _ = (report["settings"] for report in reports)
    assert [report["plain_share"] for report in reports] == [0, 0, 1]
    assert reports[2]["error_mm"]["all"]["max"] < ROUND_TRIP_MM
    assert (settings["procedural"], plain["procedural"]) == (True, False)
    assert (settings["correctives"], plain["correctives"]) == ("correctives_model.pt", None)
    motion = read_motion(tmp_path / "full/motion.npz")
    whole = SomaLayer("soma", lod="low")
    identity = whole.identity(motion.identity["params"])
    with torch.no_grad():
        posed = whole.pose(identity, torch.as_tensor(motion.rotations), torch.as_tensor(motion.translation))
    with np.load(source) as given, np.load(tmp_path / "full/frames.npz") as frames:
        error = np.linalg.norm(posed.vertices.numpy() - given["vertices"], axis=-1)
        kept = np.delete(error, layer.mesh.face_interior, 1)
        np.testing.assert_allclose(frames["mean_error"], kept.mean(1), rtol=1e-3)


def test_our_own_files_go_round(layer, tmp_path):
    from tests.tasks.test_animate import configured as animation

    animate_task.run(animation(write=["npz", "usd", "glb"], procedural=False), tmp_path / "made")
    expected = read_motion(tmp_path / "made/motion.npz")
    for name in ("body.usdc", "body.glb"):
        path = tmp_path / "made" / name
        config = configured(input=str(path), fps=None, unit=None, topology="auto", backend={"name": "soma"})
        invert.run(config, tmp_path / name)
        found = read_motion(tmp_path / name / "motion.npz")
        assert found.fps == expected.fps
        with open_vertex_sequence(path) as sequence:
            target = sequence.read(0, sequence.frame_count)
        assert 1e3 * np.abs(reposed(layer, tmp_path / name) - target).max() < ROUND_TRIP_MM


def test_chunks_give_what_the_whole_gives(layer, source, tmp_path):
    invert.run(configured(input=str(source)), tmp_path / "whole")
    invert.run(configured(input=str(source), chunk=3), tmp_path / "parts")
    whole, parts = reposed(layer, tmp_path / "whole"), reposed(layer, tmp_path / "parts")
    assert np.abs(whole - parts).max() < CHUNK_TOLERANCE
    assert not (tmp_path / "parts/chunks").exists()


class Stopping(models.GuidedInversion):
    """Stops the run at the third chunk, and counts."""

    calls = 0

    def forward(self, *args, **options):
        type(self).calls += 1
        if self.calls == 3:
            raise KeyboardInterrupt
        return super().forward(*args, **options)


def test_a_stopped_run_goes_on_after_the_chunks_that_it_finished(source, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    config = configured(input=str(source), chunk=2)
    invert.run(config, tmp_path / "whole")
    monkeypatch.setattr(models, "GuidedInversion", Stopping)
    monkeypatch.setattr(Stopping, "calls", 0)
    with pytest.raises(KeyboardInterrupt):
        invert.run(config, tmp_path / "fit")
    assert f"hydra.run.dir={tmp_path / 'fit'} goes on from here" in caplog.text
    assert len(list((tmp_path / "fit/chunks").glob("*.npz"))) == 2
    assert not (tmp_path / "fit/motion.npz").exists()
    invert.run(config, tmp_path / "fit")
    assert "going on after 2 of 4 chunks" in caplog.text
    assert Stopping.calls == 3 + 2
    for name in ("motion.npz", "frames.npz"):
        with np.load(tmp_path / "fit" / name) as found, np.load(tmp_path / "whole" / name) as expected:
            for key in expected.files:
                np.testing.assert_array_equal(found[key], expected[key], err_msg=key)
    assert (tmp_path / "fit/report.json").read_text() == (tmp_path / "whole/report.json").read_text()


def test_chunks_of_another_configuration_are_refused(source, tmp_path, monkeypatch):
    monkeypatch.setattr(models, "GuidedInversion", Stopping)
    monkeypatch.setattr(Stopping, "calls", 1)
    with pytest.raises(KeyboardInterrupt):
        invert.run(configured(input=str(source), chunk=2), tmp_path / "fit")
    for changes, said in (
        ({"chunk": 3}, r"chunk: got 3, expected 2, as in the run that .*chunks belongs to"),
        ({"backend": {"name": "soma"}}, r"params: got {}, expected {'shape': \[1\.0, -0\.5\]}"),
        ({"fps": 30, "chunk": 5}, r"fps \(and chunk\): got 30"),
    ):
        with pytest.raises(InputError, match=said):
            invert.run(configured(input=str(source), **{"chunk": 2} | changes), tmp_path / "fit")
    np.savez(source, vertices=np.zeros((FRAMES, 4505, 3)) + 1)
    with pytest.raises(InputError, match=r"content.*: got .*delete .*chunks to start over"):
        invert.run(configured(input=str(source), chunk=2), tmp_path / "fit")


def test_half_a_chunk_is_done_again(tmp_path):
    chunks = FittedChunks(tmp_path / "chunks", {"a": 1}, frame_count=5, size=2)
    assert chunks.ranges == [(0, 2), (2, 4), (4, 5)]
    for number in range(3):
        chunks.save(number, {"x": np.full(2, number)})
    cut = tmp_path / "chunks/000001.npz"
    cut.write_bytes(cut.read_bytes()[:50])
    again = FittedChunks(tmp_path / "chunks", {"a": 1}, frame_count=5, size=2)
    assert again.missing() == [1]
    again.remove()
    assert not list(tmp_path.iterdir())


def test_a_damaged_frame_is_flagged_and_the_others_are_unharmed(layer, vertices, source, tmp_path, caplog):
    spoilt = vertices.copy()
    spoilt[2, 100] = np.nan
    np.savez(tmp_path / "spoilt.npz", vertices=spoilt)
    invert.run(configured(input=str(tmp_path / "spoilt.npz")), tmp_path / "fit")
    assert "1 frames could not be used and hold the T-pose, the first is 2" in caplog.text
    report = json.loads((tmp_path / "fit/report.json").read_text(encoding="utf-8"))
    assert (report["unusable_frames"], report["unusable"]) == (1, [2])
    found = np.delete(reposed(layer, tmp_path / "fit"), 2, axis=0)
    assert 1e3 * np.abs(found - np.delete(vertices, 2, axis=0)).max() < ROUND_TRIP_MM


def test_native_vertices_of_a_plugin(tmp_path):
    pytest.importorskip("soma_backend_toy")
    from soma_core.plugin.registry import default_registry

    layer = SomaLayer("toy", lod="low")
    identity = layer.identity({"legs": 1.1})
    generator = default_registry().generator("toy", device=layer.device, dtype=layer.dtype)
    frames = generator.rest(identity.params).numpy() + np.array([[[50.0, 20, 10]], [[0, 0, 0]]])  # [cm]
    np.save(tmp_path / "toy.npy", frames.astype(np.float32))
    config = configured(
        input=str(tmp_path / "toy.npy"),
        backend={"name": "toy", "params": {"legs": 1.1}},
        topology="auto",
        unit=None,
    )
    invert.run(config, tmp_path / "fit")
    moved = read_motion(tmp_path / "fit/motion.npz").translation
    np.testing.assert_allclose(moved[0] - moved[1], [0.5, 0.1, -0.2], atol=CHUNK_TOLERANCE)


def test_the_picture_shows_the_worst_frames(source, tmp_path):
    pytest.importorskip("pyvista", reason="pictures need pyvista")
    invert.run(configured(input=str(source), picture={"frames": 2, "width": 300}, chunk=5), tmp_path / "fit")
    assert (tmp_path / "fit/errors.png").stat().st_size > 1000


def test_worst_frames_keep_apart():
    errors = np.array([0.0, 5, 6, 5, 0, 1, np.nan])
    np.testing.assert_array_equal(worst_frames(errors, 2, apart=1), [2, 5])
    np.testing.assert_array_equal(worst_frames(errors, 2, apart=0), [1, 2])
    assert len(worst_frames(errors, 99, apart=0)) == 6
    assert len(worst_frames(np.array([np.nan]), 3, apart=0)) == 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"input": None}, r"input: got none, expected an \.npz or \.npy"),
        ({"chunk": 0}, "chunk: got 0, expected at least 1"),
        ({"fps": None}, r"fps: got none in body\.npz, expected frames per second\. Pass fps=30"),
        ({"inversion": {"stages": ["guess"]}}, "stages: got 'guess'"),
    ],
)
def test_what_cannot_be_run_says_why(source, tmp_path, changes, said):
    with pytest.raises(InputError, match=said):
        invert.run(configured(**{"input": str(source)} | changes), tmp_path / "fit")
    assert not (tmp_path / "fit/motion.npz").exists()


def test_from_the_command_line(source, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["invert", f"input={source}", "fps=24", "unit=m", "topology=canonical", "lod=low",
               "backend.params.shape=[1.0,-0.5]", "picture.frames=0", "hydra.run.dir=out",
               "procedural=false"]  # fmt: skip
    assert main(command) == EXIT_OK
    streams = capsys.readouterr()
    assert streams.out.splitlines()[-1] == "out"
    assert "body.npz: 8 frames of 4505 vertices (canonical) at 24 fps" in streams.err
    assert "8 frames, 0 of them unusable; converged 100.0%" in streams.err


@pytest.mark.slow
def test_a_prior_on_neighbours_sees_across_chunks(layer, source, tmp_path):
    smooth = {"inversion": {"priors": {"temporal_strength": 0.05}}}
    invert.run(configured(input=str(source), **smooth), tmp_path / "whole")
    invert.run(configured(input=str(source), chunk=2, **smooth), tmp_path / "parts")
    invert.run(configured(input=str(source)), tmp_path / "free")
    whole, parts, free = (reposed(layer, tmp_path / name) for name in ("whole", "parts", "free"))
    assert np.abs(whole - parts).max() < CHUNK_TOLERANCE
    assert np.abs(whole - free).max() > 100 * CHUNK_TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("method", ["transfer", "analytical", "autograd", "analytical_autograd"])
def test_the_papers_methods_run_from_the_command_line(source, tmp_path, monkeypatch, capsys, method):
    monkeypatch.chdir(tmp_path)
    command = ["invert", f"input={source}", "fps=24", "unit=m", "topology=canonical", "lod=low",
               "backend.params.shape=[1.0,-0.5]", "picture.frames=0", f"inversion={method}",
               "inversion.autograd.iterations=3", "hydra.run.dir=out"]  # fmt: skip
    assert main(command) == EXIT_OK
    report = json.loads((tmp_path / "out/report.json").read_text(encoding="utf-8"))
    assert report["settings"]["inversion"]["stages"][0] == "transfer"
    assert ROUND_TRIP_MM < report["error_mm"]["all"]["mean"] < 15


def other_body(layer):
    """The same poses on somebody else."""
    motion = load_clip(frames=FrameRange(stop=440, step=55))
    turns, hips = torch.as_tensor(motion.rotations), torch.as_tensor(motion.translation)
    with torch.no_grad():
        return layer.pose(layer.identity({"shape": [-2.0, 1.0]}), turns, hips).vertices.numpy()


def spoil(layer, vertices, kind):
    """Vertices of which no fit, or a fit of another body, can be made."""
    random = np.random.default_rng(0)
    if kind == "mirrored":
        return vertices * np.array([-1, 1, 1], np.float32)
    if kind == "order":
        return vertices[:, random.permutation(vertices.shape[1])]
    if kind == "person":
        return other_body(layer)
    if kind == "change":
        return np.concatenate([vertices[:4], other_body(layer)[4:]])
    return vertices * np.nan


def command_of(file, **changes):
    settings = {
        "input": file, "fps": 24, "unit": "m", "topology": "canonical", "lod": "low", "picture.frames": 0,
        "hydra.run.dir": "out", "procedural": "false", "backend.params.shape": "[1.0,-0.5]",
    }  # fmt: skip
    return ["invert", *(f"{key}={value}" for key, value in (settings | changes).items())]


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("mirrored", "left-handed axes: negate x of the vertices"),
        ("order", "in another order than that of 'soma'"),
        ("person", "another person than the identity: pass identity=unknown"),
        ("change", "another person's from frame 4 on"),
        ("missing", "each of the 8 looked at has missing vertices"),
    ],
)
def test_a_fit_that_is_none_ends_with_one_sentence(
    layer, vertices, tmp_path, monkeypatch, capsys, kind, said
):
    monkeypatch.chdir(tmp_path)
    np.save("body.npy", spoil(layer, vertices, kind))
    assert main(command_of("body.npy")) == EXIT_FAILED
    streams = capsys.readouterr()
    (sentence,) = [line for line in streams.err.splitlines() if line.startswith("soma:")]
    assert said in sentence
    assert not streams.out
    if kind in ("mirrored", "order"):
        assert not {"motion.npz", "chunks"} & {path.name for path in (tmp_path / "out").iterdir()}
        return
    report = json.loads((tmp_path / "out/report.json").read_text(encoding="utf-8"))
    assert (report["diagnosis"]["cause"], report["diagnosis"]["failed"]) == (kind, True)
    assert report["diagnosis"]["sentence"] in sentence


def test_an_unknown_body_is_not_sought_in_mirrored_vertices(layer, vertices, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("body.npy", spoil(layer, vertices, "mirrored"))
    assert main(command_of("body.npy", identity="unknown")) == EXIT_FAILED
    streams = capsys.readouterr()
    assert "the body is mirrored" in streams.err
    assert "finding the identity" not in streams.err


@pytest.mark.parametrize("kind", ["noise", "gaps", "spoilt frames"])
def test_a_good_fit_of_bad_data_is_one(vertices, tmp_path, kind):
    random = np.random.default_rng(0)
    given = vertices + random.normal(0, 0.02, vertices.shape).astype(np.float32)
    if kind == "gaps":
        given[::2] = np.nan
    if kind == "spoilt frames":
        given[[1, 6]] = random.normal(0, 0.3, given[0].shape)
    np.save(tmp_path / "body.npy", given)
    invert.run(configured(input=str(tmp_path / "body.npy")), tmp_path / "fit")
    report = json.loads((tmp_path / "fit/report.json").read_text(encoding="utf-8"))
    assert report["diagnosis"] is None


def test_an_upside_down_body_is_a_warning_that_names_the_axis(vertices, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("body.npy", vertices[..., [0, 2, 1]] * np.array([1, -1, 1], np.float32))
    assert main(command_of("body.npy")) == EXIT_OK
    assert "body.npy: the body is lying on the whole, its head along z of the file" in capsys.readouterr().err
    assert main(command_of("body.npy", up="z", **{"hydra.run.dir": "again"})) == EXIT_OK
    assert "its head along" not in capsys.readouterr().err


def test_a_downward_y_axis_is_turned_as_a_camera_sees(layer, vertices):
    """-Y up is +Y up, turned by half a turn about x."""
    from soma_core.io.vertex_sequence import VertexSequence
    from soma_core.motion.posed_input import PosedInput

    class Held(VertexSequence):
        def _read(self, start, stop):
            return (vertices * np.array([1, -1, -1], np.float32))[start:stop]

    held = Held(Path("body.npy"), *vertices.shape[:2], metres=1.0, up="-y")
    posed = PosedInput(held, layer, topology="canonical")
    np.testing.assert_allclose(posed.read(0, FRAMES), vertices, atol=CHUNK_TOLERANCE)
    np.testing.assert_allclose(posed.axes, np.diag([1.0, -1, -1]), atol=1e-12)
    numbers, found = posed.spread(3)
    np.testing.assert_array_equal(numbers, [0, 4, 7])
    assert found.shape == (3, *vertices.shape[1:])


def test_a_conversion_that_is_no_fit_stays_one(tmp_path):
    """An earlier run's report says so again; where a body lies is told by who reads the file."""
    told = {"cause": "person", "sentence": "the body is another's", "failed": True, "frame": None}
    with pytest.raises(SomaError, match=r"clip\.npz: the body is another's; .*report\.json has the figures"):
        converter._refuse_failed(Path("clip.npz"), {"diagnosis": told}, tmp_path / "report.json")
    for found in (None, told | {"cause": "axis", "failed": False}):
        converter._refuse_failed(Path("clip.npz"), {"diagnosis": found}, tmp_path / "report.json")


@pytest.mark.parametrize(
    ("name", "code", "said"),
    [
        ("mirrored", EXIT_FAILED, "the body is mirrored"),
        ("other_person", EXIT_FAILED, "pass identity=unknown"),
        ("y_down", EXIT_OK, "upside down on the whole, its head along -y"),
    ],
)
def test_files_of_others(tmp_path, monkeypatch, capsys, name, code, said):
    file = CASES / f"20_anny_low_{name}.npy"
    if not file.is_file():
        pytest.skip(f"needs SOMA_TEST_DATA with {file}")
    pytest.importorskip("soma_backend_anny")
    file = file.resolve()
    monkeypatch.chdir(tmp_path)
    command = ["invert", f"input={file}", "fps=30", "unit=m", "backend=anny", "lod=low",
               "topology=canonical", "picture.frames=0", "hydra.run.dir=out"]  # fmt: skip
    assert main(command) == code
    assert said in capsys.readouterr().err
