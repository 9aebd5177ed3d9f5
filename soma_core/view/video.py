"""Videos of a body: its motion seen by one camera, or a turntable of a single pose; MP4 and GIF."""

from __future__ import annotations

import itertools
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.ndimage

from soma_core._lazy import needed
from soma_core.cache import atomic_write
from soma_core.errors import SomaError
from soma_core.progress import progress
from soma_core.view.picture import framing
from soma_core.view.stage import Body, open_stage

__all__ = ["write_video"]

_MP4 = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", "-movflags", "+faststart", "-f", "mp4"]
_GIF = ["-filter_complex", "[0:v][1:v]paletteuse=dither=none", "-loop", "0", "-f", "gif"]
"""What ffmpeg is told after its input."""

_NARROW = 2.5
"""Width of a path that one still camera sees [m]; along a longer one it goes with the body."""

_SMOOTH = 0.5
"""Seconds over which a camera that goes with a body is smoothed."""

_FRAMING = 24
"""Frames that decide how much the camera sees."""


def write_video(
    path: Path, body: Callable[[int], Body], frames: np.ndarray, places: np.ndarray, *, size: int, fps: float
) -> None:
    """Write bodies one after the other as a video, atomically; one pose is shown from all sides.

    Args:
        path: ``.mp4`` or ``.gif``.
        body: number of a frame -> the body in it, metres, +Y up.
        frames: numbers of the frames, in order; several alike are a turntable.
        places: (frames, 3) where the body is in each, for the camera to look at [m].
        size: height and width of the picture in pixels; even.
        fps: frames per second.

    Raises:
        SomaError: imageio-ffmpeg or pyvista is not installed, or ffmpeg failed.
    """
    program = _ffmpeg()  # before anything is drawn
    turning = len(set(frames.tolist())) == 1
    chosen = np.unique(np.linspace(0, len(frames) - 1, _FRAMING).round().astype(int))
    bodies = [body(number) for number in dict.fromkeys(frames[chosen].tolist())]
    if turning:
        bodies = [_turned(bodies[0], share) for share in np.arange(12) / 12]
    floor = min(float(each.vertices[:, 1].min()) for each in bodies)
    focus = _camera_path(places, fps) * [1, 0, 1] + [0, floor, 0]
    feet = np.tile(focus[0], (len(bodies), 1)) if turning else focus[chosen]
    rise, height = framing(bodies, feet[: len(bodies)], 1.0)

    def pictures() -> Iterator[bytes]:
        with open_stage((size, size), oversampling=2) as stage:
            for number in range(len(frames)):
                shown = _turned(bodies[0], number / len(frames)) if turning else body(int(frames[number]))
                picture = stage.shot([shown], focus=focus[number] + [0, rise, 0], height=height, floor=floor)
                yield picture.tobytes()

    drawn = progress(pictures(), label="drawing", total=len(frames), lines=10)
    atomic_write(path, lambda target: _encode(program, target, drawn, path.suffix, size=size, fps=fps))


def _turned(body: Body, share: float) -> Body:
    """The body turned about the vertical through its middle by a share of a circle."""
    angle = 2 * np.pi * share
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    middle = (body.vertices.min(axis=0) + body.vertices.max(axis=0)) / 2
    return replace(body, vertices=(body.vertices - middle) @ turn.T + middle)


def _camera_path(places: np.ndarray, fps: float) -> np.ndarray:
    """Where the camera looks (frames, 3): one place, or along with a body that goes far."""
    low, high = places.min(axis=0), places.max(axis=0)
    if np.hypot(*(high - low)[[0, 2]]) <= _NARROW:
        return np.tile((low + high) / 2, (len(places), 1))
    return scipy.ndimage.gaussian_filter1d(places, _SMOOTH * fps, axis=0, mode="nearest")


def _ffmpeg() -> str:
    """Where the program is.

    Raises:
        InputError: imageio-ffmpeg is not installed.
    """
    ffmpeg = needed("imageio_ffmpeg", setting="write", pip="[video]", otherwise="leave out mp4 and gif")
    return str(ffmpeg.get_ffmpeg_exe())


def _encode(
    program: str, path: Path, pictures: Iterator[bytes], suffix: str, *, size: int, fps: float
) -> None:
    """Have ffmpeg write pictures (size, size, 3) of bytes."""
    command = [
        program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size}x{size}",
        "-r", f"{fps:g}", "-i", "-",
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        if suffix == ".gif":
            # The first picture has the colours of all: those of one body and of its shadow.
            first = next(pictures)
            palette = _write_palette(Path(folder) / "palette.png", first, size)
            command += ["-i", str(palette), *_GIF]
            pictures = itertools.chain([first], pictures)
        else:
            command += _MP4
        _run([*command, str(path)], pictures, path.name)


def _write_palette(path: Path, picture: bytes, size: int) -> Path:
    from PIL import Image

    few = Image.frombytes("RGB", (size, size), picture).quantize(256, dither=Image.Dither.NONE)
    colours = np.resize(np.array(few.getpalette(), np.uint8).reshape(-1, 3), (256, 3))
    Image.fromarray(colours.reshape(16, 16, 3)).save(path)
    return path


def _run(command: Sequence[str], pictures: Iterator[bytes], name: str) -> None:
    """Feed a program.

    Raises:
        SomaError: it failed, with what it said.
    """
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as encoder:  # noqa: S603
        assert encoder.stdin is not None
        assert encoder.stderr is not None
        try:
            for picture in pictures:
                encoder.stdin.write(picture)
            encoder.stdin.close()
        except BrokenPipeError:
            pass  # it says why
        except BaseException:
            encoder.kill()
            raise
        told = encoder.stderr.read().decode(errors="replace").strip()
    if encoder.returncode:
        raise SomaError(f"ffmpeg could not write {name}: {told or 'it says nothing'}")
