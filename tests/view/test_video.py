"""Videos hold the frames and the size that were asked for, and show a body that moves or turns."""

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from soma_core.choices import Product
from soma_core.errors import InputError, SomaError
from soma_core.layer import SomaLayer
from soma_core.motion import load_clip
from soma_core.motion.played import Played
from soma_core.motion.products import write_products
from soma_core.motion.writers import WRITERS, WriteOptions
from soma_core.options import FrameRange, VideoChoice
from soma_core.view.video import write_video

SIZE = 64
FLAT = 4
"""Largest change of a pixel that shows nothing new: rounding of the encoders."""


@pytest.fixture(scope="module")
def played():
    layer = SomaLayer("soma", lod="xlo")
    return Played(
        layer=layer, identity=layer.identity(), motion=load_clip(frames=FrameRange(start=15, stop=24))
    )


def frames_of(path):
    """Frames per second and frames (f, SIZE, SIZE, 3) of a video."""
    program = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    command = [program, "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    run = subprocess.run(command, capture_output=True, check=True)
    rate = float(re.search(rb"([\d.]+) fps", run.stderr)[1])
    return rate, np.frombuffer(run.stdout, np.uint8).reshape(-1, SIZE, SIZE, 3).astype(int)


@pytest.fixture
def drawing():
    pytest.importorskip("pyvista", reason="videos need pyvista")
    pytest.importorskip("imageio_ffmpeg", reason="videos need imageio-ffmpeg")


@pytest.mark.usefixtures("drawing")
@pytest.mark.parametrize("product", [Product.mp4, Product.gif])
def test_a_clip_is_a_video_of_its_frames(played, tmp_path, product):
    path = tmp_path / WRITERS[product].file
    options = WriteOptions(video=VideoChoice(size=SIZE, fps=10))
    write_products(played, [product], lambda _: path, options=options)
    rate, frames = frames_of(path)
    assert rate == pytest.approx(10)
    assert len(frames) == 3
    assert np.abs(frames[0] - frames[-1]).max() > 50
    paper = frames[:, :4, :4].reshape(-1, 3)
    assert np.ptp(paper, axis=0).max() < FLAT  # behind the body, the same in every frame


@pytest.mark.usefixtures("drawing")
def test_a_single_pose_turns_once_about_itself(played, tmp_path):
    pose = replace(played, motion=played.motion.cut(slice(0, 1)))
    path = tmp_path / "body.mp4"
    options = WriteOptions(video=VideoChoice(size=SIZE, fps=8, seconds=1.0))
    write_products(pose, [Product.mp4], lambda _: path, options=options)
    _, frames = frames_of(path)
    assert len(frames) == 8
    ink = (frames < 215).any(axis=-1)
    widths = [np.ptp(np.flatnonzero(frame.any(axis=0))) for frame in ink]
    assert min(widths[1:4]) < 0.7 * max(widths)  # arms held out: narrow from the side
    assert widths[4] > 0.85 * widths[0]  # and as wide from behind


@pytest.mark.parametrize(
    ("given", "name"), [({"size": 721}, "size"), ({"fps": 0}, "fps"), ({"seconds": -1.0}, "seconds")]
)
def test_what_no_video_has_is_refused(given, name):
    with pytest.raises(InputError, match=rf"video\.{name}: got {next(iter(given.values()))}"):
        VideoChoice(**given)


def test_settings_of_videos_are_refused_without_one():
    with pytest.raises(InputError, match=r"video: got size=64, expected none with write=\[glb\]"):
        WriteOptions(video=VideoChoice(size=64)).refuse_unused([Product.glb])


def test_without_ffmpeg_the_extra_is_named(played, tmp_path, monkeypatch):
    pytest.importorskip("pyvista", reason="videos need pyvista")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(SomaError, match=r"pip install 'soma-body-core\[video\]'"):
        write_video(
            tmp_path / "body.mp4", lambda _: None, np.zeros(2, int), np.zeros((2, 3)), size=SIZE, fps=10
        )
    assert not list(tmp_path.iterdir())
