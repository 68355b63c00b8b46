"""Measures the windows per second of codes over several clip frames, and the share that reading takes.

    python benchmarks/sum_windows.py [-o DOCS.json]

A window of 11 codes of M planes reads 11 M crops of 64 x 64 px of a clip of 240 x 320 px. Seconds are those of one
core, whatever else runs. The light is random; files are in the cache of the system after the first window.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from qsim.clip.clip_info import RELATIVE, ClipInfo
from qsim.clip.writer import ClipWriter
from qsim.streams.clip import Clip
from quiver.data.illumination import Illumination
from quiver.data.windows import Windows, WindowSettings

PLANES = (1, 7, 31)
SECONDS = 5.0  # of each number of planes, at least
SIZE = (240, 320)


def clip_of(folder: Path, frames: int) -> Clip:
    """Return a clip of random light."""
    rng = np.random.default_rng(0)
    info = ClipInfo(shape=(frames, *SIZE), frame_rate=1e4, exposure=1e-4, radiance_unit=RELATIVE)
    with ClipWriter(folder, info) as writer:
        for t in range(frames):
            light = rng.uniform(0.1, 2.0, SIZE).astype(np.float32)
            writer.add(t, light, sharp=light)
    return Clip.open(folder)


def measured(clip: Clip, planes: int) -> dict[str, float]:
    """Return windows per second, and milliseconds of a window and of reading its light."""
    light = Illumination.of("spad-320x240", 4.9, planes.bit_length()).over(planes)
    data = Windows([clip], WindowSettings((light,), drift=3))
    data[0]  # tables, and files in the cache
    began = time.process_time()
    number = 0
    while time.process_time() - began < SECONDS:
        data[number]
        number += 1
    each = (time.process_time() - began) / number
    began = time.process_time()
    for n in range(number):
        data.photons_of(data.place(n))
    reading = (time.process_time() - began) / number
    return {"planes": planes, "windows_per_second": 1 / each, "ms": 1e3 * each, "ms_of_light": 1e3 * reading}


def main(words: list[str]) -> int:
    """Measure, print one row for each number of planes, and store the rows if asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    args = parser.parse_args(words)
    with tempfile.TemporaryDirectory() as folder:
        clip = clip_of(Path(folder) / "clip", 11 * max(PLANES) + 9)
        rows = [measured(clip, planes) for planes in PLANES]
    text = json.dumps(rows, indent=1)
    print(text)
    if args.output is not None:
        args.output.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
