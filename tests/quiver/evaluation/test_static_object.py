"""Real photons of a static object: the noise of the reference is subtracted, flicker divided out."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from methods import broken, method
from numpy import ndarray as Array

from quiver.data.codes import Codes, array_codes
from quiver.data.illumination import ideal_counter
from quiver.data.photon_counts import Counts, read_counts
from quiver.evaluation.static_object import evaluate_static, markdown, mean_square, reference
from quiver.restoration.interface import Restorer
from quiver.restoration.restorers import restorer, restorers

HAZELNUT = Path(__file__).parents[2] / "data" / "hazelnut_gates6.npz"


def static_counts(light: float, shares: Array, seed: int = 0) -> tuple[Counts, Array]:
    rng = np.random.default_rng(seed)
    true = light * rng.uniform(0.2, 1.6, (60, 70))
    return Counts(rng.poisson(shares[:, None, None] * true), shares, "synthetic"), true


def test_the_reference_takes_off_its_own_noise():
    """The error of an oracle against 19 noisy frames is noise of the reference: the rest is zero within its spread."""
    shares = np.tile([1.2, 0.9, 0.9], 10)
    left = []
    measured = []
    for seed in range(40):
        counts, true = static_counts(5.0, shares, seed)
        estimate, variance = reference(counts, np.arange(11, 30))
        left.append(mean_square(true / 7, estimate / 7, variance / 49))
        measured.append(mean_square(true / 7, estimate / 7, np.zeros_like(variance)))
    sigma = np.std(left, ddof=1) / math.sqrt(40)
    assert abs(np.mean(left)) < 5 * sigma  # includes the clamp: a fifth of the pixels is above white
    assert np.mean(measured) > 100 * sigma


def test_flicker_is_divided_out():
    """Frames of unequal light: the mean of eleven, divided by their shares, is unbiased."""
    shares = np.tile([1.5, 0.5], 15)
    counts, _ = static_counts(2.0, shares)
    found = evaluate_static(counts, [restorer("moment")], splits=4)[0]
    assert found.scale == pytest.approx(1.0, abs=0.05)
    flat = evaluate_static(replace(counts, shares=np.ones(30)), [restorer("moment")], splits=4)[0]
    assert flat.psnr < found.psnr


def test_one_split_has_no_spread():
    """It was stated as 0.00 dB."""
    counts, _ = static_counts(5.0, np.ones(30))
    found = evaluate_static(counts, [restorer("moment")], splits=1)
    assert math.isnan(found[0].psnr_matched_spread)
    (line,) = [line for line in markdown(counts, found, 11, 3).splitlines() if line.startswith("| moment")]
    assert "±" not in line
    assert "n/a" not in line


@pytest.mark.parametrize("name", ["moment:1", "moment:3", "state"])
def test_a_frame_is_divided_by_the_light_of_the_frames_that_its_method_sees(name):
    """Much light, so that the best factor is that of the brightness; frames differ by a factor of two."""
    counts, _ = static_counts(100.0, np.tile([4 / 3, 2 / 3], 15))

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:  # the mean of all frames up to t + 1
        seen = codes.read(0, codes.shape[0]).astype(float)
        out += np.stack([seen[: t + 2].mean(axis=0) for t in range(first, first + len(out))])

    method = Restorer(name, 3, 1, True, "", fill, seamless=False) if name == "state" else restorer(name)
    for seed in range(4):
        found = evaluate_static(counts, [method], splits=1, bits=8, seed=seed)[0]
        assert found.scale == pytest.approx(1, abs=0.03)


def test_a_method_with_a_state_restores_the_complete_stream():
    counts, _ = static_counts(5.0, np.ones(30))
    restored: list[tuple[int, int]] = []

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        restored.append((first, len(out)))
        out += codes.read(first, first + len(out))

    method = Restorer("m", 1, 0, True, "", fill)
    evaluate_static(counts, [method, replace(method, seamless=False)], splits=1)
    assert restored == [(5, 1), (0, 11)]


def test_real_photons():
    """The hazelnut: 30 frames of 3.08 photons; eleven averaged beat three, and shares are the gates' means."""
    counts = read_counts(HAZELNUT)
    assert counts.frames.shape[0] == 30
    assert counts.shares[:6] == pytest.approx(
        np.array([3.5431, 3.1394, 2.7712, 2.6510, 2.9083, 3.4963]) / 3.0849, rel=0.05
    )
    eleven, three, bad = evaluate_static(counts, [restorer("moment"), restorer("moment:3"), method("bad", broken)])
    assert eleven.psnr_matched > three.psnr_matched + 3
    assert eleven.psnr_matched > eleven.psnr_as_measured > 20
    assert bad.failure == "RuntimeError: no road leads there"
    text = markdown(counts, [eleven, three, bad], 11, 3)
    assert "| bad | failed: RuntimeError" in text


def test_an_ideal_counter_counts():
    """White is the top code; codes up to it are the counts themselves."""
    sensor = ideal_counter(3)
    assert sensor.white(1.0) == 7
    codes = array_codes(np.full((1, 4, 4), 3, np.uint8), sensor, 1.0)
    np.testing.assert_allclose(restorer("naive:1").restore(codes), 3.0)


def test_the_shipped_weights_do_not_darken_what_nears_saturation():
    """Real photons, a crop in which a fifth of the pixels fill the 3-bit code."""
    counts = read_counts(HAZELNUT)
    crop = replace(counts, frames=counts.frames[:, 64:192, 64:192])
    methods = restorers(["transform-denoise", "qbp-bm3d", "mergenet"])
    *rivals, own = evaluate_static(crop, methods, splits=1)
    assert own.psnr_matched > max(rival.psnr_matched for rival in rivals)
    assert own.scale == pytest.approx(1, abs=0.05)
