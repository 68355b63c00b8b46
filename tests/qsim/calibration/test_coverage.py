"""Coverage: intervals contain the true value as often as promised, on frames of a simulator that shares no code."""

import sys
from pathlib import Path

import numpy as np
import pytest
from stats import assert_share
from synthetic import COUNTER, QISCase, RandomArray, SPADCase

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
from calibration_simulator import random_camera
from coverage_cameras import BANDS, NAMES, hits_of


def camera_hits(cameras: int, seed: int) -> tuple[dict[str, list[bool]], list[bool]]:
    """Return by value whether intervals of random cameras hold the truth, and whether a model is called wrong."""
    hits: dict[str, list[bool]] = {name: [] for name in NAMES}
    warned = []
    for number in range(cameras):
        rng = np.random.default_rng([seed, number])
        found = hits_of(random_camera(rng, BANDS[number % len(BANDS)]), rng)
        warned.append(found.pop("warned"))
        for name, held in found.items():
            hits[name].append(held)
    return hits, warned


def test_intervals_of_cameras_are_not_broken():
    """Five cameras, one of each band of gain x read noise: of 30 intervals 95 % hold the truth, and no warning."""
    hits, warned = camera_hits(5, seed=7)
    held = [hit for row in hits.values() for hit in row]
    assert len(held) > 25
    assert_share(sum(held), len(held), 0.95)
    assert not any(warned)


@pytest.mark.slow
def test_intervals_of_cameras_cover_as_promised():
    """500 random cameras of gain x read noise from 0.1 to 12 codes: every value within 93 to 97 %.

    The number is allowed its own error: a right interval fails once in a thousand runs. A model is called wrong by a
    p-value below 0.001.
    """
    hits, warned = camera_hits(500, seed=8)
    for held in hits.values():
        assert 0.93 - 3.5 * np.sqrt(0.93 * 0.07 / len(held)) < np.mean(held)
    assert_share(sum(warned), len(warned), 0.001, false_alarm=1e-4)


def test_one_calibration_of_each_kind_comes_near_the_truth():
    """Sanity, not coverage: within eight half-widths, which a right program leaves once in 10^50 times."""
    rng = np.random.default_rng(5)
    for case in (QISCase(), SPADCase(), COUNTER):
        found, truth = case.calibrate(rng)
        for name, value in truth.items():
            v = found.values[name]
            assert abs(v.value - value) <= 8 * max(v.high - v.value, v.value - v.low), (name, v, value)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        SPADCase(dark_rate=1.0, afterpulsing=0.03),
        SPADCase(dark_rate=1.0, afterpulsing=0.03, bits=3, photons=(0.5, 1.5)),
        SPADCase(frames=15),
    ],
    ids=["planes", "counts", "none"],
)
def test_coverage_of_afterpulsing_with_dark_frames_of_few_counts(case):
    """Dark frames of 0.001 counts: they stated an error that was 5 times too small, and had nearly all of the weight.

    An interval that ends at 0 holds a truth of 0 in 97.5 %.
    """
    rng = np.random.default_rng(2)
    found = [case.calibrate(rng, ignore_dead_time=True)[0].values["afterpulsing"] for _ in range(60)]
    hits = sum(value.low <= case.afterpulsing <= value.high for value in found)
    assert_share(hits, 60, 0.95 if case.afterpulsing else 0.975)


def prnu_hits(runs: int, seed: int) -> dict[str, list[bool]]:
    """Return whether the interval contains the PRNU of random arrays, by readout."""
    hits: dict[str, list[bool]] = {}
    for i in range(runs):
        rng = np.random.default_rng([seed, i])
        array = RandomArray.draw(rng)
        found = array.calibrate(rng).values["prnu"]
        hits.setdefault(array.readout, []).append(found.low <= array.prnu <= found.high)
    return hits


@pytest.mark.slow
def test_prnu_intervals_cover_as_promised():
    """1000 random arrays: 1 ... 30 % PRNU, 0 ... 60 % vignetting, 0 ... 15 % hot pixels, 10 ... 40 pixels a side.

    2 ... 60 frames (20 ... 600 planes). A right interval leaves 93 ... 97 % once in 250 times.
    """
    hits = prnu_hits(1000, 12)
    share = np.mean([hit for one in hits.values() for hit in one])
    assert 0.93 <= share <= 0.97, share
    for one in hits.values():
        assert_share(sum(one), len(one), 0.95, false_alarm=1e-4, checks=len(hits))
