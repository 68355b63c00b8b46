"""Compares time per frame at equal error with a naive loop, on scenes that were not used for tuning.

    run() -> RenderReport: one RenderRow per scene and level [dB]; the error is that against a converged reference

The naive loop is `mi.render` per frame with the default integrator, the default `independent` sampler and a box filter.
It takes the smallest power of two of samples that reaches the level. Ours is `Renderer.frame` without ground truth,
with the budget of `choose_budget` for the level (for a clip of 21 frames); the measurement of its error is included.
Where its frame misses the level, its samples are raised step by step until it reaches it; rows state both numbers.
At AT_LEVEL a scene has a second row if frames that share samples are predicted to cost less: frames of that clip are
timed one after the other, when each traces one further frame. Both methods start from a loaded scene and are timed
alternately. Processor seconds stand beside wall seconds, because other programs change them less.
Rows of short frames take up to 15 rounds, since medians of three scatter. The variance of the reference is subtracted.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import Errors, error_at, white_in
from qsim.colour import psnr
from qsim.figures import new_figure, write_figure
from qsim.keys import words
from qsim.rendering import fidelity
from qsim.rendering.budget import Budget, grid_samples
from qsim.rendering.engine import activate
from qsim.rendering.mitsuba_scene import Stage, film_pass
from qsim.rendering.renderer import Renderer
from qsim.scene import Scene
from qsim.tables import text_table

LEVELS = (30.0, 35.0, 40.0, 45.0)  # dB below white
# of the median scene
WANTED_RATIO = 10.0
AT_LEVEL = 40.0
MOST_SAMPLES = 2**8  # of the naive loop that are timed; for more, the time is extrapolated and marked
TUNED = ("fan", "tumble", "gears", "flag", "crowd", "drums", "text")  # used while the choice of budgets was written
# rounds of timing a row; seconds after which the least number suffices
MOST_ROUNDS = 15
ENOUGH = 5.0
FRAME = 3  # the first frame that is rendered


@dataclass(frozen=True)
class RenderRow:
    """One scene at one level, rendered by both methods."""

    scene: str
    level: float  # wanted, dB below white, as all dB here
    naive_samples: int
    naive_psnr: float  # dB reached
    naive_seconds: float  # per frame, median
    extrapolated: bool  # naive_seconds is extrapolated from fewer samples
    samples: int
    denoised: bool
    bounces: int
    psnr: float  # dB reached, ours
    stated_psnr: float  # dB by our measured error of the same frame
    seconds: float  # per frame, median
    naive_processor: float = math.nan  # processor seconds per frame, all threads, median
    processor: float = math.nan  # the same, ours
    neighbours: int = 0  # frames on each side that share samples, ours
    chosen_samples: int = 0  # of `choose_budget`, before they were raised to reach the level; 0: not stated

    @property
    def raised(self) -> bool:
        """Whether the chosen samples missed the level."""
        return 0 < self.chosen_samples < self.samples

    @property
    def ratio(self) -> float:
        """Seconds of the naive loop divided by ours."""
        return self.naive_seconds / self.seconds

    @property
    def processor_ratio(self) -> float:
        """Processor seconds of the naive loop divided by ours."""
        return self.naive_processor / self.processor

    def to_dict(self) -> dict[str, object]:
        """Return the row for JSON, where the fields of the naive loop begin with "obvious_", as in stored files."""
        fields = {name.replace("naive_", "obvious_"): value for name, value in asdict(self).items()}
        return fields | {"ratio": self.ratio, "processor_ratio": self.processor_ratio}


@dataclass(frozen=True)
class RenderReport:
    """All rows, with the size and the engine that rendered them."""

    height: int
    width: int
    engine: str
    rows: tuple[RenderRow, ...]
    choosing_seconds: dict[str, float]  # per scene: the pilots of all levels, once per clip; not in `seconds`
    unit: str = "dB below white, clamped"  # of every PSNR; reports without it are in dB below the 99.9th percentile

    @property
    def median_ratio(self) -> float:
        """The median over the scenes at AT_LEVEL, frames alone."""
        return median(row.ratio for row in self.rows if row.level == AT_LEVEL and not row.neighbours)

    @property
    def ok(self) -> bool:
        """Whether the median scene at AT_LEVEL reaches WANTED_RATIO, and no scene is slower."""
        return self.median_ratio >= WANTED_RATIO and all(row.ratio >= 1 for row in self.rows)

    def to_dict(self) -> dict[str, object]:
        """Return the report for JSON."""
        rows = [row.to_dict() for row in self.rows]
        return asdict(self) | {"rows": rows, "median_ratio": self.median_ratio, "ok": self.ok}


def run(
    scenes: Sequence[Scene],
    *,
    levels: Sequence[float] = LEVELS,
    reference_samples: int = 2048,
    rounds: int = 3,
    most_samples: int = MOST_SAMPLES,
    progress: Callable[[str], None] | None = None,
) -> RenderReport:
    """Measure every scene at every level, at least `rounds` times; all scenes must have one size.

    Takes minutes at 128 x 256.
    """
    if not scenes or AT_LEVEL not in levels:
        raise ValueError(f"validate render: needs at least one scene, and {AT_LEVEL:g} among its levels")
    rows: list[RenderRow] = []
    choosing: dict[str, float] = {}
    for scene in scenes:
        name = f"{scene.name}/{scene.seed}"
        if progress is not None:
            progress(f"{name}: reference")
        renderer = Renderer(scene, budget=Budget(reference_samples, fidelity.DEEPEST), seed=1000)
        halves = renderer.halves([renderer.time(FRAME)], renderer.budget, renderer.key(FRAME))
        target = Target(halves)
        pairs = [(level, False) for level in levels] + [(AT_LEVEL, True)]
        for level, shares in sorted(pairs):
            if progress is not None:
                progress(f"{name}: {level:g} dB{', frames that share samples' * shares}")
            started = time.perf_counter()
            chosen = fidelity.choose_budget(scene, psnr=level, reuse=shares)
            choosing[name] = choosing.get(name, 0.0) + time.perf_counter() - started
            if shares and not chosen.neighbours:
                continue
            rows.append(_compare(scene, name, level, chosen, target, rounds, most_samples))
            if progress is not None:
                progress(f"{name}: {level:g} dB reached {rows[-1].ratio:.1f} times faster")
    camera = scenes[0].camera
    return RenderReport(camera.height, camera.width, renderer.engine.backend, tuple(rows), choosing)


class Target:
    """A converged frame, its white, and errors against it, clamped at white."""

    def __init__(self, halves: Array) -> None:
        self.image = halves.mean(axis=0)
        self.white = white_in(self.image)
        self.variance = Errors.of_halves(halves, self.white).at_white ** 2

    def psnr(self, image: Array) -> float:
        """Return the PSNR [dB] of an image [H, W] whose noise is independent of the reference."""
        square = Errors.between(image, self.image, self.white).at_white ** 2 - self.variance
        return psnr(self.white, math.sqrt(max(square, self.variance / 100)))


class NaiveLoop:
    """Naive reference: one `mi.render` per frame, with Mitsuba's camera and film, default integrator and sampler."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self._stage = Stage(renderer.mi, renderer.scene, smooth_weight=1.0)
        self._integrator = renderer.mi.load_dict({"type": "path"})

    def frame(self, t: int, samples: int, redraw: int = 0) -> Array:
        """Return the radiance of the window at mid-exposure of frame t, float64 [H, W]; `redraw` selects samples."""
        ours = self._renderer
        now = self._renderer.time(t)
        activate(ours.engine)
        self._stage.place(now)
        pose = ours.scene.camera.pose(now)
        seed = int(words(ours.key(t), (1, 1), redraw=redraw)[0, 0])
        return film_pass(self._stage, pose, ours.crop, seed, samples, self._integrator, "independent")

    def mean(self, t: int, samples: int) -> Array:
        """Return the same from one or more calls, as memory demands."""
        height, width = self._renderer.shape
        calls = min(samples, 2 ** max(0, math.ceil(math.log2(samples * height * width / 2**24))))
        each = samples // calls
        return np.mean([self.frame(t, each, redraw) for redraw in range(calls)], axis=0)


