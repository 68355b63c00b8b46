"""What is derived from a cdf once: moments, likelihood, estimates, tables, and the keyed draw."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from stats import assert_histogram, assert_mean, assert_share, critical_z

from qsim.keys import Key, uniform, uniform_pair, words
from qsim.sensor.compiled import jit
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor, fast_engine_works
from qsim.sensor.spad import BinarySPAD

EXPOSURE = 5e-4
SENSORS = (
    QIS(0.8, 1.6, 0.2, 3, gain=1.0769),
    QIS(0.8, 3200.0, 0.2, 3, gain=0.359, full_well=20.0),
    QIS(1.0, 0.0, 0.0, 1),
    BinarySPAD(0.4, 100.0),
    BinarySPAD(0.4, 100.0, 3),
    CountingSPAD(0.5, 200.0, 3e-8, 3),
    CountingSPAD(0.5, 200.0, 1e-4, 4),
    CountingSPAD(0.5, 200.0, 5e-5, 4, paralyzable=True),
)
each = pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: f"{type(s).__name__}-{s.bits}")


# ---- Functions of light


@each
def test_the_three_descriptions_agree(sensor: Sensor):
    """cdf = sum of exp(log_pmf); dcdf = its derivative, by differences of 4th order with an error near 1e-10."""
    light = np.array([0.02, 0.7, 3.25, 9.75, 40.0])
    cdf, pmf = sensor.cdf(light, EXPOSURE), np.exp(sensor.log_pmf(light, EXPOSURE))
    np.testing.assert_allclose(np.cumsum(pmf, axis=-1), cdf, atol=1e-12)
    np.testing.assert_array_equal(cdf[:, -1], 1.0)
    h = 1e-3
    near, far = (sensor.cdf(light + d, EXPOSURE) - sensor.cdf(light - d, EXPOSURE) for d in (h, 2 * h))
    np.testing.assert_allclose(sensor.dcdf(light, EXPOSURE), (8 * near - far) / (12 * h), atol=1e-9)


@each
@pytest.mark.parametrize("light", [0.0, 1e-12, 1e4, 1e12])
def test_extreme_light_is_a_distribution(sensor: Sensor, light):
    """One pixel among them, and a whole frame drawn: no NaN, no code without probability, nothing above 1."""
    cdf, pmf, log_pmf = (f(light, EXPOSURE) for f in (sensor.cdf, sensor.pmf, sensor.log_pmf))
    assert np.all((cdf >= 0) & (cdf <= 1) & (np.diff(cdf, prepend=0.0) >= -1e-15))
    assert pmf.sum() == pytest.approx(1.0, abs=1e-12)
    assert not np.isnan(log_pmf).any()
    assert not np.isnan(sensor.fisher_information(light, EXPOSURE))
    codes = sensor.sample(np.full((5, 9), light), EXPOSURE, key=Key(0, 1), engine="reference")
    assert np.all(pmf[codes] > 0)


@each
def test_shapes_follow_the_light(sensor: Sensor):
    light = np.linspace(0, 9, 6).reshape(2, 3)
    for function in (sensor.cdf, sensor.log_pmf, sensor.dcdf, sensor.pmf):
        assert function(light, EXPOSURE).shape == (2, 3, sensor.levels)
        np.testing.assert_allclose(function(light[1, 2], EXPOSURE), function(light, EXPOSURE)[1, 2], rtol=1e-13)
    for function in (sensor.mean, sensor.variance, sensor.fisher_information):
        assert function(light, EXPOSURE).shape == (2, 3)
    assert sensor.cdf(np.zeros((0, 4)), EXPOSURE).shape == (0, 4, sensor.levels)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, -1e-9])
@pytest.mark.parametrize("sensor", [SENSORS[0], SENSORS[3], SENSORS[7]])
def test_impossible_light_is_named(sensor: Sensor, wrong):
    light = np.full((2, 3, 4), 1.5)
    light[1, 2, 0] = light[1, 2, 1] = wrong
    message = rf"^photons\[1, 2, 0\] is {wrong!r}; expected photons are finite and not negative$"
    for function in (sensor.cdf, sensor.log_pmf, sensor.dcdf, sensor.mean, sensor.fisher_information):
        with pytest.raises(ValueError, match=message):
            function(light, EXPOSURE)


@pytest.mark.parametrize("exposure", [0.0, -1.0, np.nan, np.inf])
def test_impossible_exposure_is_named(exposure):
    with pytest.raises(ValueError, match="exposure is in seconds, finite and above 0, got"):
        SENSORS[0].cdf(1.0, exposure)


def test_small_means_keep_their_digits():
    """1e-12 photons on a perfect 1-bit pixel: mean and variance are 1e-12, not a difference of ones."""
    sensor = QIS(1.0, 0.0, 0.0, 1)
    assert sensor.mean(1e-12, EXPOSURE) == pytest.approx(1e-12, rel=1e-12)
    assert sensor.variance(1e-12, EXPOSURE) == pytest.approx(1e-12, rel=1e-12)


def test_mean_code_of_the_published_profile():
    """4.20 e-, gain 1.0769: mean code / 7 is 0.607 and std 1.91; with the paper's text 0.371 and 1.59 (spec.md, 4)."""
    published = QIS(0.8, 1.6 / EXPOSURE, 0.2, 3, gain=0.5 * 7 / 3.25)
    paper = QIS(0.8, 1.6, 0.2, 3)
    for sensor, mean, deviation, dark, bright in (
        (published, 0.607, 1.91, 0.015, 0.182),
        (paper, 0.371, 1.59, 0.075, 0.017),
    ):
        pmf = sensor.pmf(3.25, EXPOSURE)
        assert sensor.mean(3.25, EXPOSURE) / 7 == pytest.approx(mean, abs=5e-4)
        assert np.sqrt(sensor.variance(3.25, EXPOSURE)) == pytest.approx(deviation, abs=5e-3)
        assert (pmf[0], pmf[7]) == (pytest.approx(dark, abs=5e-4), pytest.approx(bright, abs=5e-4))


