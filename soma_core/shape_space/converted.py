"""Bodies of converted motions, from Parquet shards: each one once, however many clips it has."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from soma_core.correctives.processes import Processes
from soma_core.errors import InputError
from soma_core.layer import SomaLayer
from soma_core.motion.clip_stream import ClipStream
from soma_core.motion.identities import stored_identity
from soma_core.progress import progress
from soma_core.shape_space.sampling import HELD_OUT, standing

__all__ = ["ConvertedBodies"]

_IDENTITY = ("identity_model_type", "identity_options", "identity_params", "identity_rest")

LayerMaker = Callable[[str, Mapping[str, Any] | None], SomaLayer]


class ConvertedBodies:
    """The bodies of shards, some of them held out, in an order drawn from a seed.

    The rows are looked through once, each process its share; what is kept of a body is a number. Shapes are
    made when they are asked for.

    Args:
        shards: folders and files; see :class:`ClipStream`.
        held_out: bodies that are not trained on.
        most: bodies to train on at most.
        batch_sizes: of a number of bodies, sizes of the batches.
        layer: makes the layer of a backend with its options, at the mid LOD.
        seed: of the order and of what is held out.
        processes: of this run.

    Raises:
        InputError: no shards, or fewer bodies than are held out.

    Attributes:
        key: changes with the shards.
        count: bodies that are trained on.
        origins: ``backend``, ``licence`` and number of the bodies, for a file that says so.
    """

    def __init__(
        self,
        shards: Sequence[str],
        *,
        held_out: int,
        most: int,
        batch_sizes: Callable[[int], Sequence[int]],
        layer: LayerMaker,
        seed: int,
        processes: Processes,
    ) -> None:
        rows = ClipStream(shards, [*_IDENTITY, "licence"], seed=None, setting="shards")
        found = _distinct(rows.share(processes.rank, processes.count))
        bodies: dict[bytes, tuple[int, str, str]] = {}
        for part in processes.gathered(found):
            bodies = part | bodies  # the first clip of a body stands for it
        if len(bodies) <= held_out:
            raise InputError(
                "held_out", got=f"{held_out} of {len(bodies)} bodies in {', '.join(shards)}",
                expected="fewer than there are", fix="Lower held_out, or name more shards.",
            )  # fmt: skip
        ids = np.array(sorted(row for row, *_ in bodies.values()))
        drawn = np.random.default_rng([seed, HELD_OUT]).permutation(ids)
        stream = ClipStream(shards, _IDENTITY, seed=seed, setting="shards")
        self._held_out, self._training = stream.of(drawn[:held_out]), stream.of(drawn[held_out:])
        self.key, self.count = stream.key, min(most, len(ids) - held_out)
        self._starts = np.cumsum([0, *batch_sizes(self.count)])
        self.origins = _counted(bodies.values())
        self._make, self._layers = layer, dict[tuple[str, str], SomaLayer]()

    @torch.no_grad()
    def shapes(self, stream: int, batch: int, count: int) -> np.ndarray:
        """See :class:`~soma_core.shape_space.sampling.ShapeStream`."""
        start = 0 if stream == HELD_OUT else int(self._starts[batch])
        rows = self._held_out if stream == HELD_OUT else self._training
        return standing(np.stack([self._rest(row) for row in rows.part(start, start + count)]))

    def _rest(self, row: Mapping[str, Any]) -> np.ndarray:
        """The rest shape (v, 3) [m] of a row's body."""
        kind = row["identity_model_type"], row.get("identity_options", "{}")
        if kind not in self._layers:
            # Whether a model file is trusted, and so may run code, is no stranger's to say.
            options = {key: value for key, value in json.loads(kind[1]).items() if key != "trust"}
            self._layers[kind] = self._make(kind[0], options or None)
        stored = {"params": json.loads(row.get("identity_params", "{}")), "rest": row.get("identity_rest")}
        rest: np.ndarray = stored_identity(self._layers[kind], stored).rest[0].cpu().numpy()
        return rest


def _distinct(rows: ClipStream) -> dict[bytes, tuple[int, str, str]]:
    """Digest of a body -> row of its first clip, backend and licence."""
    found: dict[bytes, tuple[int, str, str]] = {}
    for row in progress(rows, label="looking for bodies, clip", total=len(rows), after=5.0):
        if not row.get("identity_model_type") or not ("identity_params" in row or "identity_rest" in row):
            continue
        digest = hashlib.blake2b(digest_size=16)
        for name in _IDENTITY:
            value = row.get(name, "")
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else f"{name} {value}".encode())
        body = row["row"], row["identity_model_type"], row.get("licence", "")
        found.setdefault(digest.digest(), body)
    return found


def _counted(bodies: Iterable[tuple[int, str, str]]) -> list[dict[str, Any]]:
    """Backends and licences of bodies, with how many there are of each."""
    kinds = Counter((backend, licence) for _, backend, licence in bodies)
    return [
        {"backend": backend, "licence": licence, "bodies": count}
        for (backend, licence), count in sorted(kinds.items())
    ]
