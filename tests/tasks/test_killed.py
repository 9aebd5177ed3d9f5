"""Commands killed in the middle and given again: the files are those of a run that nobody disturbed."""

from __future__ import annotations

import importlib.util
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from soma_core.motion.clips import clip_schema, write_rows
from soma_core.obj import write_obj
from soma_core.rig import load_canonical

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="processes are killed by a signal of POSIX"),
]

ROOT = Path(__file__).resolve().parents[2]
SOMA = (sys.executable, "-c", "from soma_core.cli import console; console()")
SHAPE = (
    "train-shape", "~mix.anny", "+mix.soma=1.0", "count=16", "components=4", "batch=4", "held_out=4",
    "save_every=1",
)  # fmt: skip
CORRECTIVES = (
    "train-correctives", "data.random_clips=3", "data.hanging_clips=1", "data.poses=2", "channels=2",
    "batch=2", "epochs=2", "save_every=1", "mebibytes=1",
)  # fmt: skip
LIMIT_S = 900
SEED = int(os.environ.get("SOMA_KILL_SEED", "0"))
"""Which of its moments a command is killed at: one a test, all of them over some seeds."""


def drawn(name: str, moments: Sequence[str]) -> str:
    """One of the moments, by the seed."""
    return random.Random(f"{SEED} {name}").choice(moments)


def environment(home: Path) -> dict[str, str]:
    """One thread, a cache of its own, and nothing of the user's."""
    own = {"SOMA_CACHE_DIR": str(home / "cache"), "OMP_NUM_THREADS": "1"}
    return {**os.environ, **own, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, sys.path)])}


def started(command: Sequence[str], home: Path, count: int = 1) -> list[subprocess.Popen[str]]:
    """A process for each rank, as torchrun starts them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
    shared |= {"WORLD_SIZE": str(count)} if count > 1 else {}
    return [
        subprocess.Popen(
            command, cwd=home, env={**environment(home), **shared, "RANK": str(rank)}, text=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )
        for rank in range(count)
    ]  # fmt: skip


def finished(command: Sequence[str], home: Path, count: int = 1) -> str:
    """Run to the end; what was said on the way."""
    said = []
    for process in started(command, home, count):
        said.append(process.communicate(timeout=LIMIT_S)[1])
        assert process.returncode == 0, said[-1][-3000:]
    return "\n".join(said)


def killed(command: Sequence[str], home: Path, when: Callable[[], object], count: int = 1) -> None:
    """Run until something is there, then SIGKILL all of it."""
    running = started(command, home, count)
    begin = time.monotonic()
    while not when():
        assert all(process.poll() is None for process in running), "it ended before it was killed"
        assert time.monotonic() - begin < LIMIT_S
        time.sleep(0.005)
    for process in running:
        process.kill()
    for process in running:
        process.communicate()
        assert process.returncode == -signal.SIGKILL


def equal_files(first: Path, second: Path, names: Sequence[str]) -> None:
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
    left = [path.name for path in second.iterdir() if path.name.startswith(".")]
    assert not left


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    """A cache of what says nothing of a run: the regressors of the rig, read again in any run."""
    home = tmp_path_factory.mktemp("warm")
    code = "from soma_core import SomaLayer; [SomaLayer('soma', lod=lod) for lod in ('low', 'mid')]"
    finished((sys.executable, "-c", code), home)
    return home / "cache"


@pytest.fixture
def homes(tmp_path, warm):
    """Folders of a run that nobody disturbs and of one that is killed."""
    found = tmp_path / "whole", tmp_path / "cut"
    for home in found:
        for kind in ("canonical", "joint_regressor"):
            shutil.copytree(warm / kind, home / "cache" / kind)
    return found


def trained(arguments: Sequence[str], home: Path) -> tuple[str, ...]:
    return (*SOMA, *arguments, f"hydra.run.dir={home / 'run'}")


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """Bodies, each in one clip of a few frames, in three files."""
    pa = pytest.importorskip("pyarrow")
    folder, random = tmp_path_factory.mktemp("shards"), np.random.default_rng(0)
    for file in range(3):
        rows = []
        for clip in range(8):
            params = json.dumps({"shape": random.normal(size=6).tolist()})
            rows.append({
                "name": f"{file}-{clip}", "state": "converted", "identity_model_type": "soma",
                "identity_params": params, "start": 0, "convention": "t_pose_relative",
                "poses": (0.2 * random.normal(size=(1, 77, 3))).tolist(),
            })  # fmt: skip
        write_rows(folder / f"{file:06d}.parquet", [pa.Table.from_pylist(rows, schema=clip_schema())])
    return str(folder)


@pytest.mark.parametrize("count", [1, 2])
def test_train_shape(homes, shards, count):
    whole, cut = homes
    arguments = SHAPE if count == 1 else (*SHAPE[3:], f"shards=[{shards}]")
    arguments = arguments if count == 1 else ("train-shape", *arguments)
    finished(trained(arguments, whole), whole)  # by one process, whatever the other takes
    command, states = trained(arguments, cut), cut / "cache/train_shape"
    killed(command, cut, lambda: list(states.glob("[!.]*.npz")), count)
    assert "going on after batch" in finished(command, cut, count)
    equal_files(whole / "run", cut / "run", ["shape_space.npz", "report.json"])


@pytest.mark.parametrize("count", [1, 2])
def test_train_correctives(homes, shards, count):
    whole, cut = homes
    arguments = CORRECTIVES if count == 1 else (*CORRECTIVES, f"data.motions=[{shards}]", "data.step=1")
    finished(trained(arguments, whole), whole, count)
    command, cache = trained(arguments, cut), cut / "cache/train_correctives"
    taught, learnt = "lessons/*/[!.]*.npz", "[!.]*.pt"
    first = drawn("train_correctives", (taught, learnt))
    moment = first if count == 1 else ({taught, learnt} - {first}).pop()  # the other one
    killed(command, cut, lambda: list(cache.glob(moment)), count)
    said = finished(command, cut, count)
    assert moment == taught or "going on after epoch" in said
    equal_files(whole / "run", cut / "run", ["correctives_model.pt", "report.json"])


def test_wrap(tmp_path, homes):
    whole, cut = homes
    mesh = load_canonical("low")[0]
    write_obj(tmp_path / "body.obj", 1.1 * mesh.vertices, mesh.triangles)
    command = (*SOMA, "wrap", f"native={tmp_path / 'body.obj'}", "unit=m", "picture=false", "out=made")
    finished(command, whole)
    killed(command, cut, lambda: list((cut / "made").glob("body.obj")))
    finished(command, cut)
    equal_files(whole / "made", cut / "made", ["SOMA_wrap.obj", "body.obj", "report.json"])


@pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="anny is not installed")
def test_assets(homes):
    whole, cut = homes
    command = (sys.executable, "-m", "assets.make", "--output", "assets")
    finished(command, whole)
    made = drawn("assets", ("SOMA_template_rig.usda", "SOMA_neutral.npz"))
    killed(command, cut, (cut / "assets" / made).exists)
    finished(command, cut)
    names = [
        path.relative_to(whole / "assets").as_posix()
        for path in (whole / "assets").rglob("*")
        if path.is_file()
    ]
    assert len(names) >= 5
    equal_files(whole / "assets", cut / "assets", names)
