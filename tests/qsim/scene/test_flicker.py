"""Flicker: the closed forms against sums over many moments, the laws of an integral, and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from qsim.scene import AreaLamp, Constant, EnvironmentImage, Glow, Mains, PointLight, PulseWidth, RectifiedSine

POINTS = 20_011  # moments of a sum


def drawn(rng: np.random.Generator):
    """A flicker of any kind, over the whole range of its parameters."""
    frequency = 10 ** rng.uniform(-1, 5)
    phase = rng.uniform(-20, 20)
    kind = rng.integers(3)
    if kind == 0:
        return Mains(frequency, rng.choice([0.0, 1.0, rng.random()]), phase)
    if kind == 1:
        return RectifiedSine(frequency, phase)
    return PulseWidth(frequency, rng.choice([1.0, 1 - rng.random(), 1e-3]), phase)


def strength(flicker, t: np.ndarray) -> np.ndarray:
    """The definition, moment by moment."""
    turns = flicker.frequency * t + flicker.phase / math.tau
    match flicker:
        case Mains(depth=depth):
            return 1 + depth * np.cos(math.tau * turns)
        case RectifiedSine():
            return math.pi / 2 * np.abs(np.sin(math.pi * turns))
        case PulseWidth(duty=duty):
            return (turns % 1 < duty) / duty


def test_the_closed_form_is_the_mean_of_the_definition():
    """The sum over n moments errs by the jumps (two per period) of a switched lamp and the bend of a smooth one."""
    rng = np.random.default_rng(1)
    for _ in range(300):
        flicker = drawn(rng)
        start = rng.uniform(-3, 3) / flicker.frequency
        length = 10 ** rng.uniform(-3, 1.5) / flicker.frequency
        moments = start + (np.arange(POINTS) + 0.5) / POINTS * length
        turns = length * flicker.frequency
        jumps = 2 * (turns + 1) / flicker.duty if isinstance(flicker, PulseWidth) else 12 * (turns + 1) ** 2 / POINTS
        found = flicker.mean(start, start + length)
        assert abs(found - strength(flicker, moments).mean()) <= jumps / POINTS, (flicker, start, length)


def test_parts_of_an_exposure_add_up_and_whole_periods_have_mean_one():
    rng = np.random.default_rng(2)
    for _ in range(300):
        flicker = drawn(rng)
        ends = np.sort(rng.uniform(-5, 5, 3)) * 10 ** rng.uniform(-4, 2) / flicker.frequency
        first, second, both = flicker.mean(ends[[0, 1, 0]], ends[[1, 2, 2]]) * (ends[[1, 2, 2]] - ends[[0, 1, 0]])
        assert first + second == pytest.approx(both, rel=1e-9, abs=1e-9 * (ends[2] - ends[0])), (flicker, ends)
        periods = int(rng.integers(1, 9))
        assert flicker.mean(ends[0], ends[0] + periods / flicker.frequency) == pytest.approx(1, abs=1e-9)


def test_a_very_short_exposure_sees_the_moment():
    """1e-8 s at 100 s: the mean has nine digits, where a difference of integrals would have six."""
    for flicker in (Mains(120, 0.7, 0.3), RectifiedSine(100, 1.1), PulseWidth(1000, 0.4, 2.0)):
        found = flicker.mean(np.array(100.0123), np.array(100.0123 + 1e-8))
        assert found == pytest.approx(strength(flicker, np.array(100.0123 + 5e-9)), rel=2e-8)


def test_a_camera_at_the_rate_of_the_mains_sees_steady_light_and_a_fast_one_its_wave():
    """2000 fps at 100 Hz: a period of 20 frames, of the depth times sinc(100 / 2000); 90 fps beats at 10 Hz."""
    flicker = Mains(100, 0.5, 0.4)

    def frames(rate):
        middle = np.arange(60) / rate
        return flicker.mean(middle - 0.5 / rate, middle + 0.5 / rate)

    np.testing.assert_allclose(frames(100), 1, atol=1e-12)
    fast = frames(2000)
    np.testing.assert_allclose(fast[20:], fast[:-20], atol=1e-12)
    waves = np.cos(2 * np.pi * 100 * np.arange(60) / 2000 + 0.4)
    np.testing.assert_allclose(fast, 1 + 0.5 * np.sinc(0.05) * waves, atol=1e-12)
    np.testing.assert_allclose(frames(90)[9:], frames(90)[:-9], atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Mains(0), r"Mains.frequency: Hz above 0 to 1e9 expected, got 0"),
        (lambda: Mains(depth=1.1), r"Mains.depth: the swing of the strength around 1, 0 to 1, got 1.1"),
        (lambda: PulseWidth(duty=0), r"PulseWidth.duty: the share of a period with light, above 0 to 1, got 0"),
        (lambda: PulseWidth(float("nan")), r"PulseWidth.frequency: Hz above 0"),
        (lambda: RectifiedSine(phase=float("inf")), r"RectifiedSine.phase: finite radians expected, got inf"),
        (lambda: RectifiedSine("100"), r"RectifiedSine.frequency: expected a number, got '100'"),
        (lambda: Constant(1.0, 100.0), r"Constant.flicker: Mains, RectifiedSine or PulseWidth is expected, got 100"),
        (lambda: Glow(1.0, 2), r"Glow.flicker: "),
        (lambda: PointLight((0, 0, 0), 1.0, flicker=2), r"PointLight.flicker: "),
        (lambda: AreaLamp((0, 1, 0), (0, 0, 0), 1, 1, 1.0, flicker=2), r"AreaLamp.flicker: "),
        (lambda: EnvironmentImage(np.ones((2, 4)), flicker=2), r"EnvironmentImage.flicker: "),
    ],
)
def test_a_wrong_flicker_is_refused_by_name(make, message):
    with pytest.raises(ValueError, match=message):
        make()
