"""Defects: nothing at strength zero, maps that spread without shifting, a pattern that stays, and closed forms."""

import re
from dataclasses import replace

import numpy as np
import pytest
from stats import FALSE_ALARM, assert_histogram, assert_mean, assert_share, assert_variance, mixture_p_value, per_check

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects.fixed_pattern import (
    PERFECT,
    DarkSpread,
    Defects,
    Maps,
    draw_maps,
    measured_dark_map,
    pmf,
    sample,
)
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
    maps = draw_maps(Defects(), photons.shape[1:])
    assert vars(maps) == vars(PERFECT)
    np.testing.assert_array_equal(sample(sensor, photons, EXPOSURE, key=KEY, maps=maps, origin=(3, 5)), expected)


@pytest.mark.parametrize("sensor", SENSORS)
def test_maps_of_ones_change_nothing(sensor):
    ones = np.ones((8, 10))
    maps = Maps(gain=ones, dead=ones < 0, dark=ones)
    expected = sensor.sample(light(), EXPOSURE, key=KEY)
    np.testing.assert_array_equal(sample(sensor, light(), EXPOSURE, key=KEY, maps=maps), expected)


def test_the_limit_of_weak_disturbances_is_none():
    """Probabilities of 1e-12 in 5000 avalanches: a change would be a 1 in 10^7 accident."""
    plane = BinarySPAD(0.5, 0.0, 3)
    expected = plane.sample(light(), EXPOSURE, key=KEY)
    weak = sample(plane, light(), EXPOSURE, key=KEY, afterpulse=1e-12, crosstalk=1e-12)
    np.testing.assert_array_equal(weak, expected)


# ---- Maps


def test_a_gain_map_has_mean_1_and_the_declared_spread():
    """Log-normal factors: fourth moment from w = 1 + s^2 (w^4 + 2 w^3 + 3 w^2 - 3 is the kurtosis)."""
    spread = 0.1
    gain = draw_maps(Defects(device_seed=4, prnu=spread), (300, 401)).gain
    w = 1 + spread**2
    assert_mean(gain, 1.0, spread**2, checks=2)
    assert_variance(gain, spread**2, spread**4 * (w**4 + 2 * w**3 + 3 * w**2 - 3), checks=2)


def test_uneven_response_does_not_shift_the_signal():
    """The mean count stays, the variance between pixels grows by (s lambda)^2: 1 + lognormal would double the mean."""
    sensor, spread, photons = CountingSPAD(1.0, 0.0, 0.0, 8), 0.1, 20.0
    maps = draw_maps(Defects(prnu=spread), (200, 201))
    codes = sample(sensor, np.full((1, 200, 201), photons), EXPOSURE, key=KEY, maps=maps).astype(float)
    assert_mean(codes, photons, photons + (spread * photons) ** 2)
    assert codes.var() > photons + 0.8 * (spread * photons) ** 2


@pytest.mark.parametrize("tail", [0.67, 1.0, 1.8])
def test_a_dark_map_has_mean_1_and_the_declared_share_of_hot_pixels(tail):
    """The tail ends at hot_to, so all its moments exist: here from 2e5 numbers on a fine grid of both uniforms."""
    spread = DarkSpread(hot_share=0.02, hot_to=100.0, tail=tail)
    dark = draw_maps(Defects(dark=spread, device_seed=2), (401, 500)).dark
    v = (np.arange(200_000) + 0.5) / 200_000
    hot, body = spread.draw(np.zeros_like(v), v), spread.draw(np.ones_like(v), v)
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
    everything = Defects(device_seed=9, prnu=0.1, dark=DarkSpread(), dead=0.05, offset=0.3, read_noise=0.2)
    whole = draw_maps(everything, (40, 50))
    crop, again = draw_maps(everything, (7, 9), origin=(11, 13)), draw_maps(everything, (40, 50))
    other = draw_maps(replace(everything, device_seed=10), (40, 50))
    for name, value in vars(whole).items():
        np.testing.assert_array_equal(value, vars(again)[name])
        np.testing.assert_array_equal(vars(crop)[name], value[11:18, 13:22])
        np.testing.assert_array_equal(vars(whole.crop(11, 13, 7, 9))[name], value[11:18, 13:22])
        assert (vars(other)[name] != value).any()
        for second, values in vars(whole).items():  # no two kinds of map share their numbers
            if name != second and value.dtype == values.dtype:
                assert abs(np.corrcoef(value.ravel(), values.ravel())[0, 1]) < 6 / np.sqrt(value.size)


