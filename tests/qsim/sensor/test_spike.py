"""Spike cameras: trains of spikes against a chain over the charge, the long-run law, crops, blocks, bad records."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import pdtr
from scipy.stats import poisson
from stats import assert_histogram, assert_share

from qsim.keys import Key
from qsim.sensor import devices
from qsim.sensor.sensor import Sensor
from qsim.sensor.spike import SpikeCamera, interval

EXPOSURE = 5e-5


def chain(sensor: SpikeCamera, electrons: np.ndarray, start: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the law of trains of spikes [2^T] (first plane in the highest bit) and the law of the last charge.

    An independent reference: it adds up all charges and all numbers of electrons of each plane [T] that matter.
    """
    m = sensor.threshold
    most = int(electrons.sum() + 12 * np.sqrt(electrons.sum()) + 30) + sensor.threshold
    charge = np.zeros(most)
    charge[:m] = 1 / m if start is None else start
    trains = charge[None]  # probability of [train so far, charge]
    for mean in electrons:
        step = poisson.pmf(np.arange(most), mean)
        grown = np.stack([np.convolve(row, step)[:most] for row in trains])
        quiet = grown.copy()
        fired = np.zeros_like(grown)
        quiet[:, m:] = 0
        if sensor.subtracts:
            fired[:, : most - m] = grown[:, m:]
        else:
            fired[:, 0] = grown[:, m:].sum(axis=1)
        trains = np.stack([quiet, fired], axis=1).reshape(-1, most)
    return trains.sum(axis=1), trains.sum(axis=0)


def drawn_trains(sensor: SpikeCamera, photons: np.ndarray, pixels: int, seed: int) -> np.ndarray:
    light = np.broadcast_to(photons[:, None, None], (len(photons), 1, pixels))
    spikes = sensor.sample(light, EXPOSURE, key=Key(seed=seed, clip=1))
    return (spikes[:, 0].T.astype(int) << np.arange(len(photons))[::-1]).sum(axis=1)


CASES = 14


@pytest.mark.parametrize("case", range(CASES))
def test_trains_of_spikes_have_the_law_of_the_chain(case: int):
    """Random thresholds, resets, dark currents and changing light, dim and above saturation: all 2^5 trains."""
    rng = np.random.default_rng([7, case])
    threshold = int(rng.choice([1, 2, 3, 7, 20, 60]))
    sensor = SpikeCamera(rng.uniform(0.2, 1), float(rng.choice([0.0, 2000.0])), threshold, bool(case % 2))
    photons = threshold * 10 ** rng.uniform(-1.5, 0.5, 5)
    law, _ = chain(sensor, sensor.arrivals(photons, EXPOSURE))
    assert law.sum() == pytest.approx(1, abs=1e-9)
    assert_histogram(drawn_trains(sensor, photons, 20_000, case), law / law.sum())


def test_a_wrong_reset_would_be_noticed():
    """The chain of one reset does not fit the spikes of the other."""
    sensor = SpikeCamera(1.0, 0.0, 5)
    photons = np.full(5, 4.0)
    law, _ = chain(replace(sensor, subtracts=False), photons)
    with pytest.raises(AssertionError):
        assert_histogram(drawn_trains(sensor, photons, 20_000, 1), law / law.sum())


