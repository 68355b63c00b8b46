"""Measures how often the 95 % intervals of a camera's calibration hold the truth; writes docs/results/coverage.md.

    python benchmarks/coverage_cameras.py [SENSORS]      # 200 of each band of gain x read noise; a second each

Continues what out/coverage_cameras.json holds. The frames come from benchmarks/calibration_simulator.py, which shares
no code with qsim. Every sensor is another one: gain, read noise, bits, size, frames, light, vignetting, drift, hot
pixels and number of dark exposures are drawn at random.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from math import isnan, sqrt
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from calibration_simulator import Camera, random_camera  # noqa: E402
from coverage_page import cell, store, stored, write_page  # noqa: E402

from qsim.calibration import calibrate_qis, measure  # noqa: E402

BANDS = ((0.1, 0.25), (0.25, 0.5), (0.5, 1.0), (1.0, 2.5), (2.5, 12.0))  # gain x read noise, codes
NAMES = (
    "gain",
    "offset",
    "read_noise",
    "dark_current",
    "quantum_efficiency",
    "prnu",
    "gain_transfer",
    "read_noise_transfer",
    "dark_current_transfer",
)


def hits_of(camera: Camera, rng: np.random.Generator) -> dict[str, bool]:
    """Return for every printed interval of one camera whether it holds the truth."""
    dark_frames, flat_frames = camera.measure(rng)
    darks = [measure([codes], bits=camera.bits, exposure=t, photons=0.0) for codes, t in dark_frames]
    flats = [measure([codes], bits=camera.bits, exposure=t, photons=p) for codes, t, p in flat_frames]
    found = calibrate_qis(darks, flats, bits=camera.bits)
    truth = camera.truth()
    hits = {
        name: bool(value.low <= truth[name] <= value.high)
        for name, value in found.values.items()
        if name in truth and not isnan(value.low)
    }
    return hits | {"warned": any("model is wrong" in words for words in found.warnings)}


def measured(band: tuple[float, float], sensors: Iterable[int]) -> Iterator[dict[str, bool]]:
    """Yield the hits of the random cameras with these numbers; an error counts as a sensor without intervals."""
    for number in sensors:
        rng = np.random.default_rng([int(1000 * band[0]), number])
        camera = random_camera(rng, band)
        began = time.process_time()
        try:
            hits = hits_of(camera, rng)
        except ValueError as refused:
            hits = {"refused": True}
            print(f"{number}: {refused}", file=sys.stderr, flush=True)
        missed = [name for name, hit in hits.items() if not hit and name != "warned"]
        print(f"{number} {time.process_time() - began:.1f} s {missed or ''} {camera if missed else ''}", flush=True)
        yield hits


def table(rows: dict[str, list[dict[str, bool]]]) -> list[str]:
    """Return the lines on all bands of cameras."""
    count = max(len(hits) for hits in rows.values())
    lines = [
        f"Each row is up to {count} random cameras. A number of a full row is known to ± "
        f"{100 * sqrt(0.95 * 0.05 / count):.1f} (one standard deviation).",
        "Drawn at random:",
        "",
        "- read noise of 0.12 to 5 e-, and 2 to 12 bits;",
        "- 12 x 12 to 64 x 64 pixels, and 4 to 40 frames of each stack;",
        "- one, two or three dark exposures of 1 µs to 300 s, and three to five flats;",
        "- PRNU of 0.5 to 4 %, and up to 50 % of the light lost in the corners;",
        "- in half of the cameras 0.5 % drift of the light between frames and between flats;",
        "- 0 to 2 % hot pixels at 5 to 30 times the dark current, some of them saturated.",
        "",
        "An empty cell: nothing is printed. A number in brackets: printed for so many of the cameras.",
        "",
        "| gain x read noise, codes | cameras | " + " | ".join(f"`{name}`" for name in NAMES) + " | warned |",
        "|---|--:|" + "--:|" * (len(NAMES) + 1),
    ]
    everything = [hits for row in rows.values() for hits in row]
    for name, hits in [*rows.items(), ("all", everything)]:
        cells = [cell([h[value] for h in hits if value in h], len(hits)) for value in NAMES]
        warned = 100 * np.mean([h.get("warned", False) for h in hits])
        lines.append(f"| {name} | {len(hits)} | " + " | ".join(cells) + f" | {warned:.1f} |")
    return [
        *lines,
        "",
        "The last column is the share with the warning that the model is wrong. It is right for all of them, and the",
        "warning is printed at a p-value below 0.001.",
    ]


def main(sensors: int) -> None:
    rows = stored("coverage_cameras")
    for number in range(sensors):
        for band in BANDS:
            row = rows.setdefault(f"{band[0]:g} to {band[1]:g}", [])
            if len(row) == number:
                row += measured(band, [number])
                store("coverage_cameras", rows)
    write_page()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
