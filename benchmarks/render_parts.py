"""Measures where the time of a rendered frame goes: its parts, and how much of each is outside of kernels.

    taskset -c 0 python benchmarks/render_parts.py fence > out/render_parts.json

Renders frames of one scene into a clip and prints JSON. For each part of a frame: `ms` by the clock, `kernels` of
these, `outside` = the rest, and `processor`, the time of its own thread. On one core kernels run in the first thread:
`processor, outside` takes their share of the clock off it. Beside other work this is the steadier number. Parts of
another thread run beside those of the first, and are marked. Each part is without the parts inside it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import scenes
from qsim import files
from qsim.clip import exr, writer
from qsim.rendering import clip_rendering, denoiser, ground_truth, renderer
from qsim.rendering.budget import DENOISE_COST, Budget
from qsim.rendering.mitsuba_scene import Stage
from qsim.rendering.ray_casting import RayCaster
from qsim.rendering.reuse import carrying, choice

FIRST = 2  # frames that do not count
PARTS: tuple[tuple[Any, str, str], ...] = (
    (Stage, "place", "scene update"),
    (Stage, "light", "scene update"),
    (renderer.Renderer, "means", "paths"),
    (carrying.Carrier, "_traced", "paths"),
    (carrying.Carrier, "pictures", "carried samples, the rest"),
    (carrying._Layers, "_coverage", "coverage"),
    (carrying._Layers, "add", "carried samples"),
    (carrying._Layers, "picture", "carried samples, pictures"),
    (renderer.Renderer, "surfaces", "surfaces"),
    (denoiser, "denoised", "denoiser"),
    (choice, "denoised", "denoiser"),
    (renderer, "cleaned_mean", "mixture"),
    (renderer, "reused_mean", "mixture"),
    (renderer, "best_of", "choice by tiles"),
    (renderer.Renderer, "_finished", "statistics"),
    (renderer.Renderer, "_shared", "statistics"),
    (renderer.Renderer, "_cut", "statistics"),
    (renderer.Renderer, "_seen", "truth"),
    (renderer.Renderer, "_truth", "truth"),
    (ground_truth, "flow_between", "truth, flow"),
    (RayCaster, "cast", "truth, rays"),
    (exr, "encode", "EXR"),
    (files, "write_bytes", "files and checksums"),
    (writer.ClipWriter, "add", "writer, the rest"),
)


class Enough(Exception):
    """All frames that count are rendered."""


class Clock:
    """Adds up the time of parts, each without those inside it."""

    def __init__(self) -> None:
        self.sums: dict[tuple[str, bool], list[float]] = defaultdict(lambda: [0.0, 0.0, 0.0])
        self._open = threading.local()

    def part(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function as a part of a frame."""

        def timed(*arguments: Any, **options: Any) -> Any:
            inside = getattr(self._open, "inside", None)
            self._open.inside = own = [0.0, 0.0, 0.0]
            first = threading.current_thread() is threading.main_thread()
            if first and inside is not None:
                inside[1] += self._kernels()
            started = time.perf_counter(), time.thread_time()
            try:
                return function(*arguments, **options)
            finally:
                own[1] += self._kernels() if first else 0.0
                whole = time.perf_counter() - started[0], time.thread_time() - started[1]
                found = self.sums[name, first]
                for i, spent in enumerate((whole[0] - own[0], own[1], whole[1] - own[2])):
                    found[i] += spent
                self._open.inside = inside
                if inside is not None:
                    inside[0] += whole[0]
                    inside[2] += whole[1]

        return timed

    def _kernels(self) -> float:
        """Return the run time [s] of the kernels since the last call."""
        import drjit

        return sum(entry["execution_time"] for entry in drjit.kernel_history()) / 1e3


def main() -> None:
    """Print the parts of a frame."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("family", help="scene")
    parser.add_argument("--size", type=int, nargs=2, default=(512, 1024), help="rows and columns")
    parser.add_argument("--samples", type=int, default=8, help="samples per pixel")
    parser.add_argument("--bounces", type=int, default=4, help="bounces of a path")
    parser.add_argument("--frames", type=int, default=4, help="frames that count")
    parser.add_argument("--seed", type=int, default=3, help="seed of the scene")
    parser.add_argument("--speed", type=float, default=1.0, help="factor of every motion")
    parser.add_argument("--denoise", choices=list(DENOISE_COST), default="", help="denoise with this quality")
    parser.add_argument("--neighbours", type=int, default=0, help="frames on each side that share samples")
    asked = parser.parse_args()
    scene = scenes.load(asked.family, seed=asked.seed, speed=asked.speed).resized(*asked.size)
    budget = Budget(
        samples=asked.samples,
        bounces=asked.bounces,
        denoise=bool(asked.denoise),
        quality=asked.denoise or "high",
        neighbours=asked.neighbours,
    )
    engine = renderer.Renderer(scene, budget=budget).engine  # loads Dr.Jit with its LLVM
    import drjit

    clock = Clock()
    for place, name, part in PARTS:
        setattr(place, name, clock.part(part, getattr(place, name)))
    marks: list[tuple[float, float]] = []
    sums: dict[tuple[str, bool], tuple[float, ...]] = {}

    def progress(done: int, _: int) -> None:
        if done == FIRST:  # the first frames load and compile
            clock.sums.clear()
            drjit.kernel_history_clear()
        # At both marks one frame more than `done` is traced: the last of a clip, which nothing follows, does not count.
        if done in (FIRST, FIRST + asked.frames):
            marks.append((time.perf_counter(), time.process_time()))
            sums.update((part, tuple(spent)) for part, spent in clock.sums.items())
        if done == FIRST + asked.frames:
            raise Enough

    with (
        tempfile.TemporaryDirectory() as folder,
        drjit.scoped_set_flag(drjit.JitFlag.KernelHistory, True),
        contextlib.suppress(Enough),
    ):
        frames = FIRST + asked.frames + 1 + asked.neighbours
        clip_rendering.render_clip(scene, Path(folder) / "clip", frames=frames, budget=budget, progress=progress)
    rows = [
        {
            "part": part,
            "beside": not first,
            "ms": round(1e3 * spent / asked.frames, 1),
            "kernels": round(1e3 * kernels / asked.frames, 1),
            "outside": round(1e3 * (spent - kernels) / asked.frames, 1),
            "processor": round(1e3 * processor / asked.frames, 1),
            "processor, outside": round(1e3 * processor * (1 - kernels / spent) / asked.frames, 1),
        }
        for (part, first), (spent, kernels, processor) in sums.items()
    ]
    whole = [1e3 * (after - before) / asked.frames for before, after in zip(*marks, strict=True)]
    in_line = [row for row in rows if not row["beside"]]
    found = {
        "family": asked.family,
        "engine": engine.backend,
        "size": list(asked.size),
        "samples": asked.samples,
        "denoised": asked.denoise,
        "ms of a frame": round(whole[0], 1),
        "processor ms of a frame": round(whole[1], 1),
        "outside of kernels, in line": round(sum(row["outside"] for row in in_line), 1),
        "the same of the processor": round(sum(row["processor, outside"] for row in in_line), 1),
        "parts": rows,
    }
    json.dump(found, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
