"""Describes the job of a measurement, and how it keeps time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from sizes import Sizes

SECTIONS = ("doctor", "sensor", "render", "train", "restore")
SAVING = 20.0  # s before the end of its time at which a resumable measurement stops, at most a fifth of it


class Absent(Exception):
    """A measurement is not possible on this machine; the message states why."""


@dataclass
class Job:
    """One measurement: where it writes, how large it is, and when it should stop."""

    section: str
    name: str
    out: Path
    result: Path
    sizes: Sizes
    seconds: float  # that it may take
    end: float  # of these, on the clock of `time.monotonic`, which all processes share
    stopped: bool = False  # the time was too short: the next piece resumes

    @classmethod
    def of(cls, told: dict[str, Any]) -> Job:
        """Return the job that the parent wrote."""
        sizes = Sizes(**told["sizes"])
        return cls(
            told["section"], told["name"], Path(told["out"]), Path(told["result"]), sizes, told["seconds"], told["end"]
        )

    def is_over(self) -> bool:
        """Return whether a resumable measurement should stop now, and note it."""
        self.stopped = time.monotonic() > self.end - min(SAVING, self.seconds / 5)
        return self.stopped


def median_seconds(work: Callable[[], object], rounds: int, finish: Callable[[], object] = lambda: None) -> float:
    """Return the median time of a function after one warm-up; `finish` waits for the device."""
    times = []
    for _ in range(rounds + 1):
        finish()
        started = time.perf_counter()
        work()
        finish()
        times.append(time.perf_counter() - started)
    return median(times[1:])
