"""Measures the seconds per restored 512 x 1024 frame of every classical method and prints a Markdown table.

    python docs/speed.py

A stack of one frame costs as much as one restored frame: its window is the same frame eleven times. Methods that treat
one pixel at a time are timed on 16 frames, whose windows differ. `path-merge` has no frames beyond the ends of a stream
in its windows: it is timed on the six frames of 16 whose windows are complete. The light is a photograph, 3 bits,
3.25 PPP. Every method runs twice, and the second run is timed.
"""

from __future__ import annotations

import time

import numpy as np
from skimage import data

from qsim.keys import Key
from qsim.sensor.devices import quiver_physical
from qsim.tables import markdown_table
from quiver.baselines import METHODS

EXPOSURE = 5e-4  # s
PIXELWISE = ("naive", "moment", "likelihood")
UNREFLECTED = "path-merge"
FRAMES = 16


def main() -> None:
    photograph = data.camera().astype(float)
    photons = np.hstack([photograph, photograph[:, ::-1]])
    photons *= 3.25 / photons.mean()
    sensor = quiver_physical(3.25)
    codes = sensor.sample(np.broadcast_to(photons, (FRAMES, *photons.shape)), EXPOSURE, key=Key(0, 0))
    header = ("method", "s per 512 x 1024 frame", "frames per s")
    print("\n".join(markdown_table([], header)))
    for name, method in METHODS.items():
        stack = codes if name in (*PIXELWISE, UNREFLECTED) else codes[:1]
        frames = range(5, FRAMES - 5) if name == UNREFLECTED else range(len(stack))
        method.restore(stack, sensor, EXPOSURE, frames=frames)
        started = time.perf_counter()
        method.restore(stack, sensor, EXPOSURE, frames=frames)
        seconds = (time.perf_counter() - started) / len(frames)
        print(markdown_table([(name, f"{seconds:.3g}", f"{1 / seconds:.3g}")], header)[-1], flush=True)


if __name__ == "__main__":
    main()
