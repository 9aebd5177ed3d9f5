"""Pose correctives: how much of their teacher they reproduce on unseen motions, and at what cost."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from soma_core.correctives.bones import bony_share
from soma_core.correctives.elastic import ElasticSurface
from soma_core.correctives.masks import find_creases, vertex_mask
from soma_core.correctives.model import Correctives, find_correctives
from soma_core.correctives.poses import random_rotations
from soma_core.correctives.weights import CorrectiveWeights, read_weights
from soma_core.errors import AssetError
from soma_core.evaluation.report import Figure, Report, ShownBody, Table
from soma_core.geometry.laplacian import random_walk
from soma_core.geometry.mesh import vertex_normals
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.io import read_motion
from soma_core.layer import SomaLayer
from soma_core.paths import assets_dir
from soma_core.progress import progress
from soma_core.rig import load_canonical
from soma_core.rig.manifest import shipped_file
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity
from soma_core.topology.lod_transfer import offset_rows
from soma_core.view.joint_picture import draw_joints

__all__ = ["run"]

_MOVED = 1e-3
_LEFT, _SHORT, _SHARE_OF_TIME, _SHARE_OF_MEMORY = 30.0, 5.0, 0.2, 0.1
_UNSEEN_SEED = 2**32  # no training run draws from it
_BATCH = 32

_BENDS = (
    ("elbow", "LeftForeArm", (0.0, -1.0, 0.0)),
    ("knee", "LeftShin", (1.0, 0.0, 0.0)),
)
_BEND_DEG = 120.0

_SHOWN = (
    *_BENDS,
    ("hip", "LeftLeg", (-1.0, 0.0, 0.0)),
    ("shoulder", "LeftArm", (0.0, 0.0, 1.0)),
)
_SHOWN_DEG = {"knee": (30, 60, 90, 120, 150), "elbow": (30, 60, 90, 120, 150), "hip": (30, 60, 90, 120)}
_RAISED_DEG = (30, 60, 90)
_HELD_TO = 120
"""Angles beyond are shown, and not held to a bound: the poses that were taught end at 145 degrees."""

_FARTHER, _BULGE, _RING = 0.0, 5.0, 20.0
_OVER_BONE = 0.5

_BODIES: tuple[tuple[str, str, Mapping[str, float]], ...] = (
    ("soma", "native space, mean", {}),
    ("anny", "infant", {"age": 0.1}),
    ("anny", "child", {"age": 0.33}),
    ("anny", "adult", {"age": 0.67}),
    ("anny", "elder", {"age": 1.0}),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Subject:
    """What is measured: the canonical body, its teacher and the correctives."""

    mesh: CanonicalMesh
    rig: Rig
    surface: ElasticSurface
    model: Correctives

    def compare(self, relative: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Vertices by twist skinning, with correctives, and the teacher's, (B, v, 3) each."""
        body = self.surface.body
        transforms = body.transforms(relative)
        scale = self.model.scale(body.identity.bind_world)[:, None, None]
        offsets = scale * self.model.offsets(self.model.features(relative))
        return body.skin(transforms), body.skin(transforms, offsets), self.surface(relative)


def _unseen(rig: Rig, count: int, files: list[str]) -> dict[str, np.ndarray]:
    """Motions that no training has seen: fresh random poses, the shipped clip, and what the user names."""
    random = np.random.default_rng(_UNSEEN_SEED)
    names = rig.user_joint_names
    motions = {"random poses": random_rotations(names, count, random)}
    motions["random poses, arms hanging"] = random_rotations(names, count, random, hanging=True)
    for path in (str(shipped_file("motions/range_of_motion.npz")), *files):
        rotations = read_motion(path).rotations
        frames = np.linspace(0, len(rotations) - 1, min(count, len(rotations))).astype(int)
        motions[path.rpartition("/")[2].removesuffix(".npz")] = rotations[frames].astype(np.float64)
    return motions


def _errors(subject: _Subject, motion: np.ndarray) -> tuple[float, float, float]:
    """Mean distance to the teacher [mm] without and with correctives where it moves skin, and the largest."""
    before, after, worst, count = 0.0, 0.0, 0.0, 0
    for part in torch.as_tensor(motion).split(8):
        plain, corrected, taught = subject.compare(part)
        missing, left = (plain - taught).norm(dim=-1), (corrected - taught).norm(dim=-1)
        moved = missing > _MOVED
        before, after = before + float(missing[moved].sum()), after + float(left[moved].sum())
        worst, count = max(worst, float(left.max())), count + int(moved.sum())
    return 1e3 * before / max(count, 1), 1e3 * after / max(count, 1), 1e3 * worst


