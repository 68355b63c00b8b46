"""What a recipe will cost: one tiny job of each kind is rendered here, and the whole is multiplied out.

A kind is a family with its render settings. Of each, a job's scene is loaded, its budget chosen, and a few frames are
rendered, sensed and stored in a temporary folder. Scenes of one family differ, and so will the truth: by 30 % or so.
"""

from __future__ import annotations

import itertools
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsim import jobs, stream
from qsim.clip import Clip
from qsim.recipe import Job, Recipe
from qsim.workers import Limits

START = 3.0  # s, a fresh worker process with its renderer; measured on two cores, shared by Limits.jobs jobs


@dataclass(frozen=True)
class Cost:
    """What one kind of job was measured to cost, and how often it is asked for."""

    family: str
    size: tuple[int, int]  # height, width
    clips: int
    frames: int  # of all clips together
    setup: float  # s per clip: scene, budget, first frame's compilation
    per_frame: float  # s, rendering and storing
    sensing: float  # s per frame, all streams
    frame_bytes: float  # of radiance, truth and streams

    @property
    def hours(self) -> float:
        return (self.clips * self.setup + self.frames * (self.per_frame + self.sensing)) / 3600

    @property
    def gigabytes(self) -> float:
        return self.frames * self.frame_bytes / 1e9


@dataclass(frozen=True)
class Plan:
    """A forecast for this machine, one worker process."""

    costs: tuple[Cost, ...]
    engine: str  # what rendered here
    peak_memory: float  # GiB of one worker

    @property
    def hours(self) -> float:
        starts = sum(cost.clips for cost in self.costs) / Limits().jobs
        return sum(cost.hours for cost in self.costs) + START * starts / 3600

    @property
    def gigabytes(self) -> float:
        return sum(cost.gigabytes for cost in self.costs)

    def to_dict(self) -> dict[str, Any]:
        """For --json."""
        rows = [{**vars(cost), "hours": cost.hours, "gigabytes": cost.gigabytes} for cost in self.costs]
        totals = {"hours": self.hours, "gigabytes": self.gigabytes, "peak_memory_gib": self.peak_memory}
        return totals | {"engine": self.engine, "kinds": rows}

    def lines(self, machines: int) -> list[str]:
        """The forecast as text."""
        head = (
            f"{'family':12} {'size':>11} {'clips':>6} {'frames':>7} {'s/clip':>7} {'s/frame':>8} {'hours':>8} {'GB':>8}"
        )
        rows = [
            f"{c.family:12} {c.size[0]:>5} x{c.size[1]:>4} {c.clips:6} {c.frames:7} {c.setup:7.2f} "
            f"{c.per_frame + c.sensing:8.3f} {c.hours:8.3f} {c.gigabytes:8.3f}"
            for c in self.costs
        ]
        day = max(1, -(-self.hours // 24))
        return [
            head,
            *rows,
            f"in all: {self.hours:.3g} hours on this machine ({self.engine}, one worker), {self.gigabytes:.3g} GB, "
            f"{self.peak_memory:.2g} GiB of memory per worker",
            f"{machines} machines like this: {self.hours / machines:.3g} hours each, by --shard or --cluster",
            f"within a day: {day:.0f} machines like this, or one that is {max(1.0, self.hours / 24):.2g} times as fast"
            + ("" if "cuda" in self.engine else "; run this command on a machine with a GPU to have that measured"),
        ]


def plan(recipe: Recipe, *, frames: int = 5, progress: stream.Progress | None = None) -> Plan:
    """Measure one job of each kind with so many frames (at least 2: the first one compiles)."""
    from qsim import engine

    if frames < 2:
        raise ValueError(f"plan: at least 2 frames are needed to tell the first from the others, got {frames}")
    kinds: dict[tuple[Any, ...], list[Job]] = {}
    for job in recipe.jobs:
        kinds.setdefault((job.family, job.settings, job.streams), []).append(job)
    costs = []
    with tempfile.TemporaryDirectory(prefix="qsim-plan-") as folder:
        for n, members in enumerate(kinds.values(), 1):
            costs.append(_measure(members, Path(folder) / f"kind{n}", frames))
            if progress is not None:
                progress(n, len(kinds))
    chosen = engine.select()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return Plan(tuple(costs), f"{chosen.backend}, {chosen.variant}", peak)


def _measure(members: list[Job], folder: Path, frames: int) -> Cost:
    """The second rendering counts: kernels are then compiled and cached, as they are for nearly all jobs."""
    _first_frames(members[0], folder / "warm", min(2, members[0].settings.frames))
    job = members[len(members) // 2]
    settings = job.settings
    started = time.perf_counter()
    clip, moments = _first_frames(job, folder / "measured", min(frames, settings.frames))
    # The first frame carries scene, budget and loading; the others are what each further frame costs.
    later = [after - before for before, after in itertools.pairwise(moments)]
    per_frame = sum(later) / len(later) if later else moments[0] - started
    setup = moments[0] - started - (per_frame if later else 0.0)
    sensing, codes = _sense(job, clip)
    stored = sum(file.stat().st_size for file in clip.path.rglob("*.exr")) / len(clip)
    return Cost(
        family=Path(job.family).stem,
        size=(settings.height, settings.width),
        clips=len(members),
        frames=len(members) * settings.frames,
        setup=max(setup, 0.0),
        per_frame=per_frame,
        sensing=sensing,
        frame_bytes=stored + codes,
    )


def _first_frames(job: Job, path: Path, frames: int) -> tuple[Clip, list[float]]:
    """The first frames of a job's clip, and when each was done."""
    from qsim import render

    settings = job.settings
    moments: list[float] = []
    scene = jobs.load_scene(job)
    clip = render.render_clip(
        scene,
        path,
        frames=frames,
        frame_rate=settings.frame_rate,
        shutter=settings.shutter,
        seed=jobs.render_seed(job),
        budget=jobs.choose_budget(job, scene),
        progress=lambda done, total: moments.append(time.perf_counter()),
    )
    return clip, moments


def _sense(job: Job, clip: Clip) -> tuple[float, float]:
    """Seconds and bytes per frame of all streams together; the second drawing counts, the first one compiles."""
    seconds = size = 0.0
    for sensing in job.streams:
        stream.sense(clip, sensing)
        started = time.perf_counter()
        drawn, _ = stream.sense(clip, sensing, force=True)
        seconds += time.perf_counter() - started
        size += drawn.path.stat().st_size
    return seconds / len(clip), size / len(clip)