def _compare(
    scene: Scene, name: str, level: float, chosen: Budget, target: Target, rounds: int, most_samples: int
) -> RenderRow:
    ours, reached, stated = _reaching(scene, chosen, level, target)
    naive = NaiveLoop(ours)
    samples, naive_psnr = _naive_samples(naive, level, target)
    timed = min(samples, most_samples)
    theirs = []
    own = []
    end = time.perf_counter() + ENOUGH
    for i in range(max(rounds, MOST_ROUNDS) + 1):  # the first round compiles and does not count
        if i > rounds and time.perf_counter() > end:
            break
        started = _clocks()
        naive.mean(FRAME + i, timed)
        between = _clocks()
        ours.frame(FRAME + i, with_truth=False)
        theirs.append(between - started)
        own.append(_clocks() - between)
    naive_seconds, naive_processor = np.median(theirs[1:], axis=0) * samples / timed
    seconds, processor = np.median(own[1:], axis=0)
    return RenderRow(
        name,
        level,
        samples,
        naive_psnr,
        float(naive_seconds),
        timed < samples,
        ours.budget.samples,
        ours.budget.denoise,
        ours.budget.bounces,
        reached,
        stated,
        float(seconds),
        float(naive_processor),
        float(processor),
        ours.budget.neighbours,
        chosen.samples,
    )


