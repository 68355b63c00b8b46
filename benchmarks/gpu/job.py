"""Describes the job of a measurement, and how it keeps time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from folder import read, write
from sizes import Sizes

SECTIONS = ("doctor", "equal", "sensor", "render", "steps", "train", "restore", "learn")
# what a quarter of an hour measures, in order of worth: section, name, and the seconds that it may take; None: the rest
QUARTER: tuple[tuple[str, str, float | None], ...] = (
    ("doctor", "machine", 30),
    ("equal", "codes", 30),
    ("equal", "merge", 20),
    ("equal", "classical", 30),
    ("equal", "windows", 20),
    ("equal", "network", 20),
    ("sensor", "torch-cuda", 20),
    ("sensor", "device-cuda", 30),
    ("restore", "mergenet-float32", 40),
    ("restore", "qbp-bm3d", 40),
    ("render", "frame-cuda-fence", 40),
    ("steps", "windows", 60),
    ("steps", "batches-21-bfloat16", 60),
    ("learn", "quiver-s", None),
)
QUARTER_MINUTES = 13.0
SAVING = 20.0  # s before the end of its time at which a resumable measurement stops, at most a fifth of it
MARGIN = 1.25  # times its longest part: the time that a resumable measurement needs for another


class Absent(Exception):
    """A measurement is not possible on this machine, or lacks one that has another state; the message states why."""

    def __init__(self, why: str, state: str = "absent") -> None:
        super().__init__(why)
        self.state = state


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
    record: dict[str, Any]  # what its record holds beside the result
    stopped: bool = False  # the time was too short: the next piece resumes
    last: float = field(default_factory=time.monotonic)  # when its last part ended; at first when it began
    longest: float | None = None  # s, of its parts

    @classmethod
    def of(cls, told: dict[str, Any]) -> Job:
        """Return the job that the parent wrote."""
        sizes = Sizes(**told["sizes"])
        paths = (Path(told["out"]), Path(told["result"]))
        return cls(told["section"], told["name"], *paths, sizes, told["seconds"], told["end"], told["record"])

    def is_over(self) -> bool:
        """Return, at the end of each part of a resumable measurement, whether it should stop now, and note it.

        It stops when another part as long as the longest may not fit. From the first part on its record is unfinished,
        with the rows of an earlier piece, so that the next piece continues it also after a kill.
        """
        if self.longest is None:
            earlier = (read(self.result) or {}).get("rows")
            write(self.result, self.record | {"state": "unfinished", "rows": earlier or []})
        now = time.monotonic()
        self.longest = max(self.longest or 0.0, now - self.last)
        self.last = now
        self.stopped = now > self.end - max(min(SAVING, self.seconds / 5), MARGIN * self.longest)
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
