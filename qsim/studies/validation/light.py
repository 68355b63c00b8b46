"""Compares error and mean light of budgeted frames with converged frames, and with what the budget states.

    run(scenes) -> LightReport: one LightRow per scene and level [dB]

Each scene gets the budget of `choose_budget`. A few of its frames are compared with converged ones, which have many
samples and the deepest bounces. Errors are clamped at white (clip/clamped_error.py); those without a clamp stand beside
them. The variance of the reference is subtracted. The mean light may differ by noise, and by the light of the bounces
that the budget omits. Independent halves give the standard error of the noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import Errors, error_at, white_in
from qsim.colour import psnr
from qsim.rendering import fidelity
from qsim.rendering.budget import Budget
from qsim.rendering.renderer import Renderer
from qsim.scene import Scene
from qsim.tables import text_table

LEVELS = (36.0,)  # dB below white
ENOUGH = 4.5  # standard errors; a correct program exceeds them in one of 100 000 rows
MISSED = 0.5  # dB below the wanted level that `shortfall` reports, too


@dataclass(frozen=True)
class LightRow:
    """One scene at one level."""

    scene: str
    asked: float  # wanted, dB below white
    reached: float  # dB against the reference, clamped at white
    stated: float  # dB, from the measured error of the frames
    reached_unclamped: float  # dB below the same white
    stated_unclamped: float
    samples: int
    bounces: int
    denoised: bool
    light: float  # relative difference of the mean light from the reference
    announced: float  # share of light that the omitted bounces would add
    light_error: float  # standard error of light + announced

    @property
    def ok(self) -> bool:
        """Whether the error is as requested, and the light differs by the announced fraction."""
        return self.reached > self.asked - MISSED and abs(self.light + self.announced) < ENOUGH * self.light_error


@dataclass(frozen=True)
class LightReport:
    """All rows, with the size and the engine that rendered them."""

    height: int
    width: int
    engine: str
    rows: tuple[LightRow, ...]

    @property
    def ok(self) -> bool:
        """Whether all rows are within their bounds."""
        return all(row.ok for row in self.rows)

    def to_dict(self) -> dict[str, object]:
        """Return the report for JSON."""
        return asdict(self) | {"rows": [asdict(row) | {"ok": row.ok} for row in self.rows], "ok": self.ok}


def run(
    scenes: Sequence[Scene],
    *,
    levels: Sequence[float] = LEVELS,
    reference_samples: int = 1024,
    frames: Sequence[int] = (2, 9, 16),
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> LightReport:
    """Measure every scene at every level; all scenes must have one size. Takes minutes at 96 x 192."""
    if not scenes or not levels or not frames:
        raise ValueError("validate light: needs at least one scene, one level and one frame")
    rows = []
    for scene in scenes:
        deep = Renderer(scene, budget=Budget(reference_samples, fidelity.DEEPEST), seed=seed + 1000)
        references = np.stack([_halves(deep, t) for t in frames], axis=1)  # [2, frames, H, W]
        for level in levels:
            rows.append(_row(scene, level, references, frames, seed))
            if progress is not None:
                progress(f"{rows[-1].scene}: {level:g} dB asked, {rows[-1].reached:.2f} dB reached")
    camera = scenes[0].camera
    return LightReport(camera.height, camera.width, deep.engine.backend, tuple(rows))


def _row(scene: Scene, level: float, references: Array, frames: Sequence[int], seed: int) -> LightRow:
    chosen = fidelity.choose_budget(scene, psnr=level, seed=seed)
    ours = Renderer(scene, budget=chosen, seed=seed)
    drawn = [ours.frame(t, with_truth=False) for t in frames]
    truth = references.mean(axis=0)
    white = white_in(truth)
    light = float(truth.mean())
    images = np.stack([frame.radiance for frame in drawn])
    found = Errors.between(images, truth, white)
    own = Errors.of_halves(references, white)
    noise = Errors.of_halves(np.stack([_halves(ours, t) for t in frames], axis=1), white).plain
    stated = [error_at(white, frame.errors_at) for frame in drawn], [frame.error for frame in drawn]
    error = math.hypot(noise, own.plain) / math.sqrt(images.size) / light
    return LightRow(
        f"{scene.name}/{scene.seed}",
        level,
        psnr(white, _without(found.at_white, own.at_white)),
        psnr(white, _mean(stated[0])),
        psnr(white, _without(found.plain, own.plain)),
        psnr(white, _mean(stated[1])),
        chosen.samples,
        chosen.bounces,
        chosen.denoise,
        float(images.mean(dtype=np.float64)) / light - 1,
        chosen.dimmed,
        math.hypot(error, chosen.dimmed_error),
    )


def _halves(renderer: Renderer, t: int) -> Array:
    """Return two independent estimates of the radiance of frame t, [2, H, W]."""
    return renderer.halves(renderer.instants(t), renderer.budget, renderer.key(t))


def _without(found: float, own: float) -> float:
    """Return an error without that of the reference, at least a tenth of the latter."""
    return math.sqrt(max(found**2 - own**2, own**2 / 100))


def _mean(errors: Sequence[float]) -> float:
    return math.sqrt(float(np.mean(np.square(errors))))


def table(report: LightReport) -> str:
    """Return the rows as text, one line each, and the verdict."""
    verdict = "every error is as wanted, every light as announced"
    wrong = [row.scene for row in report.rows if not row.ok]
    if wrong:
        verdict = f"NOT as wanted or announced: {', '.join(wrong)}"
    size = f"{report.height} x {report.width} pixels, engine {report.engine}; dB below white, light in %"
    header = (
        "scene",
        "asked",
        "reached",
        "stated",
        "unclamped: reached",
        "stated",
        "samples",
        "bounces",
        "light",
        "announced",
        "+-",
        "",
    )
    return "\n".join([size, *text_table(map(_cells, report.rows), header), verdict])


def _cells(row: LightRow) -> list[str]:
    return [
        row.scene,
        f"{row.asked:g}",
        *(f"{value:.2f}" for value in (row.reached, row.stated, row.reached_unclamped, row.stated_unclamped)),
        f"{row.samples}{' denoised' if row.denoised else ''}",
        str(row.bounces),
        f"{100 * row.light:+.3f}",
        f"{-100 * row.announced:+.3f}",
        f"{100 * row.light_error:.3f}",
        "" if row.ok else "NOT OK",
    ]
