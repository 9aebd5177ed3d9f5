"""One process or several: what ``torchrun`` started works on shares of every batch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor

__all__ = ["Processes", "joined_processes"]


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

    def wrapped(self, module: torch.nn.Module) -> torch.nn.Module:
        """The module, averaging gradients where there are several processes."""
        return torch.nn.parallel.DistributedDataParallel(module) if self.count > 1 else module


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
