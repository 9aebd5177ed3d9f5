"""``soma train-correctives``: learn pose correctives from a teacher."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from scipy.spatial.transform import Rotation

from soma_core._version import __version__
from soma_core.cache import atomic_write, content_key
from soma_core.correctives.data import ClipPlan, LessonStore, Split, Taught, split_clips
from soma_core.correctives.finish import Masks, entry_budget, finished
from soma_core.correctives.masks import find_creases, joint_mask, vertex_mask
from soma_core.correctives.model import Correctives, find_correctives
from soma_core.correctives.network import CorrectivesNetwork
from soma_core.correctives.plot import plot_history
from soma_core.correctives.processes import Processes, joined_processes
from soma_core.correctives.teacher import Clip, ElasticTeacher, Teacher
from soma_core.correctives.training import Epoch, Trainer, TrainingOptions, reduction
from soma_core.correctives.weights import CorrectiveWeights, read_weights, write_weights
from soma_core.errors import InputError
from soma_core.io import read_motion
from soma_core.motion.clip_stream import ClipStream, shard_files
from soma_core.paths import cache_dir
from soma_core.progress import progress
from soma_core.rig import load_canonical
from soma_core.rig.manifest import CORRECTIVES_NAME
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.topology.lod_transfer import offset_rows

__all__ = ["make_teacher", "read_clips", "run"]

_log = logging.getLogger(__name__)

_CODE_VERSION = 1
_OPTIONS = ("batch", "epochs", "rate", "sparsity", "patience", "ridge", "seed", "save_every")

_LONGEST, _SAID = 256, 20
"""Poses of a clip at most, and clips between two lines of the log while they are taught."""


def run(config: DictConfig, output: Path) -> None:
    """Teach, train, solve the second stage on all vertices, prune, test on held-out clips, and write.

    Writes ``correctives_model.pt`` (or the file `config.out`), ``report.json`` and, where matplotlib is
    installed, ``loss.png`` into `output`. Under ``torchrun`` all processes share the work and the first
    one writes.

    Raises:
        InputError: data, an option or a teacher that cannot be used.
        BackendError: the teacher's backend is not usable.
    """
    _check(config.data)
    if not config.smoothness >= 0:
        raise InputError(
            "smoothness", got=config.smoothness, expected="at least 0", fix="Leave folds with smoothness=0."
        )
    mesh, rig = load_canonical("mid")
    options = TrainingOptions(mirror=config.data.mirror, **{name: config[name] for name in _OPTIONS})
    masks = _masks(mesh, rig, config.reach)
    budget = entry_budget(config.mebibytes, masks, config.channels)
    with joined_processes(config.device) as processes:
        teacher = make_teacher(config.teacher, mesh, rig)
        store = LessonStore(cache_dir() / "train_correctives" / "lessons", teacher, mesh, rig)
        taught = _taught(store, config, rig, processes)
        clips = split_clips(taught, held_out=config.data.held_out, seed=config.seed)
        history: list[Epoch] = []
        if config.first:
            network = _kept_first(config, masks)
        else:
            history, network = _trained(config, options, masks, store, clips, processes)
        if processes.rank > 0:
            return
        meta = _provenance(config, teacher, clips, mesh)
        weights = finished(
            network, masks, store, clips["train"], rig, ridge=options.ridge, smoothness=config.smoothness,
            budget=budget, mirror=options.mirror, meta={**meta, "epochs": len(history)},
        )  # fmt: skip
        path = Path(config.out) if config.out else output / CORRECTIVES_NAME
        write_weights(path, weights)
        measured = _tested(read_weights(path), store, clips["test"], mesh, rig)
        _report(output, {**meta, **measured, "bytes": path.stat().st_size, "history": history})
        _log.info("error to the teacher on held-out clips reduced by %.1f %%", 100 * measured["reduction"])
        if history and not plot_history(history, output / "loss.png"):
            _log.info("matplotlib is not installed: report.json has the numbers, there is no plot")


def make_teacher(name: str, mesh: CanonicalMesh, rig: Rig) -> Teacher:
    """The elastic surface, with bone or without, or the backend `name` and its own posed meshes.

    Raises:
        InputError: a backend that cannot show posed meshes.
        BackendError: no such backend, or not usable.
    """
    if name in ("elastic", "bone"):
        return ElasticTeacher(mesh, rig, bones=name == "bone")
    from soma_core.tasks.posed_teacher import PosedTeacher

    return PosedTeacher(name)


def read_clips(data: DictConfig, seed: int, names: Sequence[str], processes: Processes) -> Iterator[Clip]:
    """The clips that this process teaches, one in memory at a time: random ones, motion files, and shards.

    Of motions every ``data.step``-th frame, in pieces. All processes together read each clip once.

    Raises:
        InputError: absolute rotations, or shards that cannot be used.
        AssetError: a file that cannot be read.
    """
    rank, count = processes.rank, processes.count
    plan = ClipPlan(
        random_clips=data.random_clips, hanging_clips=data.hanging_clips, poses=data.poses, seed=seed
    )
    for number in range(rank, len(plan), count):
        yield plan.clip(number, names)
    shards = [path for path in data.motions if shard_files(path)]
    paths = [Path(path) for path in data.motions if path not in shards]
    files = [file for path in paths for file in (sorted(path.glob("*.npz")) if path.is_dir() else [path])]
    for number in range(rank, len(files), count):
        motion = read_motion(files[number])
        _check_convention(files[number], motion.convention)
        rotations = motion.rotations[:: data.step]
        yield from _pieces(files[number].name, "", rotations, len(plan) + number)
    if not shards:
        return
    columns = ["name", "state", "start", "convention", "poses"]
    for row in ClipStream(shards, columns, seed=None, setting="data.motions").share(rank, count):
        if row["state"] != "converted" or "poses" not in row:
            continue
        _check_convention(row["name"], row["convention"])
        vectors = row["poses"][-row["start"] % data.step :: data.step].astype(np.float64)
        rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
        number = len(plan) + len(files) + row["row"]
        yield from _pieces(row["name"], f" {row['start']}", rotations.reshape(-1, 77, 3, 3), number)


def _pieces(name: str, at: str, rotations: np.ndarray, number: int) -> Iterator[Clip]:
    """A clip, in pieces of so many poses that a few of them fit into memory."""
    starts = range(0, len(rotations), _LONGEST)
    for start in starts:
        piece = f"{name}{at}" + (f"/{start}" if len(starts) > 1 else "")
        poses = rotations[start : start + _LONGEST]
        yield Clip(name=piece, rotations=poses, seed=number, part_of=name)


def _check_convention(name: str | Path, convention: str) -> None:
    if convention != "t_pose_relative":
        raise InputError(
            "data.motions",
            got=f"{name} with the convention {convention}",
            expected="rotations relative to the T-pose",
            fix="Convert it with `soma convert`.",
        )


def _masks(mesh: CanonicalMesh, rig: Rig, reach: float) -> Masks:
    if not 0 < reach <= 10:
        raise InputError("reach", got=reach, expected="above 0 and at most 10", fix="Try reach=1.5.")
    creases = find_creases(rig)
    return Masks(joints=joint_mask(rig, creases), vertices=vertex_mask(mesh, rig, creases, reach=reach))


def _check(data: DictConfig) -> None:
    if not 0 < data.held_out < 0.5:
        raise InputError(
            "data.held_out", got=data.held_out, expected="above 0 and below 0.5", fix="Try data.held_out=0.1."
        )
    if data.step < 1:
        raise InputError(
            "data.step", got=data.step, expected="at least 1", fix="Take every frame with step=1."
        )


def _taught(store: LessonStore, config: DictConfig, rig: Rig, processes: Processes) -> list[Taught]:
    """Fill the cache, each process with its share; give all clips, in an order that no process decides."""
    own = []
    for clip in read_clips(config.data, config.seed, rig.user_joint_names, processes):
        own.append((clip.seed, len(own), store.teach(clip)))
        if len(own) % _SAID == 0:
            _log.info("%d clips taught", len(own))
    found = sorted(each for part in processes.gathered(own) for each in part)
    return [taught for _, _, taught in found]


def _trained(
    config: DictConfig,
    options: TrainingOptions,
    masks: Masks,
    store: LessonStore,
    clips: Mapping[Split, Sequence[Taught]],
    processes: Processes,
) -> tuple[list[Epoch], CorrectivesNetwork]:
    """Train both stages on the vertices of ``config.lod``."""
    vertices = _training_vertices(config)
    network = CorrectivesNetwork(
        masks.joints, masks.vertices[:, vertices].tocsr(), channels=config.channels, seed=config.seed
    ).to(config.device)
    trainer = Trainer(
        network, store, train=clips["train"], validation=clips["validation"], vertices=vertices,
        options=options, processes=processes,
    )  # fmt: skip
    named = [[clip.key for clip in clips[part]] for part in clips]
    shape = (config.channels, config.reach, str(config.lod), processes.count, config.device)
    key = content_key(_CODE_VERSION, str(options), str(shape), json.dumps(named), store.key)
    trainer.run(
        state=cache_dir() / "train_correctives" / f"{key}.pt",
        key=key,
        resume=config.resume,
        progress=lambda steps, done: progress(steps, label="epoch", total=options.epochs, done=done),
    )
    return trainer.history, network


def _kept_first(config: DictConfig, masks: Masks) -> CorrectivesNetwork:
    """The first stage of a checkpoint on the vertices of the mid LOD; the second is yet to be solved.

    Raises:
        InputError: another number of joints or channels.
    """
    path = find_correctives(config.first, shipped=True)
    if path is None:
        raise InputError(
            "first", got=config.first, expected="a checkpoint", fix="Name its file, or leave it out."
        )
    first = read_weights(path).first
    network = CorrectivesNetwork(masks.joints, masks.vertices, channels=config.channels, seed=config.seed)
    wanted = network.first_matrix().shape
    if first.shape != wanted:
        raise InputError(
            "first",
            got=f"{path}, whose first stage is {first.shape}",
            expected=f"{wanted}: 6 numbers of each joint by {config.channels} activations of each",
            fix="Set channels as that checkpoint has them, or leave first out.",
        )
    network.take_first(first)
    return network


def _training_vertices(config: DictConfig) -> np.ndarray:
    """Ids in the mid LOD of the vertices that the first stage is trained on."""
    mesh, _ = load_canonical("mid" if str(config.lod) == "mid" else "low")
    return mesh.mid_ids


def _tested(
    weights: CorrectiveWeights, store: LessonStore, clips: Sequence[Taught], mesh: CanonicalMesh, rig: Rig
) -> dict[str, float]:
    """How well the written file does on clips that had no part in training."""
    model = Correctives(weights, rig, offset_rows(mesh), dtype=torch.float32, device="cpu")
    lessons = (store.read(clip, np.arange(mesh.vertex_count)) for clip in clips)
    with torch.no_grad():
        share, left = reduction((model.offsets(lesson.features), lesson.offsets) for lesson in lessons)
    return {"reduction": round(share, 5), "rms_mm": round(left, 5)}


def _provenance(
    config: DictConfig, teacher: Teacher, clips: Mapping[Split, Sequence[Taught]], mesh: CanonicalMesh
) -> dict[str, Any]:
    names = (*_OPTIONS, "channels", "reach", "mebibytes", "first", "smoothness")
    settings = {name: config[name] for name in names}
    return {
        **teacher.provenance,
        "rig_revision": mesh.revision,
        "version": __version__,
        "commit": _commit(),
        "data": OmegaConf.to_container(config.data, resolve=True),
        "clips": {part: len({clip.part_of for clip in found}) for part, found in clips.items()},
        "poses": {part: sum(clip.poses for clip in found) for part, found in clips.items()},
        "settings": {**settings, "lod": str(config.lod)},
    }


def _commit() -> str:
    """Commit of a source checkout, a linked worktree too; empty for an installed package."""
    git = Path(__file__).resolve().parents[2] / ".git"
    try:
        shared = git
        if git.is_file():
            git = Path(git.read_text(encoding="utf-8").removeprefix("gitdir: ").strip())
            shared = git / (git / "commondir").read_text(encoding="utf-8").strip()
        head = (git / "HEAD").read_text(encoding="utf-8").strip()
        return (shared / head.removeprefix("ref: ")).read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _report(output: Path, content: Mapping[str, Any]) -> None:
    text = json.dumps(content, indent=2) + "\n"
    atomic_write(output / "report.json", lambda path: _write_text(path, text))
