"""The compiled engine against the reference over random sensors, in the full range of every parameter.

A sensor may differ in 3 of its 41 472 pixels, all of a batch together in 5 pixels per million. Sensors that the engine
hands to the reference, for all or more than half of their pixels, are counted: fewer than a tenth up to 8 bits.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest

from qsim.keys import Key
from qsim.sensor.compiled import jit
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.packing import pack, unpack
from qsim.sensor.qis import QIS, thresholds
from qsim.sensor.sensor import Sensor, plan_of
from qsim.sensor.spad import BinarySPAD

EXPOSURE = 5e-4  # s
SHAPE = (2, 128, 162)  # 41 472 pixels: a frame of uniform light, one below 20 electrons
ORIGINS = ((0, 0), (5, 8), (3, 7))
# of random sensors, and 5 for every number of terms: 10 000
BATCHES = 20
SENSORS = 375
needs_engine = pytest.mark.skipif(not jit.available(), reason="no usable LLVM or CUDA on this machine")


def random_sensor(rng: np.random.Generator, bits: int) -> Sensor:
    """Half of them QIS, of the rest half clocked, and of the counting ones a third paralyzable."""
    kind = rng.choice(["QIS", "clocked", "counting", "paralyzable"], p=[0.5, 0.25, 0.17, 0.08])
    efficiency = float(rng.uniform(0.02, 1))
    dark = float(rng.choice([0.0, 10 ** rng.uniform(-1, 5)]))
    if kind == "QIS":
        return QIS(
            efficiency,
            dark,
            float(rng.choice([0.0, rng.uniform(0, 0.5), rng.uniform(0, 10)])),
            bits,
            gain=float(10 ** rng.uniform(-3, 3)),
            offset=float(rng.choice([0.0, rng.uniform(-300, 300)], p=[0.6, 0.4])),
            full_well=float(10 ** rng.uniform(-2, 4)) if rng.random() < 0.3 else None,
        )
    if kind == "clocked":
        return BinarySPAD(efficiency, dark, bits)
    # Up to three exposures; exactly none, and exactly shares, are corners
    dead = EXPOSURE * float(
        rng.choice([0.0, 10 ** rng.uniform(-6, 0.5), 1 / rng.integers(1, 9), rng.uniform(0.8, 1.2)])
    )
    return CountingSPAD(efficiency, dark, dead, bits, paralyzable=bool(kind == "paralyzable"))


def sensor_of_terms(rng: np.random.Generator, terms: int) -> QIS:
    """A QIS whose top code is certain from exactly so many electrons on, to 1e-12."""
    for attempt in range(100):
        bits = int(rng.integers(1, 9))
        noise = 0.0 if rng.random() < 0.4 or attempt > 50 else rng.uniform(0, min(10, terms / 8))
        threshold = terms - 0.5 - 7.0 * noise
        if threshold <= 0:
            continue
        gain = ((1 << bits) - 1.5) / threshold
        sensor = QIS(float(rng.uniform(0.2, 1)), 1.6, float(noise), bits, gain=float(gain))
        if 1e-3 < gain < 1e3 and terms_of(sensor) == terms:
            return sensor
    raise AssertionError(f"found no sensor of {terms} terms")


def terms_of(sensor: QIS) -> int:
    steps = thresholds(sensor)
    return int(steps.first[-1] + np.count_nonzero(steps.weights[-1] > 1e-12))


def random_light(rng: np.random.Generator, sensor: Sensor) -> np.ndarray:
    """Photons [2, H, W], float32 or float64: uniform to beyond white or to 1e6, and below 20 arrivals."""
    top = min(1.5 * sensor.white(EXPOSURE), 1e6) if rng.random() < 0.75 else 10 ** rng.uniform(0, 6)
    dark = min(rng.uniform(0, 20) / sensor.efficiency, 1e6)
    low = np.full(SHAPE[1:], dark) if rng.random() < 0.5 else rng.uniform(0, 20 / sensor.efficiency, SHAPE[1:])
    photons = np.stack([rng.uniform(0, top, SHAPE[1:]), low])
    return photons.astype(np.float32) if rng.random() < 0.5 else photons


@dataclass
class Count:
    """The results of a batch."""

    pixels: int = 0
    differ: int = 0
    few_bits: int = 0  # sensors of at most 8 bits
    handed: int = 0  # of those, to the reference


def compare(sensor: Sensor, rng: np.random.Generator, count: Count, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both engines on the same light; AssertionError with the sensor's repr if more than 3 pixels differ."""
    photons = random_light(rng, sensor)
    origin = ORIGINS[rng.integers(3)]
    key = Key(int(rng.integers(1 << 31)), 7)
    asked = []
    draw_at = type(sensor).draw_at

    def counted(self, light, *given, **places):
        if self == sensor:  # not one of its planes
            asked.append(light.size)
        return draw_at(self, light, *given, **places)

    with monkeypatch.context() as patch:
        patch.setattr(type(sensor), "draw_at", counted)
        if rng.random() < 0.5:
            found = sensor.sample(photons, EXPOSURE, key=key, origin=origin, engine="fast")
        else:
            packed = sensor.sample_packed(photons, EXPOSURE, key=key, origin=origin, engine="fast")
            found = unpack(packed, sensor.bits, SHAPE[2])
            np.testing.assert_array_equal(pack(found, sensor.bits), packed, err_msg=repr(sensor))  # no stray bits
    expected = sensor.sample(photons, EXPOSURE, key=key, origin=origin, engine="reference")
    differ = int(np.count_nonzero(found != expected))
    where = np.argwhere(found != expected)[:3].tolist()
    assert differ <= 3, (
        f"{differ} of {found.size} pixels differ, first at {where}, key {key}, origin {origin}: {sensor!r}"
    )
    count.pixels = count.pixels + found.size
    count.differ = count.differ + differ
    if sensor.bits <= 8:
        count.few_bits += 1
        count.handed += plan_of(sensor, EXPOSURE) is None or sum(asked) > 4 * found.size  # packed: octets of 8


