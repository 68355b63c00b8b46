"""Forecasts the cost of a recipe: measures a few frames of each kind of job and multiplies.

A kind is a family with its render settings. For one job of each kind the budget is chosen, and a few frames are
rendered, sensed and stored in a temporary folder. Scenes of one family differ by up to ten times in samples per pixel.
The budgets of a few more jobs are therefore chosen too, and the time of a frame is scaled by its samples.
Two clocks are read. Wall time is the time to wait on a machine as busy as now. Processor time can be compared with a
real run, whose logs hold both.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from qsim.backend import on_gpu
from qsim.dataset import job_runner
from qsim.dataset.job import Job
from qsim.dataset.jobs import Jobs
from qsim.dataset.recipe import Recipe
from qsim.dataset.worker_pool import Limits
from qsim.files import Progress
from qsim.process import peak_memory
from qsim.rendering.budget import Budget, deciding
from qsim.rendering.reuse.sharing import Sharing
from qsim.streams.clip import Clip
from qsim.streams.sensing import frames_needed
from qsim.streams.storing import sense
from qsim.tables import text_table

START = 3.0  # s, start of a worker process with its renderer, once per Limits.jobs jobs; measured on two cores
LOOKED_AT = 5  # largest number of jobs of a kind whose budgets are chosen


class Seconds(NamedTuple):
    """Time of the same work on two clocks [s]."""

    wall: float
    processor: float  # of all threads

    @staticmethod
    def now() -> Seconds:
        """Return the reading of both clocks."""
        return Seconds(time.perf_counter(), time.process_time())

    def since(self, before: Seconds) -> Seconds:
        """Return the time between two readings."""
        return Seconds(self.wall - before.wall, self.processor - before.processor)


@dataclass(frozen=True)
class Cost:
    """Measured cost of one kind of job, and the number of its clips and frames."""

    family: str
    size: tuple[int, int]  # height, width
    clips: int
    frames: int  # of all clips together
    setup: Seconds  # per clip: scene, budget, compilation with the first frame
    samples: tuple[int, int]  # per pixel, the fewest and the most of the chosen budgets
    per_frame: Seconds  # rendering and storing, mean over the chosen budgets
    sensing: Seconds  # per frame, all streams
    frame_bytes: float  # radiance, ground truth and streams [bytes]
    neighbours: tuple[int, int] = (0, 0)  # frames on each side that share samples, the fewest and the most
    planes: int = 1  # frames that share the noise of a code
    limits: tuple[str, ...] = ()  # "40 dB", "7 PPP": which of the two decided the samples of the chosen budgets

    @property
    def seconds(self) -> Seconds:
        """Return the time of all clips together."""
        wall, processor = (
            self.clips * setup + self.frames * (per_frame + sensing)
            for setup, per_frame, sensing in zip(self.setup, self.per_frame, self.sensing, strict=True)
        )
        return Seconds(wall, processor)

    @property
    def hours(self) -> float:
        """Return the wall time of all clips together [h]."""
        return self.seconds.wall / 3600

    @property
    def gigabytes(self) -> float:
        """Return the size of all clips together [GB]."""
        return self.frames * self.frame_bytes / 1e9


@dataclass(frozen=True)
class Forecast:
    """Forecast for this machine and one worker process."""

    costs: tuple[Cost, ...]
    engine: str  # backend and variant that rendered
    peak_memory: float  # GiB of one worker

    @property
    def starts(self) -> float:
        """Return the time that starting worker processes takes, on either clock [s]."""
        return START * sum(cost.clips for cost in self.costs) / Limits().jobs

    @property
    def hours(self) -> float:
        """Return the wall time of everything [h]."""
        return (sum(cost.seconds.wall for cost in self.costs) + self.starts) / 3600

    @property
    def processor_hours(self) -> float:
        """Return the processor time of everything [h]."""
        return (sum(cost.seconds.processor for cost in self.costs) + self.starts) / 3600

    @property
    def gigabytes(self) -> float:
        """Return the size of everything [GB]."""
        return sum(cost.gigabytes for cost in self.costs)

    def to_dict(self) -> dict[str, object]:
        """Return the forecast for --json."""
        rows = []
        for cost in self.costs:
            clocks = ("setup", "per_frame", "sensing")
            row = {key: value for key, value in vars(cost).items() if key not in clocks}
            row |= {f"{key}_seconds": getattr(cost, key)._asdict() for key in clocks}
            rows.append(row | {"hours": cost.hours, "gigabytes": cost.gigabytes})
        totals = {"hours": self.hours, "processor_hours": self.processor_hours, "gigabytes": self.gigabytes}
        return totals | {"peak_memory_gib": self.peak_memory, "engine": self.engine, "kinds": rows}

    def busy(self, machines: int) -> int:
        """Return how many of these machines have work: a clip is made by one machine."""
        return max(1, min(machines, sum(cost.clips for cost in self.costs)))

    def hours_each(self, machines: int) -> float:
        """Return the hours of each of these machines, at least those of the longest clip."""
        longest = max((cost.hours / cost.clips for cost in self.costs), default=0.0)
        return max(self.hours / self.busy(machines), longest)

    def lines(self, machines: int) -> list[str]:
        """Return the forecast as lines of text, for this many equal machines."""
        header = (
            "family",
            "size",
            "clips",
            "frames",
            "samples",
            "limit",
            "neighbours",
            "s/clip",
            "s/frame",
            "hours",
            "GB",
        )
        rows = [
            (
                cost.family,
                f"{cost.size[0]} x {cost.size[1]}",
                f"{cost.clips}",
                f"{cost.frames}",
                "-".join(str(n) for n in sorted(set(cost.samples))),
                " or ".join(cost.limits),
                "-".join(str(n) for n in sorted(set(cost.neighbours))),
                f"{cost.setup.wall:.2f}",
                f"{cost.per_frame.wall + cost.sensing.wall:.3f}",
                f"{cost.hours:.3f}",
                f"{cost.gigabytes:.3f}",
            )
            for cost in self.costs
        ]
        clips = sum(cost.clips for cost in self.costs)
        busy = self.busy(machines)
        each = self.hours_each(machines)
        idle = f"; {busy} of {machines} have work, because a clip is not split" if busy < machines else ""
        day = min(max(1, math.ceil(self.hours / 24)), clips)
        faster = f", or one that is {self.hours / 24:.2g} times as fast" if day > 1 else ""
        return [
            *text_table(rows, header),
            f"in all: {self.hours:.3g} hours on this machine ({self.engine}, one worker; "
            f"{self.processor_hours:.3g} hours of processor time), {self.gigabytes:.3g} GB, "
            f"{self.peak_memory:.2g} GiB of memory per worker",
            f"{_machines(machines)} like this: {each:.3g} hours{' each' if machines > 1 else ''}"
            + (", by shards or a cluster" if machines > 1 else "")
            + idle,
            f"within a day: {_machines(day)} like this{faster}"
            + ("" if on_gpu(self.engine) else "; run this command on a machine with a GPU to have that measured"),
        ]


def _machines(count: int) -> str:
    return f"{count} machine{'' if count == 1 else 's'}"


def forecast(recipe: Recipe, *, frames: int = 5, progress: Progress | None = None) -> Forecast:
    """Measure one job of each kind with `frames` frames, at least 2 because the first one compiles.

    Streams whose codes take more frames are measured with the frames of one code.
    """
    from qsim import backend

    if frames < 2:
        raise ValueError(f"plan: got {frames} frames; at least 2 frames are needed, because the first one compiles")
    kinds = kinds_of(recipe)
    costs = []
    with tempfile.TemporaryDirectory(prefix="qsim-plan-") as folder:
        for n, members in enumerate(kinds, 1):
            costs.append(measure_kind(members, Path(folder) / f"kind{n}", frames))
            if progress is not None:
                progress(n, len(kinds))
    chosen = backend.choose()
    return Forecast(tuple(costs), f"{chosen.backend}, {chosen.variant}", peak_memory() / 2**30)


def kinds_of(recipe: Recipe) -> list[Jobs]:
    """Return the jobs by kind, in the order in which a forecast lists the kinds."""
    kinds: dict[tuple[Any, ...], Jobs] = {}
    for part in recipe.jobs.by_section():
        job = part[0]
        kind = (job.family, job.settings, job.streams)
        kinds[kind] = kinds[kind].together(part) if kind in kinds else part
    return list(kinds.values())


def measure_kind(members: Sequence[Job], folder: Path, frames: int) -> Cost:
    """Measure the cost of a kind from some of its jobs, each met for the first time as in a run.

    Each scene has its own kernels, which its pilot compiles.
    """
    looked_at = evenly_spaced(members)
    budgets, choosing = zip(*map(_budget, looked_at), strict=True)
    size = members[0].settings.size
    work = [Sharing.of(budget).cost(math.prod(size)) for budget in budgets]
    typical = Seconds(*map(median, zip(*choosing, strict=True)))  # the first of a process also imports
    middle = len(looked_at) // 2
    job = looked_at[middle]
    settings = job.settings
    started = Seconds.now()
    a_code = max((frames_needed(stream, *size, settings.frame_rate) for stream in job.streams), default=1)
    shared = budgets[middle].neighbours
    planes = budgets[middle].planes
    clip, moments = render_first_frames(
        job, budgets[middle], folder, min(max(frames, a_code, 2 * shared + 3, 3 * planes), settings.frames)
    )
    setup, per_frame = setup_and_frame([moment.since(started) for moment in moments], shared, planes)
    setup = Seconds(*map(sum, zip(typical, setup, strict=True)))
    dearer = sum(work) / len(work) / work[middle]
    sensing, codes = sense_streams(job, clip)
    stored = sum(file.stat().st_size for file in clip.path.rglob("*.exr")) / len(clip)
    return Cost(
        family=Path(job.family).stem,
        size=size,
        clips=len(members),
        frames=len(members) * settings.frames,
        setup=setup,
        samples=(min(budget.samples for budget in budgets), max(budget.samples for budget in budgets)),
        per_frame=Seconds(*(dearer * seconds for seconds in per_frame)),
        sensing=sensing,
        frame_bytes=stored + codes,
        neighbours=(min(budget.neighbours for budget in budgets), max(budget.neighbours for budget in budgets)),
        planes=planes,
        limits=tuple(sorted({limit for budget in budgets if (limit := deciding(budget.findings))})),
    )


def setup_and_frame(moments: list[Seconds], shared: int, planes: int = 1) -> tuple[Seconds, Seconds]:
    """Return the time of scene and compilation, and that of a further frame, from the time at the end of each frame.

    Where frames share samples with `shared` ones on each side, the first frame also traces those after it, and the last
    ones trace none: a further frame costs what those between them do, if there are two. The `planes` of a code are
    rendered with its first: whole codes are compared.
    """
    if planes > 1 and len(moments) >= 2 * planes:
        ends = moments[planes - 1 :: planes]
        frame = Seconds(*(seconds / (planes * (len(ends) - 1)) for seconds in ends[-1].since(ends[0])))
        whole = planes * len(ends)
        return Seconds(*(max(0.0, a - whole * b) for a, b in zip(ends[-1], frame, strict=True))), frame
    usual = moments[shared : len(moments) - shared]
    usual = usual if len(usual) > 1 else moments
    if len(usual) == 1:
        return Seconds(0.0, 0.0), usual[0]
    frame = Seconds(*(seconds / (len(usual) - 1) for seconds in usual[-1].since(usual[0])))
    return Seconds(*(max(0.0, a - len(moments) * b) for a, b in zip(moments[-1], frame, strict=True))), frame


def evenly_spaced(members: Sequence[Job]) -> list[Job]:
    """Return at most LOOKED_AT jobs, evenly spaced from the first to the last."""
    count = min(LOOKED_AT, len(members))
    return [members[round(i * (len(members) - 1) / max(1, count - 1))] for i in range(count)]


def _budget(job: Job) -> tuple[Budget, Seconds]:
    """Return a job's budget, and the time that its choice took."""
    scene = job_runner.load_scene(job)
    started = Seconds.now()
    return job_runner.choose_budget(job, scene), Seconds.now().since(started)


def render_first_frames(job: Job, budget: Budget, path: Path, frames: int) -> tuple[Clip, list[Seconds]]:
    """Render the first frames of a job's clip; return the clip and the time at the end of each frame."""
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
    """Return the time and the bytes per frame of all streams together; the second draw counts, the first compiles."""
    wall = processor = size = 0.0
    for sensing in job.streams:
        sense(clip, sensing)
        started = Seconds.now()
        drawn, _ = sense(clip, sensing, force=True)
        spent = Seconds.now().since(started)
        wall = wall + spent.wall
        processor = processor + spent.processor
        size += drawn.path.stat().st_size
    return Seconds(wall / len(clip), processor / len(clip)), size / len(clip)
