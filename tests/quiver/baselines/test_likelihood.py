"""Maximum likelihood per pixel: single codes worked by hand, close to the Cramer-Rao bound, at any bits."""

import numpy as np
import pytest

from qsim.keys import Key
from qsim.sensor.devices import quiver_paper, quiver_physical
from qsim.sensor.qis import QIS
from quiver.baselines import few_codes, likelihood

EXPOSURE = 5e-4


def flat(sensor, photons, frames, shape=(40, 50)):
    return sensor.sample(np.full((frames, *shape), photons), EXPOSURE, key=Key(5, 8), engine="reference")


def test_single_codes_worked_by_hand():
    """The most likely light for each single 3-bit code but the last; less its bias it moves by at most 1.5 e-."""
    sensor = QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25)
    likeliest = sensor.maximum_likelihood(np.eye(8)[:7], EXPOSURE).photons
    np.testing.assert_allclose(likeliest, [0, 1.237, 2.467, 3.677, 4.852, 5.979, 7.055], atol=6e-4)
    codes = np.arange(8, dtype=np.uint8).reshape(1, 2, 4)
    restored = likelihood.restore(codes, sensor, EXPOSURE, window=1).ravel()
    assert (np.abs(restored[:7] - likeliest) < 1.5 / 0.8).all()
    assert (np.diff(restored) > 0).all()


@pytest.mark.parametrize(("photons", "ratio"), [(3.25, 1.017), (6.5, 1.10)])
def test_maximum_likelihood_comes_close_to_the_bound(photons, ratio):
    """Variance of 11-frame estimates over 1/(11 I), worked by simulation elsewhere; 7 % is 5 sigma of 10 000 pixels.

    The ratio is that of the likeliest light; corrected for its bias it scatters less.
    """
    sensor = quiver_physical(3.25)
    codes = flat(sensor, photons, 11, (100, 100))
    restored = likelihood.restore(codes, sensor, EXPOSURE)[5].astype(float)
    bound = 1 / (11 * float(sensor.fisher_information(np.array([photons]), EXPOSURE)[0]))
    assert 0.9 < restored.var() / bound < ratio + 0.07
    assert abs(restored.mean() / photons - 1) < 0.01


def test_many_levels_go_the_way_of_few():
    """8 bits leave the exact outcome names; the estimate must still be that of the histogram, pixel by pixel."""
    sensor = quiver_paper(bits=8)
    codes = sensor.sample(np.full((3, 4, 5), 40.0), EXPOSURE, key=Key(1, 1), engine="reference")
    restored = likelihood.restore(codes, sensor, EXPOSURE, window=3)
    histogram = np.apply_along_axis(np.bincount, 0, codes.reshape(3, 20), minlength=256).T
    likeliest = sensor.maximum_likelihood(histogram, EXPOSURE).photons
    sums = codes.reshape(3, 20).sum(axis=0, dtype=int)
    expected = few_codes.less_bias(likeliest, sums, sensor, EXPOSURE, ((1.0, 3),))
    np.testing.assert_allclose(restored[1].ravel(), expected, rtol=1e-6)
    np.testing.assert_allclose(expected, likeliest, rtol=0.01)


@pytest.mark.parametrize("gain", [0.02, 0.035, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("window", [1, 3, 11])
def test_brighter_codes_are_brighter_light_at_any_gain(gain, window):
    """Where the first code needs fifteen electrons, a dark code was restored as nearly the brightest light."""
    sensor = QIS(0.8, 1.6, 0.2, 3, gain=gain)
    steps = np.arange(sensor.levels, dtype=np.uint8)
    codes = np.broadcast_to(steps, (window, 1, sensor.levels))
    found = likelihood.restore(codes, sensor, 5e-4, window=window)[window // 2, 0]
    assert (np.diff(found) > 0).all()
    assert found[0] < sensor.white(5e-4) / 20
