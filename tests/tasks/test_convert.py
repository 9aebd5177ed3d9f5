"""``soma convert`` from the command line: a file, a folder that is mirrored, and what stands in the way."""

from __future__ import annotations

import json

import numpy as np
import pytest
from omegaconf import OmegaConf

from soma_core.cli import EXIT_FAILED, EXIT_OK, EXIT_USAGE, main
from soma_core.config.schema import ConvertConfig
from soma_core.errors import InputError
from soma_core.io import read_motion, write_motion
from soma_core.motion import conversion, convert_folder
from soma_core.motion.files import ResultFiles
from soma_core.tasks import convert
from tests.motion.test_converter import motion


@pytest.fixture
def folder(tmp_path, amass):
    """Motions of three kinds at two depths, a file without a motion, one that is cut off, one hidden."""
    root = tmp_path / "in"
    (root / "CMU/01").mkdir(parents=True)
    np.savez(root / "CMU/01/walk_poses.npz", **amass)
    np.savez(root / "CMU/01/shape.npz", betas=np.zeros(16), gender="female")
    np.savez(root / "k.npz", local_rot_mats=motion().rotations, root_positions=np.zeros((3, 3)))
    write_motion(motion(), root / "ours.npz")
    (root / "cut.npz").write_bytes((root / "k.npz").read_bytes()[:2000])
    (root / ".hidden.npz").write_bytes(b"x")
    (root / "note.txt").write_text("x")
    return root


def run(source, output):
    config = OmegaConf.structured(ConvertConfig)
    convert.run(OmegaConf.merge(config, {"input": str(source), "out": str(output)}), output)


def files_of(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


@pytest.mark.slow
def test_a_folder_is_mirrored(smplh_models, folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["convert", "input=in", "out=made", "lod=low", "picture.frames=0"]
    assert main(command) == EXIT_FAILED
    streams = capsys.readouterr()
    assert "5 of 5: ours.npz: soma, 3 frames at 24 fps, rotations carried over" in streams.err
    assert "in: 3 converted, 1 skipped, 1 failed" in streams.err
    assert "1 of 5 files could not be converted" in streams.err
    assert "cut.npz: not an NPZ file" in streams.err
    motions = ["CMU/01/walk_poses.npz", "k.npz", "ours.npz"]
    assert files_of(tmp_path / "made/motions") == motions
    assert files_of(tmp_path / "made/reports") == [
        "CMU/01/walk_poses.frames.npz",
        "CMU/01/walk_poses.json",
        "k.json",
        "ours.json",
    ]
    for name in motions:
        assert read_motion(tmp_path / "made/motions" / name).frame_count in (3, 6)
    rows = json.loads((tmp_path / "made/report.json").read_text())["files"]
    states = {name: row["state"] for name, row in rows.items()}
    assert states == dict.fromkeys(motions, "converted") | {
        "CMU/01/shape.npz": "skipped",
        "cut.npz": "failed",
    }
    assert rows["CMU/01/walk_poses.npz"]["error_mm"]["mean"] > 0
    assert "not an NPZ file" in rows["cut.npz"]["reason"]
    (folder / "cut.npz").unlink()
    assert main(command) == EXIT_OK
    streams = capsys.readouterr()
    assert streams.out.splitlines()[-1] == "made"
    assert "mm (by an earlier run)" in streams.err
    assert not (tmp_path / "made/chunks").exists()


def test_results_inside_the_input_are_not_converted_again(folder, tmp_path):
    for name in ("cut.npz", "CMU/01/walk_poses.npz"):
        (folder / name).unlink()
    for _ in range(2):
        convert_folder(folder, folder / "made")
    rows = json.loads((folder / "made/report.json").read_text())["files"]
    assert sorted(rows) == ["CMU/01/shape.npz", "k.npz", "ours.npz"]


def test_files_of_one_name_and_two_suffixes_stay_apart(tmp_path):
    made = [ResultFiles.mirrored(tmp_path, name) for name in ("a/b.npz", "a/b.parquet")]
    assert made[0].motion == tmp_path / "motions/a/b.npz"
    assert made[1].motion == tmp_path / "motions/a/b.parquet.npz"
    assert made[0].report != made[1].report


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({}, "got no file ending in .npz or .npy or .pkl .*, expected motion files"),
        ({"a.npz": {"betas": 1}}, "got 1 files without a motion"),
        ({"a.npz": {"poses": 1, "trans": 1}}, r"a\.npz: poses: got shape \(\)"),
    ],
)
def test_a_folder_without_a_motion_is_refused(tmp_path, content, said):
    for name, keys in content.items():
        np.savez(tmp_path / name, **keys)
    with pytest.raises(InputError, match=said):
        run(tmp_path, tmp_path / "out")


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["input=none.npz"], "none.npz: file is missing"),
        ([], "input: got none, expected a motion file, or a folder of them"),
        (["input=m.npz", "chunk=0"], "chunk: got 0, expected at least 1"),
        (["input=m.npz", "gender=x"], "gender: "),
        (["input=m.npz", "to=smplz"], "smplz"),
        (
            ["input=m.npz", "betas=[1]"],
            "m.npz: betas: got [1.0], expected none: a soma file has no use for it",
        ),
        (["input=m.npz", "backend=soma"], "backend: got soma, expected none with to=soma and identity=known"),
        (["input=m.npz", "translation=ground"], "translation: got ground, expected none with to=soma"),
        (["input=m.npz", "to=smplh", "most_betas=1"], "most_betas: got 1, expected none with to=smplh"),
        (["input=m.npz", "to=smplh", "identity=unknown"], "identity.method: got backend, expected none"),
    ],
)
def test_what_cannot_be_run_says_why(tmp_path, monkeypatch, capsys, overrides, said):
    monkeypatch.chdir(tmp_path)
    write_motion(motion(identity={"backend": "soma", "params": {}}), tmp_path / "m.npz")
    assert main(["convert", *overrides]) not in (EXIT_OK, None)
    assert said in capsys.readouterr().err


