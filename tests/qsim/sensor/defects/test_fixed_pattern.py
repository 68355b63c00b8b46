"""Tests fixed-pattern noise: strength zero, mean and spread of maps, constancy in time, exact distributions."""

from dataclasses import replace

import numpy as np
import pytest
from stats import FALSE_ALARM, assert_histogram, assert_mean, assert_share, assert_variance, mixture_p_value, per_check

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import (
    PERFECT,
    DarkSpread,
    FixedPattern,
    Maps,
    draw_maps,
    measured_dark_map,
    pmf,
)
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD

KEY = Key(seed=3, clip=5)
EXPOSURE = 5e-4  # s
SENSORS = [
    QIS(0.8, 1.6, 0.2, 3, gain=1.1),
    BinarySPAD(0.5, 100.0),
    BinarySPAD(0.5, 100.0, 3),
    CountingSPAD(0.5, 100.0, 1e-5, 3),
]


def light(shape: tuple[int, ...] = (3, 8, 10), seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 6, shape)


# ---- Strength zero


@pytest.mark.parametrize("sensor", SENSORS)
def test_strength_zero_is_bit_identical(sensor):
    photons = light()
    expected = sensor.sample(photons, EXPOSURE, key=KEY, origin=(3, 5))
    maps = draw_maps(FixedPattern(), photons.shape[1:])
    assert vars(maps) == vars(PERFECT)
    np.testing.assert_array_equal(PixelArray(sensor, maps).sample(photons, EXPOSURE, key=KEY, origin=(3, 5)), expected)


@pytest.mark.parametrize("sensor", SENSORS)
def test_maps_of_ones_change_nothing(sensor):
    ones = np.ones((8, 10))
    maps = Maps(gain=ones, dead=ones < 0, dark=ones)
    expected = sensor.sample(light(), EXPOSURE, key=KEY)
    np.testing.assert_array_equal(PixelArray(sensor, maps).sample(light(), EXPOSURE, key=KEY), expected)


# ---- Maps


def test_a_gain_map_has_mean_1_and_the_declared_spread():
    """Log-normal factors: fourth moment from w = 1 + s^2 (w^4 + 2 w^3 + 3 w^2 - 3 is the kurtosis)."""
    spread = 0.1
    gain = draw_maps(FixedPattern(device_seed=4, prnu=spread), (300, 401)).gain
    w = 1 + spread**2
    assert_mean(gain, 1.0, spread**2, checks=2)
    assert_variance(gain, spread**2, spread**4 * (w**4 + 2 * w**3 + 3 * w**2 - 3), checks=2)


def test_uneven_response_does_not_shift_the_signal():
    """The mean count stays, and the variance between pixels grows by (s lambda)^2."""
    sensor = CountingSPAD(1.0, 0.0, 0.0, 8)
    spread = 0.1
    photons = 20.0
    maps = draw_maps(FixedPattern(prnu=spread), (200, 201))
    codes = PixelArray(sensor, maps).sample(np.full((1, 200, 201), photons), EXPOSURE, key=KEY).astype(float)
    assert_mean(codes, photons, photons + (spread * photons) ** 2)
    assert codes.var() > photons + 0.8 * (spread * photons) ** 2


@pytest.mark.parametrize("tail", [0.67, 1.0, 1.8])
def test_a_dark_map_has_mean_1_and_the_declared_share_of_hot_pixels(tail):
    """The tail ends at hot_to, so all its moments exist: here from 2e5 numbers on a fine grid of both uniforms."""
    spread = DarkSpread(hot_share=0.02, hot_to=100.0, tail=tail)
    dark = draw_maps(FixedPattern(dark=spread, device_seed=2), (401, 500)).dark
    v = (np.arange(200_000) + 0.5) / 200_000
    hot = spread.draw(np.zeros_like(v), v)
    body = spread.draw(np.ones_like(v), v)
    mean = 0.02 * hot.mean() + 0.98 * body.mean()
    assert mean == pytest.approx(1.0, rel=1e-4)
    variance = 0.02 * (hot**2).mean() + 0.98 * (body**2).mean() - 1
    assert_mean(dark, 1.0, variance, checks=3)
    medians = dark * spread.mean
    assert_share(int((medians > 3).sum()), dark.size, 0.02, checks=3)
    far = (10**-tail - 100**-tail) / (3**-tail - 100**-tail)
    assert_share(int((medians > 10).sum()), dark.size, 0.02 * far, checks=3)
    assert abs(np.median(medians) - 1) < 0.02


