"""Scores obey their laws, agree with a second implementation, and intervals cover as promised."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from stats import assert_share

from quiver.evaluation import metrics


def pattern(frames: int = 3, height: int = 10, width: int = 13, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.05, 0.7, (frames, height, width))


def test_psnr_of_a_constant_error_is_worked_by_hand():
    """An error of 0.1 everywhere: -10 log10(0.01) = 20 dB; values outside [0, 1] count as the nearest limit."""
    target = pattern()
    np.testing.assert_allclose(metrics.psnr(target + 0.1, target), 20.0, atol=1e-9)
    np.testing.assert_allclose(metrics.psnr(np.full((1, 2, 2), 7.0), np.full((1, 2, 2), 0.9)), 20.0, atol=1e-9)
    assert np.isnan(metrics.psnr(np.full((1, 2, 2), 7.0), np.full((1, 2, 2), 3.0))).all()
    assert np.all(np.isinf(metrics.psnr(target, target)))


def noisy_pair(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A target [2, H, W] and the same with noise of 0.1 of the peak."""
    target = pattern(2, height, width)
    return np.clip(target + np.random.default_rng(1).normal(0, 0.1, target.shape), 0, 1), target


def ssim_by_definition(a: np.ndarray, b: np.ndarray, keep: np.ndarray) -> float:
    """Wang et al. 2004, window by window, with sample covariances; the mean over windows of kept pixels alone."""
    found = []
    for y, x in np.ndindex(a.shape[0] - 6, a.shape[1] - 6):
        window = (slice(y, y + 7), slice(x, x + 7))
        if keep[window].all():
            (var_a, both), (_, var_b) = np.cov(a[window].ravel(), b[window].ravel())
            mean_a = a[window].mean()
            mean_b = b[window].mean()
            light = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
            found.append(light * (2 * both + 9e-4) / (var_a + var_b + 9e-4))
    return float(np.mean(found)) if found else math.nan


@pytest.mark.parametrize(("height", "width"), [(7, 7), (10, 13), (33, 8)])
def test_ssim_is_that_of_its_definition(height: int, width: int):
    """Of complete frames, and of frames in which some pixels are not valid."""
    output, target = noisy_pair(height, width)
    valid = np.ones(target.shape, bool)
    for keep in (valid, valid & (np.arange(width) > 0)):
        expected = [ssim_by_definition(*three) for three in zip(output, target, keep, strict=True)]
        np.testing.assert_allclose(metrics.ssim(output, target, keep), expected, rtol=1e-11)
    np.testing.assert_allclose(metrics.ssim(output, target, valid), metrics.ssim(output, target), rtol=1e-12)


@pytest.mark.parametrize(
    ("height", "width", "before"),
    [
        (7, 7, (0.9083027496771398, 0.9297019169509092)),
        (10, 13, (0.9030129395396174, 0.8872972953457845)),
        (33, 8, (0.8975030346701526, 0.8915015011201638)),
    ],
)
def test_ssim_is_what_it_was_before_scikit_image_computed_it(height: int, width: int, before: tuple[float, float]):
    np.testing.assert_allclose(metrics.ssim(*noisy_pair(height, width)), before, rtol=1e-12)


def test_ssim_of_itself_is_one_and_of_tiny_frames_unknown():
    np.testing.assert_allclose(metrics.ssim(pattern(), pattern()), 1.0)
    assert np.isnan(metrics.ssim(pattern(height=6), pattern(height=6))).all()


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.0, 1.3])
def test_a_wrong_brightness_is_undone_exactly(factor: float):
    target = pattern()
    found = metrics.score(factor * target, target)
    assert found.scale == pytest.approx(1 / factor)
    assert found.psnr_matched > 200
    assert found.ssim_matched == pytest.approx(1.0)
    if factor != 1.0:
        assert found.psnr < 30


def test_clipped_highlights_do_not_move_the_factor():
    """A third of the target is above the peak; a perfect output, clamped or not, needs the factor 1."""
    target = pattern()
    target[:, :, ::3] += 1.5
    assert metrics.best_scale(target, target) == 1.0
    assert metrics.best_scale(np.minimum(target, 1), target) == 1.0
    assert metrics.best_scale(2 * target, target) == pytest.approx(0.5, rel=1e-12)
    assert metrics.score(2.1 * target, target).psnr_matched > 200


