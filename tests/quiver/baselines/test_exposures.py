"""Restoring codes of different exposures: the laws of the estimates, light beyond white, equal exposures, refusals."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines import exposures, likelihood, moment
from quiver.data.codes import array_codes
from quiver.restoration.automatic import chosen
from quiver.restoration.interface import AUTO

EXPOSURE = 5e-4
SENSORS = {
    "QIS": QIS(0.8, 200.0, 0.2, 3),
    "plane": BinarySPAD(0.5, 300.0, bits=1),
    "counting": CountingSPAD(pde=0.5, dark_count_rate=300.0, dead_time=2e-6, bits=5),
}
SCHEDULE = np.array([1.0, 0.25, 0.0625])


def drawn(sensor, light: np.ndarray, shares: np.ndarray, seed: int) -> np.ndarray:
    """Codes [T, 1, N] of light [N] at full exposure."""
    frames = [
        sensor.sample(light[None] * share, EXPOSURE * share, key=Key(seed=seed, clip=1, frame=t))
        for t, share in enumerate(shares)
    ]
    return np.stack(frames)


@pytest.mark.parametrize("kind", SENSORS)
def test_the_likelihood_is_the_maximum_of_the_exact_one(kind):
    """Random light over five decades and random windows: no light is likelier than the estimate, but for the grid."""
    sensor = SENSORS[kind]
    rng = np.random.default_rng(5)
    shares = rng.choice(SCHEDULE, 7)
    light = 10 ** rng.uniform(-1.5, 3, 60)
    codes = drawn(sensor, light, shares, 1)
    found = exposures.likeliest(codes[:, 0], shares, sensor, EXPOSURE)
    end = exposures.levels(tuple(np.unique(shares)), sensor, EXPOSURE)[-1]

    def value(photons: np.ndarray) -> np.ndarray:
        places = np.arange(60)
        each = [sensor.log_pmf(photons * s, EXPOSURE * s)[places, c] for s, c in zip(shares, codes[:, 0], strict=True)]
        return np.sum(each, axis=0)

    open_ = ~(codes[:, 0] == sensor.levels - 1).all(axis=0) & (found < 0.99 * end)
    assert open_.sum() > 20
    for factor in (0.5, 0.9, 0.97, 1.03, 1.1, 2.0):
        assert (value(found * factor + (found == 0) * 1e-2) <= value(found) + 1e-3)[open_].all(), factor


@pytest.mark.parametrize("kind", SENSORS)
def test_equal_exposures_give_the_answers_of_the_usual_methods(kind):
    sensor = SENSORS[kind]
    rng = np.random.default_rng(6)
    light = rng.uniform(0, 0.7, 200) * sensor.white(EXPOSURE)
    shares = np.ones(5)
    codes = drawn(sensor, light, shares, 2)
    for method, usual in (("likelihood", likelihood.restore), ("moment", moment.restore)):
        found = exposures.restore(codes, sensor, EXPOSURE, shares, method=method, window=5)
        expected = usual(codes, sensor, EXPOSURE, window=5)
        inner = expected < 0.8 * expected.max()
        np.testing.assert_allclose(found[inner], expected[inner], rtol=2e-3, atol=1e-3 * sensor.white(EXPOSURE))


@pytest.mark.parametrize("kind", SENSORS)
@pytest.mark.parametrize("method", ["moment", "likelihood"])
def test_a_bracket_sees_light_beyond_white(kind, method):
    """At 8 times white, full exposures are all saturated; 30 brackets find the light, and dim light too."""
    sensor = SENSORS[kind]
    count = 400
    shares = np.resize(SCHEDULE, 90)
    for level in (0.3, 8.0):
        light = np.full(count, level * sensor.white(EXPOSURE))
        codes = drawn(sensor, light, shares, 3)
        found = exposures.restore(codes, sensor, EXPOSURE, shares, method=method, window=90, frames=range(45, 46))
        spread = 6 * found.std() / np.sqrt(count)  # and a bias of second order in the noise
        assert abs(found.mean() - light[0]) < spread + found.var() / light[0]
        assert found.std() < 0.4 * light[0]


def test_the_naive_mean_leaves_saturated_codes_out():
    """Light beyond white comes from short exposures, of which the darker codes stay: 15 % low at 6 times white."""
    sensor = SENSORS["QIS"]
    shares = np.resize(SCHEDULE, 30)
    light = np.full(400, 6 * sensor.white(EXPOSURE))
    codes = drawn(sensor, light, shares, 4)
    found = exposures.restore(codes, sensor, EXPOSURE, shares, method="naive", window=30, frames=range(15, 16))
    assert found.mean() == pytest.approx(light[0], rel=0.2)
    step = sensor.white(EXPOSURE) / 7  # photons per code; of three codes the first is saturated
    dark = sensor.dark_rate * EXPOSURE / (sensor.efficiency * step)
    expected = (3 + 1 - dark * 0.3125) * step / 0.3125
    one = exposures.naive(np.array([[7], [3], [1]]), SCHEDULE, sensor, EXPOSURE)
    assert one[0] == pytest.approx(expected)


def test_all_saturated_and_all_dark_pixels_have_finite_answers():
    for sensor in SENSORS.values():
        for code in (0, sensor.levels - 1):
            codes = np.full((6, 2, 3), code, np.uint8)
            for method in exposures.METHODS:
                found = exposures.restore(codes, sensor, EXPOSURE, np.resize(SCHEDULE, 6), method=method)
                assert np.isfinite(found).all()
                assert (found >= 2 * sensor.white(EXPOSURE)).all() if code else (found <= 0.5).all()


def test_a_method_without_exposures_is_refused():
    codes = np.zeros((3, 2, 2), np.uint8)
    with pytest.raises(ValueError, match="method 'qbp': takes equal exposures only; use naive, moment, likelihood"):
        exposures.restore(codes, SENSORS["QIS"], EXPOSURE, np.ones(3), method="qbp")


@pytest.mark.parametrize("kind", SENSORS)
def test_the_likelihood_in_parts_is_the_same(kind, monkeypatch):
    """One chunk, chunks of several pixels, and of one."""
    sensor = SENSORS[kind]
    shares = np.resize(SCHEDULE, 6)
    codes = drawn(sensor, 10 ** np.random.default_rng(7).uniform(-1.5, 3, 70), shares, 5)[:, 0]
    whole = exposures.likelihood(codes, shares, sensor, EXPOSURE)
    for pixels in (16, 1):
        monkeypatch.setattr(exposures, "CHUNK", pixels * len(SCHEDULE) * sensor.levels)
        np.testing.assert_allclose(exposures.likelihood(codes, shares, sensor, EXPOSURE), whole, rtol=1e-12)


def test_the_memory_of_the_likelihood_does_not_grow_with_pixels_times_codes(monkeypatch):
    """7 bits, 3 exposures, 4000 pixels: a table of all outcomes has 6 MB, and sorting it takes several of them."""
    sensor = QIS(0.8, 200.0, 0.2, 7)
    monkeypatch.setattr(exposures, "CHUNK", 1 << 16)
    light = np.random.default_rng(8).uniform(0, 200, 4000)
    codes = drawn(sensor, light, SCHEDULE, 6)[:, 0]
    exposures.likelihood(codes[:, :10], SCHEDULE, sensor, EXPOSURE)  # responses are kept
    tracemalloc.start()
    try:
        exposures.likelihood(codes, SCHEDULE, sensor, EXPOSURE)
        assert tracemalloc.get_traced_memory()[1] < 6e6  # 3 MB are the logarithms of all probabilities
    finally:
        tracemalloc.stop()


def test_the_likelihood_sees_dim_light_of_many_bits():
    """The brightest light of 8 bits is so bright that levels from 1e-5 of it on began at 1.3 photons."""
    sensor = BinarySPAD(1.0, 0.0, bits=8)
    shares = np.resize(SCHEDULE, 12)
    codes = drawn(sensor, np.full(4000, 0.6), shares, 9)[:, 0]
    assert exposures.likelihood(codes, shares, sensor, EXPOSURE).mean() == pytest.approx(0.6, rel=0.05)


def test_a_table_of_likelihoods_that_is_too_large_is_refused(monkeypatch):
    monkeypatch.setattr(exposures, "TABLE_BYTES", 1 << 20)
    codes = np.zeros((3, 2, 2), np.uint8)
    with pytest.raises(ValueError, match=r"[23] different exposures of 6 bit need a table of .*; use .* moment"):
        exposures.restore(codes, QIS(0.8, 0.0, 0.2, 6), EXPOSURE, SCHEDULE, window=3)
    stream = replace(array_codes(codes, QIS(0.8, 0.0, 0.2, 6), EXPOSURE), shares=tuple(SCHEDULE))
    method, why = chosen(AUTO, stream)
    assert method.name == "moment"
    assert why == "auto: moment; the codes have different exposures, and 6 bit are too many for likelihood"
    assert method.restore(stream).shape == codes.shape


@pytest.mark.parametrize("gain", [0.4095, 0.2], ids=["at the top code", "below it"])
def test_the_naive_mean_leaves_codes_at_the_full_well_out(gain):
    """Light of four full wells on 12 bits: read noise spreads saturated codes, and few of them are the top one."""
    sensor = QIS(0.6, 100.0, 5.0, 12, gain=gain, full_well=1e4)
    light = 4e4 / 0.6
    shares = np.resize(SCHEDULE, 30)
    codes = drawn(sensor, np.full(200, light), shares, 10)[:, 0]
    assert exposures.naive(codes, shares, sensor, EXPOSURE).mean() == pytest.approx(light, rel=0.1)


def test_the_full_well_of_few_bits_leaves_no_code_out():
    """Random sensors of 1 to 8 bits: the naive mean is that of the same sensor without a full well."""
    rng = np.random.default_rng(11)
    shares = np.resize(SCHEDULE, 6)
    for bits in np.repeat(range(1, 9), 4):
        noise = rng.uniform(0, 3)
        gain = rng.uniform(0.2, 1.2)
        well = rng.uniform(1, 2.0**bits)
        sensor = QIS(0.6, 100.0, noise, int(bits), gain=gain, full_well=well)
        codes = rng.integers(0, 2**bits, (6, 50))
        found, without = (
            exposures.naive(codes, shares, one, EXPOSURE) for one in (sensor, replace(sensor, full_well=None))
        )
        np.testing.assert_array_equal(found, without)