def check(count: Count) -> None:
    print(f"{count.differ} of {count.pixels} pixels differ; {count.handed} of {count.few_bits} sensors handed over")
    assert count.differ <= 5e-6 * count.pixels
    assert count.handed < 0.1 * count.few_bits


def random_batch(seed: int, sensors: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng([18, seed])
    count = Count()
    for n in range(sensors):
        compare(random_sensor(rng, 1 + n % 8 if n % 10 else int(rng.integers(9, 17))), rng, count, monkeypatch)
    check(count)


def batch_of_terms(terms: list[int], seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng([19, seed])
    count = Count()
    seen = Counter()
    for number in terms:
        sensor = sensor_of_terms(rng, number)
        seen[terms_of(sensor)] += 1
        compare(sensor, rng, count, monkeypatch)
    check(count)
    assert seen == Counter(terms)


@needs_engine
@pytest.mark.parametrize("seed", range(4))
def test_random_sensors_have_the_references_codes(seed, monkeypatch):
    random_batch(seed, 50, monkeypatch)


@needs_engine
def test_every_length_of_sum_has_the_references_codes(monkeypatch):
    """Most densely where sums were once wrong and where they change into curves."""
    batch_of_terms([1, 2, 3, 5, 20, *range(48, 111, 3), 59, 71, 75, 76, 130, 200, 300, 499, 500], 0, monkeypatch)


@needs_engine
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 100 + BATCHES))
def test_thousands_of_random_sensors_have_the_references_codes(seed, monkeypatch):
    random_batch(seed, SENSORS, monkeypatch)


@needs_engine
@pytest.mark.slow
@pytest.mark.parametrize("first", range(1, 501, 50))
def test_every_number_of_terms_five_times(first, monkeypatch):
    batch_of_terms([n for n in range(first, first + 50) for _ in range(5)], first, monkeypatch)