def test_log_likelihood_picks_the_code_and_broadcasts():
    sensor, light = SENSORS[0], np.array([[1.0, 5.0, 9.0], [0.0, 2.0, 3.0]])
    codes = np.array([[[0, 7, 3], [1, 2, 6]], [[5, 0, 0], [7, 1, 4]]], np.uint8)
    found = sensor.log_likelihood(codes, light, EXPOSURE)
    assert found.shape == (2, 2, 3)
    for t, y, x in np.ndindex(codes.shape):
        expected = sensor.log_pmf(light[y, x], EXPOSURE)[codes[t, y, x]]
        assert found[t, y, x] == pytest.approx(expected, rel=1e-13)
    with pytest.raises(ValueError, match=r"codes are integers 0 ... 7 of this 3-bit sensor"):
        sensor.log_likelihood(np.array([8]), light[0, :1], EXPOSURE)


def test_fisher_information_of_simple_pixels():
    """One plane: pde^2 q / p; an ideal counter that never clips: pde / photons; nothing left at 1e9 photons."""
    q = np.exp(-0.4 * 3.0)
    assert BinarySPAD(0.4, 0.0).fisher_information(3.0, EXPOSURE) == pytest.approx(0.16 * q / (1 - q), rel=1e-12)
    assert QIS(0.8, 0.0, 0.0, 8).fisher_information(20.0, EXPOSURE) == pytest.approx(0.8 / 20.0, rel=1e-12)
    assert BinarySPAD(0.4, 0.0).fisher_information(0.0, EXPOSURE) == np.inf
    for sensor in SENSORS:
        assert np.isfinite(sensor.fisher_information(np.array([1e-3, 30.0, 1e9]), EXPOSURE)).all()


# ---- Estimates


@pytest.mark.parametrize("sensor", [SENSORS[0], SENSORS[4], SENSORS[6], SENSORS[7]])
def test_estimates_scatter_as_fisher_information_says(sensor: Sensor):
    """From 2000 codes each: z-scores have mean 0 (bias of the order 1/sqrt(n)) and variance 1; intervals hold 95 %."""
    n, repeats, light = 2000, 2000, 4.0
    histograms = np.random.default_rng(5).multinomial(n, sensor.pmf(light, EXPOSURE), size=repeats)
    found = sensor.maximum_likelihood(histograms, EXPOSURE)
    z = (found.photons - light) * np.sqrt(n * sensor.fisher_information(light, EXPOSURE))
    limit = critical_z(checks=12)
    assert abs(z.mean()) < limit / np.sqrt(repeats) + 3 / np.sqrt(n)
    assert abs(z.var() - 1) < limit * np.sqrt(2 / repeats) + 10 / n
    inside = int(((found.lower < light) & (light < found.upper)).sum())
    assert abs(inside / repeats - 0.95) < limit * np.sqrt(0.95 * 0.05 / repeats) + 10 / n


