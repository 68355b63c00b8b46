"""Tests the photon-by-photon simulation: limits, laws of renewal theory, and the closed forms."""

import re

import numpy as np
import pytest
from stats import assert_histogram, assert_mean, assert_share

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.event_simulation import (
    TOLERANCE,
    Effects,
    Memory,
    State,
    effects,
    expose,
    follow,
    sample,
    simulate,
    trace,
)
from qsim.sensor.defects.fixed_pattern import Maps
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.spad import BinarySPAD

KEY = Key(seed=1, clip=7)
EXPOSURE = 5e-4  # s
NO_MEMORY = Memory()


def counter(dead_share: float, bits: int = 5, **more: bool) -> CountingSPAD:
    return CountingSPAD(1.0, 0.0, dead_share * EXPOSURE, bits, **more)


def counts(sensor: CountingSPAD, photons: np.ndarray, memory: Memory = NO_MEMORY, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return simulate(sensor, photons, EXPOSURE, EXPOSURE, memory, rng)


def constant(arrivals: float, frames: int, slices: int = 1) -> np.ndarray:
    return np.full((frames, slices), arrivals / slices)


def exposed(sensor: CountingSPAD, times: list[float], state: State = State()) -> tuple[int, State]:  # noqa: B008
    """One exposure of 1 s with given arrivals."""
    return expose(sensor, times, 0.0, 1.0, NO_MEMORY, state, np.random.default_rng(0))


# ---- By hand


def test_arrivals_within_the_dead_time_are_lost_and_restart_it_in_paralyzable_pixels():
    """Dead time 0.3: 0.0 counts, 0.2 does not; 0.4 counts unless 0.2 has started a new dead time."""
    times = [0.0, 0.2, 0.4, 0.75]
    assert exposed(CountingSPAD(1, 0, 0.3, 5), times)[0] == 3
    assert exposed(CountingSPAD(1, 0, 0.3, 5, paralyzable=True), times)[0] == 2


def test_a_running_dead_time_is_carried():
    sensor = CountingSPAD(1, 0, 0.3, 5)
    count, state = exposed(sensor, [0.9])
    assert (count, state.dead_until) == (1, pytest.approx(1.2))
    assert exposed(sensor, [0.1, 0.25], State(dead_until=0.2))[0] == 1


def test_trapped_carriers_fire_when_they_are_released_unless_the_pixel_is_dead_or_the_shutter_closed():
    sensor = CountingSPAD(1, 0, 0.3, 5)
    assert exposed(sensor, [], State(trapped=(0.5,)))[0] == 1
    assert exposed(sensor, [0.4], State(trapped=(0.5,)))[0] == 1
    assert exposed(sensor, [], State(trapped=(-0.5,)))[0] == 0
    assert exposed(sensor, [], State(trapped=(1.5,))) == (0, State(trapped=(1.5,)))
    restarted = CountingSPAD(1, 0, 0.3, 5, paralyzable=True)
    assert exposed(restarted, [0.1], State(trapped=(-0.1,)))[0] == 1, "a closed shutter: no avalanche, no dead time"


# ---- The closed forms


@pytest.mark.parametrize(("arrivals", "share"), [(0.5, 0.1), (3.0, 0.05), (8.0, 0.25), (6.0, 1.0), (4.0, 0.37)])
@pytest.mark.parametrize("paralyzable", [False, True])
def test_the_closed_form_of_dead_time_is_the_law_of_the_events(arrivals, share, paralyzable):
    sensor = counter(share, paralyzable=paralyzable)
    drawn = counts(sensor, constant(arrivals, 10_000), seed=int(100 * share))
    pmf = np.exp(sensor.log_pmf(np.array(arrivals), EXPOSURE))
    assert_histogram(np.minimum(drawn, sensor.levels - 1), pmf, checks=10)


def test_without_dead_time_the_counts_are_poisson_for_any_flux():
    light = np.tile([0.1, 2.0, 0.0, 0.9], (20_000, 1))
    pmf = np.exp(counter(0.0).log_pmf(np.array(3.0), EXPOSURE))
    assert_histogram(counts(counter(0.0), light), pmf)


def test_dark_counts_and_efficiency_enter_as_in_the_closed_form():
    sensor = CountingSPAD(0.4, 2000.0, 0.05 * EXPOSURE, 4)
    drawn = counts(sensor, constant(5.0, 20_000, slices=3))
    assert_histogram(np.minimum(drawn, 15), np.exp(sensor.log_pmf(np.array(5.0), EXPOSURE)))


def test_a_clocked_pixel_detects_whether_anything_arrived():
    """One plane of a BinarySPAD is a counter that stays dead after its first count."""
    drawn = counts(counter(2.0), constant(0.7, 20_000))
    share = float(np.exp(BinarySPAD(1.0, 0.0).log_pmf(np.array(0.7), EXPOSURE))[1])
    assert_share(int(drawn.sum()), drawn.size, share)


# ---- Effects beyond the closed forms


def test_light_that_comes_at_once_loses_more_counts():
    """All light in the first of four slices, dead time as long as a slice: at most one count, P = 1 - exp(-6)."""
    light = np.tile([6.0, 0.0, 0.0, 0.0], (20_000, 1))
    drawn = counts(counter(0.25), light)
    assert drawn.max() == 1
    assert_share(int(drawn.sum()), drawn.size, -np.expm1(-6.0))


def test_a_carried_dead_time_gives_the_renewal_rate():
    """A non-paralyzable pixel counts r / (1 + r tau) without gaps; the variance tends to r / (1 + r tau)^3.

    With a new start in every frame it counts more, as in the closed form.
    """
    arrivals = 6.0
    share = 0.25
    frames = 10_000
    expected = arrivals / (1 + arrivals * share)
    carried = counts(counter(share), constant(arrivals, frames), Memory(carry=True))
    whole = carried.reshape(-1, 100).sum(axis=1)[1:]  # 100 frames: the edges of a block weigh little
    assert_mean(whole, 100 * expected, 100 * arrivals / (1 + arrivals * share) ** 3 * 1.1, checks=2)
    fresh = counts(counter(share), constant(arrivals, frames))
    mean, variance = (float(f(np.array(arrivals), EXPOSURE)) for f in (counter(share).mean, counter(share).variance))
    assert_mean(fresh, mean, variance, checks=2)
    assert mean > 1.05 * expected


def test_a_paralyzable_pixel_that_never_rests_counts_r_exp_minus_r_tau():
    arrivals = 3.0
    share = 0.3
    drawn = counts(counter(share, paralyzable=True), constant(arrivals, 20_000), Memory(carry=True))
    mean = arrivals * np.exp(-arrivals * share)
    whole = drawn.reshape(-1, 100).sum(axis=1)
    variance = 100 * mean * (1 - 2 * share * mean) * 1.1  # of the counts of a type II counter, edges aside
    assert_mean(whole, 100 * mean, variance)


def test_afterpulses_multiply_the_counts_by_one_over_one_minus_p():
    """No dead time: an arrival starts a family of 1 / (1 - p) counts (geometric), mean square (1 + p) / (1 - p)^2."""
    p = 0.2
    arrivals = 4.0
    memory = Memory(carry=True, afterpulse=p, afterpulse_delay=0.2 * EXPOSURE)
    drawn = counts(counter(0.0), constant(arrivals, 20_000), memory)
    whole = drawn.reshape(-1, 100).sum(axis=1)[1:]  # the first block starts without trapped carriers
    assert_mean(whole, 100 * arrivals / (1 - p), 1.1 * 100 * arrivals * (1 + p) / (1 - p) ** 2)


def test_afterpulses_within_the_dead_time_are_not_seen():
    """Delays of a thousandth of the dead time: 1 of e^1000 carriers outlives it."""
    memory = Memory(carry=True, afterpulse=0.5, afterpulse_delay=1e-3 * 0.1 * EXPOSURE)
    quiet, with_traps = (counts(counter(0.1), constant(2.0, 300), m, seed=3) for m in (Memory(carry=True), memory))
    assert quiet.sum() > 400
    assert abs(int(with_traps.sum()) - int(quiet.sum())) < 6 * np.sqrt(2 * quiet.sum())


# ---- Choosing


def test_small_effects_take_the_closed_form_and_equal_it_bit_by_bit():
    sensor = CountingSPAD(0.5, 100.0, 35e-9, 3)
    light = np.full((3, 2, 8, 10), 1.5)
    codes, found, who = sample(sensor, light, EXPOSURE, frame_time=EXPOSURE, key=KEY, memory=Memory(carry=True))
    assert who == "closed form"
    assert 0 < found.largest < 1e-3
    np.testing.assert_array_equal(codes, sensor.sample(light.sum(axis=1), EXPOSURE, key=KEY))


def test_large_effects_are_reported_and_photons_are_followed():
    sensor = counter(0.2, bits=3)
    light = np.zeros((2, 4, 3, 5))
    light[:, 0] = 4.0
    codes, found, who = sample(sensor, light, EXPOSURE, frame_time=EXPOSURE, key=KEY)
    assert who == "events"
    assert found.varying_flux == pytest.approx(0.2 * 4 * 3)  # c^2 = 3 for one slice of four
    assert codes.dtype == np.uint8
    assert codes.max() <= 2
    assert "varying flux 2.4" in str(found)


def test_a_crop_has_the_codes_of_the_frame():
    sensor = counter(0.3, bits=3)
    light = np.random.default_rng(0).uniform(0, 3, (4, 2, 5, 6))
    memory = Memory(carry=True, afterpulse=0.1, afterpulse_delay=EXPOSURE)
    whole = sample(sensor, light, EXPOSURE, frame_time=2 * EXPOSURE, key=KEY, memory=memory)[0]
    crop = sample(
        sensor, light[:, :, 2:, 1:4], EXPOSURE, frame_time=2 * EXPOSURE, key=KEY, memory=memory, origin=(2, 1)
    )[0]
    np.testing.assert_array_equal(crop, whole[:, 2:, 1:4])
    assert (whole[0] != whole[1]).any()


@pytest.mark.parametrize(("arrivals", "share"), [(1.0, 0.05), (2.0, 0.03)])
def test_the_stated_effects_are_those_found(arrivals, share):
    """To leading order: within 30 % of the difference of simulated means, whose error follows from n and sigma."""
    frames = 40_000
    sensor = counter(share)
    light = np.tile([2 * arrivals, 0.0], (frames, 1))
    stated = effects(sensor, light[:1], EXPOSURE, EXPOSURE, NO_MEMORY)
    expected = float(sensor.mean(np.array(2 * arrivals), EXPOSURE))
    found = 1 - counts(sensor, light).mean() / expected
    error = 5 * np.sqrt(2 * arrivals / frames) / expected
    assert stated.varying_flux == pytest.approx(found, abs=0.3 * found + error)


@pytest.mark.parametrize(("arrivals", "share"), [(0.5, 0.05), (8.0, 0.25), (30.0, 0.1), (1.5e3, 0.01)])
def test_the_stated_loss_of_a_paralyzable_pixel_is_exact(arrivals, share):
    """Beside the mean count of the closed form; with carried dead times n exp(-x) remain. It was far too small."""
    sensor = counter(share, bits=8, paralyzable=True)
    stated = effects(sensor, np.full((1, 1), arrivals), EXPOSURE, EXPOSURE, Memory(carry=True)).carried_dead_time
    carried = arrivals * np.exp(-arrivals * share)
    assert stated == pytest.approx(float(sensor.mean(np.array(arrivals), EXPOSURE)) / carried - 1, rel=1e-6)


def test_bright_paralyzable_pixels_are_followed():
    """300 000 photons: all dead times of 1e-4 exposures overlap, and only a new start of each frame counts one."""
    sensor = CountingSPAD(1.0, 0.0, 1e-4 * EXPOSURE, 8, True)
    bright = np.full((1, 1), 1.5e5)
    assert effects(sensor, bright, EXPOSURE, EXPOSURE, Memory(carry=True)).largest > TOLERANCE
    assert effects(sensor, 1e3 * bright, EXPOSURE, EXPOSURE, Memory(carry=True)).largest < np.inf
    assert effects(sensor, 0 * bright, EXPOSURE, EXPOSURE, Memory(carry=True)).largest == 0


def test_light_that_varies_changes_a_bright_paralyzable_pixel_by_no_more_than_is_stated():
    """Half an exposure each at n (1 + c) and n (1 - c): r exp(-r tau) gives cosh(c x) - c sinh(c x)."""
    n = 1e5
    x = 8.0
    c = 0.05
    sensor = counter(x / n, bits=8, paralyzable=True)
    light = np.array([[n / 2 * (1 + c), n / 2 * (1 - c)]])
    stated = effects(sensor, light, EXPOSURE, EXPOSURE, NO_MEMORY).varying_flux
    found = np.cosh(c * x) - c * np.sinh(c * x) - 1
    assert found <= stated < 2 * found


def test_no_effect_without_dead_time_gap_or_memory():
    light = np.random.default_rng(0).uniform(0, 3, (4, 3, 2, 2))
    assert effects(counter(0.0), light, EXPOSURE, EXPOSURE, Memory(carry=True)) == Effects(0.0, 0.0, 0.0)
    assert effects(counter(0.2), light, EXPOSURE, 1.3 * EXPOSURE, Memory(carry=True)).carried_dead_time == 0
    assert effects(counter(0.2), light, EXPOSURE, EXPOSURE, NO_MEMORY).carried_dead_time == 0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"afterpulse": 1.0}, "Memory.afterpulse must be a probability below 1, got 1.0"),
        ({"afterpulse": 0.1}, "Memory.afterpulse_delay must be in seconds and above 0, got 0.0"),
    ],
)
def test_impossible_memories_are_refused(arguments, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        Memory(**arguments)


def test_wrong_light_is_refused():
    sensor = counter(0.1)
    light = np.ones((2, 1, 3, 3))
    light[1, 0, 2, 0] = np.nan
    with pytest.raises(ValueError, match=re.escape("photons[1, 0, 2, 0] is nan")):
        sample(sensor, light, EXPOSURE, frame_time=EXPOSURE, key=KEY)
    with pytest.raises(ValueError, match="must be at least the exposure"):
        sample(sensor, np.ones((2, 1, 3, 3)), EXPOSURE, frame_time=EXPOSURE / 2, key=KEY)
    with pytest.raises(ValueError, match=re.escape("[T, slices, H, W], got [3, 3]")):
        sample(sensor, np.ones((3, 3)), EXPOSURE, frame_time=EXPOSURE, key=KEY)


def test_dead_pixels_of_counters_stay_dead_when_followed():
    maps = Maps(dead=np.arange(20).reshape(4, 5) % 2 == 0)
    sensor = CountingSPAD(0.5, 10.0, 1e-4, 3)
    array = PixelArray(sensor, maps, Defects(carry_dead_time=True))
    counts = follow(array, lambda t, y, rows: np.full((1, rows, 5), 20.0), (3, 4, 5), 5e-4, 5e-4, Key(0, 0))
    assert not counts[:, maps.dead].any()
    assert counts[:, ~maps.dead].all()


def test_followed_counts_have_crosstalk_as_those_of_the_closed_form():
    """Every count sends Binomial(1, c) to each of four neighbours: inside, the mean grows by 4 c; dead pixels stay."""
    c = 0.05
    mean = 3.0
    shape = (4, 30, 31)
    maps = Maps(dead=np.zeros(shape[1:], bool))
    maps.dead[0, 7] = True
    array = PixelArray(CountingSPAD(1.0, 0.0, 0.0, 8), maps, Defects(crosstalk=c))
    codes = follow(array, lambda t, y, rows: np.full((1, rows, 31), mean), shape, EXPOSURE, EXPOSURE, KEY)
    total = mean * (1 + 4 * c)
    assert_mean(codes[:, 2:-1, 1:-1].astype(float), total, total * (1 + 8 * c + 12 * c**2))
    assert not codes[:, 0, 7].any()


def test_events_of_pixels_with_crosstalk_are_refused():
    array = PixelArray(counter(0.1), defects=Defects(crosstalk=0.1))
    events = trace(array, lambda t, y, rows: np.ones((1, rows, 3)), (1, 2, 3), EXPOSURE, EXPOSURE, KEY)
    with pytest.raises(ValueError, match="crosstalk: its detections have no times; leave it out"):
        next(events)


def test_following_photons_tells_each_row():
    """87 s passed without a word; codes do not depend on rows being drawn one by one."""
    sensor = CountingSPAD(pde=0.5, dark_count_rate=100.0, dead_time=1e-5, bits=8)
    array = PixelArray.of(Defects(), sensor, 5, 4)
    light = np.random.default_rng(0).uniform(0, 20, (3, 1, 5, 4))
    told: list[tuple[int, int]] = []
    whole = follow(
        array,
        lambda t, y, n: light[t, :, y : y + n],
        (3, 5, 4),
        1e-3,
        2e-3,
        Key(seed=1, clip=2),
        progress=lambda *done: told.append(done),
    )
    assert told == [(y, 5) for y in range(1, 6)]
    rest = PixelArray.of(Defects(), sensor, 3, 4, (2, 0))
    below = follow(
        rest, lambda t, y, n: light[t, :, 2 + y : 2 + y + n], (3, 3, 4), 1e-3, 2e-3, Key(seed=1, clip=2), (2, 0)
    )
    np.testing.assert_array_equal(whole[:, 2:], below)
