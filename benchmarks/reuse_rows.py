"""Measures what sharing samples between frames gains, how honest its stated error is, and how its error flickers.

    python benchmarks/reuse_rows.py                              # nine families at 128 x 256: hours on one core
    python benchmarks/reuse_rows.py --rows plain,room --busy     # these alone, beside other programs
    python benchmarks/reuse_rows.py --seed 307                   # other clips of the same families
    python benchmarks/reuse_rows.py --tiny --out out/rows        # minutes: a test of this program

A row is RESULTS/FAMILY-SIZE.json. It is written when it is complete, and made once; only missing ones are made. Per
row: one clip is budgeted at the asked PSNR twice, frames alone and with neighbours. Both budgets render the same frames
in turn, in one process; processor seconds are of frames that have all their neighbours. Scenes and samples have a seed
that no constant of qsim was chosen with, but four clips of seed 61 served to choose how a shared frame states its
error: honesty is that of other seeds.

Every judged frame is compared with a converged reference in two halves R1 and R2. The mean of (F - R1)(F - R2), clamped
at white, is the squared error of F without that of the reference. The same product of spectra over consecutive frames
is the spectrum of the error over time.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import result_page
from numpy import ndarray as Array
from rows import grow, keep_apart

from qsim import scenes
from qsim.clip.clamped_error import error_at, over_neighbours, white_in
from qsim.colour import psnr
from qsim.rendering.budget import Budget
from qsim.rendering.fidelity import DEEPEST, choose_budget
from qsim.rendering.renderer import Renderer
from qsim.rendering.reuse.sharing import NAME
from qsim.scene import Scene
from qsim.tables import markdown_table

ROOT = Path(__file__).parents[1]
FAMILIES = ("fence", "glass", "glossy", "lamp", "pellets", "plain", "room", "shadow", "wires")  # none tuned a constant
SEED = 61  # its clips of lamp, glossy, room and fence chose how a shared frame states its error
MARK = " \\*"
# dB between stated and reached, in nine of ten frames; by which no frame states too little
WITHIN = 1.0
NEVER = 2.0


@dataclass(frozen=True)
class Plan:
    """What one row measures."""

    height: int = 128
    width: int = 256
    frames: int = 16
    first: int = 4  # the first of the consecutive frames whose error is followed over time
    count: int = 8  # their number; the first and the last frame of the clip are judged, too
    level: float = 40.0  # asked, dB below white
    seed: int = SEED
    speed: float = 1.0
    reference: int = 256  # samples per pixel of each reference

    @property
    def judged(self) -> list[int]:
        """The frames that are compared with references."""
        return sorted({0, self.frames - 1, *range(self.first, self.first + self.count)})


@dataclass
class Clip:
    """One way to render the clip: its frames, the errors that they state, and their processor seconds."""

    renderer: Renderer
    choosing: float
    images: dict[int, Array] = field(default_factory=dict)
    errors: dict[int, Any] = field(default_factory=dict)
    seconds: dict[int, float] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, plan: Plan, reuse: bool) -> Clip:
        """Return a clip whose budget is chosen, with or without neighbours."""
        started = time.process_time()
        budget = choose_budget(scene, frames=plan.frames, psnr=plan.level, seed=plan.seed, reuse=reuse)
        choosing = time.process_time() - started
        return cls(Renderer(scene, budget=budget, seed=plan.seed, frames=plan.frames), choosing)

    def render(self, t: int) -> None:
        """Render frame t."""
        started = time.process_time()
        frame = self.renderer.frame(t, with_truth=False)
        self.seconds[t] = time.process_time() - started
        self.images[t] = frame.radiance.astype(np.float64)
        self.errors[t] = frame.errors_at

    def row(self, plan: Plan, references: dict[int, Array], white: float) -> dict[str, Any]:
        """Return what was measured, by the references [2, H, W] of the judged frames."""
        budget = self.renderer.budget
        apart = {}
        for t in plan.judged:
            apart[t] = np.minimum(self.images[t], white) - np.minimum(references[t], white)
        reached = {t: decibels(white, float(np.mean(d[0] * d[1]))) for t, d in apart.items()}
        means = [float(self.images[t].mean()) for t in range(plan.frames)]
        own = [error_at(white, self.errors[t]) for t in range(plan.frames)]
        errors = over_neighbours(own, means, budget.neighbours > 0)
        stated = {t: psnr(white, errors[t]) for t in plan.judged}
        followed = np.stack([apart[t] for t in range(plan.first, plan.first + plan.count)], axis=1)
        steady = [self.seconds[t] for t in steady_frames(plan, budget.neighbours)]
        return {
            "samples": budget.samples,
            "neighbours": budget.neighbours,
            "denoise": budget.denoise,
            "bounces": budget.bounces,
            "reached": [round(reached[t], 3) for t in plan.judged],
            "stated": [round(stated[t], 3) for t in plan.judged],
            "processor_seconds": round(median(steady), 4),
            "choosing_seconds": round(self.choosing, 2),
            "spectrum": [round(share, 4) for share in spectrum(followed)],
            "flicker": round(flicker(followed), 4),
        }


def steady_frames(plan: Plan, neighbours: int) -> list[int]:
    """Return the frames that have all their neighbours, without the first one, which compiles and traces several."""
    inner = list(range(neighbours + 1, plan.frames - neighbours))
    return inner or list(range(1, plan.frames))


def decibels(white: float, square: float) -> float:
    """Return a squared error in dB below white; a product of halves may be below zero, which counts as 80 dB."""
    return psnr(white, float(np.sqrt(max(square, (1e-4 * white) ** 2))))


def spectrum(apart: Array) -> list[float]:
    """Return the share of the squared error in each frequency over time, 0 ... frames / 2 periods.

    `apart` [2, frames, H, W] are the differences from both references, whose noise cancels in the product.
    """
    first, second = (np.fft.fft(half, axis=0) for half in apart)
    power = np.real(first * np.conj(second)).mean(axis=(1, 2))
    half = len(power) // 2
    folded = [power[0], *(power[k] + (power[-k] if k < len(power) - k else 0) for k in range(1, half + 1))]
    return (np.array(folded) / np.sum(folded)).tolist()


def flicker(apart: Array) -> float:
    """Return the squared change of the error between neighbouring frames over that of independent errors: 1 if white.

    `apart` as of `spectrum`. The references of neighbouring frames are independent, and cancel in the product.
    """
    steps = np.diff(apart, axis=1)
    return float(np.mean(steps[0] * steps[1]) / (2 * np.mean(apart[0] * apart[1])))


def measure(family: str, plan: Plan) -> dict[str, Any]:
    """Return the row of a family."""
    scene = scenes.load(family, seed=plan.seed, speed=plan.speed).resized(plan.height, plan.width)
    clips = {name: Clip.of(scene, plan, name == "shared") for name in ("alone", "shared")}
    budget = clips["shared"].renderer.budget
    why = next(finding for finding in budget.findings if finding.effect == NAME)
    for t in range(plan.frames):
        for clip in clips.values():
            clip.render(t)
    deep = Renderer(scene, budget=Budget(plan.reference, DEEPEST), seed=plan.seed + 1000)
    references = {t: deep.halves([deep.time(t)], deep.budget, deep.key(t)) for t in plan.judged}
    white = white_in(np.mean(list(references.values()), axis=1))
    noise = np.mean([np.mean(np.diff(np.minimum(halves, white), axis=0) ** 2) / 4 for halves in references.values()])
    row = {name: clip.row(plan, references, white) for name, clip in clips.items()}
    return {"reuse": f"{why.chosen}; {why.size}", "reference": round(decibels(white, float(noise)), 2), **row}


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the page of the rows, by name."""
    header = ("scene", "alone", "s", "shared", "s", "ratio", "reached", "stated - reached", "at most", "flicker")
    lines = []
    ratios = []
    stating: dict[str, list[float]] = {}
    for name, row in rows.items():
        ratio = row["alone"]["processor_seconds"] / row["shared"]["processor_seconds"]
        gaps = {kind: np.subtract(row[kind]["stated"], row[kind]["reached"]) for kind in ("alone", "shared")}
        for kind in ("alone", "shared") if row["shared"]["neighbours"] else ("alone",):
            stating.setdefault(f"Seed {row['plan']['seed']}, frames {kind}", []).extend(gaps[kind].tolist())
        ratios.append(ratio if row["shared"]["neighbours"] else 1.0)
        lines.append(
            (
                name if row["quiet"] else name + MARK,
                how(row["alone"]),
                f"{row['alone']['processor_seconds']:.2f}",
                how(row["shared"]) if row["shared"]["neighbours"] else "alone",
                f"{row['shared']['processor_seconds']:.2f}",
                f"{ratios[-1]:.2f}",
                f"{np.mean(row['shared']['reached']):.1f}",
                f"{np.mean(gaps['shared']):+.2f}",
                f"{np.max(gaps['shared']):+.2f}",
                f"{row['shared']['flicker']:.2f}",
            )
        )
    text = [
        *result_page.head("Frames that share samples", "reuse_rows.py", "; rows that end in -s307 with `--seed 307`"),
        "Processor seconds per frame at equal asked PSNR, frames alone and with neighbours; decibels below white.",
        "A frame states the error that clip.json has.",
        "`stated - reached` is the mean over the judged frames of a clip, `at most` the worst frame. `flicker` is the",
        "squared change of the error between frames, 1 if errors of frames are independent. Where the budget has no",
        "neighbours, frames alone are predicted to cost no more.",
        "",
        *markdown_table(lines, header),
        "",
        f"Median ratio of {len(ratios)} rows: {median(ratios):.2f}.",
        f"Clips of lamp, glossy, room and fence with seed {SEED} served to choose how a shared frame states its error.",
        "",
        *(f"* {honesty(kind, gaps)}" for kind, gaps in sorted(stating.items())),
        "",
        *([f"{MARK} made beside other programs."] if any(not row["quiet"] for row in rows.values()) else []),
    ]
    return "\n".join(text) + "\n"


