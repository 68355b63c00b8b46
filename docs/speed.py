"""Seconds per restored 512 x 1024 frame of every classical method, as a Markdown table.

    python docs/speed.py

A stack of one frame takes the work of one restored frame: its window is the same frame eleven times. The pixelwise
methods are timed on 32 frames, because theirs are too short to time alone. Light is a photograph, 3 bits, 3.25 PPP.
"""

from __future__ import annotations

import time

import numpy as np
from skimage import data

from qsim.devices import quiver_physical
from qsim.keys import Key
from quiver.baselines import METHODS

EXPOSURE = 5e-4  # s
MANY = ("naive", "moment")  # thousandths of a second per frame


def main() -> None:
    photograph = data.camera().astype(float)
    photons = np.hstack([photograph, photograph[:, ::-1]])
    photons *= 3.25 / photons.mean()
    sensor = quiver_physical(3.25)
    codes = sensor.sample(np.broadcast_to(photons, (32, *photons.shape)), EXPOSURE, key=Key(0, 0))
    print("| method | s per 512 x 1024 frame | frames per s |\n|---|---|---|")
    for name, method in METHODS.items():
        stack = codes if name in MANY else codes[:1]
        method.restore(stack[:, :64, :64], sensor, EXPOSURE)  # tables are made and kept
        started = time.perf_counter()
        method.restore(stack, sensor, EXPOSURE)
        seconds = (time.perf_counter() - started) / len(stack)
        print(f"| {name} | {seconds:.3g} | {1 / seconds:.3g} |", flush=True)


if __name__ == "__main__":
    main()