def test_a_map_is_a_function_of_device_and_place():
    everything = FixedPattern(device_seed=9, prnu=0.1, dark=DarkSpread(), dead=0.05, offset=0.3, read_noise=0.2)
    whole = draw_maps(everything, (40, 50))
    crop = draw_maps(everything, (7, 9), origin=(11, 13))
    again = draw_maps(everything, (40, 50))
    other = draw_maps(replace(everything, device_seed=10), (40, 50))
    for name, value in vars(whole).items():
        np.testing.assert_array_equal(value, vars(again)[name])
        np.testing.assert_array_equal(vars(crop)[name], value[11:18, 13:22])
        np.testing.assert_array_equal(vars(whole.crop(11, 13, 7, 9))[name], value[11:18, 13:22])
        assert (vars(other)[name] != value).any()
        for second, values in vars(whole).items():  # no two kinds of map have common random numbers
            if name != second and value.dtype == values.dtype:
                assert abs(np.corrcoef(value.ravel(), values.ravel())[0, 1]) < 6 / np.sqrt(value.size)


def test_a_device_has_one_pattern_for_frames_and_crops(tmp_path):
    """Drawn and measured maps of a crop are the crop of the maps; a measured map has to cover the place."""
    rng = np.random.default_rng(0)
    np.save(tmp_path / "dead.npy", rng.random((12, 15)) < 0.2)
    np.save(tmp_path / "gain.npy", rng.uniform(0.5, 1.5, (12, 15)))
    measured = {f"{name}_map": str(tmp_path / f"{name}.npy") for name in ("dead", "gain")}
    found = Defects(FixedPattern(device_seed=9, dark=DarkSpread()), measured)
    whole = PixelArray.of(found, SENSORS[0], 12, 15)
    crop = PixelArray.of(found, SENSORS[0], 5, 6, (4, 7))
    for name in ("gain", "dark", "dead"):
        np.testing.assert_array_equal(vars(crop.maps)[name], vars(whole.maps)[name][4:9, 7:13])
    with pytest.raises(ValueError, match="has 12 x 15 pixels, the frames 5 x 6 at row 8, column 0; a map must cover"):
        PixelArray.of(found, SENSORS[0], 5, 6, (8, 0))


def test_the_pattern_is_fixed_while_the_noise_is_not():
    """200 dark frames: the mean of a pixel follows its rate; a pattern drawn per frame would average out."""
    sensor = BinarySPAD(0.5, 800.0)
    maps = draw_maps(FixedPattern(dark=DarkSpread(hot_share=0.1, hot_to=20.0)), (20, 21))
    frames = PixelArray(sensor, maps).sample(np.zeros((400, 20, 21)), EXPOSURE, key=KEY)
    p = -np.expm1(-0.4 * maps.dark)
    z = (frames.mean(axis=0) - p) / np.sqrt(p * (1 - p) / 400)
    assert np.abs(z).max() < 6
    assert frames.mean(axis=0).std() > 3 * np.sqrt(0.25 / 400)
    assert all((frames[t] != frames[t + 1]).any() for t in range(399))


def test_measured_rates_become_a_map_of_mean_1():
    rates = np.array([[1.0, 2.0], [0.0, 5.0]])
    mean, relative = measured_dark_map(rates)
    np.testing.assert_allclose(mean * relative, rates)
    assert relative.mean() == 1
    for wrong in (np.zeros((2, 2)), np.array([[-1.0, 2.0]]), np.array([[np.nan, 2.0]])):
        with pytest.raises(ValueError, match="measured dark rates"):
            measured_dark_map(wrong)


# ---- Read-out maps


