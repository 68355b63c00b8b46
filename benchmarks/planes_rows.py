"""Measures what codes that sum planes cost, over sharp frames with the same asked error, and the error of their light.

    python benchmarks/planes_rows.py                             # six families at 240 x 320: an hour on one core
    python benchmarks/planes_rows.py --rows fan,lamp --busy      # these alone, beside other programs
    python benchmarks/planes_rows.py --tiny --out out/rows       # seconds: a test of this program

A row is RESULTS/FAMILY-SIZE.json. It is written when it is complete, and made once; only missing ones are made. Per
row, in one process: a clip of sharp frames at the rate of the codes, and a clip of their planes, each with its own
budget for 100 codes, of which the first few are rendered and stored. A third clip has the light of the planes alone,
without the sharp frame in the middle of each code. Processor seconds are medians over all frames, or codes, but the
first.

The light of a judged code is compared with a converged reference in two halves R1 and R2. The mean of
(F - R1)(F - R2), clamped at white, is the squared error of F without that of the reference.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import result_page
from numpy import ndarray as Array
from rows import grow, keep_apart

from qsim import scenes
from qsim.colour import psnr
from qsim.rendering.budget import Budget
from qsim.rendering.clip_rendering import render_clip
from qsim.rendering.fidelity import DEEPEST, choose_budget
from qsim.rendering.renderer import Renderer
from qsim.scene import Scene
from qsim.streams.clip import Clip
from qsim.tables import markdown_table

ROOT = Path(__file__).parents[1]
FAMILIES = ("fan", "lamp", "glossy", "pellets", "plain", "room")
SEED = 61
MARK = " \\*"
LEAST = 80.0  # dB of an error that a product of halves cannot tell from none


@dataclass(frozen=True)
class Plan:
    """What one row measures."""

    height: int = 240
    width: int = 320
    planes: int = 7
    codes: int = 100  # of the clips whose budgets are chosen
    rendered: int = 4  # of them
    rate: float = 10_000.0  # Hz, of the planes
    level: float = 40.0  # asked, dB below white
    seed: int = SEED
    reference: int = 126  # samples per pixel of each reference

    @property
    def judged(self) -> range:
        """The codes that are compared with references."""
        return range(1, self.rendered)


@dataclass
class Side:
    """One of the two clips, as far as it is rendered."""

    budget: Budget
    choosing: float  # s
    seconds: list[float]  # per sharp frame, or per code
    clip: Clip

    @classmethod
    def of(cls, scene: Scene, plan: Plan, planes: int, folder: Path) -> Side:
        """Render sharp frames (`planes` is 1) or the planes of codes."""
        rate = plan.rate * planes / plan.planes
        started = time.process_time()
        budget = choose_budget(
            scene,
            frame_rate=rate,
            frames=plan.codes * planes,
            psnr=plan.level,
            codes=(planes,),
            seed=plan.seed,
        )
        return cls.rendered(scene, plan, planes, folder / f"of{planes}", budget, time.process_time() - started)

    @classmethod
    def rendered(
        cls, scene: Scene, plan: Plan, planes: int, folder: Path, budget: Budget, choosing: float = 0.0
    ) -> Side:
        """Render with a budget."""
        moments = [time.process_time()]
        clip = render_clip(
            scene,
            folder,
            frames=plan.rendered * planes,
            frame_rate=plan.rate * planes / plan.planes,
            seed=plan.seed,
            budget=budget,
            progress=lambda done, total: moments.append(time.process_time()),
        )
        return cls(budget, choosing, np.diff(moments[::planes]).tolist(), clip)

    def row(self, plan: Plan, reached: list[float]) -> dict[str, Any]:
        """Return what was measured; `reached` are the squared errors of the judged light."""
        info = self.clip.info
        assert info.white is not None
        errors = info.error_at_white_per_code or info.error_at_white_per_frame
        return {
            "samples": self.budget.samples,
            "sharp_samples": self.budget.sharp_samples,
            "denoise": self.budget.denoise,
            "planes": self.budget.planes,
            "neighbours": self.budget.neighbours,
            "processor_seconds": round(median(self.seconds[1:]), 4),
            "choosing_seconds": round(self.choosing, 2),
            "reached": [round(decibels(info.white, square), 3) for square in reached],
            "stated": [round(psnr(info.white, errors[code]), 3) for code in plan.judged],
        }


def decibels(white: float, square: float) -> float:
    """Return a squared error in dB below white, at most LEAST: a product of halves may be below zero."""
    return psnr(white, float(np.sqrt(max(square, (10 ** (-LEAST / 20) * white) ** 2))))


def squared_error(light: Array, reference: Array, white: float) -> float:
    """Return the squared error of light [H, W] clamped at white, by a reference in halves [2, H, W]."""
    first, second = np.minimum(light, white) - np.minimum(reference, white)
    return float(np.mean(first * second))


def measure(family: str, plan: Plan) -> dict[str, Any]:
    """Return the row of a family."""
    scene = scenes.load(family, seed=plan.seed).resized(plan.height, plan.width)
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, planes in (("sharp", 1), ("summed", plan.planes)):
            side = Side.of(scene, plan, planes, Path(folder))
            deep = Renderer(scene, frame_rate=side.clip.frame_rate, budget=Budget(plan.reference, DEEPEST), seed=99)
            squares = []
            for code in plan.judged:
                frames = range(code * planes, (code + 1) * planes)
                light = np.mean([side.clip.radiance(t) for t in frames], axis=0, dtype=np.float64)
                reference = deep.halves([deep.time(t) for t in frames], deep.budget, deep.key(code))
                squares.append(squared_error(light, reference, side.clip.info.white or 1.0))
            found[name] = side.row(plan, squares)
        alone = Side.rendered(scene, plan, plan.planes, Path(folder) / "light", replace(side.budget, codes=()))
        found["summed"]["light_seconds"] = round(median(alone.seconds[1:]), 4)
    return found


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the page of the rows, by name."""
    header = (
        "scene",
        "sharp",
        "s",
        "planes",
        "in the middle",
        "s",
        "ratio",
        "light alone",
        "sharp reached",
        "codes reached",
        "stated",
    )
    lines = []
    ratios = []
    alone = []
    for name, row in rows.items():
        sharp = row["sharp"]
        summed = row["summed"]
        alone.append(summed["light_seconds"] / sharp["processor_seconds"])
        ratios.append(summed["processor_seconds"] / sharp["processor_seconds"])
        lines.append(
            (
                name if row["quiet"] else name + MARK,
                how(sharp),
                f"{sharp['processor_seconds']:.2f}",
                how(summed),
                f"{summed['sharp_samples']}",
                f"{summed['processor_seconds']:.2f}",
                f"{ratios[-1]:.2f}",
                f"{alone[-1]:.2f}",
                f"{np.mean(sharp['reached']):.1f}",
                f"{np.mean(summed['reached']):.1f}",
                f"{np.mean(summed['stated']):.1f}",
            )
        )
    text = [
        *result_page.head("Codes that sum planes", "planes_rows.py"),
        "Processor seconds of a sharp frame, and of a code",
        "with its sharp frame in the middle, ground truth of all frames and storing included. Both have the same asked",
        "PSNR. Samples are per pixel and frame. Errors are those of the light of a frame and of a code, in dB below",
        "white; a code states the larger of the errors of its light and of its sharp frame.",
        "",
        *markdown_table(lines, header),
        "",
        f"Median ratio of {len(ratios)} rows: {median(ratios):.2f}; of the light alone, without sharp frames in the",
        f"middle: {median(alone):.2f}.",
        "",
        *([f"{MARK} made beside other programs."] if any(not row["quiet"] for row in rows.values()) else []),
    ]
    return "\n".join(text) + "\n"