def test_one_file_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_motion(motion(), tmp_path / "m.npz")
    assert main(["convert", "input=m.npz", "out=made"]) == EXIT_OK
    streams = capsys.readouterr()
    assert streams.out == "made\n"
    assert "m.npz: soma, 3 frames at 24 fps, rotations carried over" in streams.err
    assert {"config.yaml", "environment.json", "motion.npz", "report.json"} <= {*files_of(tmp_path / "made")}
    assert main(["convert", "input=m.npz"]) == EXIT_OK
    assert capsys.readouterr().out.startswith("outputs/convert/")


def test_a_stopped_run_says_how_to_go_on(tmp_path, monkeypatch, caplog):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(conversion.Converter, "__call__", stop)
    write_motion(motion(), tmp_path / "m.npz")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "m.npz", tmp_path / "out")
    assert f"stopped; the same command with out={tmp_path / 'out'} goes on from here" in caplog.text


@pytest.mark.slow
def test_shards_are_named_and_rows_of_clips_are_told_from_frames(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pyarrow")
    monkeypatch.chdir(tmp_path)
    write_motion(motion(), tmp_path / "m.npz")
    assert main(["convert", "input=m.npz", "output=parquet", "out=made", "workers=1"]) == EXIT_OK
    streams = capsys.readouterr()
    assert streams.out == "made\n"
    assert "m.npz: 1 converted; 1 shards in" in streams.err
    assert main(["convert", "input=made/shards/000000.parquet", "out=again"]) != EXIT_OK
    assert "input: got 000000.parquet, a Parquet file of clips" in capsys.readouterr().err
    assert main(["convert", "input=m.npz", "engine=ray", "out=again"]) != EXIT_OK
    assert "engine: got ray, for one file" in capsys.readouterr().err


def test_two_folders_for_one_run_are_refused(tmp_path, capsys):
    command = ["convert", "input=walk.npz", f"out={tmp_path}/a", f"hydra.run.dir={tmp_path}/b"]
    assert main(command) == EXIT_USAGE
    assert f"hydra.run.dir: got {tmp_path}/b beside out={tmp_path}/a" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
