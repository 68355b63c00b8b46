"""Measures what a frame of equal error costs here and in Blender's Cycles 5.0, on the same scenes and two threads.

    python benchmarks/cycles_rows.py --cycles PYTHON                # three scenes at 128 x 256: an hour or two
    python benchmarks/cycles_rows.py --cycles PYTHON --rows plain --busy
    python benchmarks/cycles_rows.py --cycles PYTHON --tiny --out out/rows      # minutes: a test of this program

PYTHON is that of an environment with bpy, which cycles_render.py alone imports. A row is RESULTS/SCENE-SIZE.json. It is
written when it is complete, and made once. Only missing rows are made, and marked ones again on quiet cores.

Per row: the converged pictures of both programs are compared first; no time is measured unless they agree to AGREED dB.
Then our clip, with the budget that asks for the PSNR, and the clips of Cycles are rendered in turn: ours, one setting,
ours, the next. Samples double until a setting reaches both the asked PSNR and what ours reached. Seconds are medians
over frames and rounds, without the first frame, which loads and compiles. The squared error of a picture F is the mean
of (F - R1)(F - R2), clamped at white, for two halves R1 and R2 of the converged picture of the same program.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cycles_scene
import numpy as np
from cycles_page import page
from numpy import ndarray as Array
from reuse_rows import decibels, steady_frames
from rows import ROOT, grow, keep_apart

from qsim import scenes
from qsim.clip.clamped_error import white_in
from qsim.rendering.budget import Budget
from qsim.rendering.fidelity import DEEPEST, choose_budget
from qsim.rendering.renderer import Renderer
from qsim.scene import Scene

FAMILIES = ("plain", "glossy", "room")
SAMPLES = (1, 2, 4, 8, 16, 32, 64)
# Prefilter and quality of the denoiser in Cycles' words; its default first
DENOISERS = {"OIDN": "ACCURATE/HIGH", "OIDN, no prefilter": "NONE/HIGH", "OIDN, fast": "FAST/FAST", "raw": None}
AGREED = 50.0  # dB below white
SIGMAS = 3  # standard errors of the squared difference that count as difference


@dataclass(frozen=True)
class Plan:
    """What one row measures."""

    height: int = 128
    width: int = 256
    frames: int = 16
    judged: tuple[int, ...] = (2, 7, 13)
    level: float = 40.0  # asked, dB below white
    scene_seed: int = 4
    seed: int = 61  # of our samples
    reference: int = 256  # samples per pixel of each half of a converged picture
    rounds: int = 1
    threads: int = 2
    most: int = SAMPLES[-1]  # samples of Cycles


@dataclass
class Timed:
    """Seconds of the frames of one setting, [wall, processor] each, and the pictures of the judged frames."""

    seconds: list[Any] = field(default_factory=list)
    pictures: Array = field(default_factory=lambda: np.zeros(0))  # [J, H, W]; every round draws the same

    def row(self, references: Array, white: float) -> dict[str, Any]:
        """Return what was measured, by the references [2, J, H, W]."""
        wall, used = np.median(self.seconds, axis=0)
        return {
            "reached": round(reached(self.pictures, references, white), 2),
            "wall_seconds": round(float(wall), 4),
            "processor_seconds": round(float(used), 4),
        }


class Cycles:
    """The other program, on one neutral file."""

    def __init__(self, python: str, folder: Path, plan: Plan) -> None:
        self.scene = folder / "scene.npz"
        self._out = folder / "out.npz"
        self._plan = plan
        self._start = [python, str(ROOT / "benchmarks" / "cycles_render.py"), str(self.scene), str(self._out)]

    def render(self, samples: int, bounces: int, *options: str) -> dict[str, Array]:
        """Return radiance [T, H, W] and seconds [T, 2]; `ValueError` with the last line of its error."""
        numbers = ["--samples", samples, "--bounces", bounces, "--threads", self._plan.threads]
        line = [*self._start, *map(str, numbers), *options]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode:
            said = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise ValueError(f"cycles_render.py stopped with code {done.returncode}: {said}")
        with np.load(self._out) as found:
            return {name: found[name] for name in found.files}

    def converged(self) -> Array:
        """Return two independent pictures of the judged frames, float64 [2, J, H, W]."""
        frames = ",".join(map(str, self._plan.judged))
        halves = [
            self.render(self._plan.reference, DEEPEST, "--seed", str(seed), "--frames", frames)["radiance"]
            for seed in (1001, 1002)
        ]
        return np.asarray(halves, np.float64)


class Ours:
    """One way of ours to render the clip, with its budget."""

    def __init__(self, scene: Scene, plan: Plan, reuse: bool) -> None:
        started = time.process_time()
        self.budget = choose_budget(scene, frames=plan.frames, psnr=plan.level, seed=plan.seed, reuse=reuse)
        self.choosing = time.process_time() - started
        self.renderer = Renderer(scene, budget=self.budget, seed=plan.seed, frames=plan.frames)
        self._plan = plan
        self.timed = Timed()

    def render(self) -> None:
        """Render the clip once."""
        pictures = []
        for t in range(self._plan.frames):
            wall = time.perf_counter()
            used = time.process_time()
            picture = self.renderer.frame(t, with_truth=False).radiance
            if t in steady_frames(self._plan, self.budget.neighbours):
                self.timed.seconds.append([time.perf_counter() - wall, time.process_time() - used])
            pictures.append(picture)
        self.timed.pictures = np.stack([pictures[t] for t in self._plan.judged])

    def row(self, references: Array, white: float) -> dict[str, Any]:
        """Return the budget and what was measured."""
        budget = {name: getattr(self.budget, name) for name in ("samples", "neighbours", "denoise", "bounces")}
        return budget | {"choosing_seconds": round(self.choosing, 2)} | self.timed.row(references, white)


def reached(pictures: Array, references: Array, white: float) -> float:
    """Return the PSNR of pictures [J, H, W], by references [2, J, H, W] whose noise cancels."""
    apart = np.minimum(np.asarray(pictures, np.float64), white) - np.minimum(references, white)
    return decibels(white, float(np.mean(apart[0] * apart[1])))


def agreement(ours: Array, theirs: Array, white: float) -> dict[str, float]:
    """Return how converged pictures [2, J, H, W] of both programs agree, their noise taken out.

    `difference` is in dB below white, with SIGMAS standard errors added to its square; `as_seen` has the noise of both.
    `mean` is the mean light of theirs over ours, less 1, and `mean_error` its standard error.
    """
    apart = np.minimum(theirs, white) - np.minimum(ours, white)
    product = apart[0] * apart[1]
    error = float(product.std() / np.sqrt(product.size))
    spread = [float(np.std(each[0] - each[1]) / 2 / np.sqrt(each[0].size)) for each in (ours, theirs)]
    return {
        "difference": round(decibels(white, max(float(product.mean()), 0.0) + SIGMAS * error), 2),
        "as_seen": round(decibels(white, float(np.mean(apart.mean(axis=0) ** 2))), 2),
        "mean": float(theirs.mean() / ours.mean()) - 1,
        "mean_error": float(np.hypot(*spread) / ours.mean()),
    }


def measure(family: str, plan: Plan, python: str) -> dict[str, Any]:
    """Return the row of a family."""
    scene = scenes.load(family, seed=plan.scene_seed).resized(plan.height, plan.width)
    scene = cycles_scene.with_shared_materials(scene)
    with tempfile.TemporaryDirectory() as folder:
        cycles = Cycles(python, Path(folder), plan)
        deep = Renderer(scene, budget=Budget(plan.reference * 2, DEEPEST), seed=plan.seed + 1000)
        cycles_scene.write(scene, [deep.time(t) for t in range(plan.frames)], cycles.scene)
        halves = [deep.halves([deep.time(t)], deep.budget, deep.key(t)) for t in plan.judged]
        own = np.stack(halves, axis=1)
        other = cycles.converged()
        white = white_in(own.mean(axis=0))
        agree = agreement(own, other, white)
        if agree["difference"] < AGREED:
            raise ValueError(
                f"{family}: the converged pictures agree to {agree['difference']:.1f} dB only, and a comparison of "
                f"times needs {AGREED:g}; give more --reference samples, or find what differs"
            )
        ours = [Ours(scene, plan, reuse) for reuse in (False, True)]
        ours = [each for each in ours if each.budget.neighbours or each is ours[0]]
        for each in ours:
            each.render()
        wanted = max(plan.level, *(reached(each.timed.pictures, own, white) for each in ours))
        theirs = in_turns(cycles, ours, plan, lambda found: reached(found, other, white) >= wanted)
    rows = [
        {"denoiser": kind, "samples": samples, **timed.row(other, white)} for (kind, samples), timed in theirs.items()
    ]
    return {"agreement": agree, "ours": [each.row(own, white) for each in ours], "cycles": rows}


def in_turns(
    cycles: Cycles, ours: list[Ours], plan: Plan, enough: Callable[[Array], bool]
) -> dict[tuple[str, int], Timed]:
    """Return the clips of Cycles by denoiser and samples, each rendered after ours, `plan.rounds` times.

    Samples double until `enough(pictures)` is true for the judged frames.
    """
    found: dict[tuple[str, int], Timed] = {}
    for turn in range(plan.rounds):
        for kind, words in DENOISERS.items():
            for samples in SAMPLES:
                if samples > plan.most or (turn and (kind, samples) not in found):
                    continue
                for each in ours:
                    each.render()
                options = [] if words is None else ["--denoise", words]
                clip = cycles.render(samples, ours[0].budget.bounces, *options)
                timed = found.setdefault((kind, samples), Timed())
                timed.seconds += clip["seconds"][1:].tolist()
                timed.pictures = clip["radiance"][list(plan.judged)]
                if not turn and enough(timed.pictures):
                    break
    return found


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycles", metavar="PYTHON", required=True, help="of the environment with bpy")
    parser.add_argument("--rows", default=",".join(FAMILIES), help="families, separated by commas (default: all)")
    parser.add_argument("--size", default="128x256", help="HEIGHTxWIDTH in px (default 128x256)")
    parser.add_argument("--reference", type=int, default=Plan.reference, help="samples of half a converged picture")
    parser.add_argument("--rounds", type=int, default=Plan.rounds, help=f"times each clip (default {Plan.rounds})")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "cycles", help="folder of the rows")
    parser.add_argument("--busy", action="store_true", help="also beside other programs; such rows are marked")
    parser.add_argument("--tiny", action="store_true", help="few and small frames: a test of this program")
    args = parser.parse_args(words)
    height, width = map(int, args.size.split("x"))
    plan = Plan(height, width, reference=args.reference, rounds=args.rounds)
    if args.tiny:
        plan = Plan(32, 48, frames=4, judged=(1, 2), level=25.0, reference=args.reference, rounds=1, most=2)
    use_only(plan.threads)
    busy = args.busy or args.tiny
    try:
        keep_apart("cycles", args.out, trial=args.tiny)
        args.out.mkdir(parents=True, exist_ok=True)
        for family in args.rows.split(","):
            path = args.out / f"{family}-{plan.height}x{plan.width}.json"
            grow(path, plan, partial(beside_cycles, family, plan, args.cycles), page, busy=busy, marked_again=True)
    except (ValueError, OSError) as error:
        print(f"cycles_rows: {error}", file=sys.stderr)
        return 2
    return 0


def beside_cycles(family: str, plan: Plan, python: str) -> dict[str, Any]:
    """Return the row of a family; `ValueError` if this is not the Python of an environment with bpy."""
    check(python)
    return measure(family, plan, python)


def check(python: str) -> None:
    """Raise `ValueError` if this is not the Python of an environment with bpy."""
    try:
        found = subprocess.run([python, "-c", "import bpy"], capture_output=True, check=False).returncode == 0
    except OSError:
        found = False
    if not found:
        raise ValueError(
            f"--cycles {python}: expected a Python that imports bpy; make one: pip install bpy==5.0.0 numpy"
        )


def use_only(threads: int) -> None:
    """Keep this program and those that it starts on so many cores, where the system can."""
    os.environ["QSIM_THREADS"] = str(threads)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])


if __name__ == "__main__":
    sys.exit(main())