def _section_figures(subject: _Subject) -> list[Figure]:
    """Volume around bent joints, as a share of the teacher's."""
    rig, sections = subject.rig, subject.surface.sections
    figures = []
    for label, joint, axis in _BENDS:
        relative = _bent(subject, joint, axis, _BEND_DEG)
        centres = sections.posed_centres(subject.surface.body.transforms(relative))
        row = int(np.flatnonzero(sections.joints == rig.joint_names.index(joint))[0])
        volumes = [sections.volumes(v.numpy(), centres)[0, row] for v in subject.compare(relative)]
        plain, corrected, taught = (100 * volume / sections.rest_volumes[row] for volume in volumes)
        name = f"{label} at {_BEND_DEG:.0f} degrees"
        figures += [
            Figure(name=f"{name}, volume by twist skinning", value=plain, unit="% of rest"),
            Figure(name=f"{name}, volume by the teacher", value=taught, unit="% of rest"),
            Figure(
                name=f"{name}, volume short of the teacher's", value=100 * (1 - corrected / taught),
                unit="%", bound=_SHORT,
            ),
        ]  # fmt: skip
    return figures


def _bent(subject: _Subject, joint: str, axis: tuple[float, float, float], degrees: float) -> Tensor:
    """The bind pose with one joint turned from the T-pose, (1, J - 1, 3, 3)."""
    relative = subject.surface.body.bind_pose.clone()
    turn = np.radians(degrees) * torch.tensor(axis, dtype=torch.float64)
    relative[0, subject.rig.user_joint_names.index(joint)] = axis_angle_to_matrix(turn)
    return relative


def _shape_rows(subject: _Subject) -> list[list[Any]]:
    """How joints look when they bend: normals, and the skin over the bone of knees and elbows.

    A row holds the joint, the angle, the farthest that a normal turns against the bone above [degrees] by
    twist skinning and with correctives, how much farther than at rest skin over bone is from the joint [mm],
    and the largest Laplacian of that distance [1/m]: a ring around the kneecap has a large one.
    """
    rig, mesh, body = subject.rig, subject.mesh, subject.surface.body
    rest, triangles, edges = rig.bind_shape, mesh.triangles, mesh.edges()
    creases = find_creases(rig)
    bones, ridge = bony_share(rig, creases), random_walk(edges, len(rest))
    squared = ((rest[edges[:, 0]] - rest[edges[:, 1]]) ** 2).sum(1)
    ends = edges.T.ravel()
    spacing = np.bincount(ends, np.tile(squared, 2)) / np.bincount(ends)  # mean squared edge of a vertex
    normals = vertex_normals(rest, triangles)
    rows = []
    for label, name, axis in _SHOWN:
        joint = rig.joint_names.index(name)
        near = np.linalg.norm(rest - rig.bind_world[joint, :3, 3], axis=1) < 2 * creases.radius[joint]
        for degrees in _SHOWN_DEG.get(label, _RAISED_DEG):
            relative = _bent(subject, name, axis, degrees)
            transforms = body.transforms(relative)
            plain, corrected, _ = (found[0].numpy() for found in subject.compare(relative))
            above = transforms[0, rig.parents[joint], :, :3].numpy()
            row: list[Any] = [label, degrees]
            for vertices in (plain, corrected):
                cosine = ((vertex_normals(vertices, triangles) @ above) * normals)[near].sum(1)
                row.append(float(np.degrees(np.arccos(cosine.clip(-1, 1))).max()))
            if joint in bones:
                place = rig.bind_world[joint, :3, 3]
                moved = transforms[0, joint, :, :3].numpy() @ place + transforms[0, joint, :, 3].numpy()
                farther = np.linalg.norm(corrected - moved, axis=1) - np.linalg.norm(rest - place, axis=1)
                over = bones[joint] > _OVER_BONE
                curved = 4 * np.abs(ridge @ farther) / spacing
                row += [1e3 * float(farther[over].max()), float(curved[over].max())]
            rows.append([*row, *[None] * (6 - len(row))])
    return rows


