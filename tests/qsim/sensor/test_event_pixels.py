"""Pixels of event cameras: a plain loop, exact times of ramps, counts, caps, rates of leak and noise, thresholds."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from event_loop import events_of
from numpy import ndarray as Array
from scipy.integrate import solve_ivp
from stats import assert_mean, assert_share, assert_variance

from qsim.keys import Key
from qsim.sensor.event_camera import LEAST_THRESHOLD, EventCamera
from qsim.sensor.event_pixels import EventPixels, thresholds

FRAME = 5e-4  # s
KEY = Key(seed=3, clip=5)


def drawn(camera: EventCamera, currents: Array, key: Key = KEY, seconds: float = FRAME, origin=(0, 0)) -> Array:
    """Return events [n] with the fields pixel, t [s from the first frame] and p, in the order of pixel and time."""
    pixels = EventPixels(camera, currents[0], key, origin)
    found = []
    for t, current in enumerate(currents[1:]):
        each = pixels.advance(current, seconds)
        found += list(zip(each.pixels, t * seconds + each.times, each.polarities, strict=True))
    return np.array(sorted(found), dtype=[("pixel", int), ("t", float), ("p", int)])


def random_case(case: int) -> tuple[EventCamera, Array, float]:
    """Return a camera, photocurrents [T, H, W] and seconds of a frame over the whole range of each."""
    rng = np.random.default_rng([5, case])

    def scale(low: float, high: float) -> float:
        return float(10.0 ** rng.uniform(low, high))

    seconds = scale(-5, -1)
    shape = tuple(rng.integers([2, 1, 1], [8, 5, 7]))
    base = scale(0, 8)
    currents = base * np.exp(rng.normal(0, scale(-2, 0.7), shape))
    if rng.random() < 0.3:
        currents[:] = currents[0]
    camera = EventCamera(
        threshold_on=scale(-1.5, 0.5),
        threshold_off=scale(-1.5, 0.5),
        mismatch=rng.choice([0.0, scale(-3, -0.5)]),
        refractory=rng.choice([0.0, seconds * scale(-3, 1)]),
        cutoff=None if rng.random() < 0.3 else scale(-2, 2) / seconds,
        leak_rate=min(rng.choice([0.0, scale(-2, 1) / seconds]), 1e4),
        shot_noise=min(rng.choice([0.0, scale(-2, 1) / seconds]), 1e4),
        shot_noise_bright=rng.uniform(0, 1),
        bright=base * scale(-1, 1),
    )
    return camera, currents, seconds


def check_case(case: int) -> int:
    camera, currents, seconds = random_case(case)
    expected = sorted((pixel, t, p) for t, pixel, p in events_of(camera, currents, seconds, KEY))
    found = drawn(camera, currents, seconds=seconds)
    assert [(one["pixel"], one["p"]) for one in found] == [(pixel, p) for pixel, _, p in expected], camera
    np.testing.assert_allclose(found["t"], [t for _, t, _ in expected], rtol=0, atol=1e-9 * seconds)
    return len(found)


def test_events_are_those_of_a_plain_loop():
    assert sum(check_case(case) for case in range(12)) > 100


@pytest.mark.slow
def test_events_are_those_of_a_plain_loop_over_the_whole_range():
    assert sum(check_case(case) for case in range(12, 3000)) > 1e5


def ramp(slope: Array, frames: int = 6) -> Array:
    """Return photocurrents [T, H, W] whose logarithm grows by `slope` [H, W] per second."""
    return 1e4 * np.exp(slope * FRAME * np.arange(frames)[:, None, None])


def test_an_exponential_ramp_crosses_thresholds_at_their_multiples():
    """ln i = r t reaches j thresholds at j threshold / |r|, whatever the frames are."""
    slope = np.array([[700.0, -1300.0, 333.0]])
    camera = EventCamera(threshold_on=0.17, threshold_off=0.29)
    found = drawn(camera, ramp(slope))
    for pixel, rate in enumerate(slope.ravel()):
        threshold = 0.17 if rate > 0 else 0.29
        mine = found[found["pixel"] == pixel]
        count = int(abs(rate) * 5 * FRAME / threshold)
        np.testing.assert_allclose(mine["t"], threshold / abs(rate) * np.arange(1, count + 1), rtol=1e-9)
        assert set(mine["p"]) == {int(rate > 0)}


def test_events_count_the_thresholds_in_a_contrast():
    """floor(|ln ratio| / threshold), also of whole multiples, which rounding must not lose."""
    rng = np.random.default_rng(1)
    thresholds_of = rng.uniform(LEAST_THRESHOLD, 1.5, 40)
    for threshold in thresholds_of:
        ratio = np.concatenate([rng.uniform(-6, 6, 50), threshold * np.arange(-5, 6)])
        camera = EventCamera(threshold_on=threshold, threshold_off=threshold)
        found = drawn(camera, 50 * np.exp(np.stack([0 * ratio, ratio])[:, None]))
        expected = np.floor(np.abs(ratio) / threshold + 1e-9)
        np.testing.assert_array_equal(np.bincount(found["pixel"], minlength=len(ratio)), expected)


def test_contrast_adds_up_over_frames_and_turns():
    """A pixel remembers what is left of a threshold: 0.7 up and 0.5 down of a threshold are no event, 0.9 more one."""
    steps = 0.2 * np.array([0, 0.7, 0.2, 1.1])
    found = drawn(EventCamera(), 50 * np.exp(steps)[:, None, None])
    np.testing.assert_allclose(found["t"], (2 + 0.8 / 0.9) * FRAME, rtol=1e-9)


def test_the_refractory_time_caps_the_rate():
    """Events of a steady ramp are threshold / r + refractory apart: light that changes meanwhile is lost."""
    camera = EventCamera(refractory=3e-5)
    found = drawn(camera, ramp(np.array([[2000.0, 1e5]]), frames=12))
    for pixel, rate in enumerate((2000.0, 1e5)):
        times = found["t"][found["pixel"] == pixel]
        np.testing.assert_allclose(np.diff(times), 0.2 / rate + 3e-5, rtol=1e-6)
        assert len(times) == int((11 * FRAME - 0.2 / rate) / (0.2 / rate + 3e-5)) + 1


def test_constant_light_gives_no_events_without_noise():
    assert len(drawn(EventCamera(mismatch=0.1, cutoff=10.0, bright=1e3), np.full((9, 7, 10), 50.0))) == 0


def test_leaks_come_at_their_rate_from_any_phase():
    """n = T / P periods: floor(n) or one more, the latter with the share n - floor(n) of a uniform phase."""
    camera = EventCamera(leak_rate=230.0)
    found = drawn(camera, np.full((7, 100, 100), 50.0))
    counts = np.bincount(found["pixel"], minlength=10_000)
    periods = 6 * FRAME * 230.0
    assert set(found["p"]) == {1}
    assert set(counts) == {0, 1}
    assert_share(int(counts.sum()), counts.size, periods % 1)
    times = found["t"][counts[found["pixel"]] == 1]
    assert_mean(times, 3 * FRAME, (6 * FRAME) ** 2 / 12)


def test_the_leak_of_a_pixel_follows_its_threshold():
    """The leak is one rate of log light for all: a pixel of a higher threshold leaks more rarely."""
    camera = EventCamera(mismatch=0.05, leak_rate=9000.0)
    on, _ = thresholds(camera, (8, 10))
    found = drawn(camera, np.full((40, 8, 10), 50.0))
    counts = np.bincount(found["pixel"], minlength=80)
    assert np.abs(counts - 39 * FRAME * 9000 * 0.2 / on.ravel()).max() <= 1


@pytest.mark.parametrize("bright", [100.0, 1e6])
def test_shot_noise_has_its_rate_in_every_light(bright: float):
    """Counts in constant light are Poisson of n T, n = dark rate (1 - 0.7 min(i / bright, 1)); half of them ON."""
    camera = EventCamera(shot_noise=800.0, shot_noise_bright=0.3, bright=bright)
    found = drawn(camera, np.full((9, 60, 70), 50.0))
    expected = 800 * (1 - 0.7 * min(50 / bright, 1)) * 8 * FRAME
    counts = np.bincount(found["pixel"], minlength=4200)
    fourth = expected + 3 * expected**2
    assert_mean(counts, expected, expected, checks=8)
    assert_variance(counts, expected, fourth, checks=8)
    assert_share(int(found["p"].sum()), len(found), 0.5, checks=8)
    assert_mean(found["t"], 4 * FRAME, (8 * FRAME) ** 2 / 12, checks=8)


def test_a_refractory_pixel_swallows_noise():
    """Intervals are dead + Exp(1/n): the renewal law's mean (T - 1/n)/m + (s^2 + m^2)/(2 m^2), variance T s^2/m^3."""
    dead = 4e-4
    rate = 3000.0
    span = 100 * FRAME
    camera = EventCamera(shot_noise=rate, shot_noise_bright=1.0, refractory=dead)
    counts = np.bincount(drawn(camera, np.full((101, 20, 25), 50.0))["pixel"], minlength=500)
    mean = dead + 1 / rate
    expected = (span - 1 / rate) / mean + (rate**-2 + mean**2) / (2 * mean**2)
    assert_mean(counts, expected, span * rate**-2 / mean**3)
    assert expected < 0.5 * rate * span  # without the dead time it would be twice as many


