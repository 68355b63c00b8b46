"""The denoiser: its mixture with raw samples, and the stated error."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_scenes import CAMERA, plate, renderer

from qsim.backend import GPU_VARIANT, VARIANTS
from qsim.rendering import denoiser, optix_denoiser
from qsim.rendering.budget import Budget
from qsim.rendering.denoiser import available, cleaned_mean, mixture
from qsim.scene import Spin, SunSky


@pytest.mark.parametrize("bias", [0.0, 0.3, 2.0])
def test_the_best_mixture_is_known_without_the_truth(bias):
    """A filter adds a bias to the truth, with raw noise of 0.5: D(A) - B contains the bias, A - B does not.

    Weights are 1 / variance, which is 0.125 for the mean of two halves: w = 0.125 / (0.125 + bias^2), and
    error^2 = w bias^2. Over 40 000 pixels the estimate has a sigma of at most 0.001 (0.125 sqrt(2) / 200; for a bias of
    2, w is 0.03 and bias Z w as large). One sigma is added.
    """
    rng = np.random.default_rng(3)
    truth = rng.random((200, 200))
    halves = truth + 0.5 * rng.standard_normal((2, 200, 200))
    mixed = mixture(halves, np.stack([truth + bias] * 2))
    share = mixed.share
    error = mixed.error
    best = 0.125 / (0.125 + bias**2)
    assert share.mean() == pytest.approx(best, abs=0.05)
    assert error**2 == pytest.approx(max(best * bias**2, 0.00125), abs=0.006)


def test_noise_that_the_filter_keeps_is_part_of_the_error():
    """A filter keeps the fraction k of the noise, without bias: E (C - truth)^2 is k^2 of the raw one.

    The best w is 1 (only C), with the error k sqrt(V / 2). Here half the difference of D(A) and D(B) gives the same; in
    the test above it does not. 160 000 pixels: sigma of the square below 0.4 %.
    """
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((2, 400, 400))
    mixed = mixture(1 + noise, 1 + 0.6 * noise)
    share = mixed.share
    error = mixed.error
    assert share.mean() > 0.9
    assert error**2 == pytest.approx(0.36 / 2, rel=0.03)


def test_each_part_of_a_picture_is_mixed_by_its_own_errors():
    """A filter is right on the left and biased on the right: denoised left, raw right, away from the border.

    The left fraction is a ratio of two sums of 33 x 33 squares: 6 % of noise, 9 % at a border, which mirrors half of
    them, and at most 1. The right one is 0.005, with far less noise.
    """
    rng = np.random.default_rng(6)
    truth = np.ones((120, 300))
    cleaned = truth + np.where(np.arange(300) < 150, 0.0, 3.0)
    share = mixture(truth + 0.3 * rng.standard_normal((2, 120, 300)), np.stack([cleaned] * 2)).share
    assert share[:, :120].min() > 0.6
    assert share[:, :120].mean() > 0.95
    assert share[:, 180:].max() < 0.05


def test_only_a_gpu_whose_denoiser_works_has_one_more_kind(monkeypatch):
    gpu = GPU_VARIANT.replace("_mono", "_rgb")
    for works, kinds in ((True, (*denoiser.QUALITIES, denoiser.OPTIX)), (False, denoiser.QUALITIES)):
        monkeypatch.setattr(denoiser, "gpu_denoises", lambda works=works: works)
        assert denoiser.kinds(gpu) == kinds
        assert denoiser.kinds(VARIANTS["llvm"]) == denoiser.QUALITIES


@pytest.mark.skipif(not available(), reason="Open Image Denoise is not installed: pip install pyoidn")
@pytest.mark.parametrize("added", [0.0, 0.1, 1.0])
def test_the_error_of_the_denoiser_of_a_gpu_contains_its_bias(monkeypatch, added):
    """A stand-in returns the truth with stripes of 8 px added, which keep the mean light; noise of 0.5 in each half."""
    rng = np.random.default_rng(7)
    truth = 2 + rng.random((120, 168))
    halves = truth + 0.5 * rng.standard_normal((2, *truth.shape))
    stripes = added * (-1.0) ** (np.arange(truth.shape[1]) // 8)
    monkeypatch.setattr(optix_denoiser, "denoised", lambda colour, albedo: np.stack([truth + stripes] * 3, axis=-1))
    mixed = cleaned_mean(halves, np.ones_like(truth), np.zeros((*truth.shape, 3)), math.inf, denoiser.OPTIX)
    distance = math.sqrt(np.mean((mixed.picture - truth) ** 2))
    assert max(distance, 0.1 * 0.5 / math.sqrt(2)) == pytest.approx(mixed.error, rel=0.15)
    assert (distance < 0.05) == (added == 0)


def test_another_engine_refuses_the_denoiser_of_a_gpu():
    with pytest.raises(ValueError, match="optix is the denoiser of a GPU"):
        renderer(plate(None), budget=Budget(8, 2, denoise=True, quality=denoiser.OPTIX))


def test_a_filter_without_effect_lowers_no_error():
    halves = np.random.default_rng(4).standard_normal((2, 100, 100))
    assert mixture(halves, halves).error == pytest.approx(math.sqrt(0.5), rel=0.05)


@pytest.mark.skipif(not available(), reason="Open Image Denoise is not installed: pip install pyoidn")
def test_the_stated_error_of_a_denoised_frame_is_its_error():
    """A matt plate under sun and sky: the stated error of a denoised frame covers its distance from the truth."""
    made = plate(Spin((0, 0, 1), 200.0), light=SunSky(), camera=CAMERA.resized(96, 132))
    raw, clean = (renderer(made, budget=Budget(8, 2, denoise=on)).frame(0, with_truth=False) for on in (False, True))
    converged = renderer(made, seed=9, budget=Budget(512, 2)).frame(0, with_truth=False).radiance
    distance = math.sqrt(np.mean((clean.radiance - converged) ** 2))
    assert distance < 0.7 * raw.error
    assert clean.error == pytest.approx(distance, rel=0.2)


def test_denoising_without_the_package_is_refused(monkeypatch):
    from qsim.rendering import denoiser

    monkeypatch.setattr(denoiser, "available", lambda: False)
    with pytest.raises(ValueError, match="denoising requires Open Image Denoise, which is missing"):
        renderer(plate(None), budget=Budget(2, 1, denoise=True)).frame(0)


@pytest.mark.parametrize("seed", range(10))
def test_a_denoised_frame_keeps_the_mean_light(monkeypatch, seed):
    """Also if the denoiser changes the mean light by up to three per cent."""
    rng = np.random.default_rng([9, seed])
    shift = rng.uniform(0.97, 1.03)
    monkeypatch.setattr(denoiser, "denoised", lambda half, *_: shift * np.ones_like(half))
    halves = 1 + 0.3 * rng.standard_normal((2, 128, 128))
    mixed = denoiser.cleaned_mean(halves, halves[0], halves[0], 2.5)
    moved = abs(shift - 1) > denoiser.KEPT * mixed.error
    if not moved:
        assert mixed.picture.mean() == pytest.approx(halves.mean(), rel=1e-12)
    assert abs(mixed.picture.mean() - halves.mean()) <= abs(shift * 1 - halves.mean())


def test_a_stray_path_does_not_brighten_the_frame(monkeypatch):
    """One pixel of a million times the light has 60 times the frame's mean; it shifts it by a part of its error."""
    monkeypatch.setattr(denoiser, "denoised", lambda half, *_: np.ones_like(half))
    halves = 1 + 0.01 * np.random.default_rng(1).standard_normal((2, 128, 128))
    halves[0, 5, 5] = 1e6
    mixed = denoiser.cleaned_mean(halves, halves[0], halves[0], 2.5)
    assert np.median(mixed.picture) == pytest.approx(1.0, abs=0.02)
