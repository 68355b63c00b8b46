"""What a recipe will cost: one tiny job of each kind is rendered here, and the whole is multiplied out.

A kind is a family with its render settings. Of each, a job's scene is loaded, its budget chosen, and a few frames are
rendered, sensed and stored in a temporary folder. Scenes of one family differ, some in samples per pixel by ten times:
the budgets of a few more jobs are chosen too, and a frame of theirs is taken to cost as much more as its samples say.
Both clocks are read: wall time is what to wait for on a machine as busy as it is now, processor time is what the work
needs, and what a real run can fairly be compared with (every job's log says both).
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from qsim.clip.clip import Clip
from qsim.clip.sensing import sense
from qsim.dataset import job_runner
from qsim.dataset.job import Job
from qsim.dataset.recipe import Recipe
from qsim.dataset.worker_pool import Limits
from qsim.files import Progress
from qsim.process import peak_memory
from qsim.rendering.budget import Budget
from qsim.rendering.denoiser import DENOISE_COST
from qsim.tables import text_table

START = 3.0  # s, a fresh worker process with its renderer; measured on two cores, shared by Limits.jobs jobs
LOOKED_AT = 5  # jobs of a kind whose budgets are chosen, at most


class Seconds(NamedTuple):
    """The same work on two clocks."""

    wall: float
    processor: float  # of all threads

    @staticmethod
    def now() -> Seconds:
        return Seconds(time.perf_counter(), time.process_time())

    def since(self, before: Seconds) -> Seconds:
        return Seconds(self.wall - before.wall, self.processor - before.processor)


@dataclass(frozen=True)
class Cost:
    """What one kind of job was measured to cost, and how often it is asked for."""

    family: str
    size: tuple[int, int]  # height, width
    clips: int
    frames: int  # of all clips together
    setup: Seconds  # per clip: scene, budget, first frame's compilation
    samples: tuple[int, int]  # per pixel, the fewest and the most of the budgets that were looked at
    per_frame: Seconds  # rendering and storing, the mean of those
    sensing: Seconds  # per frame, all streams
    frame_bytes: float  # of radiance, truth and streams

    @property
    def seconds(self) -> Seconds:
        """Of all clips together."""
        wall, processor = (
            self.clips * setup + self.frames * (per_frame + sensing)
            for setup, per_frame, sensing in zip(self.setup, self.per_frame, self.sensing, strict=True)
        )
        return Seconds(wall, processor)

    @property
    def hours(self) -> float:
        return self.seconds.wall / 3600

    @property
    def gigabytes(self) -> float:
        return self.frames * self.frame_bytes / 1e9


@dataclass(frozen=True)
class Forecast:
    """A forecast for this machine, one worker process."""

    costs: tuple[Cost, ...]
    engine: str  # what rendered here
    peak_memory: float  # GiB of one worker

    @property
    def starts(self) -> float:
        """Seconds that starting worker processes takes, on either clock."""
        return START * sum(cost.clips for cost in self.costs) / Limits().jobs

    @property
    def hours(self) -> float:
        return (sum(cost.seconds.wall for cost in self.costs) + self.starts) / 3600

    @property
    def processor_hours(self) -> float:
        return (sum(cost.seconds.processor for cost in self.costs) + self.starts) / 3600

    @property
    def gigabytes(self) -> float:
        return sum(cost.gigabytes for cost in self.costs)

    def to_dict(self) -> dict[str, Any]:
        """For --json."""
        rows = []
        for cost in self.costs:
            clocks = ("setup", "per_frame", "sensing")
            row = {key: value for key, value in vars(cost).items() if key not in clocks}
            row |= {f"{key}_seconds": getattr(cost, key)._asdict() for key in clocks}
            rows.append(row | {"hours": cost.hours, "gigabytes": cost.gigabytes})
        totals = {"hours": self.hours, "processor_hours": self.processor_hours, "gigabytes": self.gigabytes}
        return totals | {"peak_memory_gib": self.peak_memory, "engine": self.engine, "kinds": rows}

    def lines(self, machines: int) -> list[str]:
        """The forecast as text."""
        header = ("family", "size", "clips", "frames", "samples", "s/clip", "s/frame", "hours", "GB")
        rows = [
            (
                cost.family,
                f"{cost.size[0]} x {cost.size[1]}",
                f"{cost.clips}",
                f"{cost.frames}",
                "-".join(str(n) for n in sorted(set(cost.samples))),
                f"{cost.setup.wall:.2f}",
                f"{cost.per_frame.wall + cost.sensing.wall:.3f}",
                f"{cost.hours:.3f}",
                f"{cost.gigabytes:.3f}",
            )
            for cost in self.costs
        ]
        day = max(1, math.ceil(self.hours / 24))
        faster = f", or one that is {self.hours / 24:.2g} times as fast" if day > 1 else ""
        return [
            *text_table(rows, header),
            f"in all: {self.hours:.3g} hours on this machine ({self.engine}, one worker; "
            f"{self.processor_hours:.3g} hours of processor time), {self.gigabytes:.3g} GB, "
            f"{self.peak_memory:.2g} GiB of memory per worker",
            f"{_machines(machines)} like this: {self.hours / machines:.3g} hours{' each' if machines > 1 else ''}"
            + (", by --shard or --cluster" if machines > 1 else ""),
            f"within a day: {_machines(day)} like this{faster}"
            + ("" if "cuda" in self.engine else "; run this command on a machine with a GPU to have that measured"),
        ]


def _machines(count: int) -> str:
    return f"{count} machine{'' if count == 1 else 's'}"


def forecast(recipe: Recipe, *, frames: int = 5, progress: Progress | None = None) -> Forecast:
    """Measure one job of each kind with so many frames (at least 2: the first one compiles)."""
    from qsim import backend

    if frames < 2:
        raise ValueError(f"plan: at least 2 frames are needed to tell the first from the others, got {frames}")
    kinds: dict[tuple[Any, ...], list[Job]] = {}
    for job in recipe.jobs:
        kinds.setdefault((job.family, job.settings, job.streams), []).append(job)
    costs = []
    with tempfile.TemporaryDirectory(prefix="qsim-plan-") as folder:
        for n, members in enumerate(kinds.values(), 1):
            costs.append(measure_kind(members, Path(folder) / f"kind{n}", frames))
            if progress is not None:
                progress(n, len(kinds))
    chosen = backend.choose()
    return Forecast(tuple(costs), f"{chosen.backend}, {chosen.variant}", peak_memory() / 2**30)


def measure_kind(members: list[Job], folder: Path, frames: int) -> Cost:
    """Every job is met for the first time, as in a run: a scene has kernels of its own, which its pilot compiles."""
    looked_at = evenly_spaced(members)
    budgets, choosing = zip(*map(_budget, looked_at), strict=True)
    work = [_work(budget) for budget in budgets]
    typical = Seconds(*map(median, zip(*choosing, strict=True)))  # the first of a process also imports
    middle = len(looked_at) // 2
    job = looked_at[middle]
    settings = job.settings
    started = Seconds.now()
    clip, moments = render_first_frames(job, budgets[middle], folder, min(frames, settings.frames))
    # The first frame carries scene and compilation; the others are what each further frame costs.
    first, more = moments[0].since(started), moments[-1].since(moments[0])
    if len(moments) > 1:
        per_frame = Seconds(*(seconds / (len(moments) - 1) for seconds in more))
        setup = Seconds(*(a + max(0.0, b) for a, b in zip(typical, first.since(per_frame), strict=True)))
    else:
        per_frame, setup = first, typical
    dearer = sum(work) / len(work) / work[middle]
    sensing, codes = sense_streams(job, clip)
    stored = sum(file.stat().st_size for file in clip.path.rglob("*.exr")) / len(clip)
    return Cost(
        family=Path(job.family).stem,
        size=(settings.height, settings.width),
        clips=len(members),
        frames=len(members) * settings.frames,
        setup=setup,
        samples=(min(budget.samples for budget in budgets), max(budget.samples for budget in budgets)),
        per_frame=Seconds(*(dearer * seconds for seconds in per_frame)),
        sensing=sensing,
        frame_bytes=stored + codes,
    )


def evenly_spaced(members: list[Job]) -> list[Job]:
    """At most LOOKED_AT of them, evenly spaced, from the first to the last."""
    count = min(LOOKED_AT, len(members))
    return [members[round(i * (len(members) - 1) / max(1, count - 1))] for i in range(count)]


def _budget(job: Job) -> tuple[Budget, Seconds]:
    """A job's budget, and what its choice took."""
    scene, started = job_runner.load_scene(job), Seconds.now()
    return job_runner.choose_budget(job, scene), Seconds.now().since(started)