def _shape_figures(rows: list[list[Any]], *, bones: bool) -> list[Figure]:
    """What the rows of :func:`_shape_rows` come to; skin over bone is bound where a teacher has bones."""
    held = [row for row in rows if row[1] <= _HELD_TO]
    bony = [row for row in rows if row[4] is not None]
    ring = max(row[5] for row in bony if row in held)
    return [
        Figure(
            name="normals turn farther than by twist skinning", value=max(row[3] - row[2] for row in held),
            unit="degrees", bound=_FARTHER,
        ),
        Figure(
            name="skin over bone, farther from the joint than at rest", value=max(row[4] for row in bony),
            unit="mm", bound=_BULGE if bones else None,
        ),
        Figure(
            name="skin over bone, Laplacian of that distance", value=ring, unit="1/m",
            bound=_RING if bones else None,
        ),
    ]  # fmt: skip


def _exact_figures(subject: _Subject, weights: CorrectiveWeights) -> list[Figure]:
    """What holds by construction: nothing at the bind pose, nothing outside the masks."""
    rig, mesh = subject.rig, subject.mesh
    relative = subject.surface.body.bind_pose
    still = float(subject.model.offsets(subject.model.features(relative)).abs().max())
    mask = vertex_mask(mesh, rig, find_creases(rig), reach=float(weights.meta["settings"]["reach"]))
    held = np.setdiff1d(np.arange(mesh.vertex_count), mask.indices)
    drawn = random_rotations(rig.user_joint_names, 8, np.random.default_rng(_UNSEEN_SEED))
    offsets = subject.model.offsets(subject.model.features(torch.as_tensor(drawn)))
    return [
        Figure(name="largest offset at the bind pose", value=1e3 * still, unit="mm", bound=1e-6),
        Figure(
            name="largest offset outside the masks", value=1e3 * float(offsets[:, held].abs().max()),
            unit="mm", bound=0.0,
        ),
    ]  # fmt: skip


def _cost_figures(weights: CorrectiveWeights, subject: _Subject) -> list[Figure]:
    """Time and memory beside the dense product of the same weights, masked at every call."""
    rig = subject.rig
    model = Correctives(weights, rig, offset_rows(subject.mesh), dtype=torch.float32, device="cpu")
    random = np.random.default_rng(_UNSEEN_SEED)
    drawn = torch.as_tensor(random_rotations(rig.user_joint_names, _BATCH, random)).float()
    features = model.features(drawn)
    first, second = (torch.as_tensor(m.astype(np.float32).toarray()) for m in (weights.first, weights.second))
    mask = (second != 0).to(torch.float32)
    seen = features.flatten(1)

    def dense() -> Tensor:
        return torch.tanh(torch.relu(seen @ first)) @ (second * mask)

    apart = float((dense().view(_BATCH, -1, 3) - model.offsets(features)).abs().max())
    sparse_time, dense_time = _seconds(lambda: model.offsets(features)), _seconds(dense)
    held = sum(buffer.nbytes for buffer in model.buffers())
    return [
        Figure(name="dense product and ours apart", value=1e3 * apart, unit="mm", bound=1e-3),
        Figure(name=f"dense masked product, {_BATCH} poses", value=1e3 * dense_time, unit="ms"),
        Figure(name=f"ours, {_BATCH} poses", value=1e3 * sparse_time, unit="ms"),
        Figure(name="ours, share of the time", value=sparse_time / dense_time, bound=_SHARE_OF_TIME),
        Figure(
            name="ours, share of the memory of W2 alone", value=held / second.nbytes, bound=_SHARE_OF_MEMORY
        ),
    ]


def _seconds(call: Callable[[], Tensor], repeats: int = 5) -> float:
    call()
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return min(taken)