def corner_sensor(rng: np.random.Generator, bits: int) -> Sensor:
    """A QIS whose thresholds lie on electrons or next to them; a third of them any sensor, a third paralyzable."""
    kind = rng.integers(3)
    if kind == 0:
        return random_sensor(rng, bits)
    if kind == 1:
        dead = EXPOSURE / float(rng.choice([10 ** rng.uniform(-0.5, 6), rng.integers(1, 60)]))
        return CountingSPAD(float(rng.uniform(0.02, 1)), float(10 ** rng.uniform(-1, 6)), dead, bits, True)
    return QIS(
        float(rng.choice([1.0, 0.5, 0.3])),
        float(rng.choice([0.0, 1e-30, 2000.0])),
        float(rng.choice([0.0, 1e-6, 1e-3, 0.5])),
        bits,
        gain=float(rng.choice([1.0, 0.5, 2.0, 1 / 3, 2.0**-6])),
        offset=float(rng.choice([0.0, 0.5, -0.5, 1e-9, 0.49999999])),
        full_well=rng.choice([None, 1.0, 0.5, 3.0, 1e-3]),
    )


def corner_light(rng: np.random.Generator, sensor: Sensor, shape: tuple[int, ...]) -> np.ndarray:
    """All orders of magnitude; none, denormal and much; usual; float64 beyond float32's digits; next to integers."""
    kind = rng.integers(5)
    if kind == 0:
        return 10 ** rng.uniform(-2, 6, shape)
    if kind == 1:
        return np.resize([0.0, 5e-324, 1e-310, 1e-45, 1e-40, 1e-38, 1e-30, 1e-9, 1.0, 1e6], shape)
    if kind == 2:
        return rng.uniform(0, 1.5 * min(sensor.white(EXPOSURE), 1e6), shape)
    if kind == 3:
        return rng.uniform(0, 3, shape) * (1 + 2.0**-25)
    return np.nextafter(rng.integers(0, 60, shape).astype(float), rng.choice([-1, 1e9])).clip(0)


def corner_batch(seed: int, sensors: int) -> None:
    """Frames of any width at any origin, both ways to write codes, and a crop: 5 pixels per million may differ."""
    rng = np.random.default_rng([20, seed])
    pixels = 0
    differ = 0
    for n in range(sensors):
        sensor = corner_sensor(rng, 1 + n % 8)
        width = int(rng.choice([1, 2, 3, 5, 7, 8, 9, 63, 130, 257]))
        rows = max(1, 20_000 // width)
        shape = (1, rows, width) if rng.random() < 0.5 else (max(1, rows // 16), 16, width)
        photons = corner_light(rng, sensor, shape)
        photons = photons.astype(np.float32) if rng.random() < 0.3 else photons
        y, x = (int(i) for i in rng.integers(0, 1000, 2))
        key = Key(int(rng.integers(1 << 31)), 3, int(rng.integers(100)))
        expected = sensor.sample(photons, EXPOSURE, key=key, origin=(y, x), engine="reference")
        whole = sensor.sample(photons, EXPOSURE, key=key, origin=(y, x), engine="fast")
        packed = sensor.sample_packed(photons, EXPOSURE, key=key, origin=(y, x), engine="fast")
        np.testing.assert_array_equal(packed, pack(whole, sensor.bits), err_msg=repr(sensor))
        top = int(rng.integers(shape[1]))
        left = int(rng.integers(width))
        part = photons[:, top:, left:]
        place = (y + top, x + left)
        crop = sensor.sample(part, EXPOSURE, key=key, origin=place, engine="fast")
        found = np.count_nonzero(whole != expected), np.count_nonzero(crop != expected[:, top:, left:])
        assert max(found) <= 2, f"{found} pixels differ, key {key}, {shape} at {(y, x)}: {sensor!r}"
        pixels = pixels + whole.size + crop.size
        differ = differ + sum(found)
    assert differ <= max(5e-6 * pixels, 2)


@needs_engine
def test_corners_of_light_places_and_thresholds_have_the_references_codes():
    corner_batch(0, 25)


@needs_engine
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 11))
def test_many_corners_have_the_references_codes(seed):
    corner_batch(seed, 200)