def test_the_pattern_is_fixed_while_the_noise_is_not():
    """200 dark frames: the mean of a pixel follows its own rate; a pattern that was drawn anew would average out."""
    sensor = BinarySPAD(0.5, 800.0)
    maps = draw_maps(Defects(dark=DarkSpread(hot_share=0.1, hot_to=20.0)), (20, 21))
    frames = sample(sensor, np.zeros((400, 20, 21)), EXPOSURE, key=KEY, maps=maps)
    p = -np.expm1(-0.4 * maps.dark)
    z = (frames.mean(axis=0) - p) / np.sqrt(p * (1 - p) / 400)
    assert np.abs(z).max() < 6
    assert frames.mean(axis=0).std() > 3 * np.sqrt(0.25 / 400)
    assert all((frames[t] != frames[t + 1]).any() for t in range(399))


def test_dead_pixels_never_fire_and_the_others_do_not_notice():
    sensor = BinarySPAD(0.5, 100.0, 3)
    maps = draw_maps(Defects(dead=0.1), (30, 31))
    photons = np.full((2, 30, 31), 50.0)
    codes = sample(sensor, photons, EXPOSURE, key=KEY, maps=maps, crosstalk=0.3, afterpulse=0.3)
    assert (codes[:, maps.dead] == 0).all()
    alone = sample(sensor, photons, EXPOSURE, key=KEY, maps=maps)
    np.testing.assert_array_equal(
        alone, np.where(maps.dead, 0, sensor.sample(photons, EXPOSURE, key=KEY)).astype(np.uint8)
    )
    assert_share(int(draw_maps(Defects(dead=0.1), (200, 201)).dead.sum()), 200 * 201, 0.1)


def test_measured_rates_become_a_map_of_mean_1():
    rates = np.array([[1.0, 2.0], [0.0, 5.0]])
    mean, relative = measured_dark_map(rates)
    np.testing.assert_allclose(mean * relative, rates)
    assert relative.mean() == 1
    for wrong in (np.zeros((2, 2)), np.array([[-1.0, 2.0]]), np.array([[np.nan, 2.0]])):
        with pytest.raises(ValueError, match="measured dark rates"):
            measured_dark_map(wrong)


# ---- Read-out maps


def test_read_out_maps_draw_from_the_pixels_own_cdf():
    """Two halves with their own offset and read noise: each follows the closed form of such a sensor."""
    sensor, n = QIS(0.8, 1.6, 0.3, 3), 200
    offset, noise = np.zeros((n, 2 * n)), np.ones((n, 2 * n))
    offset[:, n:], noise[:, n:] = 0.75, 3.0
    codes = sample(sensor, np.full((1, n, 2 * n), 3.0), EXPOSURE, key=KEY, maps=Maps(offset=offset, read_noise=noise))
    for part, own in ((codes[..., :n], sensor), (codes[..., n:], replace(sensor, offset=0.75, read_noise=0.9))):
        assert_histogram(part, np.exp(own.log_pmf(np.array(3.0), EXPOSURE)), checks=2)


def test_drawn_read_out_maps_have_their_spread():
    maps = draw_maps(Defects(offset=0.5, read_noise=0.2), (200, 201))
    assert_mean(maps.offset, 0.0, 0.25, checks=3)
    assert_variance(maps.offset, 0.25, 3 * 0.25**2, checks=3)
    assert_mean(maps.read_noise, 1.0, 0.04, checks=3)


# ---- Afterpulses and crosstalk