def test_thresholds_are_normal_over_the_pixels_of_a_device():
    camera = EventCamera(threshold_on=0.3, threshold_off=0.2, mismatch=0.03)
    for found, mean in zip(thresholds(camera, (100, 90)), (0.3, 0.2), strict=True):
        assert_mean(found, mean, 0.03**2, checks=6)
        assert_variance(found, 0.03**2, 3 * 0.03**4, checks=6)
    on, off = thresholds(camera, (100, 90))
    assert_mean((on - 0.3) * (off - 0.2), 0.0, 0.03**4, checks=6)
    assert (thresholds(replace(camera, device_seed=1), (100, 90))[0] != on).all()
    assert thresholds(replace(camera, mismatch=1.0), (100, 90))[0].min() == LEAST_THRESHOLD


def test_the_photoreceptor_follows_its_equation():
    """dy/dt = (x - y) / tau, tau = 1 / (2 pi cutoff min(i / bright, 1)): a numerical solution; slow when dim."""
    camera = EventCamera(cutoff=400.0, bright=500.0, threshold_on=20.0, threshold_off=20.0)
    currents = np.array([40.0, 300.0, 2000.0, 3.0, 3.0])[:, None, None] * np.array([[1.0, 0.1]])
    pixels = EventPixels(camera, currents[0], KEY)
    for pixel in range(2):
        levels = currents[:, 0, pixel]
        seen = np.log(levels[0])
        for first, last in itertools.pairwise(levels):
            pace = 2 * np.pi * 400 * min((first + last) / 1000, 1)
            x = np.log([first, last])

            def slope(t: float, y: Array, x: Array = x, pace: float = pace) -> Array:
                return pace * (x[0] + (x[1] - x[0]) * t / FRAME - y)

            seen = solve_ivp(slope, (0, FRAME), [seen], rtol=1e-10, atol=1e-12).y[0, -1]
        if pixel == 0:
            for current in currents[1:]:
                pixels.advance(current, FRAME)
        assert pixels.seen[pixel] == pytest.approx(seen, abs=1e-8)


