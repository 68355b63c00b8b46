"""Compares the laws in the browser's script with the exact channel of qsim.sensor, over random sensors and light."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from javascript import script
from stats import assert_histogram, critical_z, mixture_p_value, per_check

from qsim.sensor import QIS, BinarySPAD, CountingSPAD, devices
from qsim.sensor.sensor import Sensor

MODELS = ("QIS", "BinarySPAD", "CountingSPAD")
SENSORS = 20  # of each model
PIXELS = 6_000  # of a drawn picture


@pytest.fixture(scope="module")
def law():
    with script("sensor_law.js") as loaded:
        yield loaded


def random_sensor(model: str, rng: np.random.Generator) -> tuple[dict, Sensor]:
    """A sensor anywhere in the range of the sliders: as the script's record, and as ours."""
    record = {
        "model": model,
        "bits": int(rng.integers(1, 9)),
        "efficiency": float(rng.uniform(0.05, 1)),
        "dark": float(rng.choice([0.0, 10 ** rng.uniform(-1, 5)])),
        "exposure": float(5e-4 * rng.integers(1, 17)),
        "noise": float(rng.choice([0.0, rng.uniform(0.02, 3)])),
        "gain": float(rng.choice([0.5, 1.0, 10 ** rng.uniform(-1.7, 0.7)])),  # ties of rounding, and none
        "dead": float(rng.choice([0.0, 10 ** rng.uniform(-9, -3)])),
    }
    return record, ours(record)


def ours(record: dict) -> Sensor:
    efficiency = record["efficiency"]
    dark = record["dark"]
    bits = record["bits"]
    if record["model"] == "QIS":
        return QIS(efficiency, dark, record["noise"], bits, gain=record["gain"])
    if record["model"] == "BinarySPAD":
        return BinarySPAD(efficiency, dark, bits)
    return CountingSPAD(efficiency, dark, record["dead"], bits)


def light_levels(record: dict, rng: np.random.Generator, count: int) -> np.ndarray:
    """Light from deep dark to far above saturation."""
    top = (2 ** record["bits"] - 1) / record["efficiency"] / (record["gain"] if record["model"] == "QIS" else 1.0)
    return np.append(0.0, top * 10 ** rng.uniform(-4, 0.7, count - 1))


@pytest.mark.parametrize("model", MODELS)
def test_the_pmf_is_that_of_the_exact_channel(law, model):
    """Every probability within 1e-9 in absolute terms, 1e-6 of its value where it is above 1e-6."""
    rng = np.random.default_rng(MODELS.index(model))
    for _ in range(SENSORS):
        record, sensor = random_sensor(model, rng)
        light = light_levels(record, rng, 12)
        found = law.value(
            "light.map(x => Array.from(probabilities(lawOf(s)(meanEvents(s, x)))))", s=record, light=light.tolist()
        )
        exact = sensor.pmf(light, record["exposure"])
        np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-9, err_msg=str(record))


@pytest.mark.parametrize("model", MODELS)
def test_drawn_codes_follow_the_exact_channel(law, model):
    """Chi-square of the codes of even light, whose draw shares no formula with the law."""
    rng = np.random.default_rng(10 + MODELS.index(model))
    for seed in range(SENSORS):
        record, sensor = random_sensor(model, rng)
        light = float(light_levels(record, rng, 2)[1])
        codes = law.value("Array.from(drawCodes(s, Array(n).fill(x), seed))", s=record, n=PIXELS, x=light, seed=seed)
        pmf = sensor.pmf(np.array(light), record["exposure"])
        assert_histogram(np.array(codes), pmf, checks=SENSORS * len(MODELS))


@pytest.mark.parametrize("model", MODELS)
def test_the_expected_histogram_of_a_picture_is_that_of_its_pixels(law, model):
    """Grouping the light into bins moves no share by a tenth of its standard deviation in a drawn picture."""
    rng = np.random.default_rng(20 + MODELS.index(model))
    for seed in range(10):
        record, sensor = random_sensor(model, rng)
        light = light_levels(record, rng, 2)[1] * rng.lognormal(0, 0.7, 4000)
        found = law.value("expectedShares(s, light)", s=record, light=light.tolist())
        pmf = sensor.pmf(light, record["exposure"])
        share, sigma = (np.array(list(found[name].values())) for name in ("share", "sigma"))
        np.testing.assert_allclose(share.sum(), 1, rtol=1e-9)
        own = np.sqrt((pmf * (1 - pmf)).sum(axis=0)) / len(light)
        np.testing.assert_allclose(sigma, own, rtol=0.01, atol=1e-6)
        assert np.all(np.abs(share - pmf.mean(axis=0)) <= 0.1 * own + 1e-9), record
        codes = law.value("Array.from(drawCodes(s, light, seed))", s=record, light=light.tolist(), seed=seed)
        assert mixture_p_value(np.array(codes), pmf) > per_check(1e-6, 30)
        counts = np.bincount(codes, minlength=sensor.levels)
        often = len(light) * sigma > 5
        z = (counts - len(light) * share)[often] / (len(light) * sigma[often])
        assert np.all(np.abs(z) < critical_z(checks=30 * 256)), record


