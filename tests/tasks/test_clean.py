"""``soma clean`` as its user sees it: what it writes, says and refuses."""

import json

import numpy as np
import pytest

from soma_core.cli import EXIT_FAILED, EXIT_OK, EXIT_USAGE, main
from soma_core.io import read_motion
from soma_core.motion import load_clip, write
from soma_core.options import FrameRange


@pytest.fixture
def spiked(tmp_path, monkeypatch):
    """Two seconds of the shipped clip, in one frame of which an elbow is turned by 40 degrees."""
    motion = load_clip(frames=FrameRange(start=200, stop=260))
    elbow = motion.joint_names.index("LeftForeArm")
    turn = np.radians(40)
    motion.rotations[30, elbow] @= [
        [np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1],
    ]  # fmt: skip
    write(motion, tmp_path / "spiked.npz")
    monkeypatch.chdir(tmp_path)
    return motion


def run(capsys, *settings):
    code = main(["clean", *settings, "hydra.run.dir=out"])
    said = capsys.readouterr()
    return code, said.out + said.err


def test_a_motion_is_cleaned_and_what_was_done_is_said(spiked, tmp_path, capsys):
    code, said = run(capsys, "input=spiked.npz", "rate=60")
    assert code == EXIT_OK
    assert "spikes: 1 replaced, of LeftForeArm" in said
    assert "119 frames at 60 fps" in said
    found = read_motion(tmp_path / "out/motion.npz")
    assert (found.frame_count, found.fps) == (119, 60)
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["spikes"] == {"LeftForeArm": [30]}
    assert report["after"]["jitter_m_s3"] < report["before"]["jitter_m_s3"]


def test_nothing_to_do_changes_nothing(spiked, tmp_path, capsys):
    assert run(capsys, "input=spiked.npz", "spikes=false", "smooth=off")[0] == EXIT_OK
    found = read_motion(tmp_path / "out/motion.npz")
    assert np.abs(found.rotations - spiked.rotations).max() < 1e-5
    assert (found.translation == spiked.translation).all()


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ([], "Pass input=FILE"),
        (["input=spiked.npz", "rate=0"], "rate: got 0"),
        (["input=spiked.npz", "seconds.arms=50"], "seconds.arms: got 50"),
        (["input=spiked.npz", "smooth=much"], "smooth"),
        (["input=spiked.npz", "frames.start=100"], "60 frames"),
    ],
)
def test_what_cannot_be_is_refused(spiked, capsys, settings, expected):
    code, said = run(capsys, *settings)
    assert code == EXIT_USAGE
    assert expected in said


def test_a_missing_file_is_said(spiked, capsys):
    code, said = run(capsys, "input=nowhere.npz")
    assert code in (EXIT_USAGE, EXIT_FAILED)
    assert "nowhere.npz" in said
