"""Measures how often the 95 % intervals of a SPAD array's calibration hold the truth; writes docs/results/coverage.md.

    python benchmarks/coverage_spad.py [ARRAYS [VALUES [KIND]]]    # 200 of each kind, of at most 1e6 values a flat

A value is a pixel of a frame; KIND is the beginning of the names of kinds, as in counter.

Continues what out/coverage_spad.json holds. The frames come from benchmarks/calibration_simulator.py, which knows
nothing of qsim; planes and counters of 1 to 8 bits.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from math import isnan, sqrt
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from calibration_simulator import SPADArray, vignetting  # noqa: E402
from coverage_page import cell, store, stored, write_page  # noqa: E402

from qsim.calibration import Calibration, calibrate_spad, measure  # noqa: E402

EFFICIENCY = 0.4


@dataclass(frozen=True)
class SPADCase:
    """One kind of SPAD array and of recording; None is drawn anew for every array."""

    bits: int = 1
    planes: int | None = None  # frames of a flat
    side: int | None = None  # px
    hot: float | None = None  # share of hot pixels
    hottest: float = 8.0  # dark counts per exposure of the hottest pixel
    afterpulsing: float | None = None
    crosstalk: float | None = None
    dead_time: float | None = None  # of the exposure
    light: tuple[float, float] = (0.2, 1.2)  # avalanches per exposure, of the dimmest and the brightest flat
    flats: int = 2
    dark: float | None = None  # dark counts per exposure of the median pixel
    dark_exposures: tuple[float, ...] = (1.0,)  # in exposures of the flats
    spread: float | None = None  # of the logarithm of the dark rate
    prnu: float | None = None
    vignetting: float | None = None  # light lost in the corners
    drift: float = 0.005
    most_values: float = 1e6  # pixels x frames, that limit the time of a test


def _either(value: float | None, rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high)) if value is None else value


def _of(value: float | None, rng: np.random.Generator, choices: tuple[float, ...]) -> float:
    return float(rng.choice(choices)) if value is None else value


def calibrated(case: SPADCase, rng: np.random.Generator) -> tuple[Calibration, dict[str, float]]:
    """Draw an array, record and calibrate it; return the result and the true values."""
    side = int(rng.integers(12, 65)) if case.side is None else case.side
    most = max(min(5000, case.most_values / side**2), 50)
    planes = int(np.exp(rng.uniform(np.log(50), np.log(most)))) if case.planes is None else case.planes
    shape = (side, side)
    exposure = float(10 ** rng.uniform(-7, 1))
    pattern = 1 + _either(case.prnu, rng, 0.01, 0.1) * rng.standard_normal(shape)
    pattern /= pattern.mean()
    prnu = float(pattern.std())
    dark = float(np.exp(_either(None if case.dark is None else np.log(case.dark), rng, np.log(1e-3), np.log(2e-2))))
    rate = dark * rng.lognormal(0, _either(case.spread, rng, 0.0, 0.8), shape)
    population = dark
    hot = rng.random(shape) < _of(case.hot, rng, (0.0, 0.005, 0.02))
    rate[hot] = dark * np.exp(rng.uniform(np.log(15), np.log(max(case.hottest / dark, 20)), int(hot.sum())))
    array = SPADArray(
        EFFICIENCY * pattern,
        rate / exposure,
        case.bits,
        0.0 if case.bits == 1 else _of(case.dead_time, rng, (0.01, 0.03)) * exposure,
        _of(case.afterpulsing, rng, (0.0, 0.03, 0.1)),
        _of(case.crosstalk, rng, (0.0, 0.003)),
    )
    shading = vignetting(shape, _either(case.vignetting, rng, 0.0, 0.5), tuple(rng.uniform(-0.2, 0.2, 2)))
    darks = [
        measure(
            [array.frames(rng, np.zeros(shape), exposure * times, 2 * planes)],
            bits=case.bits,
            exposure=exposure * times,
            photons=0.0,
        )
        for times in case.dark_exposures
    ]
    flats = []
    for level in np.geomspace(*case.light, case.flats):
        photons = level / EFFICIENCY
        frames = array.frames(rng, photons * shading, exposure, planes, case.drift)
        flats.append(measure([frames], bits=case.bits, exposure=exposure, photons=photons))
    found = calibrate_spad(darks, flats, bits=case.bits)
    # The light standard is the mean over the field, so the efficiency is weighted by its shading.
    truth = {
        "dark_count_rate": float(array.dark_rate.mean()),
        "dark_count_rate_good": float(array.dark_rate[~found.maps["hot_pixels"]].mean()),
        "pde_fill": float((array.efficiency * shading).mean()),
        "prnu": prnu,
        "afterpulsing": array.afterpulsing,
        "crosstalk": array.crosstalk,
        "dead_time": array.dead_time,
    }
    z_of = {"median": 50.0} | {f"p{p:g}": p for p in (1, 10, 25, 75, 90, 99, 99.9)}
    for name, percent in z_of.items():
        truth[f"dark_count_rate_{name}"] = float(np.percentile(array.dark_rate, percent))
    truth["population median"] = population / exposure
    return found, truth


CASES: dict[str, SPADCase] = {
    "planes": SPADCase(),
    "planes, saturated hot pixels": SPADCase(hot=0.02, hottest=30.0, planes=200),
    "planes, 10 % afterpulses": SPADCase(afterpulsing=0.1, crosstalk=0.003),
    "planes, few and small": SPADCase(planes=50, side=12),
    "planes, many": SPADCase(planes=3000, side=24),
    "planes, several dark exposures": SPADCase(dark_exposures=(1.0, 10.0, 40.0), hot=0.02),
    "planes, equal dark rates": SPADCase(spread=0.0, hot=0.0, dark=2e-3, planes=150),
    "planes, bright": SPADCase(light=(1.0, 2.5)),
    "counter, 2 bits": SPADCase(bits=2, light=(0.3, 1.5)),
    "counter, 3 bits": SPADCase(bits=3, light=(1.0, 4.0)),
    "counter, 5 bits": SPADCase(bits=5, light=(2.0, 12.0), hottest=60.0),
    "counter, 8 bits": SPADCase(bits=8, light=(4.0, 60.0), hottest=400.0, dead_time=0.003, flats=3),
    "counter, no dead time": SPADCase(bits=6, light=(2.0, 25.0), dead_time=0.0),
}


NAMES = (
    "dark_count_rate",
    "dark_count_rate_good",
    "dark_count_rate_median",
    "pde_fill",
    "prnu",
    "afterpulsing",
    "crosstalk",
    "dead_time",
)


def hits_of(case: SPADCase, seed: list[int]) -> dict[str, bool]:
    """Return for every printed interval of one array whether it holds the truth."""
    found, truth = calibrated(case, np.random.default_rng(seed))
    # An interval that ends at 0 holds a truth of 0 in 97.5 %: it is left out.
    truth = {name: value for name, value in truth.items() if value > 0}
    return {
        name: bool(value.low <= truth[name] <= value.high)
        for name, value in found.values.items()
        if name in truth and not isnan(value.low)
    }


def table(rows: dict[str, list[dict[str, bool]]]) -> list[str]:
    """Return the lines on all kinds of arrays."""
    rows = {kind: row for kind, row in rows.items() if row}
    fewest = min(map(len, rows.values()))
    lines = [
        f"A number of {fewest} arrays is known to ± {100 * sqrt(0.95 * 0.05 / fewest):.1f} (one standard deviation).",
        "Drawn at random:",
        "",
        "- 12 x 12 to 64 x 64 pixels, 50 to 5,000 frames of a flat (at most 1e6 values), exposures of 0.1 µs to 10 s;",
        "- PRNU of 1 to 10 %, up to 50 % of the light lost in the corners, 0.5 % drift of the light;",
        "- dark rates that spread by up to 0.8 (of the logarithm), and 0, 0.5 or 2 % hot pixels, some saturated;",
        "- 0, 3 or 10 % afterpulses, crosstalk of 0 or 0.3 % per neighbour, dead times of counters.",
        "",
        "An empty cell: nothing is printed, or the truth is 0. In brackets: intervals, where fewer than arrays.",
        "`percentiles` are those of the array's own pixels, all printed ones together.",
        "",
        "| kind | arrays | " + " | ".join(f"`{name}`" for name in NAMES) + " | percentiles |",
        "|---|--:|" + "--:|" * (len(NAMES) + 1),
    ]
    for kind, hits in rows.items():
        cells = [cell([hit[name] for hit in hits if name in hit], len(hits)) for name in NAMES]
        percentiles = [held for hit in hits for name, held in hit.items() if name.startswith("dark_count_rate_p")]
        lines.append(f"| {kind} | {len(hits)} | " + " | ".join([*cells, cell(percentiles, 0)]) + " |")
    return lines


def main(arrays: int, values: float, chosen: str) -> None:
    rows = stored("coverage_spad")
    for number in range(arrays):
        for n, (kind, case) in enumerate(CASES.items()):
            row = rows.setdefault(kind, [])
            if len(row) > number or not kind.startswith(chosen):
                continue
            row.append(hits_of(replace(case, most_values=values), [n, number]))
            store("coverage_spad", rows)
        print(f"{number + 1} of {arrays}", flush=True)
    write_page()


if __name__ == "__main__":
    main(
        int(sys.argv[1]) if len(sys.argv) > 1 else 200,
        float(sys.argv[2]) if len(sys.argv) > 2 else 1e6,
        sys.argv[3] if len(sys.argv) > 3 else "",
    )
