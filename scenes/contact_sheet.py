"""Renders a picture of every family and measures its motion.

    python -m scenes.contact_sheet -o docs/pictures/scenes.jpg

Each row is one family, one seed after the other. The motion is that of the true flow between two frames in the middle
of a clip at 2000 frames per second and speed 1, over the pixels that move, scaled to 512 x 1024.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from qsim import scenes
from qsim.colour import tone
from qsim.scenes.common import FRAME_RATE, HEIGHT

FRAME = 8  # index of the rendered frame
MOVES = 0.05  # px/frame at 512 x 1024; slower pixels count as still


def picture(family: str, seed: int, height: int, samples: int) -> tuple[NDArray[np.uint8], float, float, float]:
    """Return a tone-mapped frame, and mean, largest motion and fraction of moving pixels [px/frame at 512 x 1024]."""
    from qsim.rendering import Budget, Renderer

    renderer = Renderer(
        scenes.load(family, seed).resized(height, 2 * height), frame_rate=FRAME_RATE, budget=Budget(samples=samples)
    )
    frame = renderer.frame(FRAME)
    assert frame.flow is not None
    motion = np.hypot(*frame.flow) * HEIGHT / height
    moving = motion[motion > MOVES]
    grey = tone(frame.radiance, float(np.percentile(frame.radiance, 99.5)))
    return grey, float(moving.mean()), float(moving.max()), moving.size / motion.size


def sheet(rows: dict[str, list[NDArray[np.uint8]]], columns: int) -> Image.Image:
    """Return the page: families in `columns` columns, each with its name over the pictures of its seeds."""
    height, width = next(iter(rows.values()))[0].shape
    line = 14
    gap = 3
    cell = (height + line + gap, len(next(iter(rows.values()))) * (width + gap))
    page = Image.new("L", (columns * cell[1] - gap, math.ceil(len(rows) / columns) * cell[0] - gap), 255)
    draw = ImageDraw.Draw(page)
    for i, (family, pictures) in enumerate(rows.items()):
        top = i // columns * cell[0]
        left = i % columns * cell[1]
        draw.text((left + 2, top + 1), family, fill=0)
        for k, grey in enumerate(pictures):
            page.paste(Image.fromarray(grey), (left + k * (width + gap), top + line))
    return page


def main() -> None:
    """Render the sheet and print the measured motion."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True, help="the picture (.jpg or .png)")
    parser.add_argument("--families", nargs="+", default=list(scenes.FAMILIES), help="which (default all)")
    parser.add_argument("--seeds", type=int, default=3, help="seeds per family (default 3)")
    parser.add_argument("--height", type=int, default=96, help="of one picture, px (default 96)")
    parser.add_argument("--samples", type=int, default=64, help="per pixel (default 64)")
    args = parser.parse_args()
    rows = {}
    print("family      mean motion of each seed [px/frame]   largest   moving share")
    for family in args.families:
        found = [picture(family, seed, args.height, args.samples) for seed in range(args.seeds)]
        means = " ".join(f"{mean:5.2f}" for _, mean, _, _ in found)
        largest = max(f[2] for f in found)
        share = float(np.mean([f[3] for f in found]))
        print(f"{family:10}  {means:36}  {largest:7.1f}  {share:13.3f}", flush=True)
        rows[family] = [grey for grey, *_ in found]
    args.output.parent.mkdir(parents=True, exist_ok=True)
    sheet(rows, 2).save(args.output, quality=80)


if __name__ == "__main__":
    main()