def _work(budget: Budget) -> float:
    """What a frame costs, in samples per pixel: nearly everything else that a frame needs is small beside them."""
    return budget.samples + (DENOISE_COST if budget.denoise else 0.0)


def render_first_frames(job: Job, budget: Budget, path: Path, frames: int) -> tuple[Clip, list[Seconds]]:
    """The first frames of a job's clip, and when each was done."""
    from qsim.rendering.clip_rendering import render_clip

    settings = job.settings
    moments: list[Seconds] = []
    clip = render_clip(
        job_runner.load_scene(job),
        path,
        frames=frames,
        frame_rate=settings.frame_rate,
        shutter=settings.shutter,
        seed=job_runner.render_seed(job),
        budget=budget,
        progress=lambda done, total: moments.append(Seconds.now()),
    )
    return clip, moments


def sense_streams(job: Job, clip: Clip) -> tuple[Seconds, float]:
    """Seconds and bytes per frame of all streams together; the second drawing counts, the first one compiles."""
    wall = processor = size = 0.0
    for sensing in job.streams:
        sense(clip, sensing)
        started = Seconds.now()
        drawn, _ = sense(clip, sensing, force=True)
        spent = Seconds.now().since(started)
        wall, processor = wall + spent.wall, processor + spent.processor
        size += drawn.path.stat().st_size
    return Seconds(wall / len(clip), processor / len(clip)), size / len(clip)