def how(budget: dict[str, Any]) -> str:
    """Return samples and denoiser of a budget as text."""
    near = f", {budget['neighbours']} neighbours" if budget["neighbours"] else ""
    return f"{budget['samples']}{near}{', denoised' if budget['denoise'] else ''}"


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default=",".join(FAMILIES), help="families, separated by commas (default: all)")
    parser.add_argument("--size", default="240x320", help="HEIGHTxWIDTH in px (default 240x320)")
    parser.add_argument("--planes", type=int, default=Plan.planes, help=f"in a code (default {Plan.planes})")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "planes", help="folder of the rows")
    parser.add_argument("--busy", action="store_true", help="also beside other programs; such rows are marked")
    parser.add_argument("--tiny", action="store_true", help="few and small frames: a test of this program")
    args = parser.parse_args(words)
    height, width = map(int, args.size.split("x"))
    plan = Plan(height, width, args.planes)
    if args.tiny:
        plan = Plan(24, 32, 3, codes=3, rendered=3, level=25.0, reference=48)
    try:
        keep_apart("planes", args.out, trial=args.tiny)
        args.out.mkdir(parents=True, exist_ok=True)
        for family in args.rows.split(","):
            more = "" if plan.planes == Plan.planes else f"-{plan.planes}"
            path = args.out / f"{family}-{plan.height}x{plan.width}{more}.json"
            grow(path, plan, partial(measure, family, plan), table, busy=args.busy or args.tiny)
    except ValueError as error:
        print(f"planes_rows: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
