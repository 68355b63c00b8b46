"""Measures the error of flow that is composed over the planes of a code, against flow between the two instants.

    python benchmarks/composed_flow.py [--planes 7,31] [--speed 4] [-o ROWS.json]

Both are computed from the known motion of a scene at 10,000 planes per second, without light.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import scenes
from qsim.clip.composed_flow import composed
from qsim.rendering.renderer import Renderer

RATE = 1e4  # planes per second
SIZE = (120, 160)
CODES = 3  # of each scene
FAMILIES = ("fan", "gears", "flag", "fence", "text", "drums", "tumble", "walker")


@dataclass
class Frames:
    """The ground truth of a scene, frame by frame, as `composed` reads it."""

    renderer: Renderer
    found: dict[int, dict[str, Array]] = field(default_factory=dict)

    def of(self, t: int) -> dict[str, Array]:
        """Return the truth of frame t."""
        if t not in self.found:
            self.found[t] = self.renderer.truth(t)
        return self.found[t]

    def flow(self, t: int) -> Array:
        """Return flow, float32 [2, H, W] px."""
        return self.of(t)["flow"]

    def valid(self, t: int) -> Array:
        """Return bool [H, W]."""
        return self.of(t)["valid"]

    def holds(self, channel: str) -> bool:
        """Return True: nothing is missing."""
        return True

    def body_id(self, t: int) -> Array:
        """Return the body of each pixel, int32 [H, W]."""
        return self.of(t)["body_id"]

    def depth(self, t: int) -> Array:
        """Return the depth of each pixel, float32 [H, W] m."""
        return self.of(t)["depth"]


def measured(family: str, planes: int, speed: float) -> dict[str, Any]:
    """Return the motion of a scene, the errors of its composed flow [px], and the share of points that were lost."""
    scene = scenes.load(family, seed=7, speed=speed).resized(*SIZE)
    single = Frames(Renderer(scene, frame_rate=RATE))
    whole = Renderer(scene, frame_rate=RATE / planes)
    lengths = []
    errors = []
    lost = 0
    seen = 0
    for t in range(CODES):
        direct = whole.truth(t)
        flow, valid = composed(single, t * planes, (t + 1) * planes)
        moving = direct["valid"] & (np.hypot(*direct["flow"]) > 0.1)
        both = moving & valid
        lengths.append(np.hypot(*direct["flow"])[both])
        errors.append(np.hypot(*(flow - direct["flow"]))[both])
        seen += int(moving.sum())
        lost += int((moving & ~valid).sum())
    length = np.concatenate(lengths)
    error = np.concatenate(errors)
    return {
        "scene": family,
        "planes": planes,
        "mean_px": float(length.mean()),
        "median_error_px": float(np.median(error)),
        "rms_error_px": float(np.sqrt(np.mean(error**2))),
        "p99_error_px": float(np.quantile(error, 0.99)),
        "lost": lost / max(seen, 1),
    }


def main(words: list[str]) -> int:
    """Measure every scene, print a table in Markdown, and store the rows if asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--planes", default="7,31", help="numbers of planes of a code, comma-separated")
    parser.add_argument("--speed", type=float, default=4.0, help="factor on all motions")
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    args = parser.parse_args(words)
    rows = []
    print("| scene | planes | mean motion [px] | median error [px] | rms error | 99th percentile | points lost |")
    print("|---|---|---|---|---|---|---|")
    for planes in map(int, args.planes.split(",")):
        for family in FAMILIES:
            row = measured(family, planes, args.speed)
            rows.append(row)
            print(
                f"| {family} | {planes} | {row['mean_px']:.2f} | {row['median_error_px']:.1e} | "
                f"{row['rms_error_px']:.1e} | {row['p99_error_px']:.1e} | {100 * row['lost']:.1f} % |",
                flush=True,
            )
    if args.output is not None:
        args.output.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
