"""One process or several: what ``torchrun`` started works on shares of every batch."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar, cast

import torch
import torch.distributed as dist
from torch import Tensor

__all__ = ["Processes", "joined_processes"]

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Processes:
    """Place of this process among those of a run.

    Attributes:
        rank: 0 is the one that writes.
        count: number of processes.
    """

    rank: int = 0
    count: int = 1

    def total(self, values: Tensor) -> Tensor:
        """Sum of a tensor over all processes."""
        if self.count > 1:
            dist.all_reduce(values)
        return values

    def wait(self) -> None:
        """Until all are here."""
        if self.count > 1:
            dist.barrier()

    def average(self, parameters: Iterable[torch.nn.Parameter]) -> None:
        """Set gradients to their mean over all processes.

        Not by ``DistributedDataParallel``, which packs them in another way after its first step: a run that
        goes on would add up in another order.
        """
        for parameter in parameters if self.count > 1 else ():
            assert parameter.grad is not None
            self.total(parameter.grad)
            parameter.grad /= self.count

    def spread(self, parameters: Iterable[torch.nn.Parameter]) -> None:
        """Give all processes the numbers of the first."""
        for parameter in parameters if self.count > 1 else ():
            dist.broadcast(parameter.data, 0)

    def gathered(self, value: T) -> list[T]:
        """What every process has, in the order of their ranks."""
        found: list[T | None] = [value] * self.count
        if self.count > 1:
            dist.all_gather_object(found, value)
        return cast(list[T], found)

    def brought(self, values: Tensor | None, shape: Sequence[int], *, rank: int) -> Tensor | None:
        """Bring float64 `values` of one process to the first; None on the others."""
        if rank == 0:
            return values if self.rank == 0 else None
        if self.rank == rank:
            assert values is not None
            dist.send(values.contiguous(), 0)
        if self.rank > 0:
            return None
        found = torch.empty(*shape, dtype=torch.float64)
        dist.recv(found, rank)
        return found


@contextmanager
def joined_processes(device: str) -> Iterator[Processes]:
    """Join the process group that the environment of ``torchrun`` describes; alone without one."""
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Processes()
        return
    dist.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    try:
        yield Processes(rank=dist.get_rank(), count=count)
    finally:
        dist.destroy_process_group()