@pytest.mark.parametrize("threshold", [1, 2, 3, 5, 9, 40, 300])
def test_intervals_of_a_pixel_that_is_reset_to_zero(threshold: int):
    """E[I] from a plain sum over planes, and its slope, from a thousandth of the threshold to five times it."""
    light = threshold * np.geomspace(1e-3, 5, 23)
    found, change = interval(light, threshold)
    for n, longer in zip(light, found, strict=True):
        planes = np.arange(1, int((threshold + 12 * threshold**0.5 + 60) / n) + 2)
        expected = pdtr(threshold - 1, planes * n).sum()
        assert abs(longer - expected) < 1e-11 * (1 + expected)
    step = 1e-5 * light
    slope = (interval(light + step, threshold)[0] - interval(light - step, threshold)[0]) / (2 * step)
    np.testing.assert_allclose(change, slope, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("subtracts", [True, False])
def test_the_law_of_a_plane_is_that_of_the_chain_in_the_long_run(subtracts: bool):
    """After many planes the chain's share of spikes is the stated one, where it has no backlog."""
    for threshold in (1, 3, 8):
        for light in (0.05, 0.4, 0.8):
            sensor = SpikeCamera(0.5, 0.0, threshold, subtracts)
            mean = np.array([light * threshold])
            state = np.full(threshold, 1 / threshold)
            fired = 0.0
            for _ in range(300):
                law, after = chain(sensor, mean, state)
                if subtracts:  # charge above the threshold waits: keep what the next start may hold
                    break
                state = after[:threshold] / after[:threshold].sum()
                fired = law[1]
            if subtracts:
                fired = _with_backlog(threshold, float(mean[0]))
            expected = sensor.pmf(mean / 0.5, EXPOSURE)[0, 1]
            assert fired == pytest.approx(expected, rel=1e-6)


def _with_backlog(threshold: int, mean: float) -> float:
    """Return the long-run share of spikes of a pixel that subtracts: a chain over all charges up to 400."""
    size = 400
    step = poisson.pmf(np.arange(size), mean)
    charge = np.zeros(size)
    charge[:threshold] = 1 / threshold
    share = 0.0
    for _ in range(600):
        grown = np.convolve(charge, step)[:size]
        share = grown[threshold:].sum()
        charge = np.concatenate([grown[threshold:], np.zeros(threshold)])
        charge[:threshold] += grown[:threshold]
    return float(share)


def test_the_share_of_spikes_is_linear_up_to_saturation():
    sensor = SpikeCamera(0.5, 1000.0, 50)
    photons = np.array([0.0, 10.0, 60.0, 99.0, 500.0])
    np.testing.assert_allclose(sensor.mean(photons, EXPOSURE), np.minimum((0.5 * photons + 0.05) / 50, 1), rtol=1e-12)
    np.testing.assert_allclose(sensor.response(EXPOSURE).invert(np.array([0.3]), 10**6), 29.9, rtol=1e-5)


def test_probabilities_fall_into_place():
    for subtracts in (True, False):
        for threshold in (1, 2, 30):
            sensor = SpikeCamera(0.7, 0.0, threshold, subtracts)
            photons = np.append(0.0, np.geomspace(1e-9, 100 * threshold, 60))
            pmf = sensor.pmf(photons, EXPOSURE)
            np.testing.assert_allclose(pmf.sum(axis=1), 1, rtol=1e-12)
            assert pmf[0].tolist() == [1.0, 0.0]
            assert (np.diff(pmf[:, 1]) >= 0).all()
            light = np.geomspace(0.01, 0.9, 9) * threshold
            step = 1e-5 * light
            slope = (sensor.cdf(light + step, EXPOSURE) - sensor.cdf(light - step, EXPOSURE))[:, 0] / (2 * step)
            np.testing.assert_allclose(sensor.dcdf(light, EXPOSURE)[:, 0], slope, rtol=1e-4, atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_crops_and_blocks_hold_the_same_spikes(data):
    """A crop at its origin, and a clip in blocks, equal the full clip; one pixel does not depend on its neighbours."""
    shape = tuple(data.draw(st.integers(1, most)) for most in (6, 8, 11))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    light = rng.uniform(0, 30, shape)
    sensor = SpikeCamera(0.8, 0.0, 17, bool(rng.integers(2)))
    key = Key(seed=3, clip=1, frame=4)
    full = sensor.sample(light, EXPOSURE, key=key)
    y = data.draw(st.integers(0, shape[1] - 1))
    x = data.draw(st.integers(0, shape[2] - 1))
    crop = sensor.sample(light[:, y:, x:], EXPOSURE, key=key, origin=(y, x))
    np.testing.assert_array_equal(crop, full[:, y:, x:])
    cut = data.draw(st.integers(0, shape[0]))
    parts = [part for part in (light[:cut], light[cut:]) if len(part)]
    np.testing.assert_array_equal(np.concatenate(list(sensor.spikes(parts, EXPOSURE, key))), full)
    np.testing.assert_array_equal(sensor.sample(light[0], EXPOSURE, key=key), full[0])


def test_charge_is_kept_or_lost():
    """Some 10 000 electrons in the first plane, then darkness, at a threshold of 2000: four or five spikes, or one."""
    light = np.zeros((6, 1, 400))
    light[0] = 1e4
    kept = SpikeCamera(1.0, 0.0, 2000).sample(light, EXPOSURE, key=Key(seed=0, clip=1))
    lost = SpikeCamera(1.0, 0.0, 2000, False).sample(light, EXPOSURE, key=Key(seed=0, clip=1))
    assert lost.sum(axis=0).max() == lost.sum(axis=0).min() == 1
    assert kept.sum(axis=0).min() >= 4
    np.testing.assert_array_equal(np.sort(kept, axis=0), kept[::-1], "all spikes come first")


def test_the_first_charge_is_uniform_below_the_threshold():
    sensor = SpikeCamera(1.0, 0.0, 7)
    charge = sensor.start(Key(seed=5, clip=1), (100, 350))
    assert_histogram(charge.ravel().astype(int), np.full(7, 1 / 7))


def test_a_pixel_in_the_dark_fires_at_its_dark_current():
    sensor = SpikeCamera(0.6, 3.0 / EXPOSURE, 9)
    spikes = sensor.sample(np.zeros((1, 100, 300)), EXPOSURE, key=Key(seed=2, clip=1))
    n = np.arange(80)
    fired = float((poisson.pmf(n, 3.0) * np.minimum(n, 9) / 9).sum())
    assert_share(int(spikes.sum()), spikes.size, fired)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"threshold": 0}, "threshold is a whole number of electrons, 1 ..."),
        ({"threshold": 2.5}, "threshold is a whole number of electrons"),
        ({"threshold": True}, "threshold is a whole number of electrons"),
        ({"threshold": 2**20 + 1}, "threshold is a whole number of electrons"),
        ({"bits": 2}, "bits is 1, a spike or none per plane; got 2"),
        ({"subtracts": 1}, "subtracts is true or false"),
        ({"quantum_efficiency": 0}, "quantum_efficiency is a number, above 0"),
        ({"dark_current": -1}, "dark_current is a number, at least 0"),
    ],
)
def test_wrong_records_are_refused(changes, message: str):
    with pytest.raises(ValueError, match=message):
        SpikeCamera(**{"quantum_efficiency": 0.5, "dark_current": 0.0, "threshold": 10} | changes)


def test_a_record_survives_a_file(tmp_path):
    sensor: Sensor = SpikeCamera(0.5, 10.0, 400, False)
    assert devices.from_dict(sensor.to_dict()) == sensor
    text = '[sensor]\nmodel = "SpikeCamera"\nquantum_efficiency = 0.5\ndark_current = 10.0\nthreshold = 400\n'
    (tmp_path / "s.toml").write_text(text + "subtracts = false\n")
    assert devices.load(tmp_path / "s.toml", bits=1) == sensor
    (tmp_path / "s.toml").write_text(text.replace("400", "400.5"))
    with pytest.raises(ValueError, match="threshold"):
        devices.load(tmp_path / "s.toml")


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"photons have the shape \[H, W\] or \[T, H, W\], got \[4\]"):
        SpikeCamera(0.5, 0.0, 10).sample(np.zeros(4), EXPOSURE, key=Key(seed=0, clip=1))
