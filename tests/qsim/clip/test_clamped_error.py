"""Tests white and errors clamped there, against known errors of random images, and the fields of clips."""

from __future__ import annotations

import math

import numpy as np
import pytest
from stats import critical_z

from qsim.clip.clamped_error import (
    STEPS,
    Clamp,
    Errors,
    clamped_squares,
    error_at,
    frame_errors,
    measured,
    over_neighbours,
    stated,
    white_in,
    white_of,
)
from qsim.clip.clip_info import ClipInfo, ErrorInfo
from qsim.optics.radiometry import WHITE_PER_MEAN

SIZE = 200  # px, sides of the noise images


def truth_of(rng: np.random.Generator) -> np.ndarray:
    """Return an image [SIZE, SIZE] whose brightest pixels lie 1 to 100 times above white."""
    return np.exp(rng.uniform(0.2, 2.0) * rng.standard_normal((SIZE, SIZE)))


@pytest.mark.parametrize("seed", range(40))
def test_two_halves_give_the_error_at_white(seed):
    """For random images and whites: noise proportional to light or uniform, weak or strong, and rare bright paths.

    The squares are drawn once for the estimate and once for the real error. Noise that crosses white counts twice: the
    estimate is at most a third too large, and never too small beyond the scatter of the draws.
    """
    rng = np.random.default_rng([7, seed])
    truth = truth_of(rng)
    white = white_in(truth) * rng.uniform(0.3, 2.0)
    level = 10 ** rng.uniform(-3, -0.7)
    sigma = level * (truth if seed % 2 else truth.mean())
    halves = truth + math.sqrt(2) * sigma * rng.standard_normal((2, SIZE, SIZE))
    if seed % 4 >= 2:  # 1 in 200 pixels of a half has a path of up to 30 whites; its mean belongs to the truth
        stray = 30 * white * rng.random()
        halves += stray * (rng.random(halves.shape) < 0.005)
        truth = truth + 0.005 * stray
    halves = np.maximum(halves, 0)
    picture = halves.mean(axis=0)
    real = (np.minimum(picture, white) - np.minimum(truth, white)) ** 2
    found = clamped_squares((halves[0] - halves[1]) ** 2 / 4, picture, halves.min(axis=0), white)
    assert Errors.of_halves(halves, white).at_white == pytest.approx(math.sqrt(found.mean()))
    chance = critical_z(checks=40) * math.hypot(real.std(), found.std()) / SIZE
    assert 0.85 * real.mean() - chance < found.mean() < 1.35 * real.mean() + chance


@pytest.mark.parametrize("seed", range(8))
def test_squares_of_a_clamp_are_those_of_its_law_to_the_bit(seed):
    """The law in single steps, with whites that no pixel, some and all reach, and squares that are one number."""
    rng = np.random.default_rng([8, seed])
    halves = rng.gamma(2.0, 1.0, (2, *rng.integers(1, 40, 2)))
    picture = halves.mean(axis=0)
    lower = halves.min(axis=0)
    squares = (halves[0] - halves[1]) ** 2 / 4 if seed % 2 else 0.25
    for white in (0.01, *rng.uniform(0.5, 5.0, 3), math.inf):
        stray = float(np.mean(np.where(lower < white, np.maximum(picture - white, 0), 0)))
        wanted = np.where(picture < white, squares, (white - np.minimum(lower, white)) ** 2) + stray**2
        clamp = Clamp.at(white, picture, lower)
        np.testing.assert_array_equal(clamp.squares(squares), wanted)
        np.testing.assert_array_equal(clamp.below, picture < white)


def test_without_anything_above_white_the_clamp_changes_nothing():
    halves = 1 + 0.01 * np.random.default_rng(1).standard_normal((2, 50, 50))
    errors = Errors.of_halves(halves, 2.0)
    assert errors.at_white == errors.plain == pytest.approx(0.01 / math.sqrt(2), rel=0.1)


def test_white_is_the_lower_of_two():
    assert white_of(1.0, 10.0) == WHITE_PER_MEAN
    assert white_of(1.0, 1.2) == 1.2
    assert white_of(1.0, 0.0) == WHITE_PER_MEAN  # a spark in the dark