def _bodies(
    subject: _Subject, motion: np.ndarray, *, bones: bool
) -> tuple[list[list[str | float | None]], list[ShownBody]]:
    """The same correctives on other bodies: error to a teacher of their own, and pictures of one pose."""
    rows: list[list[str | float | None]] = []
    shown = []
    turned = ((motion - np.eye(3)) ** 2)[:, 1:].sum((1, 2, 3))
    frame = motion[int(turned.argmax())][None]  # the one that bends most
    for backend, label, params in progress(_BODIES, label="body", total=len(_BODIES)):
        layer = SomaLayer(backend, dtype=torch.float64, correctives=None)
        identity = layer.identity(params)
        surface = ElasticSurface(subject.mesh, subject.rig, identity=identity, bones=bones)
        own = _Subject(mesh=subject.mesh, rig=subject.rig, surface=surface, model=subject.model)
        before, after, _ = _errors(own, motion)
        height = float(np.ptp(identity.rest[0, :, 1].numpy()))
        rows.append([f"{backend}, {label}", height, before, after, 100 * (1 - after / before)])
        shown += _pictured(own, identity, f"{backend}, {label}", torch.as_tensor(frame))
    return rows, shown


def _pictured(subject: _Subject, identity: Identity, caption: str, pose: Tensor) -> list[ShownBody]:
    """The corrected rest shape and the posed body, coloured by the length of the offsets."""
    scale = subject.model.scale(identity.bind_world)[:, None, None]
    offsets = scale * subject.model.offsets(subject.model.features(pose))
    _, corrected, _ = subject.compare(pose)
    length = 1e3 * offsets[0].norm(dim=-1).numpy()
    triangles = subject.mesh.triangles
    rest = (identity.rest + offsets)[0].numpy()
    return [
        ShownBody(caption=f"{caption}\nat rest", vertices=rest, triangles=triangles, errors_mm=length),
        ShownBody(
            caption=f"{caption}\nposed", vertices=corrected[0].numpy(), triangles=triangles, errors_mm=length
        ),
    ]


@torch.no_grad()
def run(config: DictConfig) -> Report:
    """Measure the shipped correctives, or ``experiment.checkpoint``, on `experiment.count` poses a motion.

    Raises:
        AssetError: no checkpoint, or one that does not belong to the rig.
    """
    path = find_correctives(config.experiment.checkpoint or "auto", shipped=True)
    if path is None:
        raise AssetError(assets_dir(), cause="holds no correctives", fix="Run: soma train-correctives")
    weights = read_weights(path)
    mesh, rig = load_canonical("mid")
    model = Correctives(weights, rig, offset_rows(mesh), dtype=torch.float64, device="cpu")
    bones = weights.meta.get("teacher") == "bone"
    subject = _Subject(mesh=mesh, rig=rig, surface=ElasticSurface(mesh, rig, bones=bones), model=model)
    motions = _unseen(rig, config.experiment.count, list(config.experiment.motions))
    rows: list[list[str | float | None]] = []
    figures = []
    for name, motion in progress(motions.items(), label="motion", total=len(motions)):
        before, after, worst = _errors(subject, motion)
        rows.append([name, len(motion), before, after, worst])
        left = 100 * after / before
        figures.append(Figure(name=f"error to the teacher left, {name}", value=left, unit="%", bound=_LEFT))
    clip = motions["range_of_motion"]
    bent = _shape_rows(subject)
    body_rows, shown = _bodies(subject, clip[:: max(1, len(clip) // 16)], bones=bones)
    return Report(
        title="Pose correctives against their teacher, on motions held out from training",
        tables=[
            Table(
                title="Distance to the teacher where it moves skin by more than 1 mm",
                columns=("motion", "poses", "twist skinning, mm", "with correctives, mm", "largest, mm"),
                rows=rows,
            ),
            Table(
                title="One joint bent: the farthest turn of a normal, and skin over bone",
                columns=(
                    "joint", "degrees", "twist skinning, degrees", "with correctives, degrees",
                    "farther than at rest, mm", "Laplacian of that, 1/m",
                ),
                rows=bent,
            ),
            Table(
                title="Other bodies, each against a teacher of its own (range of motion)",
                columns=("body", "height, m", "twist skinning, mm", "with correctives, mm", "error gone, %"),
                rows=body_rows,
            ),
        ],
        figures=[
            *figures, *_section_figures(subject), *_shape_figures(bent, bones=bones),
            *_exact_figures(subject, weights), *_cost_figures(weights, subject),
        ],
        notes=(
            f"Teacher: {weights.meta.get('teacher')}; made by commit {str(weights.meta.get('commit'))[:12]}. "
            "Times are those of this run, in passing.",
        ),
        bodies=shown,
        pictures={"joints.png": partial(draw_joints, checkpoint=config.experiment.checkpoint)},
    )  # fmt: skip