def test_one_plane_has_its_closed_form():
    """Binary pixels: photons = -log(share of zeros) / PDE - dark; 0 where dark counts explain more than was seen."""
    sensor = BinarySPAD(0.4, 100.0)
    ones = np.array([1, 5, 40, 90, 99])
    found = sensor.maximum_likelihood(np.stack([100 - ones, ones], axis=-1), EXPOSURE)
    expected = np.maximum((-np.log1p(-ones / 100) - 100 * EXPOSURE) / 0.4, 0)
    np.testing.assert_allclose(found.photons, expected, rtol=1e-9, atol=1e-15)
    assert found.photons[0] == 0
    assert np.all((found.lower <= found.photons) & (found.photons < found.upper))


@pytest.mark.parametrize("n", [1, 11, 10**9])
def test_all_dark_has_a_one_sided_bound(n):
    """No count in n planes: 0, and an upper bound where that has a probability of 5 %: 2.996 / (n PDE)."""
    found = BinarySPAD(0.4, 0.0, 3).maximum_likelihood(np.array([n, 0, 0, 0, 0, 0, 0, 0]), EXPOSURE)
    assert (found.photons, found.lower) == (0.0, 0.0)
    assert found.upper == pytest.approx(-np.log(0.05) / (0.4 * n), rel=1e-6)


@pytest.mark.parametrize("n", [1, 11, 10**6])
@each
def test_all_saturated_is_finite_with_a_one_sided_bound(sensor: Sensor, n):
    """The highest possible code n times: P^n is 1/2 at the estimate, 5 % at the lower bound, if it can be certain."""
    histogram = np.zeros(sensor.levels)
    highest = np.flatnonzero(sensor.log_pmf(5.0, EXPOSURE) > -np.inf)[-1]
    histogram[highest] = n
    found = sensor.maximum_likelihood(histogram, EXPOSURE)
    assert np.isfinite(found.photons)
    assert 0 < found.lower < found.photons
    # On the rising branch of a paralyzable pixel a single code can be likeliest before the end
    assert found.upper == np.inf or getattr(sensor, "paralyzable", False)
    if sensor.pmf(1e6, EXPOSURE)[highest] == 1:
        saturated = np.exp(n * sensor.log_pmf(np.stack([found.photons, found.lower]), EXPOSURE)[:, highest])
        np.testing.assert_allclose(saturated, [0.5, 0.05], rtol=1e-4)


def test_the_likelihood_is_highest_at_the_estimate():
    rng = np.random.default_rng(2)
    for sensor in SENSORS:
        histograms = rng.multinomial(30, sensor.pmf(rng.uniform(0.5, 12, 50), EXPOSURE))
        found = sensor.maximum_likelihood(histograms, EXPOSURE)
        best, *others = (
            (histograms * np.maximum(sensor.log_pmf(found.photons * factor, EXPOSURE), -1e9)).sum(axis=1)
            for factor in (1.0, 0.99, 1.01)
        )
        for beside in others:
            dark_or_bright = (found.photons == 0) | np.isinf(found.upper)
            assert np.all((beside <= best + 1e-9) | dark_or_bright)


def test_histograms_without_answer_are_named():
    sensor = QIS(0.8, 0.0, 0.0, 3, gain=2.0)
    with pytest.raises(ValueError, match=r"^histogram has the shape \[..., 8\], one bin per code; got \[2, 4\]$"):
        sensor.maximum_likelihood(np.ones((2, 4)), EXPOSURE)
    counts = np.ones((3, 2, 8))
    counts[1, 0] = 0
    with pytest.raises(ValueError, match=r"^histogram\[1, 0\] counts codes: finite, not negative, at least one"):
        sensor.maximum_likelihood(counts, EXPOSURE)
    counts[1, 0, 0] = 1
    with pytest.raises(ValueError, match=r"^histogram\[0, 0\] holds code 1, which no light gives with this QIS\("):
        sensor.maximum_likelihood(counts, EXPOSURE)  # gain 2 without read noise: codes are even


# ---- Tables


@each
def test_response_is_the_exact_mean_and_variance(sensor: Sensor):
    table = sensor.response(EXPOSURE)
    some = slice(None, None, 97)
    np.testing.assert_allclose(table.mean[some], sensor.mean(table.photons[some], EXPOSURE), rtol=1e-9)
    np.testing.assert_allclose(table.variance[some], sensor.variance(table.photons[some], EXPOSURE), atol=1e-12)