@pytest.mark.parametrize("seed", range(20))
def test_an_error_is_interpolated_at_any_white(seed):
    """Between the stored whites the interpolation is right to 3 %; the true error is smooth."""
    rng = np.random.default_rng([8, seed])
    truth = truth_of(rng)
    halves = truth + 0.05 * rng.standard_normal((2, SIZE, SIZE)) * truth
    forecast = white_in(truth)
    pairs = frame_errors(lambda white: Errors.of_halves(halves, white).at_white, forecast)
    white = forecast * rng.uniform(STEPS[0], STEPS[-1])
    assert error_at(white, pairs) == pytest.approx(Errors.of_halves(halves, white).at_white, rel=0.03)
    assert error_at(forecast, pairs) == pytest.approx(Errors.of_halves(halves, forecast).at_white)


def described(mean: float, found: ErrorInfo) -> ClipInfo:
    """A clip of a mean radiance with the errors of its frames."""
    return ClipInfo(shape=(2, 8, 8), frame_rate=2000.0, exposure=5e-4, mean_radiance=mean, **vars(found))


def test_a_clip_states_both_figures_below_its_own_white():
    pairs = [[[1.0, 0.01], [4.0, 0.04]], [[1.0, 0.02], [4.0, 0.04]]]
    found = measured(means=[0.4, 0.4], high=5.0, errors=[0.1, 0.1], errors_at=pairs)
    assert found.white == pytest.approx(1.0)
    assert found.error_at_white_per_frame == pytest.approx([math.hypot(0.01, 0.02) / math.sqrt(2)] * 2)
    assert found.psnr_of_truth == pytest.approx(-10 * math.log10((0.01**2 + 0.02**2) / 2))
    assert found.psnr_unclamped == pytest.approx(20.0)
    line = stated(described(0.4, found)).line
    assert line == "36.0 dB below white (2.5 x the mean), clamped there; 20.0 dB unclamped"
    plain = measured([0.4, 0.4], 5.0, [0.1, 0.1], [[], []])  # without clamped errors: the plain error is never smaller
    assert plain.psnr_of_truth == plain.psnr_unclamped
    assert measured([0.0], 0.0, [0.1], [[]]).psnr_of_truth is None


def test_a_white_above_those_of_the_frames_takes_the_plain_error():
    found = measured([4.0, 4.0], 100.0, [1.0, 1.0], [[[1.0, 0.01], [2.0, 0.02]]] * 2)
    assert found.white == pytest.approx(10.0)
    assert found.psnr_of_truth == found.psnr_unclamped == pytest.approx(20.0)


def test_a_frame_states_the_mean_of_three_estimates():
    """Under equal light the mean of the squares of a frame and its neighbours; the ends have one neighbour."""
    found = over_neighbours([1.0, 2.0, 3.0, 4.0], [5.0] * 4)
    assert found == pytest.approx(np.sqrt([5 / 2, 14 / 3, 29 / 3, 25 / 2]))
    assert over_neighbours([0.3], [2.0]) == [0.3]


def test_frames_of_other_light_do_not_count():
    """Light that flickers changes the error with it."""
    found = over_neighbours([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [1.0, 1.04, 1.2, 0.0, 0.0, 0.1])
    assert found == pytest.approx([*np.sqrt([5 / 2, 5 / 2]), 3.0, *np.sqrt([41 / 2, 41 / 2]), 6.0])


def test_the_ends_of_a_clip_whose_frames_share_samples_count_for_themselves():
    """They share with one side only; clip.json of such a clip says so in `neighbours`."""
    found = over_neighbours([4.0, 1.0, 2.0, 3.0, 5.0], [1.0] * 5, True)
    assert found == pytest.approx([4.0, *np.sqrt([5 / 2, 14 / 3, 13 / 2]), 5.0])
    assert over_neighbours([0.3], [2.0], True) == [0.3]
    assert over_neighbours([0.3, 0.4], [2.0, 2.0], True) == pytest.approx([0.3, 0.4])


@pytest.mark.parametrize("count", [64, 4096])
def test_chance_in_an_estimate_falls_by_the_root_of_three(count):
    """Estimates of 1 from `count` normal numbers have a standard deviation of sqrt(2 / count); a third of it is left.

    Every fourth frame is taken, so that no two share an estimate.
    """
    rng = np.random.default_rng(count)
    errors = np.sqrt(np.mean(rng.standard_normal((1200, count)) ** 2, axis=1))
    found = np.square(over_neighbours(errors, np.ones(1200)))[2:-1:4]
    assert np.var(found) == pytest.approx(2 / count / 3, rel=critical_z() * math.sqrt(2 / len(found)))