def drawn_device(rng: np.random.Generator, shape: tuple[int, int]):
    """A random sensor with random maps; each map is absent in half of the cases."""
    bits, some = int(rng.integers(1, 5)), lambda: bool(rng.random() < 0.5)
    rate = float(rng.choice([0.0, 300.0, 3000.0]))
    kind = rng.integers(3)
    if kind == 0:
        noise, well = float(rng.choice([0.0, 0.2, 0.7])), float(rng.uniform(3, 30)) if some() else None
        sensor = QIS(0.8, rate, noise, bits, gain=float(np.exp(rng.normal(0, 0.7))), offset=0.3, full_well=well)
    elif kind == 1:
        sensor = BinarySPAD(0.4, rate, bits)
    else:
        sensor = CountingSPAD(0.5, rate, float(rng.choice([0.0, 2e-5])), bits)
    pattern = Defects(
        device_seed=int(rng.integers(1000)),
        prnu=0.3 if some() else 0.0,
        dark=DarkSpread(hot_share=0.1) if some() else None,
        dead=0.05 if some() else 0.0,
        offset=0.4 if kind == 0 and some() else 0.0,
        read_noise=0.5 if kind == 0 and some() else 0.0,
    )
    return sensor, draw_maps(pattern, shape)


def test_the_exact_distribution_holds_for_random_devices():
    """Drawn codes of random sensors and maps against `pmf`, by chi-square; without the maps most of them fail."""
    rng = np.random.default_rng(21)
    devices, shape, blind = 60, (24, 25), 0
    for i in range(devices):
        sensor, maps = drawn_device(rng, shape)
        photons = rng.uniform(0.1, 6, shape) * float(np.exp(rng.normal(0, 0.7)))
        codes = sample(sensor, np.repeat(photons[None], 12, axis=0), 5e-4, key=Key(seed=i, clip=3), maps=maps)
        chances = pmf(sensor, photons, 5e-4, maps)
        assert chances.min() > -1e-9
        np.testing.assert_allclose(chances.sum(axis=-1), 1, atol=1e-9)
        flat = chances.reshape(-1, sensor.levels)
        assert mixture_p_value(codes, np.tile(flat, (12, 1))) > per_check(FALSE_ALARM, devices), (sensor, maps)
        plain = sensor.pmf(photons, 5e-4).reshape(-1, sensor.levels)
        blind += mixture_p_value(codes, np.tile(plain, (12, 1))) > per_check(FALSE_ALARM, devices)
    assert blind < devices / 2


def test_the_exact_distribution_without_maps_is_the_sensor_s_own():
    photons = light((4, 5))
    for sensor in (QIS(0.8, 100.0, 0.2, 3), BinarySPAD(0.4, 50.0, 2)):
        np.testing.assert_array_equal(pmf(sensor, photons, 5e-4, PERFECT), sensor.pmf(photons, 5e-4))
    with pytest.raises(ValueError, match="has no read-out"):
        pmf(BinarySPAD(0.4, 50.0, 2), photons, 5e-4, Maps(offset=np.zeros((4, 5))))


def test_afterpulses_reach_the_stationary_rate():
    """P(fire) = p / (1 - a (1 - p)) after some planes; neighbouring planes are then correlated with a (1 - p)."""
    p, a = 0.3, 0.4
    photons = np.full((60, 40, 50), -np.log1p(-p))
    planes = sample(BinarySPAD(1.0, 0.0), photons, EXPOSURE, key=KEY, afterpulse=a)[20:].astype(float)
    rate = p / (1 - a * (1 - p))
    correlation = a * (1 - p)  # P(fire | fired before) - P(fire | not)
    inflated = rate * (1 - rate) * (1 + correlation) / (1 - correlation)
    assert_mean(planes, rate, inflated)
    found = np.corrcoef(planes[:-1].ravel(), planes[1:].ravel())[0, 1]
    assert abs(found - correlation) < 6 * 2 / np.sqrt(planes.size)