@each
def test_response_gives_the_light_of_a_mean_code_back(sensor: Sensor):
    """Interpolated between 4096 levels of light: to 1e-4 of what a hundred codes resolve, and never beyond its cap."""
    table = sensor.response(EXPOSURE)
    light = np.linspace(0.2, 1.0, 5) * table.cap(100)
    np.testing.assert_allclose(table.invert(sensor.mean(light, EXPOSURE), 10**6), light, rtol=1e-4)
    assert table.invert(sensor.levels, 11) == table.cap(11) < table.photons[-1]


# ---- The draw


@each
def test_samples_have_the_distribution(sensor: Sensor):
    for i, light in enumerate((0.3, 3.25, 20.0)):
        codes = sensor.sample(np.full((150, 301), light), EXPOSURE, key=Key(1, i), engine="reference")
        assert_histogram(codes, sensor.pmf(light, EXPOSURE), checks=3 * len(SENSORS))


@each
def test_a_crop_of_codes_is_the_code_of_the_crop(sensor: Sensor):
    light = np.random.default_rng(1).uniform(0, 15, (4, 21, 19))
    key = Key(3, 4, frame=11)
    whole = sensor.sample(light, EXPOSURE, key=key, engine="reference")
    for y, x, h, w in ((0, 0, 8, 7), (3, 5, 10, 7), (13, 18, 8, 1)):
        crop = np.ascontiguousarray(light[1:3, y : y + h, x : x + w])
        codes = sensor.sample(crop, EXPOSURE, key=key.at(12), origin=(y, x), engine="reference")
        np.testing.assert_array_equal(codes, whole[1:3, y : y + h, x : x + w])


@each
def test_frames_may_be_drawn_in_any_order(sensor: Sensor):
    light = np.random.default_rng(1).uniform(0, 15, (6, 8, 10))
    whole = sensor.sample(light, EXPOSURE, key=Key(5, 6), engine="reference")
    for t in (4, 0, 5, 2):
        alone = sensor.sample(light[t], EXPOSURE, key=Key(5, 6, t), engine="reference")
        np.testing.assert_array_equal(alone, whole[t])


