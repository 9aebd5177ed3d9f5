"""A folder from Python: bodies that are not known, errors by file, and a second call that goes on."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re

import numpy as np
import pytest

from soma_core.errors import AssetError, InputError
from soma_core.motion import ConvertOptions, conversion, convert, convert_folder, folder, identities
from soma_core.paths import assets_dir
from tests.motion.test_converter import motion, write_motion

PAGE = assets_dir().parent / "docs/convert.md"
_EXAMPLE = re.compile(
    r"<!-- run with stand-ins -->\n```python\n(?P<code>.*?)```\n```text\n(?P<printed>.*?)```", re.DOTALL
)


@pytest.fixture
def clips(smplh_models, amass, tmp_path, monkeypatch):
    """A folder as on the page: a SAM 3D Body output of a stand-in, an AMASS file, one that is none."""
    from tests.standins.mhr_files import mhr_body, write_mhr_pair

    pytest.importorskip("soma_backend_mhr")
    (tmp_path / "data").mkdir()
    for supplied in smplh_models.glob("SMPL*"):
        (tmp_path / "data" / supplied.name).symlink_to(supplied)
    write_mhr_pair(tmp_path / "data/MHR", 1)
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path / "data"))
    root = tmp_path / "clips"
    (root / "CMU").mkdir(parents=True)
    np.savez(root / "CMU/01_01_poses.npz", **amass)
    seen = mhr_body(1).vertices * np.array([1, -1, -1])  # as the camera has it
    np.savez(root / "person.npz", pred_vertices=np.stack([seen, seen + 0.1]).astype(np.float32))
    (root / "download.npz").write_bytes(b"<html></html>")
    return root


@pytest.mark.slow
def test_the_example_of_the_page(clips, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    search = identities.fit_identity  # how near it comes is told elsewhere
    monkeypatch.setattr(identities, "fit_identity", lambda *a, **k: search(*a, **k | {"iterations": 1}))
    (example,) = _EXAMPLE.finditer(PAGE.read_text(encoding="utf-8"))
    assert len(example["code"].splitlines()) <= 12
    assert not re.search(r"\b_\w", example["code"])
    stream = io.StringIO()
    with contextlib.redirect_stdout(stream):
        exec(compile(example["code"], "<example>", "exec"), {"__name__": "example"})
    assert stream.getvalue() == example["printed"]


def test_a_folder_that_was_stopped_goes_on(tmp_path, monkeypatch):
    for name in "abc":
        write_motion(motion(), tmp_path / f"{name}.npz")
    original, done = conversion.Converter.__call__, []

    def stopping(self, path, *given):
        done.append(path.name)
        if len(done) == 2:
            raise KeyboardInterrupt
        return original(self, path, *given)

    monkeypatch.setattr(conversion.Converter, "__call__", stopping)
    with pytest.raises(KeyboardInterrupt):
        convert_folder(tmp_path, tmp_path / "out")
    assert '"a.npz"' in (tmp_path / "out/report.json").read_text()
    found = convert_folder(tmp_path, tmp_path / "out")
    assert (list(found.converted), found.errors, found.skipped) == (["a.npz", "b.npz", "c.npz"], {}, [])
    assert found.converted["b.npz"].motion().frame_count == 3


def test_errors_and_files_without_a_motion_are_told_apart(tmp_path):
    write_motion(motion(), tmp_path / "good.npz")
    np.savez(tmp_path / "shape.npz", betas=np.zeros(16))
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    found = convert_folder(tmp_path, tmp_path / "out")
    assert (list(found.converted), found.skipped, len(found)) == (["good.npz"], ["shape.npz"], 3)
    assert isinstance(found.errors["bad.npz"], AssetError)


def test_what_is_no_file_is_a_row_with_a_reason(tmp_path):
    """Under names of motions; a reader that opened them would wait for ever."""
    write_motion(motion(), tmp_path / "good.npz")
    (tmp_path / "folder.npz").mkdir()
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "device.bvh").symlink_to("/dev/zero")
    (tmp_path / "lost.bvh").symlink_to(tmp_path / "gone")
    found = convert_folder(tmp_path, tmp_path / "out", options=ConvertOptions(person="all"))
    assert (list(found.converted), found.skipped) == (["good.npz"], [])
    said = {name: error.cause for name, error in found.errors.items()}
    assert said == {
        "pipe.npz": "is a pipe, not a file", "device.bvh": "is a device, not a file",
        "lost.bvh": "is a link to nothing",
    }  # fmt: skip
    rows = json.loads((tmp_path / "out/report.json").read_text())["files"]
    assert rows["pipe.npz"]["state"] == "failed"
    assert "is a pipe, not a file" in rows["pipe.npz"]["reason"]


@pytest.mark.parametrize("name", ["a" * 251, "走" * 83])
def test_a_long_name_leaves_room_for_those_of_results(tmp_path, name):
    (tmp_path / "in").mkdir()
    write_motion(motion(), tmp_path / f"in/{name}.npz")
    found = convert_folder(tmp_path / "in", tmp_path / "out")
    assert not found.errors
    (file,) = (tmp_path / "out/motions").iterdir()
    assert file.name.startswith(name[:60])


def test_one_file_without_anything_left_on_disk(tmp_path):
    given = motion()
    write_motion(given, tmp_path / "m.npz")
    np.testing.assert_array_equal(convert(tmp_path / "m.npz").rotations, given.rotations)
    assert [path.name for path in tmp_path.iterdir()] == ["m.npz"]
    with pytest.raises(InputError, match="to: got smplh, expected soma"):
        convert(tmp_path / "m.npz", options=ConvertOptions(to="smplh"))


def test_twist_and_correctives_are_options_of_a_conversion(smplh_models, amass_file, tmp_path):
    plain = ConvertOptions(lod="low", procedural=False, correctives=None)
    found = conversion.convert_file(amass_file, tmp_path / "out", options=plain)
    settings = found.report["settings"]
    assert (settings["procedural"], settings["correctives"]) == (False, None)
    with pytest.raises(InputError, match=r"procedural \(and correctives\): got True, expected False"):
        conversion.convert_file(amass_file, tmp_path / "out", options=ConvertOptions(lod="low"))


@pytest.mark.parametrize("kind", [RecursionError, MemoryError, KeyError, ZeroDivisionError])
def test_what_nobody_foresaw_is_one_failed_row(tmp_path, monkeypatch, kind):
    for name in "ab":
        write_motion(motion(), tmp_path / f"{name}.npz")
    read = folder.layout_of

    def failing(file):
        if file.name == "a.npz":
            raise kind("deep in a reader")
        return read(file)

    monkeypatch.setattr(folder, "layout_of", failing)
    found = convert_folder(tmp_path, tmp_path / "out")
    assert list(found.converted) == ["b.npz"]
    told = str(found.errors["a.npz"])
    assert re.search(rf"a\.npz: soma_core\.[\w.]+ failed .*{kind.__name__}: .*deep in a reader", told)
