"""Chooses how many threads torch uses, by one measurement per process.

Two threads on busy cores can be many times slower than one.

    the given number, else that of the resumed run, else the faster of one thread and of all, by a small convolution

OpenMP's threads wait for each other by spinning, unless OMP_WAIT_POLICY is set before torch is loaded. On a core that
another process needs, each wait then lasts until the scheduler intervenes. So commands set it to PASSIVE.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from qsim.files import read_json

SECONDS = 0.15  # limit of the measurement, after one call of each number


@dataclass(frozen=True)
class Threads:
    """A number of threads and the reason for it."""

    number: int
    reason: str

    def __str__(self) -> str:
        return f"{self.number} of {cores()} ({self.reason})"


def cores() -> int:
    """Return the processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def wait_without_spinning() -> None:
    """Make OpenMP's threads sleep while they wait. Call it before torch is imported; a user's setting stays.

    NumPy's BLAS gets one thread: its products are small here, and its threads spin too.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def use(wanted: int | None = None, earlier: int | None = None) -> Threads:
    """Set torch's number of threads: `wanted`, else that of an `earlier` part of the work, else the measured one.

    `ValueError` if fewer than 1 or more than the machine's cores are wanted.
    """
    check(wanted)
    import torch

    if wanted is not None:
        chosen = Threads(wanted, "as asked for")
    elif earlier is not None:
        chosen = Threads(max(1, min(earlier, cores())), "as this work began")
    else:
        chosen = measured()
    torch.set_num_threads(chosen.number)
    return chosen


def current() -> int:
    """Return torch's number of threads."""
    import torch

    return torch.get_num_threads()


def recorded(path: Path) -> int | None:
    """Return the number of threads in a description or journal; None without a valid one."""
    try:
        found = read_json(path).get("threads")
    except (OSError, ValueError):  # the reader of the file reports what is wrong with it
        return None
    return found if isinstance(found, int) and not isinstance(found, bool) and found >= 1 else None


def check(wanted: int | None) -> None:
    """Raise `ValueError` unless the machine has this many cores; None is allowed."""
    if wanted is not None and not 1 <= wanted <= cores():
        raise ValueError(f"threads={wanted}: this machine has {cores()} cores; give 1 to {cores()}")


@cache
def measured() -> Threads:
    """Return the faster of one thread and of all that torch would take, by the time of a small convolution."""
    import torch

    most = min(torch.get_num_threads(), cores())
    if most == 1:
        return Threads(1, "torch was given no more")
    x = torch.ones(1, 32, 64, 64)
    kernel = torch.ones(32, 32, 3, 3)

    def seconds(number: int) -> float:
        torch.set_num_threads(number)
        started = time.perf_counter()
        torch.nn.functional.conv2d(x, kernel, padding=1)
        return time.perf_counter() - started

    numbers = (1, most)
    for number in numbers:
        seconds(number)  # starts the threads
    end = time.perf_counter() + SECONDS
    spent: list[list[float]] = []
    while not spent or time.perf_counter() < end:
        spent.append([seconds(number) for number in numbers])
    mean = [sum(column) / len(spent) for column in zip(*spent, strict=True)]
    times = ", ".join(f"{1e3 * time_:.2g} ms with {number}" for number, time_ in zip(numbers, mean, strict=True))
    return Threads(numbers[mean.index(min(mean))], f"measured: {times}")