def drawn_pair(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A random target [T, H, W] up to far above the peak, and an output of wrong brightness with noise of any size."""
    shape = (int(rng.integers(1, 4)), int(rng.integers(1, 9)), int(rng.integers(1, 9)))
    target = rng.gamma(rng.uniform(0.2, 4), 1.0, shape) * rng.uniform(0.05, 3)
    if rng.random() < 0.2:
        target = np.minimum(target, 1)
    output = target * np.exp(rng.normal(0, 1.5)) * np.exp(rng.normal(0, rng.uniform(0, 1.5), shape))
    return output + rng.normal(0, rng.uniform(0, 0.5), shape), target


def clamped_error(output: np.ndarray, target: np.ndarray, factor: float) -> float:
    return float(np.sum((np.clip(factor * output, 0, 1) - np.clip(target, 0, 1)) ** 2))


@pytest.mark.parametrize("draws", [15, pytest.param(150, marks=pytest.mark.slow)])
@pytest.mark.parametrize("chunk", [5, 1 << 20])
def test_the_factor_is_the_best_behind_the_clamp(chunk, draws, monkeypatch):
    """Against 4001 factors tried one by one, over random images; and the matched score is never below the raw one."""
    monkeypatch.setattr(metrics, "CHUNK", chunk)
    rng = np.random.default_rng(5)
    tried = np.geomspace(*metrics.FACTORS, 4001)
    moved = 0
    for _ in range(draws):
        output, target = drawn_pair(rng)
        least = min(clamped_error(output, target, s) for s in tried)
        found = metrics.best_scale(output, target)
        assert clamped_error(output, target, found) <= least * (1 + 1e-9) + 1e-13
        moved += found != 1.0
        for per_frame in (False, True):
            score = metrics.score(output, target, per_frame_scale=per_frame)
            assert score.psnr_matched >= score.psnr or math.isnan(score.psnr)
    assert moved > draws * 2 / 3  # the search is no search if 1 is always best


def test_no_score_is_infinite_unless_the_frames_are_equal():
    """Any light, any brightness, any noise: where the clamp hides all error there is no score, never infinity."""
    rng = np.random.default_rng(6)
    hidden = 0
    for _ in range(400):
        output, target = drawn_pair(rng)
        light = np.exp(rng.uniform(-3, 6))  # the target's share above the peak runs from none to all
        score = metrics.score(output * light, target * light)
        values = (score.psnr, score.psnr_matched)
        assert not any(math.isinf(v) for v in values)
        assert all(math.isnan(v) for v in values) == (score.frames == 0)
        hidden += score.frames < len(target)
        if score.frames == 0:
            assert math.isnan(score.ssim)
        assert math.isinf(metrics.score(target * light, target * light).psnr)
    assert 20 < hidden < 380


def test_a_larger_error_scores_less():
    """The same noise, ever stronger, at light levels from a tenth of the peak to above it."""
    rng = np.random.default_rng(7)
    for mean in (0.1, 0.4, 0.9):
        target = rng.gamma(2, mean / 2, (1, 40, 40))
        noise = rng.normal(0, 1, target.shape)
        scores = [metrics.score(target + s * noise, target).psnr for s in np.geomspace(0.003, 0.3, 9)]
        assert all(a > b for a, b in pairwise(scores))


def test_invalid_pixels_count_nowhere():
    """For any values in them, the score is that of the other pixels; a frame without valid pixels has none."""
    rng = np.random.default_rng(8)
    target = rng.uniform(0.05, 1.2, (3, 20, 24))
    output = 1.2 * target + rng.normal(0, 0.05, target.shape)
    valid = np.ones(target.shape, bool)
    valid[0, :, 12:] = False
    valid[2] = False
    found = metrics.score(output, target, valid=valid)
    spoilt = np.where(valid, output, 40.0)
    other = np.where(valid, target, 7.0)
    assert metrics.score(spoilt, other, valid=valid) == found
    assert found.frames == 2
    left = metrics.psnr(output[:1, :, :12], target[:1, :, :12])
    assert metrics.psnr(spoilt, other, valid)[0] == pytest.approx(left[0])
    assert metrics.ssim(spoilt, other, valid)[0] == pytest.approx(metrics.ssim(output[:, :, :12], target[:, :, :12])[0])
    assert found.above_peak == pytest.approx(float((target[valid] > 1).mean()))
    with pytest.raises(ValueError, match=r"valid: expected bool \[3, 20, 24\]"):
        metrics.psnr(output, target, valid[:2])


@pytest.mark.parametrize("output", [0.0, -1.0])
def test_a_black_output_gets_the_factor_one(output: float):
    assert metrics.best_scale(np.full((1, 3, 3), output), pattern(1, 3, 3)) == 1.0


def test_one_factor_per_frame_follows_a_flicker_that_one_per_clip_cannot():
    target = pattern()
    flicker = target * np.array([0.6, 1.1, 1.4])[:, None, None]
    per_clip = metrics.score(flicker, target)
    per_frame = metrics.score(flicker, target, per_frame_scale=True)
    assert per_frame.psnr_matched > 200 > 30 > per_clip.psnr_matched
    assert per_clip.scale_spread == 0.0
    assert per_frame.scale_spread == pytest.approx(np.std([1 / 0.6, 1 / 1.1, 1 / 1.4]))
    found, factors = metrics.score_and_factors(flicker, target, per_frame_scale=True)
    assert found == per_frame
    np.testing.assert_allclose(factors, [1 / 0.6, 1 / 1.1, 1 / 1.4], rtol=1e-6)


def test_bad_input_names_the_place():
    bad = pattern()
    bad[1, 4, 2] = np.nan
    with pytest.raises(ValueError, match=r"output is nan at \(t, y, x\) = \(1, 4, 2\)"):
        metrics.score(bad, pattern())
    with pytest.raises(ValueError, match=r"output has shape \(3, 10, 13\), target \(2, 10, 13\)"):
        metrics.psnr(pattern(), pattern(2))
    with pytest.raises(ValueError, match="at least one pixel"):
        metrics.psnr(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)))


def test_intervals_over_scenes_cover_95_percent():
    """2000 experiments of five scenes with two clips each; the clips of one scene share its deviation."""
    rng = np.random.default_rng(3)
    scenes = [scene for scene in range(5) for _ in range(2)]
    covered = 0
    for _ in range(2000):
        deviation = np.repeat(rng.normal(25, 3, 5), 2) + rng.normal(0, 0.1, 10)
        found = metrics.over_scenes(list(deviation), scenes)
        covered += abs(found.mean - 25) < found.half_width
    assert_share(covered, 2000, 0.95)
    assert found.scenes == 5


def test_intervals_say_when_they_do_not_know():
    one = metrics.over_scenes([20.0, 22.0], ["fan", "fan"])
    assert one.mean == 21.0
    assert math.isnan(one.half_width)
    assert math.isnan(metrics.over_scenes([math.nan], ["fan"]).mean)
    assert metrics.over_scenes([math.nan, 3.0, 5.0], ["a", "b", "c"]).scenes == 2
    with pytest.raises(ValueError, match="2 values but 1 scenes"):
        metrics.over_scenes([1.0, 2.0], ["a"])


def test_clamped_variance_matches_a_drawn_one():
    """Mean far below, at and far above the peak; at the peak the variance of min(X, m) is s^2 (1/2 - 1/(2 pi))."""
    rng = np.random.default_rng(4)
    found = metrics.clamped_variance(np.array([0.2, 1.0, 1.3, 3.0, 0.5]), np.array([0.01, 0.04, 0.04, 0.04, 0.0]))
    assert found[0] == pytest.approx(0.01, rel=1e-6)
    assert found[1] == pytest.approx(0.04 * (0.5 - 1 / (2 * math.pi)), rel=1e-12)
    drawn = np.minimum(rng.normal(1.3, 0.2, 400_000), 1).var()
    assert found[2] == pytest.approx(drawn, rel=0.03)  # fourth moment: sigma of the drawn variance is 0.9 %
    assert found[3] < 1e-12
    assert found[4] == 0.0


def test_truth_psnr():
    """The mean over frames, as a score is."""
    assert metrics.truth_psnr([0.01]) == pytest.approx(40.0)
    assert metrics.truth_psnr([0.01, 0.1]) == pytest.approx(30.0)
    assert math.isinf(metrics.truth_psnr([0.0]))
    with pytest.raises(ValueError, match="finite number"):
        metrics.truth_psnr([0.01, float("nan")])


def test_rounding_is_no_spread_of_one_factor():
    """24 equal factors have a deviation of 1e-16; it hid the spread over clips in every table."""
    target = pattern(24, 16, 16)
    for factor in (0.72, 0.964, 0.984, 0.994):
        assert metrics.score(target / factor, target).scale_spread == 0.0
