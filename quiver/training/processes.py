"""Joins the processes of a run: those of `torchrun`, which share its steps, and workers, which draw samples."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass

import torch

from quiver.device import device_of_process, group_backend


@dataclass(frozen=True)
class Process:
    """Rank and device of this process among those of torchrun."""

    rank: int
    world: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """Return whether this process writes files and shows progress."""
        return self.rank == 0

    def wait(self) -> None:
        """Wait for all processes."""
        if self.world > 1:
            torch.distributed.barrier()

    def from_leader(self, number: float) -> float:
        """Return the leader's number in every process."""
        if self.world == 1:
            return number
        value = torch.tensor(number, dtype=torch.float64)  # on the host, so that nobody waits for a GPU
        torch.distributed.broadcast(value, 0)
        return float(value)

    def any(self, condition: bool) -> bool:
        """Return in every process whether the condition holds in any of them."""
        if self.world == 1:
            return condition
        flag = torch.tensor(float(condition))
        torch.distributed.all_reduce(flag, torch.distributed.ReduceOp.MAX)
        return bool(flag)


@contextlib.contextmanager
def joined(device: str) -> Iterator[Process]:
    """Join the process group if torchrun started this process, and leave it at the end."""
    rank = int(os.environ.get("RANK", 0))
    world = int(os.environ.get("WORLD_SIZE", 1))
    if world > 1:
        torch.distributed.init_process_group(group_backend(device))
    try:
        yield Process(rank, world, device_of_process(device))
    finally:
        if world > 1:
            torch.distributed.destroy_process_group()


# Workers


def begin_worker(number: int) -> None:
    """Ignore Ctrl-C and termination in a worker, which job managers send to all processes of a run.

    The process that trains ends after its step, saves, and stops its workers.
    """
    for number_of_signal in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number_of_signal, signal.SIG_IGN)


@contextlib.contextmanager
def plain_errors() -> Iterator[None]:
    """Raise the error of a worker with its own message, to which torch adds the traceback of the worker."""
    try:
        yield
    except (ValueError, OSError, MemoryError) as error:
        first, _, rest = str(error).strip().partition("\n")
        if "in DataLoader worker process" not in first:
            raise
        last = rest.rpartition("\n")[2]  # as in `ValueError: clip fan_0003: ...`
        raise type(error)(last.partition(": ")[2] or last) from error