def test_unlimited_bandwidth_is_the_limit_of_a_high_cutoff():
    currents = np.exp(np.random.default_rng(2).normal(0, 1, (6, 7, 9)))
    ideal = drawn(EventCamera(), currents)
    fast = drawn(EventCamera(cutoff=1e9, bright=1e-3), currents)
    assert len(fast) == len(ideal) > 500
    np.testing.assert_allclose(fast["t"], ideal["t"], atol=1e-8)


def test_noise_is_of_the_seed_and_a_crop_has_that_of_the_full_frame():
    camera = EventCamera(shot_noise=900.0, shot_noise_bright=1.0, leak_rate=300.0, mismatch=0.05)
    full = np.full((6, 8, 10), 50.0)
    found = drawn(camera, full)
    assert np.array_equal(found, drawn(camera, full))
    assert not np.array_equal(found, drawn(camera, full, key=Key(seed=4, clip=5)))
    y, x = np.divmod(found["pixel"], 10)
    inside = found[(y >= 3) & (y < 7) & (x >= 2) & (x < 9)]
    crop = drawn(camera, full[:, 3:7, 2:9], origin=(3, 2))
    assert np.array_equal(crop["t"], inside["t"])
    assert np.array_equal(crop["p"], inside["p"])


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.nan, np.inf])
def test_light_without_a_logarithm_is_named(wrong: float):
    with pytest.raises(ValueError, match="e-/s is not above 0"):
        EventPixels(EventCamera(), np.array([[1.0, wrong]]), KEY)


def test_more_events_than_memory_holds_are_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("qsim.limits.EVENTS", 100)
    with pytest.raises(ValueError, match="more than 100 events between two frames; give higher thresholds"):
        drawn(EventCamera(), np.stack([np.full((5, 7), 1.0), np.full((5, 7), 10.0)]))


def test_bright_light_must_be_stated_where_it_matters():
    with pytest.raises(ValueError, match=r"state the photocurrent of bright light, as in bright=1e4"):
        EventPixels(EventCamera(cutoff=10.0), np.ones((2, 2)), KEY)