def how(budget: dict[str, Any]) -> str:
    """Return samples, neighbours and denoiser of a budget as text."""
    near = f", {budget['neighbours']} neighbours" if budget["neighbours"] else ""
    return f"{budget['samples']}{near}{', denoised' if budget['denoise'] else ''}"


def honesty(kind: str, gaps: list[float]) -> str:
    """Return how far stated and reached errors differ, as a line."""
    near = sum(abs(gap) <= WITHIN for gap in gaps)
    return (
        f"{kind}: {near} of {len(gaps)} state their error within {WITHIN:g} dB, {sum(g > NEVER for g in gaps)} "
        f"state more than {NEVER:g} dB too much; worst {max(gaps):+.2f} dB."
    )


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default=",".join(FAMILIES), help="families, separated by commas (default: all)")
    parser.add_argument("--size", default="128x256", help="HEIGHTxWIDTH in px (default 128x256)")
    parser.add_argument("--speed", type=float, default=1.0, help="factor on all motions (default 1)")
    parser.add_argument("--seed", type=int, default=SEED, help=f"of scenes and samples (default {SEED})")
    parser.add_argument("--reference", type=int, default=Plan.reference, help="samples of the references")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "reuse", help="folder of the rows")
    parser.add_argument("--busy", action="store_true", help="also beside other programs; such rows are marked")
    parser.add_argument("--tiny", action="store_true", help="few and small frames: a test of this program")
    args = parser.parse_args(words)
    height, width = map(int, args.size.split("x"))
    plan = Plan(height, width, speed=args.speed, reference=args.reference, seed=args.seed)
    if args.tiny:
        plan = Plan(24, 32, frames=6, first=1, count=4, level=25.0, reference=32, seed=args.seed)
    fast = "" if plan.speed == 1 else f"-x{plan.speed:g}"
    other = "" if plan.seed == SEED else f"-s{plan.seed}"
    try:
        keep_apart("reuse", args.out, trial=args.tiny)
        args.out.mkdir(parents=True, exist_ok=True)
        for family in args.rows.split(","):
            path = args.out / f"{family}-{plan.height}x{plan.width}{fast}{other}.json"
            grow(path, plan, partial(measure, family, plan), table, busy=args.busy or args.tiny)
    except ValueError as error:
        print(f"reuse_rows: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
