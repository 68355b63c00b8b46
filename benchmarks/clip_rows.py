"""Measures what a frame of equal error costs: naive loop, frames alone, frames that share.

    python benchmarks/clip_rows.py                                         # nine families at 128 x 256: half an hour
    python benchmarks/clip_rows.py --size 512x1024 --rows plain,room,lamp  # half an hour
    python benchmarks/clip_rows.py --tiny --out out/rows                   # minutes: a test of this program

A row is RESULTS/FAMILY-SIZE.json. It is written when it is complete, and made once. Only missing rows are made, and
marked ones again on quiet cores.

Errors are in two units: dB below white, with picture and truth clamped there (qsim/clip/clamped_error.py), and dB below
the 99.9th percentile without a clamp. The naive loop is rendered with TRIAL samples; by MSE = c / samples, the power of
two that reaches the PSNR in each unit follows, and its time.

The squared error of a picture F is the mean of (F - R1)(F - R2) over two halves of converged pictures.
Processor seconds are of all threads, medians over frames without the first.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from clip_page import page
from clip_parts import described, timed_frames
from cycles_rows import use_only
from numpy import ndarray as Array
from reuse_rows import FAMILIES, decibels
from rows import ROOT, grow, keep_apart

from qsim import scenes
from qsim.clip.clamped_error import white_in
from qsim.clip.motion_statistics import MOVING
from qsim.clip.writer import ClipWriter
from qsim.colour import bright_end
from qsim.rendering.budget import Budget
from qsim.rendering.fidelity import DEEPEST, choose_budget
from qsim.rendering.renderer import Renderer
from qsim.scene import Scene
from qsim.studies.validation.rendering import NaiveLoop

TRIAL = 64  # samples per pixel of the naive loop
TRIED = 6  # speeds
TARGETS = {  # function: part of a frame
    "qsim.rendering.renderer:Renderer.frame": "choice",
    "qsim.rendering.renderer:Renderer._pass": "paths",
    "qsim.rendering.reuse.carrying:Carrier._traced": "paths",
    "qsim.rendering.reuse.carrying:Carrier.pictures": "carrying",
    "qsim.rendering.renderer:Renderer.surfaces": "surfaces",
    "qsim.rendering.denoiser:denoised": "denoiser",
    "qsim.rendering.reuse.choice:denoised": "denoiser",
    "qsim.rendering.mitsuba_scene:Stage.place": "scene",
    "qsim.rendering.renderer:Renderer.truth": "truth",
    "qsim.clip.writer:ClipWriter.add": "writing",
}


@dataclass(frozen=True)
class Plan:
    """What one row measures."""

    height: int = 128
    width: int = 256
    frames: int = 16  # of the clip
    rendered: tuple[int, ...] = (5, 6, 7, 8, 9, 10)  # consecutive, in its middle; the first one is not timed
    judged: tuple[int, ...] = (6, 8, 10)  # of these, compared with references
    level: float = 40.0  # asked [dB]
    motion: float = 2.0  # px/frame of the median moving pixel; half as much more or less is accepted
    scene_seed: int = 61
    seed: int = 61  # of samples
    reference: int = 512  # samples per pixel of both halves of a converged picture
    threads: int = 2


TINY = Plan(24, 32, 6, (1, 2, 3, 4), (2, 4), 25.0, reference=32)


def plan_of(height: int, width: int, motion: float, reference: int | None) -> Plan:
    """Return the plan of a size; large frames, whose means are of more pixels, are fewer with smaller references."""
    plan = Plan(height, width, motion=motion)
    if height * width > 2**16:
        plan = replace(plan, rendered=(6, 7, 8, 9), judged=(7, 9), reference=128)
    return replace(plan, reference=reference or plan.reference)


def measure(family: str, plan: Plan) -> dict[str, Any]:
    """Return the row of a family."""
    scene, motion = moving_scene(family, plan)
    deep = Renderer(scene, budget=Budget(plan.reference, DEEPEST), seed=plan.seed + 1000)
    halves = [deep.halves([deep.time(t)], deep.budget, deep.key(t)) for t in plan.judged]
    own = np.stack(halves, axis=1)
    white, peak = levels_of(own)
    naive = naive_loop(scene, plan, own)
    ours = {"alone": ours_at(scene, plan, own, False), "shared": ours_at(scene, plan, own, True)}
    if not ours["shared"]["neighbours"]:
        del ours["shared"]
    return {
        "speed": scene.speed,
        "motion": round(motion, 3),
        "white": white,
        "peak": peak,
        "references": {"noise": noise_of(own, white)},
        "ways": {**naive, **ours},
    }


# ---- Scene


def moving_scene(family: str, plan: Plan) -> tuple[Scene, float]:
    """Return a scene at the speed at which its median moving pixel moves by about `plan.motion`, and that motion [px].

    `ValueError` if no speed is found.
    """
    speed = 1.0
    found = []
    for _ in range(TRIED):
        scene = scenes.load(family, seed=plan.scene_seed, speed=speed).resized(plan.height, plan.width)
        motion = median_motion(scene, plan)
        found.append(f"{motion:.2g} px at speed {speed:g}")
        if 0.5 <= motion / plan.motion <= 1.5:
            return scene, motion
        speed = float(f"{speed * (plan.motion / motion if motion > 0 else 0.5):.2g}")
    raise ValueError(f"{family}: no speed moves its pixels by {plan.motion:g} px/frame; tried {', '.join(found)}")


def median_motion(scene: Scene, plan: Plan) -> float:
    """Return the median motion [px/frame] of pixels that move in the judged frames, 0 if none does."""
    renderer = Renderer(scene)
    motions = np.concatenate([np.hypot(*renderer.truth(t)["flow"]).ravel() for t in plan.judged])
    moving = motions[motions > MOVING]
    return float(np.median(moving)) if moving.size else 0.0


# ---- Errors


def levels_of(references: Array) -> tuple[float, float]:
    """Return white and the 99.9th percentile of references [2, J, H, W], in their unit."""
    mean = references.mean(axis=0)
    return white_in(mean), bright_end(mean)


def reached(pictures: Array, references: Array) -> dict[str, float]:
    """Return the PSNR [dB] of pictures [J, H, W] in both units, by references [2, J, H, W]."""
    white, peak = levels_of(references)
    apart = np.asarray(pictures, np.float64) - references
    clamped = np.minimum(np.asarray(pictures, np.float64), white) - np.minimum(references, white)
    squares = {"white": (white, clamped), "peak": (peak, apart)}
    return {unit: round(decibels(top, float(np.mean(d[0] * d[1]))), 2) for unit, (top, d) in squares.items()}


def noise_of(references: Array, white: float) -> float:
    """Return the noise of the mean of references [2, J, H, W], dB below white."""
    halves = np.minimum(references, white)
    return round(decibels(white, float(np.mean((halves[0] - halves[1]) ** 2) / 4)), 2)


# ---- Ways to render


def ours_at(scene: Scene, plan: Plan, references: Array, reuse: bool) -> dict[str, Any]:
    """Return what frames alone, or with neighbours, cost and reach."""
    started = time.process_time()
    budget = choose_budget(scene, frames=plan.frames, psnr=plan.level, seed=plan.seed, reuse=reuse)
    choosing = time.process_time() - started
    way = {name: getattr(budget, name) for name in ("samples", "denoise", "bounces", "neighbours")}
    if reuse and not budget.neighbours:
        return way
    renderer = Renderer(scene, budget=budget, seed=plan.seed, frames=plan.frames)
    with tempfile.TemporaryDirectory() as folder:
        told = described(scene, len(plan.rendered), renderer.frame_rate)
        pictures, taken = timed_frames(renderer, ClipWriter(Path(folder) / "clip", told), plan.rendered, TARGETS)
    errors = reached(np.stack([pictures[t] for t in plan.judged]), references)
    return way | {"asked": plan.level, "reached": errors, "choosing_seconds": round(choosing, 2)} | taken


def naive_loop(scene: Scene, plan: Plan, references: Array) -> dict[str, Any]:
    """Return what the naive loop costs that reaches the level in each unit, extrapolated from TRIAL samples."""
    loop = NaiveLoop(Renderer(scene, seed=plan.seed))
    loop.mean(plan.rendered[0], TRIAL)  # compiles
    pictures = []
    seconds = []
    for t in plan.judged:
        started = time.process_time()
        pictures.append(loop.mean(t, TRIAL))
        seconds.append(time.process_time() - started)
    found = reached(np.stack(pictures), references)
    return {f"naive, {unit}": extrapolated(found, unit, plan.level, median(seconds)) for unit in found}


def extrapolated(found: dict[str, float], unit: str, level: float, seconds: float) -> dict[str, Any]:
    """Return the power of two of samples that reaches a level, from errors and seconds of TRIAL samples."""
    samples = 2 ** max(0, math.ceil(math.log2(TRIAL) + (level - found[unit]) / (10 * math.log10(2)) - 1e-9))
    gain = 10 * math.log10(samples / TRIAL)
    return {
        "asked": level,
        "samples": samples,
        "reached": {name: round(value + gain, 2) for name, value in found.items()},
        "processor_seconds": round(seconds * samples / TRIAL, 4),
    }


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default=",".join(FAMILIES), help="families, separated by commas")
    parser.add_argument("--size", default="128x256", help="HEIGHTxWIDTH in px (default 128x256)")
    parser.add_argument("--motion", type=float, default=Plan.motion, help="px/frame (default 2)")
    parser.add_argument("--reference", type=int, help="samples of a converged picture (default 512, large frames 128)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "clips", help="folder of the rows")
    parser.add_argument("--busy", action="store_true", help="also beside other programs; such rows are marked")
    parser.add_argument("--tiny", action="store_true", help="few and small frames: a test of this program")
    args = parser.parse_args(words)
    height, width = map(int, args.size.split("x"))
    plan = TINY if args.tiny else plan_of(height, width, args.motion, args.reference)
    use_only(plan.threads)
    busy = args.busy or args.tiny
    fast = "" if plan.motion == Plan.motion else f"-{plan.motion:g}px"
    try:
        keep_apart("clips", args.out, trial=args.tiny)
        args.out.mkdir(parents=True, exist_ok=True)
        for name in args.rows.split(","):
            path = args.out / f"{name}-{plan.height}x{plan.width}{fast}.json"
            grow(path, plan, partial(measure, name, plan), page, busy=busy, marked_again=True)
    except ValueError as error:
        print(f"clip_rows: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
