"""Gradient training of both stages: Adam, early stopping, and a state that a killed run goes on from."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypedDict

import numpy as np
import torch
from torch import Tensor

from soma_core.correctives.data import Batch, LessonStore, Taught
from soma_core.correctives.network import CorrectivesNetwork
from soma_core.correctives.processes import Processes
from soma_core.correctives.second_stage import accumulate, all_entries, solve
from soma_core.correctives.weights import write_tensors
from soma_core.errors import InputError
from soma_core.stored_matrix import StoredMatrix
from soma_core.tensor_archive import read_tensor_archive

__all__ = ["MOVED", "Epoch", "Progress", "Trainer", "TrainingOptions", "reduction"]

_log = logging.getLogger(__name__)

MOVED = 1e-3
"""Offsets longer than this [m] count as moved by the teacher."""

_CM_PER_M, _MM2_PER_CM2 = 100.0, 100.0


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """How the stages are trained.

    Attributes:
        batch: poses a step, over all processes.
        epochs: at most.
        rate: learning rate of the first epoch; it falls along half a cosine.
        sparsity: weight of the mean length of W2's entries [mm^2/cm] beside the squared error.
        patience: epochs without a better validation error after which training stops.
        ridge: of the closed-form second stage; see :func:`second_stage.solve`.
        mirror: learn from the mirror image of every pose as well.
        seed: of the first weights and the order of the poses.
        save_every: batches between two saved states; one is saved after every epoch as well.
    """

    batch: int = 64
    epochs: int = 24
    rate: float = 0.003
    sparsity: float = 0.01
    patience: int = 8
    ridge: float = 1e-4
    mirror: bool = True
    seed: int = 0
    save_every: int = 500


class Epoch(TypedDict):
    """One line of the history; errors are root mean squares over all trained vertices [mm]."""

    epoch: int
    train_mm: float
    validation_mm: float
    reduction: float


class Progress(Protocol):
    """Shows the steps of an iterable."""

    def __call__(self, steps: Iterable[int], done: int) -> Iterable[int]:
        """The same steps, `done` of them being over."""
        ...


def reduction(
    pairs: Iterable[tuple[Tensor, Tensor]], processes: Processes | None = None
) -> tuple[float, float]:
    """How much of the teacher is reproduced: share of the error that goes, and what is left.

    Args:
        pairs: found and taught offsets (B, v, 3) [m].

    Returns:
        ``1 - |found - taught| / |taught|``, both averaged over vertices that the teacher moves by more
        than a millimetre, and the root mean square error over all vertices [mm].
    """
    sums = torch.zeros(4, dtype=torch.float64)
    for found, taught in pairs:
        error, length = (found - taught).norm(dim=-1), taught.norm(dim=-1)
        moved = length > MOVED
        sums += (
            torch.stack(
                [
                    error[moved].sum(),
                    length[moved].sum(),
                    (error * error).sum(),
                    torch.tensor(float(error.numel())),
                ]
            )
            .cpu()
            .double()
        )
    left, before, squared, count = (processes or Processes()).total(sums).tolist()
    return 1 - left / max(before, 1e-12), 1e3 * math.sqrt(squared / max(count, 1.0))


@dataclass
class _State:
    """All that the next batch depends on, with the network and the optimiser: `batch` in the `epoch`."""

    epoch: int = 0
    batch: int = 0
    squared: float = 0.0
    best: float = math.inf
    best_epoch: int = 0
    history: list[Epoch] = field(default_factory=list)


class Trainer:
    """Trains a network on the lessons of a store.

    Args:
        network: on the device that trains.
        store: where lessons are.
        train, validation: clips.
        vertices: ids in the mid LOD of the network's vertices.
        options: see :class:`TrainingOptions`.
        processes: of this run.

    Raises:
        InputError: fewer poses than one batch, or a batch that the processes cannot share evenly.
    """

    def __init__(
        self,
        network: CorrectivesNetwork,
        store: LessonStore,
        *,
        train: Sequence[Taught],
        validation: Sequence[Taught],
        vertices: np.ndarray,
        options: TrainingOptions,
        processes: Processes | None = None,
    ) -> None:
        self.processes = processes or Processes()
        poses = sum(clip.poses for clip in train)
        if options.batch < 1 or options.batch > poses or options.batch % self.processes.count:
            raise InputError(
                "batch",
                got=options.batch,
                expected=f"a multiple of {self.processes.count} processes, at most {poses} training poses",
                fix="Change the batch, or teach more poses.",
            )
        self.network, self._store, self._options = network, store, options
        self._train, self._validation, self._vertices = train, validation, vertices
        self._device = network.first.device
        self._optimiser = torch.optim.Adam(network.parameters(), lr=options.rate, betas=(0.9, 0.99))
        self._state, self._best = _State(), _copied(network)

    @property
    def history(self) -> list[Epoch]:
        """What happened so far, epoch by epoch."""
        return self._state.history

    def warm_start(self) -> None:
        """Set the second stage to the least squares solution for the first stage as it is."""
        network = self.network
        samples = (
            (network.activations(seen), wanted)
            for seen, wanted in self._share(self._train, mirrored=self._options.mirror)
        )
        with torch.no_grad():
            normal = accumulate(samples, list(network.sizes), network.vertices, network.channels)
            for block in (normal.gram, *normal.cross):
                self.processes.total(block)
            strength = network.strength.cpu().double().numpy()
            ids = network.vertices.cpu().numpy()
            entries = all_entries(normal, ids, list(network.sizes), strength, network.channels)
            values = solve(normal.gram, entries, ridge=self._options.ridge)
            joint = entries.activation // network.channels
            order = np.lexsort((entries.activation, entries.vertex, joint))
            found = torch.as_tensor(values[order]).view_as(network.second).to(network.second)
            network.second.copy_(found / network.strength[:, None, None])

    def run(self, *, state: Path, key: str, resume: bool, progress: Progress) -> None:
        """Train to the end; the network holds the best weights afterwards.

        Args:
            state: file that holds everything between batches; removed at the end.
            key: identifies the run; a state of another run is not taken up.
            resume: go on from `state`; the result equals that of an uninterrupted run to the last bit.
            progress: shows the epochs.
        """
        found = resume and self._restore(state, key)
        self.processes.wait()  # all have read the state before it is written again
        if not found:
            self.warm_start()
        self.processes.spread(self.network.parameters())
        for epoch in progress(range(self._state.epoch, self._options.epochs), self._state.epoch):
            if self._state.epoch - self._state.best_epoch >= self._options.patience:
                break
            self._history_line(epoch, self._epoch(epoch, lambda: self._save(state, key)))
            self._save(state, key)
        self.network.load_state_dict(self._best)
        self.processes.wait()
        state.unlink(missing_ok=True)

    def _epoch(self, epoch: int, save: Callable[[], None]) -> float:
        """What is left of one pass over the training poses; the root mean square error [mm] on the way."""
        options, state = self._options, self._state
        rate = options.rate * 0.5 * (1 + math.cos(math.pi * epoch / options.epochs))
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        share = options.batch // self.processes.count
        part = slice(self.processes.rank * share, (self.processes.rank + 1) * share)
        squared = torch.zeros((), dtype=torch.float64, device=self._device)
        random = np.random.default_rng([options.seed, epoch])
        batches = self._store.batches(
            self._train, options.batch, random, self._vertices, mirrored=options.mirror
        )
        for batch in itertools.islice(batches, state.batch, None):
            seen, wanted = self._tensors(batch.part(part))
            error = _MM2_PER_CM2 * (self.network(seen) - wanted).square().sum(-1).mean()
            length = self.network.masked_second().square().sum(-1).add(1e-12).sqrt().mean()
            self._optimiser.zero_grad(set_to_none=True)
            (error + options.sparsity * length).backward()
            self.processes.average(self.network.parameters())
            self._optimiser.step()
            squared += error.detach()
            state.batch += 1
            if state.batch % options.save_every == 0:
                state.squared += float(self.processes.total(squared.cpu()))
                squared.zero_()
                save()
        state.squared += float(self.processes.total(squared.cpu()))
        mean = state.squared / self.processes.count / max(state.batch, 1)
        state.squared, state.batch = 0.0, 0
        return math.sqrt(mean)

    def _history_line(self, epoch: int, train: float) -> None:
        share, left = self.validate()
        state = self._state
        line = Epoch(epoch=epoch, train_mm=train, validation_mm=left, reduction=share)
        state.history.append(line)
        state.epoch = epoch + 1
        if left < state.best:
            state.best, state.best_epoch, self._best = left, epoch + 1, _copied(self.network)
        if self.processes.rank == 0:
            _log.info(
                "epoch %d: training %.3f mm, validation %.3f mm, reduction %.1f %%",
                epoch + 1, train, left, 100 * share,
            )  # fmt: skip

    @torch.no_grad()
    def validate(self) -> tuple[float, float]:
        """See :func:`reduction`, on the validation clips."""
        pairs = (
            (self.network(seen) / _CM_PER_M, wanted / _CM_PER_M)
            for seen, wanted in self._share(self._validation)
        )
        return reduction(pairs, self.processes)

    def _share(self, clips: Sequence[Taught], *, mirrored: bool = False) -> Iterator[tuple[Tensor, Tensor]]:
        """Features and offsets [cm] of this process's share of the clips, clip by clip."""
        for clip in clips[self.processes.rank :: self.processes.count]:
            yield self._tensors(self._store.read(clip, self._vertices, mirrored=mirrored))

    def _tensors(self, batch: Batch) -> tuple[Tensor, Tensor]:
        return batch.features.to(self._device), _CM_PER_M * batch.offsets.to(self._device)

    def _save(self, path: Path, key: str) -> None:
        if self.processes.rank > 0:
            return
        content: dict[str, Any] = {
            "key": key,
            "state": asdict(self._state),
            "network": self.network.state_dict(),
            "best": self._best,
            "optimiser": self._optimiser.state_dict(),
        }
        write_tensors(path, content)

    def _restore(self, path: Path, key: str) -> bool:
        if not path.is_file():
            return False
        # Sizes are checked before torch takes memory for them.
        read_tensor_archive(path, fix="Delete it to start over.", sparse=StoredMatrix.csr)
        content = torch.load(path, weights_only=True, map_location=self._device)
        if content["key"] != key:
            _log.warning("the state at %s belongs to another configuration; starting over", path)
            return False
        self.network.load_state_dict(content["network"])
        self._optimiser.load_state_dict(content["optimiser"])
        self._state, self._best = _State(**content["state"]), content["best"]
        _log.info("going on after epoch %d and %d batches", self._state.epoch, self._state.batch)
        return True


def _copied(network: torch.nn.Module) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in network.state_dict().items()}
