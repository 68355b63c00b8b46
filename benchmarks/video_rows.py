"""Measures frames between frames: PSNR of estimated light where the true frames are known.

    python benchmarks/video_rows.py --page docs/results/video.md --data FOLDER     # ten minutes on one core

Every N-th frame of a clip is taken, and those between are estimated by optical flow, by blending both neighbours, and
by repeating the nearer one. Rendered clips are families of the scene library at 2000 frames per second. FOLDER holds
two real recordings, of which a row is made where their files are there: ball_12bit_THW.npy (a falling ball, 30,000
frames per second) and reds_2000fps_14x180x320.npz (a street, REDS, validation clip 000). PSNR is behind a peak of 2.5
times the mean light, at most its largest value.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import result_page
from numpy import ndarray as Array

from qsim.dataset.scene_rendering import render
from qsim.formats.between_frames import Between, estimator
from qsim.tables import markdown_table

FAMILIES = ("tumble", "walker", "flag", "fan", "room")
STEPS = (4, 8, 33, 66)  # frames of 2000 per second: 500, 250, 61 and 30 per second
REAL_STEPS = {"ball_12bit_THW.npy": (2, 7, 14), "reds_2000fps_14x180x320.npz": (2, 4, 12)}
FRAMES = 67
SIDE = 96  # px
ERROR = 35.0  # dB, of the rendered light
TRIED = 8  # frames between, at most, of each pair
HEADER = ("clip", "every", "px between frames", "repeated [dB]", "blended [dB]", "flow [dB]")


def rows(data: Path | None) -> Iterator[list[str]]:
    """Yield the cells of the table."""
    with tempfile.TemporaryDirectory() as folder:
        for family in FAMILIES:
            clip = render(
                family, Path(folder) / family, frames=FRAMES, height=SIDE, width=SIDE, psnr=ERROR, shutter=0.0
            )
            speeds = [np.hypot(*clip.flow(t))[clip.valid(t)] for t in range(0, FRAMES - 1, 16)]
            speed = float(np.percentile(np.concatenate(speeds), 90))
            for step in STEPS:
                yield [family, str(step), f"{step * speed:.1f}", *compared(clip[:], step)]
    for name, steps in REAL_STEPS.items():
        path = None if data is None else data / name
        if path is None or not path.is_file():
            continue
        found = np.load(path)
        light = found if isinstance(found, np.ndarray) else found["frames"]
        for step in steps:
            yield [path.stem, str(step), "", *compared(light.astype(np.float64), step)]


def compared(light: Array, step: int) -> list[str]:
    """Return the PSNR of repeating, blending and flow where every `step`-th frame of light [T, H, W] is taken."""
    light = light / min(2.5 * light.mean(), light.max())
    squares: dict[str, list[float]] = {"repeated": [], "blended": [], "flow": []}
    for start in range(0, len(light) - step, step):
        first = light[start]
        second = light[start + step]
        between = Between(first, second)
        for number in sorted(set(np.linspace(1, step - 1, TRIED).round().astype(int))):
            share = number / step
            truth = np.clip(light[start + number], 0, 1)
            made = {
                "repeated": first if share < 0.5 else second,
                "blended": (1 - share) * first + share * second,
                "flow": between.at(share)[0],
            }
            for name, found in made.items():
                squares[name].append(float(np.mean((np.clip(found, 0, 1) - truth) ** 2)))
    return [f"{-10 * np.log10(np.mean(each)):.1f}" for each in squares.values()]


def page(data: Path | None) -> str:
    """Return the page of the table."""
    lines = [
        *result_page.head("Frames between frames", "video_rows.py --page docs/results/video.md --data FOLDER"),
        f"Every N-th frame is taken; those between are estimated ({estimator()}), blended, or repeated.",
        f"Families are rendered without blur at 2000 frames per second, {SIDE} x {SIDE} px, to {ERROR:g} dB.",
        "Pixels between frames are the 90th percentile of the true flow.",
        "",
        *markdown_table(rows(data), HEADER),
        "",
        "`ball_12bit_THW` is a falling ball at 30,000 frames per second, `reds_2000fps_14x180x320` a street of REDS",
        "(Nah et al., CVPR Workshops 2019, CC BY 4.0), hand-held, with light that changes by 30 %.",
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    result_page.main(__doc__, page, data="folder of the real recordings")
