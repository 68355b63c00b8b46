"""Every classical method for random sensors at random light: finite and right, or refused in one sentence."""

import warnings

import numpy as np
import pytest
from stats import assert_mean

from qsim.keys import Key
from qsim.sensor import devices
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines import METHODS, moment

EXPOSURE = 5e-4
DEAD_TIMES = (0.0, 35e-9, 1e-6, 1e-4, 4e-4, 2e-3)
REFUSALS = (
    "does not rise with light",
    "does not resolve; use a longer window",
    "which has probability 0 at every light level",
)


def random_sensor(rng, photons, most):
    """A sensor of 1 to `most` bits; every third one has the gain rule of the named sensors."""
    bits = int(rng.integers(1, most + 1))
    dark = float(rng.choice([0, 1.6, 25, 3200, 1e4]))
    match rng.integers(6):
        case 0:
            return devices.quiver_physical(photons, bits)
        case 1:
            return devices.quiver_published(photons, bits)
        case 2 | 3:
            well = None if rng.random() < 0.7 else float(10 ** rng.uniform(-1, 3))
            noise = float(rng.choice([0, 0.2, 0.5, 2, 6.6]))
            offset = float(rng.choice([0, 0, 3, 32, -5, -300]))
            return QIS(rng.uniform(0.1, 1), dark, noise, bits, float(10 ** rng.uniform(-1.5, 2)), offset, well)
        case 4:
            return BinarySPAD(rng.uniform(0.05, 1), dark, bits)
        case _:
            return CountingSPAD(rng.uniform(0.05, 1), dark, float(rng.choice(DEAD_TIMES)), bits, bool(rng.integers(2)))


def check(seed, names, most=8):
    """Restore one small stream of at most `most` bits with these methods; returns how many restored it."""
    rng = np.random.default_rng(seed)
    photons = float(10 ** rng.uniform(-1, np.log10(300)))
    sensor = random_sensor(rng, photons, most)
    shape = tuple(int(n) for n in rng.integers(1, (4, 20, 20)))
    match rng.integers(4):
        case 0:
            codes = np.zeros(shape, np.uint8)
        case 1:
            codes = np.full(shape, sensor.levels - 1, np.uint8)
        case _:
            codes = sensor.sample(photons * rng.uniform(0, 2, shape), EXPOSURE, key=Key(1, seed), engine="reference")
    restored = 0
    for name in names:
        where = f"seed {seed}, {name}, {sensor}, {photons:.3g} photons"
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                video = METHODS[name].restore(codes, sensor, EXPOSURE, window=int(rng.choice([1, 3, 11])))
            except ValueError as error:
                text = str(error)
                assert any(reason in text for reason in REFUSALS), f"{where}: {text}"
                assert type(sensor).__name__ in text
                continue
        assert (video.shape, video.dtype) == (shape, np.float32), where
        assert np.isfinite(video).all(), where
        assert video.min() >= 0 or name in ("naive", "moment", "likelihood"), where  # unbiased below the dark
        restored += 1
    return restored


def test_every_method_restores_or_refuses_random_streams():
    names = list(METHODS)
    done = sum(check(seed, [names[seed % len(names)]], most=4) for seed in range(36))
    assert done > 18  # of 36: refusing everything would be no answer


@pytest.mark.slow
def test_every_method_restores_or_refuses_many_random_streams():
    done = sum(check(seed, METHODS) for seed in range(1000, 1250))
    assert done > 1000


@pytest.mark.parametrize("name", ["moment", "likelihood", "transform-denoise", "qbp", "qbp-bm3d"])
@pytest.mark.parametrize(("bits", "photons"), [(1, 26.0), (1, 60.0), (1, 300.0), (2, 300.0)])
def test_a_flat_field_keeps_its_light_where_codes_are_rare(name, bits, photons):
    """The default gain rule puts the first step at half of the range: one bit at 26 photons reads 26 electrons as 1."""
    sensor = devices.quiver_physical(photons, bits)
    light = 1.25 * photons  # the mean of electrons is then on the step of one bit
    codes = sensor.sample(np.full((11, 24, 24), light), EXPOSURE, key=Key(3, bits), engine="reference")
    restored = METHODS[name].restore(codes, sensor, EXPOSURE, window=11, frames=range(5, 6))
    variance = 1 / (11 * float(sensor.fisher_information(np.array([light]), EXPOSURE)[0]))
    assert_mean(restored[0], light, 1.3 * variance + restored[0].size * (0.02 * light / 4.9) ** 2)


@pytest.mark.parametrize(
    "sensor",
    [
        devices.quiver_physical(26.0, bits=1),
        devices.quiver_physical(1000.0, bits=1),
        QIS(0.8, 1.6, 0.2, 3, gain=0.5, offset=-300.0),
        QIS(0.8, 1.6, 0.2, 6, full_well=2.5),
        BinarySPAD(0.05, 25.0, 3),
        CountingSPAD(0.4, 25.0, 1e-4, 5),
        CountingSPAD(0.4, 25.0, 1e-4, 5, paralyzable=True),
        CountingSPAD(0.4, 25.0, 35e-9, 2, paralyzable=True),
    ],
    ids=str,
)
def test_tables_reach_the_light_of_every_sensor(sensor):
    """From darkness to the end of the rise, far above white or at the peak of a paralyzable pixel."""
    table = sensor.response(EXPOSURE, points=64)
    far = min(sensor.brightest(EXPOSURE), 30 * table.photons[-1])
    here, there = sensor.mean(np.array([table.photons[-1], far]), EXPOSURE)
    assert there - here < 1e-5 * (sensor.levels - 1)
    assert table.photons[0] == 0


@pytest.mark.parametrize("name", list(METHODS))
def test_a_large_negative_offset_moves_the_light_and_hides_nothing(name):
    """The first code needs 600 electrons, 50 times what white promises: 0 codes until there, 3 of 7 at 760 photons."""
    sensor = QIS(0.8, 1.6, 0.2, 3, gain=0.5, offset=-300.0)
    codes = sensor.sample(np.full((11, 16, 16), 760.0), EXPOSURE, key=Key(1, 1), engine="reference")
    restored = METHODS[name].restore(codes, sensor, EXPOSURE, window=11, frames=range(5, 6))
    assert abs(restored.mean() / 760 - 1) < 0.02


def test_a_window_too_short_to_tell_any_light_is_refused():
    """In the dark this sensor has 2.4 of 3 codes; one code above 2.5 would be the only answer."""
    sensor = devices.quiver_published(0.2, bits=2)
    codes = np.full((1, 8, 8), 3, np.uint8)
    with pytest.raises(ValueError, match=r"^QIS .* in the dark to 3 at .* mean of 1 codes does not resolve"):
        moment.restore(codes, sensor, EXPOSURE, window=1)
    assert moment.restore(codes, sensor, EXPOSURE, window=11).min() > 0
