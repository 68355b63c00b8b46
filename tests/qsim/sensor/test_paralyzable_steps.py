"""Single steps of a paralyzable counter: the table's numbers and codes, at any light, from one circle per pixel."""

import numpy as np
import pytest
from mpmath import mp
from oracles import paralyzable_oracle
from scipy import stats

from qsim.keys import Key, uniform, words
from qsim.sensor import paralyzable
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.sensor import Sensor

EXPOSURE = 5e-4  # s


def steps_of(mean: float, codes: np.ndarray, ratio: float, inside: bool) -> np.ndarray:
    pixels = np.arange(len(codes))
    nodes = paralyzable.circle(np.full(len(codes), mean), np.full(len(codes), inside), ratio)
    return nodes.sums(codes, pixels) + (0 if inside else 1)


def random_sensor(rng: np.random.Generator, bits: int, longest: float = 1e6) -> CountingSPAD:
    ratio = 10 ** rng.uniform(-0.5, np.log10(longest))
    return CountingSPAD(rng.uniform(0.05, 1), 10 ** rng.uniform(-1, 5), EXPOSURE / ratio, bits, True)


@pytest.mark.parametrize("seed", range(12))
def test_steps_and_their_slopes_are_the_tables(seed):
    """Random dead times from the shortest exposures that have circles; F_k from the side on which it is used."""
    rng = np.random.default_rng([5, seed])
    ratio = paralyzable.LEAST if seed == 0 else paralyzable.LEAST * 10 ** rng.uniform(0, 1.5)
    means = np.concatenate([[0.0, 1e-300, 1e-9], 10 ** rng.uniform(-1, 2.6, 4), rng.uniform(0, 200, 3)])
    law = CountingSPAD(1.0, 0.0, EXPOSURE / ratio, 7, True)
    table, slope = (f(means, EXPOSURE)[:, :-1] for f in (law.cdf, law.dcdf))
    width = min(table.shape[1], int(ratio) + 1)
    for mean, expected in zip(means, table[:, :width], strict=True):
        for inside in (True, False):
            codes = np.flatnonzero((expected < 0.5) == inside)
            found = steps_of(mean, codes, ratio, inside)
            np.testing.assert_allclose(found, expected[codes], rtol=0, atol=1e-11, err_msg=f"{ratio!r} {mean!r}")
    grid, change = paralyzable.steps(ratio, width, means)
    np.testing.assert_allclose(grid.T, table[:, :width], rtol=0, atol=1e-11, err_msg=repr(ratio))
    # Below a millionth of an arrival the slope divides a rounding by the light; curves take it times its root
    np.testing.assert_allclose(change.T[3:], slope[3:, :width], rtol=0, atol=1e-10, err_msg=repr(ratio))


@pytest.mark.parametrize(("share", "arrivals", "most"), [(1 / 60, 200.0, 60), (1 / 60, 60.0, 60), (1e-3, 8e3, 90)])
def test_steps_in_bright_light_agree_with_the_oracle(share, arrivals, most):
    """Light for which there was no closed form, up to the fall of the response."""
    with mp.workdps(600):
        pmf = paralyzable_oracle(arrivals, share, most)
        expected = np.array([float(mp.fsum(pmf[: k + 1])) for k in range(len(pmf))])
    for inside in (True, False):
        codes = np.flatnonzero((expected < 0.5) == inside)
        np.testing.assert_allclose(steps_of(arrivals, codes, 1 / share, inside), expected[codes], rtol=0, atol=1e-11)


@pytest.mark.parametrize("seed", range(20))
def test_codes_found_step_by_step_are_those_of_the_whole_table(seed):
    """The law of streams that are stored: `decide` of the sensor against that of the base class, at the same words."""
    rng = np.random.default_rng([6, seed])
    sensor = random_sensor(rng, int(rng.integers(1, 11)), 300)
    top = min(400.0, 2 * sensor.white(EXPOSURE) * sensor.efficiency) / sensor.efficiency
    photons = np.concatenate([[0.0, 1e-9], rng.uniform(0, top, 200), rng.uniform(0, 20, 198)])
    u = np.concatenate([rng.uniform(0, 1, 396), [2.0**-33, 1 - 2.0**-33, 0.5, 2.0**-20]])
    narrow = CountingSPAD(sensor.pde, sensor.dark_count_rate, sensor.dead_time, min(sensor.bits, 9), True)
    expected, tails = Sensor.decide(narrow, u, photons, EXPOSURE)
    found, near = sensor.decide(u, photons, EXPOSURE)
    np.testing.assert_array_equal(np.minimum(found, narrow.levels - 1), expected, err_msg=repr(sensor))
    if sensor.bits == narrow.bits:
        np.testing.assert_array_equal(near, tails, err_msg=repr(sensor))