def test_a_wrong_law_would_be_seen(law):
    """The same chi-square rejects a read noise that is 0.15 e- off."""
    record, _ = random_sensor("QIS", np.random.default_rng(3))
    record |= {"bits": 3, "noise": 0.2, "gain": 1.0, "dark": 0.0, "efficiency": 0.8}
    codes = law.value("Array.from(drawCodes(s, Array(n).fill(2), 1))", s=record, n=30 * PIXELS)
    with pytest.raises(AssertionError):
        assert_histogram(np.array(codes), ours(record | {"noise": 0.35}).pmf(np.array(2.0), record["exposure"]))


@pytest.mark.parametrize("model", MODELS)
def test_mean_deviation_and_snr_are_those_of_the_exact_channel(law, model):
    rng = np.random.default_rng(30 + MODELS.index(model))
    for _ in range(SENSORS):
        record, sensor = random_sensor(model, rng)
        exposure = record["exposure"]
        light = light_levels(record, rng, 8)[1:]
        found = law.value("responseAt(s, light)", s=record, light=light.tolist())
        mean = sensor.mean(light, exposure)
        variance = sensor.variance(light, exposure)
        np.testing.assert_allclose([f["mean"] for f in found], mean, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose([f["deviation"] for f in found], np.sqrt(variance), rtol=1e-5, atol=1e-5)
        slope = -sensor.dcdf(light, exposure).sum(axis=-1)  # of the mean code
        clear = variance > 1e-6
        snr = (light * slope / np.sqrt(np.maximum(variance, 1e-6)))[clear]
        np.testing.assert_allclose(np.array([f["snr"] for f in found])[clear], snr, rtol=1e-3, atol=1e-4)


def test_light_of_codes_inverts_the_mean(law):
    """Without dark counts, saturation and dead time, code k of gain 1 is k / efficiency photons."""
    record = {"model": "QIS", "bits": 8, "efficiency": 0.5, "dark": 0.0, "exposure": 1.0, "noise": 0.3, "gain": 1.0}
    light = [0.01 * 1.05**i for i in range(250)]
    found = list(law.value("lightOfCodes(responseAt(s, light), 255)", s=record, light=light).values())
    np.testing.assert_allclose(found[2:200], 2 * np.arange(2, 200), rtol=5e-3)
    assert np.all(np.diff(found) >= 0)


def test_rounding_is_half_to_even_as_numpy_rounds(law):
    values = [-1.5, -0.5, 0.5, 1.5, 2.5, 2.4999, 2.5001, 7.0]
    assert law.value("x.map(roundHalfEven)", x=values) == [abs(v) if v == 0 else v for v in np.rint(values)]


def test_normal_cdf_and_factorials(law):
    z = np.linspace(-12, 12, 97)
    found = np.array(law.value("z.map(normalCdf)", z=z.tolist()))
    expected = np.array([math.erfc(-x / math.sqrt(2)) / 2 for x in z])
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
    n = [0, 1, 2, 19, 20, 21, 170, 10_000]
    np.testing.assert_allclose(law.value("n.map(logFactorial)", n=n), [math.lgamma(k + 1) for k in n], rtol=1e-14)


def test_the_sensor_file_is_read_as_the_same_sensor(law, tmp_path):
    rng = np.random.default_rng(5)
    for model in MODELS:
        record, sensor = random_sensor(model, rng)
        (tmp_path / "mine.toml").write_text(law.value("sensorFile(s)", s=record))
        assert devices.load(str(tmp_path / "mine.toml")) == sensor, json.dumps(record)


def test_the_same_seed_draws_the_same_codes(law):
    record, _ = random_sensor("QIS", np.random.default_rng(6))
    record |= {"bits": 8, "gain": 1.0, "noise": 1.0}
    draw = "[1, 1, 2].map(seed => Array.from(drawCodes(s, Array(500).fill(20), seed)).join())"
    first, again, other = law.value(draw, s=record)
    assert first == again
    assert first != other