def test_another_process_draws_the_same():
    """Frames 3 and 1 by a fresh interpreter with another hash seed: neither state, order nor worker is in the noise."""
    light = np.full((4, 7, 9), 3.25)
    here = SENSORS[0].sample(light, EXPOSURE, key=Key(5, 6), engine="reference")
    program = (
        "import numpy as np; from qsim.keys import Key; from qsim.sensor.qis import QIS\n"
        f"sensor, light = {SENSORS[0]!r}, np.full((7, 9), 3.25)\n"
        f"print([sensor.sample(light, {EXPOSURE}, key=Key(5, 6, t), engine='reference').tolist() for t in (3, 1)])"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7", "PYTHONPATH": str(Path(__file__).parents[3])}
    there = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    np.testing.assert_array_equal(json.loads(there.stdout), here[[3, 1]])


@each
def test_no_two_frames_or_clips_share_their_noise(sensor: Sensor):
    """Constant light: 12 frames of 3 clips are all different."""
    light = np.full((12, 9, 17), sensor.white(EXPOSURE) / 2)
    codes = np.concatenate([sensor.sample(light, EXPOSURE, key=Key(1, clip), engine="reference") for clip in range(3)])
    assert len(np.unique(codes.reshape(36, -1), axis=0)) == 36


def test_blocks_of_rows_do_not_show():
    """More levels mean fewer rows at a time: the same frame in one piece, row by row."""
    sensor, light = QIS(0.8, 1.6, 0.2, 6), np.random.default_rng(0).uniform(0, 60, (90, 65))
    whole = sensor.sample(light, EXPOSURE, key=Key(1, 1), engine="reference")
    key = Key(1, 1)
    rows = [sensor.sample(light[y : y + 1], EXPOSURE, key=key, origin=(y, 0), engine="reference") for y in range(90)]
    np.testing.assert_array_equal(whole, np.concatenate(rows))


@pytest.mark.parametrize("sensor", SENSORS[:-1])
def test_more_light_never_lowers_a_code(sensor: Sensor):
    """At a fixed key u is fixed and F falls with light (but for paralysis): a brighter world differs upwards only."""
    low, high = (sensor.sample(np.full((40, 41), v), EXPOSURE, key=Key(2, 2), engine="reference") for v in (3.0, 3.6))
    assert np.all(high >= low)
    assert np.any(high > low)


def test_tails_are_drawn_to_two_to_the_minus_64():
    """At 0.01 photons codes above 3 need u within 1e-9 of 1: words near 2^64 reach them, from the survival function."""
    sensor = QIS(0.8, 1.6, 0.2, 3)
    survival = np.cumsum(sensor.pmf(0.01, EXPOSURE)[::-1])[::-1]  # P(code >= k)
    for k in range(4, 8):
        v = round(survival[k] * 2.0**64)  # 1 - u in units of 2^-64
        for offset, code in ((-max(1, v // 100), k), (max(1, v // 100), k - 1)):
            place = 2**64 - 1 - max(v + offset, 0)
            first, second = np.array([place >> 32], np.uint32), np.array([place & 0xFFFFFFFF], np.uint32)
            assert sensor.codes_at(first, second, np.array([0.01]), EXPOSURE)[0] == code
    lowest = np.zeros(1, np.uint32)
    assert sensor.codes_at(lowest, lowest, np.array([30.0]), EXPOSURE)[0] == 0


@pytest.mark.parametrize("sensor", [BinarySPAD(1.0, 0.0), QIS(1.0, 0.0, 0.0, 1)])
def test_the_second_word_is_drawn_when_the_first_cannot_decide(sensor: Sensor):
    """A pixel whose F_0 lies in the middle of the cell of its first word is decided by the second word alone."""
    key = Key(9, 9)
    first, second = (words(key, (16, 16), redraw=r) for r in (0, 1))
    light = -np.log(uniform(first))  # F_0 = exp(-photons) = u of the first word
    codes = sensor.sample(light, EXPOSURE, key=key, engine="reference")
    below, _ = uniform_pair(first, second)
    np.testing.assert_array_equal(codes, below >= np.exp(-light))
    assert_share(int(codes.sum()), codes.size, 0.5)


def test_rare_codes_are_as_rare_as_they_should_be():
    """1e-5 photons: 2^20 pixels expect 10.5 ones, an exact binomial test."""
    codes = BinarySPAD(1.0, 0.0).sample(np.full((1024, 1024), 1e-5), EXPOSURE, key=Key(0, 3), engine="reference")
    assert_share(int(codes.sum()), codes.size, -np.expm1(-1e-5))


def test_types_and_shapes_of_codes():
    light = np.full((2, 3, 5), 2.0, np.float32)
    assert QIS(0.8, 1.6, 0.2, 8).sample(light, EXPOSURE, key=Key(0, 0), engine="reference").dtype == np.uint8
    assert QIS(0.8, 1.6, 0.2, 9).sample(light, EXPOSURE, key=Key(0, 0), engine="reference").dtype == np.uint16
    assert QIS(0.8, 1.6, 0.2, 3).sample(light[:0], EXPOSURE, key=Key(0, 0), engine="reference").shape == (0, 3, 5)
    with pytest.raises(ValueError, match=r"photons have the shape \[H, W\] or \[T, H, W\], got \[5\]"):
        QIS(0.8, 1.6, 0.2, 3).sample(light[0, 0], EXPOSURE, key=Key(0, 0))
    with pytest.raises(ValueError, match="engine is one of auto, reference, fast, got 'gpu'"):
        QIS(0.8, 1.6, 0.2, 3).sample(light, EXPOSURE, key=Key(0, 0), engine="gpu")


def test_without_a_compiler_the_reference_serves_and_says_so_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(jit, "available", lambda: False)
    fast_engine_works.cache_clear()
    sensor, light = SENSORS[0], np.full((4, 5), 2.0)
    try:
        with pytest.warns(UserWarning, match="no usable LLVM or CUDA: codes are drawn by the NumPy engine"):
            codes = sensor.sample(light, EXPOSURE, key=Key(1, 1))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            sensor.sample(light, EXPOSURE, key=Key(1, 1), engine="fast")
    finally:
        fast_engine_works.cache_clear()
    np.testing.assert_array_equal(codes, sensor.sample(light, EXPOSURE, key=Key(1, 1), engine="reference"))


def test_mean_of_a_stack_is_the_closed_form_and_a_bias_is_caught():
    sensor, light = SENSORS[0], np.full((10, 80, 81), 3.25)
    codes = sensor.sample(light, EXPOSURE, key=Key(4, 4), engine="reference")
    variance = float(sensor.variance(3.25, EXPOSURE))
    assert_mean(codes, float(sensor.mean(3.25, EXPOSURE)), variance)
    with pytest.raises(AssertionError, match="z = "):
        assert_mean(codes, float(sensor.mean(3.25 * 1.02, EXPOSURE)), variance)


@each
def test_records_name_themselves(sensor: Sensor):
    settings = sensor.to_dict()
    assert settings.pop("model") == type(sensor).__name__
    assert type(sensor)(**settings) == sensor
