"""Incremental PCA over a stream of identities, which can stop at any moment and go on exactly."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from soma_core._lazy import needed
from soma_core.cache import atomic_arrays
from soma_core.correctives.processes import Processes
from soma_core.errors import InputError
from soma_core.shape_space.sampling import TRAINING, ShapeStream

if TYPE_CHECKING:
    from sklearn.decomposition import IncrementalPCA

__all__ = ["Components", "TrainingPlan", "mirror_shapes", "train_components"]

_log = logging.getLogger(__name__)

_EXTRA_COMPONENTS = 32
"""Kept while training and dropped at the end: what one batch cuts off may matter with the next."""

_FITTED = (
    "components_",
    "singular_values_",
    "mean_",
    "var_",
    "n_samples_seen_",
    "explained_variance_",
    "explained_variance_ratio_",
    "noise_variance_",
    "n_components_",
)


@dataclass(frozen=True, kw_only=True)
class TrainingPlan:
    """How much to train on.

    Attributes:
        count: identities; mirror images come on top.
        components: principal components in the result.
        batch: identities taken at a time.
        mirror: train on each identity and its mirror image.
        save_every: batches between two saved states.
    """

    count: int
    components: int
    batch: int
    mirror: bool = True
    save_every: int = 4

    def __post_init__(self) -> None:
        """Refuse a plan whose first batch cannot carry the components."""
        for name in ("count", "components", "batch", "save_every"):
            if getattr(self, name) < 1:
                raise InputError(name, got=getattr(self, name), expected="at least 1", fix=f"Raise {name}.")
        first = self.batch_sizes[0] * (2 if self.mirror else 1)
        if first < self.components:
            raise InputError(
                "batch",
                got=f"{first} shapes in the first batch",
                expected=f"at least as many as components ({self.components})",
                fix="Raise batch and count, or lower components.",
            )

    @property
    def batch_sizes(self) -> tuple[int, ...]:
        """Sizes of the batches: equal to within one, largest first."""
        number = -(-self.count // self.batch)
        small, larger = divmod(self.count, number)
        return (small + 1,) * larger + (small,) * (number - larger)


@dataclass(frozen=True, kw_only=True, eq=False)
class Components:
    """The principal components of the shapes seen.

    Attributes:
        mean: (v, 3) float64 [cm].
        directions: (k, 3 v) float64, orthonormal, vertex-major xyz.
        eigenvalues: (k,) float64 [cm^2], descending.
        explained: (k,) share of the variance explained by each component.
        shapes: number of shapes seen, mirror images included.
    """

    mean: np.ndarray
    directions: np.ndarray
    eigenvalues: np.ndarray
    explained: np.ndarray
    shapes: int


def train_components(
    stream: ShapeStream,
    plan: TrainingPlan,
    *,
    bind: np.ndarray,
    partner: np.ndarray,
    state: Path,
    key: str,
    resume: bool = False,
    progress: Callable[[Iterable[int], int], Iterable[int]] = lambda steps, _done: steps,
    processes: Processes | None = None,
) -> Components | None:
    """Run incremental PCA over the training stream.

    Several processes take turns at making batches; the first takes them up in order, so that the result is
    the same for any number, and is alone in having one: None elsewhere.

    Args:
        stream: supply of shapes [cm].
        plan: how many.
        bind, partner: bind shape (v, 3) [cm] and mirror ids (v,), for the mirror images.
        state: file that holds the state between batches; removed at the end.
        key: identifies the run; a state of another run is not taken up.
        resume: go on from `state` where it fits; the result equals that of an uninterrupted run.
        progress: shows the steps of an iterable, the number of those done before being given.
    """
    sklearn = needed("sklearn", "decomposition", setting="task train-shape", pip="[train]")
    rows = plan.batch_sizes[0] * (2 if plan.mirror else 1)
    pca = sklearn.decomposition.IncrementalPCA(min(plan.components + _EXTRA_COMPONENTS, rows, bind.size))
    processes = processes or Processes()
    done = _restore(pca, state, key) if resume else 0
    processes.wait()  # all have read the state before it is written again
    sizes = plan.batch_sizes
    made = _made(stream, sizes, done, bind.shape, processes)
    for number, shapes in zip(progress(range(done, len(sizes)), done), made, strict=True):
        if shapes is None:
            continue
        if plan.mirror:
            shapes = np.concatenate((shapes, mirror_shapes(shapes, bind, partner)))
        pca.partial_fit(shapes.reshape(len(shapes), -1))
        if (number + 1) % plan.save_every == 0 and number + 1 < len(sizes):
            _save(pca, state, key, number + 1)
    if processes.rank > 0:
        return None
    state.unlink(missing_ok=True)
    kept = slice(plan.components)
    return Components(
        mean=np.asarray(pca.mean_).reshape(-1, 3),
        directions=np.array(pca.components_[kept]),
        eigenvalues=np.array(pca.explained_variance_[kept]),
        explained=np.array(pca.explained_variance_ratio_[kept]),
        shapes=int(pca.n_samples_seen_),
    )


def _made(
    stream: ShapeStream, sizes: Sequence[int], done: int, shape: tuple[int, ...], processes: Processes
) -> Iterator[np.ndarray | None]:
    """Batches from number `done` on, in order, on the first process; None for each on the others."""
    for start in range(done, len(sizes), processes.count):
        own = start + processes.rank
        shapes = None
        if own < len(sizes):
            shapes = torch.from_numpy(stream.shapes(TRAINING, own, sizes[own]))
        for rank, number in enumerate(range(start, min(start + processes.count, len(sizes)))):
            brought = processes.brought(shapes, (sizes[number], *shape), rank=rank)
            yield None if brought is None else brought.numpy()


def _save(pca: IncrementalPCA, state: Path, key: str, done: int) -> None:
    arrays = {name: np.asarray(getattr(pca, name)) for name in _FITTED}
    atomic_arrays(state, {"key": np.array(key), "done": np.array(done)} | arrays, compressed=False)


def _restore(pca: IncrementalPCA, state: Path, key: str) -> int:
    """Put the saved state into `pca`; return the number of batches it has seen, 0 without a state."""
    if not state.is_file():
        return 0
    with np.load(state, allow_pickle=False) as saved:
        if str(saved["key"]) != key:
            _log.warning("the state at %s belongs to another configuration; starting over", state)
            return 0
        for name, value in _fitted_values(saved):
            setattr(pca, name, value)
        pca.n_features_in_ = pca.components_.shape[1]
        done = int(saved["done"])
    _log.info("going on after batch %d", done)
    return done


def _fitted_values(saved: Mapping[str, np.ndarray]) -> Iterator[tuple[str, object]]:
    for name in _FITTED:
        value = saved[name]
        yield name, value if value.ndim else value.item()


def mirror_shapes(shapes: np.ndarray, bind: np.ndarray, partner: np.ndarray) -> np.ndarray:
    """Mirror shapes (batch, v, 3) in the plane x = 0, vertex ids included.

    The canonical mesh is not exactly symmetric, so the deviation from `bind` (v, 3) is mirrored rather
    than the positions: the bind shape is its own mirror image. `partner` (v,) holds each vertex's
    counterpart on the other side. All lengths in one unit.
    """
    deviation = (shapes - bind)[:, partner]
    deviation[..., 0] *= -1
    return bind + deviation
