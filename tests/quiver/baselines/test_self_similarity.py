"""What looks alike in a picture: equal to a plain program, sharp on what repeats, and as noisy as stated."""

import merge_reference as plain
import numpy as np
import pytest
import torch
from operators import Operators
from scipy.ndimage import gaussian_filter

from quiver.baselines.self_similarity import REACH, mean_of_alike


def found_by(image, variance):
    mean, noise = mean_of_alike(torch.from_numpy(image)[None], torch.from_numpy(variance)[None])
    return mean[0].numpy(), noise[0].numpy()


@pytest.mark.parametrize("seed", range(12))
def test_it_is_what_the_plain_program_finds(seed):
    """Over sizes from a cell on, textures, noise and its variation."""
    rng = np.random.default_rng(seed)
    shape = tuple(2 * int(n) for n in rng.integers(1, 30, 2))
    noise = rng.uniform(0.1, 1, shape) * rng.choice([0.1, 1.0])
    texture = gaussian_filter(rng.normal(size=shape), rng.uniform(0.5, 3)) * rng.choice([0.0, 1.0, 10.0])
    image = (texture + rng.normal(size=shape) * noise).astype(np.float32)
    variance = np.square(noise).astype(np.float32)
    expected = plain.mean_of_alike(image, variance)
    for value, wanted in zip(found_by(image, variance), expected, strict=True):
        np.testing.assert_allclose(value, wanted, rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("period", [2, 3, 4, 5, 7, 8, 12, 16])
@pytest.mark.parametrize("kind", ["stripes", "checks", "grid"])
def test_what_repeats_loses_its_noise(period, kind):
    """A partner within reach at least halves the noise, beside edges of full contrast."""
    y, x = np.mgrid[:96, :96]
    half = period // 2
    picture = {
        "stripes": x % period < half,
        "checks": (x % period < half) ^ (y % period < half),
        "grid": (x % period == 0) | (y % period == 0),
    }[kind] * 8.0
    noise = np.random.default_rng(period).normal(size=picture.shape)
    mean, variance = found_by((picture + noise).astype(np.float32), np.ones(picture.shape, np.float32))
    inner = (slice(REACH, -REACH),) * 2
    error = np.square(mean - picture)[inner].mean()
    assert error < 0.5
    # Stated noise leaves out what makes a place look alike: that of the place itself.
    assert error == pytest.approx(variance[inner].mean(), abs=0.12)


def test_what_does_not_repeat_stays():
    rng = np.random.default_rng(0)
    picture = (10 * rng.normal(size=(64, 64))).astype(np.float32)
    mean, variance = found_by(picture, np.full(picture.shape, 0.01, np.float32))
    np.testing.assert_allclose(mean, picture, atol=0.05)
    assert variance.min() > 0.005


def test_all_sizes_take_as_many_operators_and_wait_for_nothing():
    counts = []
    for batch in (1, 4):
        image = torch.zeros(batch, 48, 64, device="meta")
        with Operators() as operators:
            mean_of_alike(image, image)
        assert not operators.waits
        counts.append(operators.count)
    assert counts[0] == counts[1] < 5000