def test_crosstalk_raises_the_rate_as_four_neighbours_can():
    """Inside, P(fire) = 1 - (1 - p)(1 - p c)^4; at an edge with three neighbours, to the third power."""
    p, c = 0.2, 0.15
    planes = sample(BinarySPAD(1.0, 0.0), np.full((60, 40, 50), -np.log1p(-p)), EXPOSURE, key=KEY, crosstalk=c).astype(
        float
    )
    inside, edge = planes[:, 1:-1, 1:-1], planes[:, 0, 1:-1]
    for part, neighbours in ((inside, 4), (edge, 3)):
        rate = 1 - (1 - p) * (1 - p * c) ** neighbours
        spread = rate * (1 - rate) * (1 + 12 * c * p)  # neighbours share sources: a bound on their covariance
        assert_mean(part, rate, spread, checks=2)


def test_crosstalk_of_counts_adds_binomial_numbers():
    """Every count sends Binomial(1, c) to each of four neighbours: the mean grows by 4 c."""
    c, mean = 0.05, 3.0
    sensor = CountingSPAD(1.0, 0.0, 0.0, 8)
    codes = sample(sensor, np.full((20, 40, 50), mean), EXPOSURE, key=KEY, crosstalk=c)[:, 1:-1, 1:-1].astype(float)
    total = mean * (1 + 4 * c)
    assert_mean(codes, total, total * (1 + 8 * c + 12 * c**2))


@pytest.mark.parametrize("bits", [1, 3])
def test_a_crop_with_a_margin_equals_the_whole(bits):
    sensor = BinarySPAD(0.5, 200.0, bits)
    photons = light((4, 17, 23), seed=1)
    maps = draw_maps(Defects(prnu=0.1, dark=DarkSpread(), dead=0.05), (17, 23))
    settings = {"afterpulse": 0.2, "crosstalk": 0.2}
    whole = sample(sensor, photons, EXPOSURE, key=KEY, maps=maps, **settings)
    y, x, h, w = 4, 5, 6, 7
    part = (slice(None), slice(y - 1, y + h + 1), slice(x - 1, x + w + 1))
    crop = sample(
        sensor,
        photons[part],
        EXPOSURE,
        key=KEY,
        maps=maps.crop(y - 1, x - 1, h + 2, w + 2),
        origin=(y - 1, x - 1),
        margin=(1, 1, 1, 1),
        **settings,
    )
    np.testing.assert_array_equal(crop, whole[:, y : y + h, x : x + w])
    corner = sample(
        sensor,
        photons[:, : h + 1, : w + 1],
        EXPOSURE,
        key=KEY,
        maps=maps.crop(0, 0, h + 1, w + 1),
        margin=(0, 0, 1, 1),
        **settings,
    )
    np.testing.assert_array_equal(corner, whole[:, :h, :w])


def test_frames_of_a_disturbed_clip_all_differ():
    frames = sample(BinarySPAD(0.5, 0.0), np.full((20, 8, 10), 1.0), EXPOSURE, key=KEY, afterpulse=0.3, crosstalk=0.1)
    assert len({frame.tobytes() for frame in frames}) == 20


@pytest.mark.parametrize(
    ("sensor", "settings", "text"),
    [
        (SENSORS[0], {"crosstalk": 0.1}, "a QIS has no avalanches"),
        (SENSORS[0], {"afterpulse": 0.1}, "defined per binary plane"),
        (SENSORS[3], {"afterpulse": 0.1}, "use events.sample"),
        (SENSORS[1], {"afterpulse": 1.0}, "afterpulse is a probability below 1, got 1.0"),
        (SENSORS[1], {"crosstalk": -0.1}, "crosstalk is a probability below 1, got -0.1"),
        (SENSORS[1], {"maps": Maps(offset=np.ones((8, 10)))}, "BinarySPAD has no read-out"),
        (SENSORS[1], {"key": KEY.at(3), "afterpulse": 0.1}, "sample the clip from frame 0, not from frame 3"),
    ],
)
def test_what_makes_no_sense_is_refused(sensor, settings, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        sample(sensor, light(), EXPOSURE, **({"key": KEY} | settings))


@pytest.mark.parametrize("field", ["prnu", "dead", "offset", "read_noise"])
def test_negative_strengths_are_refused(field):
    with pytest.raises(ValueError, match=f"Defects.{field}"):
        Defects(**{field: -0.1})