@pytest.mark.parametrize("seed", range(10))
def test_numbers_of_64_bits_are_decided_from_either_end(seed):
    rng = np.random.default_rng([7, seed])
    sensor = random_sensor(rng, 6, 1e3)
    photons = rng.uniform(0, 150, 60)
    first, second = rng.integers(0, 1 << 32, (2, 60), dtype=np.uint32)
    # tails
    first[:20] = 0
    first[20:40] = 0xFFFFFFFF
    expected = Sensor.codes_at(sensor, first, second, photons, EXPOSURE)
    np.testing.assert_array_equal(sensor.codes_at(first, second, photons, EXPOSURE), expected, err_msg=repr(sensor))


@pytest.mark.parametrize("seed", range(12))
def test_all_light_up_to_a_million_photons_is_served(seed):
    """Any sensor, any light: codes are possible ones, and their mean is that of the renewal law."""
    rng = np.random.default_rng([8, seed])
    sensor = random_sensor(rng, 16)
    photons = 10 ** rng.uniform(-3, 6)
    codes = sensor.sample(np.full((32, 64), photons), EXPOSURE, key=Key(seed, 1), engine="reference").astype(float)
    mean = float(sensor.arrivals(photons, EXPOSURE))
    a = sensor.dead_time / EXPOSURE
    expected = -np.expm1(-mean * min(a, 1)) + mean * np.exp(-mean * a) * max(1 - a, 0)
    if expected + 8 * np.sqrt(expected) > 65535:
        assert codes.max() <= 65535
        return
    # An exposure holds at most as many counts as dead times and one; their variance is below that of a Poisson law
    sigma = np.sqrt(max(expected, 1e-6) / codes.size)
    assert abs(codes.mean() - expected) < 5 * sigma + 1 / codes.size, repr(sensor)


@pytest.mark.parametrize(("ratio", "arrivals"), [(1e4, 3e4), (200.0, 1e3), (50.0, 60.0)])
def test_bright_codes_are_counts_of_arrivals_one_by_one(ratio, arrivals):
    """Against arrivals that are drawn one by one; the first case had no closed form."""
    rng = np.random.default_rng(9)
    counts = []
    for n in rng.poisson(arrivals, 2000):
        times = np.sort(rng.uniform(0, ratio, n))
        counts.append(int(n > 0) + np.count_nonzero(np.diff(times) >= 1))
    sensor = CountingSPAD(1.0, 0.0, EXPOSURE / ratio, 16, True)
    codes = sensor.sample(np.full((100, 100), arrivals), EXPOSURE, key=Key(1, 2), engine="reference").ravel()
    assert stats.ks_2samp(codes, counts, method="asymp").pvalue > 1e-4
    assert stats.ks_2samp(codes + max(1, int(0.3 * codes.std())), counts, method="asymp").pvalue < 1e-4


def test_crops_and_single_pixels_equal_the_whole():
    sensor = CountingSPAD(0.6, 1e3, 1e-8, 12, True)
    photons = np.random.default_rng(3).uniform(0, 5e4, (40, 61))
    whole = sensor.sample(photons, EXPOSURE, key=Key(4, 5), engine="reference")
    crop = sensor.sample(photons[3:30, 7:50], EXPOSURE, key=Key(4, 5), origin=(3, 7), engine="reference")
    np.testing.assert_array_equal(crop, whole[3:30, 7:50])
    u = uniform(words(Key(4, 5), photons.shape, (0, 0)))
    order = np.random.default_rng(4).permutation(photons.size)
    codes, _ = sensor.decide(u.ravel()[order], photons.ravel()[order], EXPOSURE)
    np.testing.assert_array_equal(codes, whole.ravel()[order])