def test_read_out_maps_draw_from_the_cdf_of_each_pixel():
    """Two halves differ in offset and read noise; each follows the closed form of such a sensor."""
    sensor = QIS(0.8, 1.6, 0.3, 3)
    n = 200
    offset = np.zeros((n, 2 * n))
    noise = np.ones((n, 2 * n))
    offset[:, n:] = 0.75
    noise[:, n:] = 3.0
    array = PixelArray(sensor, Maps(offset=offset, read_noise=noise))
    codes = array.sample(np.full((1, n, 2 * n), 3.0), EXPOSURE, key=KEY)
    for part, own in ((codes[..., :n], sensor), (codes[..., n:], replace(sensor, offset=0.75, read_noise=0.9))):
        assert_histogram(part, np.exp(own.log_pmf(np.array(3.0), EXPOSURE)), checks=2)


def test_drawn_read_out_maps_have_their_spread():
    maps = draw_maps(FixedPattern(offset=0.5, read_noise=0.2), (200, 201))
    assert_mean(maps.offset, 0.0, 0.25, checks=3)
    assert_variance(maps.offset, 0.25, 3 * 0.25**2, checks=3)
    assert_mean(maps.read_noise, 1.0, 0.04, checks=3)


def drawn_device(rng: np.random.Generator, shape: tuple[int, int]):
    """A random sensor with random maps; each map is absent in half of the cases."""
    bits = int(rng.integers(1, 5))

    def some() -> bool:
        return bool(rng.random() < 0.5)

    rate = float(rng.choice([0.0, 300.0, 3000.0]))
    kind = rng.integers(3)
    if kind == 0:
        noise = float(rng.choice([0.0, 0.2, 0.7]))
        well = float(rng.uniform(3, 30)) if some() else None
        sensor = QIS(0.8, rate, noise, bits, gain=float(np.exp(rng.normal(0, 0.7))), offset=0.3, full_well=well)
    elif kind == 1:
        sensor = BinarySPAD(0.4, rate, bits)
    else:
        sensor = CountingSPAD(0.5, rate, float(rng.choice([0.0, 2e-5])), bits)
    pattern = FixedPattern(
        device_seed=int(rng.integers(1000)),
        prnu=0.3 if some() else 0.0,
        dark=DarkSpread(hot_share=0.1) if some() else None,
        dead=0.05 if some() else 0.0,
        offset=0.4 if kind == 0 and some() else 0.0,
        read_noise=0.5 if kind == 0 and some() else 0.0,
    )
    return sensor, draw_maps(pattern, shape)


def test_the_exact_distribution_holds_for_random_devices():
    """Codes of random sensors and maps agree with `pmf` by chi-square; without the maps most disagree."""
    rng = np.random.default_rng(21)
    devices = 60
    shape = (24, 25)
    blind = 0
    for i in range(devices):
        sensor, maps = drawn_device(rng, shape)
        photons = rng.uniform(0.1, 6, shape) * float(np.exp(rng.normal(0, 0.7)))
        codes = PixelArray(sensor, maps).sample(np.repeat(photons[None], 12, axis=0), 5e-4, key=Key(seed=i, clip=3))
        chances = pmf(sensor, photons, 5e-4, maps)
        assert chances.min() > -1e-9
        np.testing.assert_allclose(chances.sum(axis=-1), 1, atol=1e-9)
        flat = chances.reshape(-1, sensor.levels)
        assert mixture_p_value(codes, np.tile(flat, (12, 1))) > per_check(FALSE_ALARM, devices), (sensor, maps)
        plain = sensor.pmf(photons, 5e-4).reshape(-1, sensor.levels)
        blind += mixture_p_value(codes, np.tile(plain, (12, 1))) > per_check(FALSE_ALARM, devices)
    assert blind < devices / 2


def test_the_exact_distribution_without_maps_is_that_of_the_sensor():
    photons = light((4, 5))
    for sensor in (QIS(0.8, 100.0, 0.2, 3), BinarySPAD(0.4, 50.0, 2)):
        np.testing.assert_array_equal(pmf(sensor, photons, 5e-4, PERFECT), sensor.pmf(photons, 5e-4))
    with pytest.raises(ValueError, match="has no read-out"):
        pmf(BinarySPAD(0.4, 50.0, 2), photons, 5e-4, Maps(offset=np.zeros((4, 5))))


@pytest.mark.parametrize("field", ["prnu", "dead", "offset", "read_noise"])
def test_negative_strengths_are_refused(field):
    with pytest.raises(ValueError, match=f"FixedPattern.{field}"):
        FixedPattern(**{field: -0.1})