def _clocks() -> Array:
    """Return wall and processor seconds (of all threads of this process), float64 [2]."""
    return np.array([time.perf_counter(), time.process_time()])


def _reaching(scene: Scene, chosen: Budget, level: float, target: Target) -> tuple[Renderer, float, float]:
    """Return our renderer, and the PSNR [dB] that one frame reaches and states.

    The budget is the chosen one, with more samples where that misses the level.
    """
    while True:
        renderer = Renderer(scene, budget=chosen)
        frame = renderer.frame(FRAME, with_truth=False)
        reached = target.psnr(frame.radiance)
        if reached >= level or chosen.samples >= fidelity.MOST_SAMPLES:
            return renderer, reached, psnr(target.white, error_at(target.white, frame.errors_at))
        chosen = replace(chosen, samples=2 * grid_samples(chosen.samples // 2 + 1))


def _naive_samples(naive: NaiveLoop, level: float, target: Target) -> tuple[int, float]:
    """Return the smallest power of two of samples that reaches the level, and its PSNR [dB], by MSE = c / samples."""
    trial = 64
    measured = target.psnr(naive.mean(FRAME, trial))
    samples = 2 ** max(0, math.ceil(math.log2(trial) + (level - measured) / (10 * math.log10(2))))
    return samples, measured + 10 * math.log10(samples / trial)


def table(report: RenderReport) -> str:
    """Return the rows as text, one line each, and the verdict."""
    size = f"{report.height} x {report.width} pixels, engine {report.engine}"
    lines = [f"{size}; seconds per frame, radiance only; {report.unit}"]
    header = ("scene", "level", "naive: samples", "dB", "s", "ours: samples", "dB", "s", "faster", "in processor time")
    lines += text_table(map(_cells, report.rows), header)
    if any(row.extrapolated for row in report.rows):
        lines.append("* extrapolated from the time of fewer samples")
    choosing = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in report.choosing_seconds.items())
    lines.append(f"choosing the budgets, once per clip (all levels): {choosing}")
    verdict = "reached" if report.ok else "NOT reached"
    lines.append(
        f"median at {AT_LEVEL:g} dB: {report.median_ratio:.1f} times faster; "
        f"wanted: {WANTED_RATIO:g}, and no scene slower: {verdict}"
    )
    return "\n".join(lines)


def _cells(row: RenderRow) -> list[str]:
    return [
        row.scene,
        f"{row.level:g}",
        str(row.naive_samples),
        f"{row.naive_psnr:.1f}",
        f"{row.naive_seconds:.3f}{'*' if row.extrapolated else ''}",
        f"{row.samples}{f' (raised from {row.chosen_samples})' * row.raised}{' denoised' * row.denoised}"
        f"{f', {row.neighbours} neighbours' * (row.neighbours > 0)}",
        f"{row.psnr:.1f}",
        f"{row.seconds:.3f}",
        f"{row.ratio:.1f}",
        f"{row.processor_ratio:.1f}",
    ]


def figure(report: RenderReport, path: Path) -> None:
    """Write seconds per frame against PSNR to `path` (.png, .svg or .pdf), one panel per scene."""
    names = list(dict.fromkeys(row.scene for row in report.rows))
    across = min(4, len(names))
    down = math.ceil(len(names) / 4)
    drawn = new_figure(3.2 * across, 3.4 * down)
    panels = np.ravel(drawn.subplots(down, across, sharex=True, sharey=True, squeeze=False))
    for axes in panels[len(names) :]:
        axes.remove()
    for name, axes in zip(names, panels[: len(names)], strict=True):
        rows = [row for row in report.rows if row.scene == name and not row.neighbours]
        axes.plot([r.naive_seconds for r in rows], [r.naive_psnr for r in rows], "o-", label="naive loop")
        axes.plot([r.seconds for r in rows], [r.psnr for r in rows], "s-", label="qsim")
        axes.set(xscale="log", xlabel="seconds per frame", title=name)
        axes.tick_params(labelbottom=True)  # of all: the last row may be shorter
        axes.grid(alpha=0.3)
    drawn.axes[0].set_ylabel("PSNR of the radiance [dB below white]")
    drawn.axes[0].legend(frameon=False)
    write_figure(drawn, path)
