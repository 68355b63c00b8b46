"""Planes of a code: their light and its mean have the errors that they state, in any order, and resume to the bit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from small_scenes import CAMERA, RATE, plate, renderer
from stats import critical_z

from qsim.clip.clamped_error import StatedError, rms, stated
from qsim.rendering import planes
from qsim.rendering.budget import Allowed, Budget, deciding
from qsim.rendering.clip_rendering import render_clip
from qsim.rendering.denoiser import available
from qsim.rendering.fidelity import SENSOR_SHARE, Noise, _Work, choose_budget, planes_bias, planes_together
from qsim.rendering.planes import most_planes, together
from qsim.rendering.renderer import Renderer
from qsim.scene import Constant, PulseWidth, Spin, SunSky

BUDGET = Budget(samples=2, bounces=2, planes=3, codes=(3,), sharp_samples=12)
SPINNING = plate(Spin((0, 0, 1), 200.0), light=SunSky())
DRAWS = 24
SIDE = 64


def moving(n: int) -> np.ndarray:
    """Return an edge that moves by a pixel per plane over a ramp, float64 [n, SIDE, SIDE]."""
    ramp = np.linspace(0.2, 1.0, SIDE)[:, None] * np.ones(SIDE)
    return np.stack([np.where(np.arange(SIDE) < SIDE // 2 + i, ramp, 0.3 * ramp) for i in range(n)])


@pytest.mark.parametrize("denoise", [False, True])
def test_planes_and_their_mean_have_the_errors_that_they_state(monkeypatch, denoise):
    """Squared errors against a known truth, over the stated ones, in independent draws of noise that is seldom small.

    A mixture states one standard error more: at most 2 / SIDE of the squared raw error.
    """
    monkeypatch.setattr(planes, "denoised", lambda half, *_: gaussian_filter(half, 1.0).astype(np.float32))
    truth = moving(5)
    budget = Budget(denoise=denoise, white=0.9)
    surfaces = (np.ones((SIDE, SIDE)), np.ones((SIDE, SIDE, 3))) if denoise else None
    rng = np.random.default_rng(4)
    ratios = []
    for _ in range(DRAWS):
        halves = (truth[:, None] * rng.gamma(1.5, 1 / 1.5, (5, 2, SIDE, SIDE))).astype(np.float32)
        light, errors = together(halves, surfaces, budget)
        assert (light >= 0).all()
        raw = [rms(halves.mean(axis=1)[0] - truth[0]), rms(halves.mean(axis=(0, 1)) - truth.mean(axis=0))]
        pictures = [(light[0], truth[0], errors[0]), (light.mean(axis=0), truth.mean(axis=0), errors[-1])]
        for white in (math.inf, 0.9):
            row = []
            for (picture, true, error), noise in zip(pictures, raw, strict=True):
                found = error.plain if white == math.inf else error.at(white)
                row.append([found**2 / rms(np.minimum(picture, white) - np.minimum(true, white)) ** 2])
                more = 2 / SIDE * noise**2 / rms(picture - true) ** 2
                row[-1].append(more if denoise else 0.0)
            ratios.append(row)
    found = np.reshape(ratios, (DRAWS, 2, 2, 2))  # draws, white, plane or mean, ratio and what is added
    ratio = found[:, 0, :, 0]
    more = found[:, 0, :, 1]
    sigma = ratio.std(axis=0, ddof=1) / math.sqrt(DRAWS)
    assert (np.abs(ratio.mean(axis=0) - 1) < critical_z(checks=4) * sigma + more.mean(axis=0)).all()
    # Clamped errors are upper estimates where a half is above white
    assert (found[:, 1, :, 0].mean(axis=0) > 1 - critical_z(checks=4) * sigma).all()
    if denoise:  # the mean is cleaned, and its light is shared out
        assert errors[-1].plain < 0.8 * raw[1]


def test_a_cleaned_mean_is_the_mean_of_its_planes(monkeypatch):
    """Also where no path found light: the planes share it evenly."""
    monkeypatch.setattr(planes, "denoised", lambda half, *_: gaussian_filter(half, 2.0).astype(np.float32))
    cleaned = []
    known = planes.keeping_mean
    monkeypatch.setattr(planes, "keeping_mean", lambda *given: cleaned.append(known(*given)) or cleaned[-1])
    halves = np.random.default_rng(1).exponential(1.0, (4, 2, 40, 40)).astype(np.float32)
    halves[:, :, :8] = 0
    light, _ = together(halves, (np.ones((40, 40)), np.ones((40, 40, 3))), Budget(denoise=True, white=2.0))
    np.testing.assert_allclose(light.mean(axis=0), cleaned[0].picture, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(light[0, :4], light[3, :4])


def test_raw_planes_are_frames_of_their_own_and_the_middle_has_a_sharp_one():
    made = renderer(SPINNING, BUDGET, frames=8)
    frames = {t: made.frame(t) for t in (4, 0, 1, 7, 6, 3)}
    again = renderer(SPINNING, BUDGET, frames=8)
    for t in sorted(frames):
        np.testing.assert_array_equal(again.frame(t, with_truth=False).radiance, frames[t].radiance)
    assert [t for t, frame in frames.items() if frame.sharp is not None] == [4, 1, 7]
    assert [t for t, frame in frames.items() if frame.code is not None] == [4, 1]  # the last code lacks a plane
    sharp = renderer(SPINNING, BUDGET.of_middles).frame(4)
    np.testing.assert_array_equal(frames[4].sharp, sharp.radiance)
    np.testing.assert_array_equal(frames[4].flow, sharp.flow)
    assert frames[4].code.plain >= sharp.error


def test_the_mean_of_rendered_planes_errs_as_stated():
    """A reference of 128 times the samples has a hundredth of the squared noise."""
    squares = []
    said = []
    made = renderer(SPINNING, replace(BUDGET, samples=4), frames=24)
    for first in range(0, 24, 3):
        light = np.mean([made.frame(t, with_truth=False).radiance for t in range(first, first + 3)], axis=0)
        times = [made.time(t) for t in range(first, first + 3)]
        deep = made.halves(times, Budget(1536, 2), made.key(first, 99)).mean(axis=0)
        squares.append(rms(light - deep) ** 2)
        said.append(made._planes_of(first).error.plain ** 2)
    ratio = np.array(squares) / np.array(said)
    assert abs(ratio.mean() - 1) < critical_z() * ratio.std(ddof=1) / math.sqrt(len(ratio)) + 0.01


def test_a_clip_of_planes_resumes_and_states_the_errors_of_its_codes(tmp_path):
    class Stop(Exception):
        pass

    def stop(done, _):
        if done == 4:
            raise Stop

    budget = replace(BUDGET, samples=4, denoise=available(), quality="fast")
    options = {"frames": 7, "budget": budget, "frame_rate": RATE}
    whole = render_clip(SPINNING, tmp_path / "whole", **options)
    with pytest.raises(Stop):
        render_clip(SPINNING, tmp_path / "broken", **options, progress=stop)
    resumed = render_clip(SPINNING, tmp_path / "broken", **options)
    assert resumed.info.checksums == whole.info.checksums
    info = whole.info
    assert (len(info.error_per_frame), len(info.error_per_code), len(info.error_at_white_per_code)) == (7, 2, 2)
    assert stated(info).line.endswith("of the mean of 3 frames and of its sharp middle")
    assert max(info.error_per_code) < np.median(info.error_per_frame)
    assert np.array_equal(whole.sharp(1), whole.radiance(1)) == (not budget.denoise)  # the planes share one picture
    np.testing.assert_array_equal(whole.sharp(2), whole.radiance(2))


def test_lights_of_planes_flicker_and_a_window_has_planes_of_its_own():
    flashing = plate(None, Constant(0.7, flicker=PulseWidth(RATE / 2, duty=0.5)))
    made = renderer(flashing, replace(BUDGET, planes=2, codes=(2,)), frames=2)
    alone = renderer(flashing, Budget(2, 2))
    assert made.frame(0).radiance.mean() == pytest.approx(alone.frame(0).radiance.mean(), rel=0.05)
    part = made.window((2, 3, 10, 12))
    assert part.frame(1).radiance.shape == (10, 12)


@pytest.mark.parametrize("wrong", [{"planes": 0}, {"planes": 3}, {"planes": 3, "sharp_samples": 8, "neighbours": 1}])
def test_a_budget_of_planes_needs_sharp_samples_and_no_neighbours(wrong):
    with pytest.raises(ValueError, match=r"Budget\.planes"):
        Budget(**wrong)


def test_an_open_shutter_has_no_planes():
    with pytest.raises(ValueError, match="open shutter"):
        Renderer(SPINNING, shutter=0.5, budget=BUDGET)


@pytest.mark.parametrize(
    ("codes", "shutter", "frames", "found"),
    [
        ((), 0.0, 9, (1, "")),
        ((1,), 0.0, 9, (1, "")),
        ((7, 3), 0.0, 9, (3, "")),
        ((7, 1), 0.0, 9, (1, "a stream has one frame in a code, or codes whose rows or exposures differ")),
        ((3,), 0.5, 9, (1, "the shutter is open")),
        ((12,), 0.0, 9, (1, "the clip has fewer than 12 frames")),
    ],
)
def test_frames_share_noise_where_all_codes_sum(codes, shutter, frames, found):
    assert planes_together(SPINNING, codes, shutter, frames) == found


def test_planes_fit_into_memory_or_are_rendered_alone():
    most = most_planes(4000 * 4000)
    large = replace(SPINNING, camera=replace(CAMERA, height=4000, width=4000))
    assert planes_together(large, (most,), 0.0, 99)[0] == most
    assert "leave memory for" in planes_together(large, (most + 1,), 0.0, 99)[1]
    with pytest.raises(ValueError, match="codes: expected frames in a code from 1 up, got 0"):
        planes_together(large, (0,), 0.0, 99)


def test_a_code_has_the_error_asked_of_it():
    """Seven planes with the noise of one picture: fewer samples each, and the same frame in the middle."""
    asked = {"psnr": 30.0, "denoise": False, "frames": 14, "frame_rate": 14000.0}
    sharp = choose_budget(SPINNING, **asked, ppp=None)
    code = choose_budget(SPINNING, **asked, codes=(7,))
    assert (code.planes, code.codes, code.sharp_samples) == (7, (7,), sharp.samples)
    assert code.samples < sharp.samples
    assert deciding(code.findings) == "30 dB"
    made = Renderer(SPINNING, frame_rate=14000.0, budget=code, frames=14)
    assert made.frame(3).code.at(code.white) < 1.2 * code.white * 10 ** (-30 / 20)


def test_the_limit_that_decides_is_named():
    """In much light the noise of the sensor is small, and the renderer has to be quieter."""
    asked = {"psnr": 25.0, "denoise": False, "frames": 2}
    found = [deciding(choose_budget(SPINNING, **asked, ppp=ppp).findings) for ppp in (None, 0.1, 300.0)]
    assert found == ["25 dB", "25 dB", "300 PPP"]


def test_the_larger_of_two_errors_and_their_sum_hold_at_every_white():
    one = StatedError(3.0, ((1.0, 2.0), (2.0, 2.5)))
    assert one.or_larger(StatedError(2.0, ((1.0, 2.2), (2.0, 2.2)))) == StatedError(3.0, ((1.0, 2.2), (2.0, 2.5)))
    assert one.and_more(4.0).plain == 5.0
    assert one.at(1.0) == 2.0
    assert one.at(9.0) == 3.0


@pytest.mark.parametrize("seed", range(4))
def test_the_bias_of_binary_planes_by_their_noise_is_half_of_the_variance_that_the_budget_allows(seed):
    """Counts of noisy planes of random light and numbers, drawn by NumPy: as `planes_bias` states, to second order."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 12))
    light = float(rng.uniform(0.2, 2.0))  # photons per code
    error = float(rng.uniform(0.1, 0.3))  # of a plane, over its light
    allowed = Allowed(1.0, 1.0, math.sqrt(SENSOR_SHARE / light))
    noise = Noise((error,) * 3, (error,) * 3)  # alike at any number of samples
    stated_bias = planes_bias(_Work(2, count, 9, 1.0, allowed, noise), 4, 4)
    noisy = light / count * (1 + error * rng.choice([-1.0, 1.0], (100_000, count)))
    lost = (-np.expm1(-light / count) - (-np.expm1(-noisy)).mean()) * count * math.exp(light / count)
    sampled = 4 * light / math.sqrt(count * 100_000) * error  # of the noise itself, whose mean is not quite 0
    assert abs(lost / light - stated_bias) < 0.1 * stated_bias + sampled / light


def test_a_budget_states_the_bias_of_its_planes_and_bounds_it(monkeypatch):
    asked = {"psnr": 25.0, "denoise": False, "frames": 6, "frame_rate": 14000.0, "codes": (3,)}
    for ppp, words in ((None, "is not bounded"), (2.0, "of the light")):
        budget = choose_budget(SPINNING, **asked, ppp=ppp)
        (shown,) = [finding.size for finding in budget.findings if finding.effect == "planes"]
        assert f"{words}" in shown
        assert "lowers the counts of binary planes" in shown
    monkeypatch.setattr("qsim.rendering.fidelity.BIAS", 2e-3)
    strict = choose_budget(SPINNING, **asked, ppp=2.0)
    assert any("would lower the counts of binary planes by more than 0.2 %" in one.size for one in strict.findings)
    assert strict.samples > budget.samples
