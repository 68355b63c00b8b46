"""Calibration: intervals hold the truth as often as promised, wrong models are noticed, hard data are refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stats import assert_share
from synthetic import CASES, COUNTER, Array, QISCase, SPADCase, coverage

from qsim.calibration.dead_time import calibrate_static, matched_variance
from qsim.calibration.frame_statistics import measure, measure_sums
from qsim.calibration.qis import calibrate_qis
from qsim.calibration.sensor_file import read_stack, sensor_of, write
from qsim.calibration.spad import calibrate_spad
from qsim.sensor import devices
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects import defect_table

DATA = Path(__file__).parents[2] / "data"


def test_one_calibration_of_each_kind_comes_near_the_truth():
    """Not coverage, but sanity: within eight half-widths, which a right program leaves once in 10^50 times."""
    rng = np.random.default_rng(5)
    for case in (QISCase(), SPADCase(), COUNTER):
        found, truth = case.calibrate(rng)
        for name, value in truth.items():
            v = found.values[name]
            assert abs(v.value - value) <= 8 * max(v.high - v.value, v.value - v.low), (name, v, value)


@pytest.mark.parametrize("name", ["resolved peaks"])
def test_quick_coverage(name):
    """30 calibrations: a coverage of 95 % is not told from 93 %, but a broken interval is."""
    hits, _ = coverage(CASES[name], 30, seed=1)
    for count in hits.values():
        assert_share(count, 30, 0.95, checks=len(hits))


@pytest.mark.slow
def test_intervals_cover_as_promised():
    """1000 calibrations of each case: every parameter within 93 ... 97 %, as docs/coverage.py shows it.

    Each parameter has at least 2000 intervals; one that covers 95 % leaves 93 ... 97 % once in 20,000 times.
    """
    hits: dict[str, list[int]] = {}
    for case in CASES.values():
        found, p_values = coverage(case, 1000, seed=7)
        for parameter, count in found.items():
            hits.setdefault(parameter, []).append(count)
        if not np.isnan(p_values[0]):
            assert_share(int(np.sum(np.array(p_values) < 0.05)), 1000, 0.05, false_alarm=1e-4)
    shares = {parameter: sum(counts) / (1000 * len(counts)) for parameter, counts in hits.items()}
    assert all(0.93 <= share <= 0.97 for share in shares.values()), shares


def prnu_hits(runs: int, seed: int) -> dict[str, list[bool]]:
    """Whether the interval holds the PRNU of random arrays, by readout."""
    hits: dict[str, list[bool]] = {}
    for i in range(runs):
        rng = np.random.default_rng([seed, i])
        array = Array.draw(rng)
        found = array.calibrate(rng).values["prnu"]
        hits.setdefault(array.readout, []).append(found.low <= array.prnu <= found.high)
    return hits


def test_quick_coverage_of_prnu():
    """40 small arrays of planes, of any PRNU, vignetting and share of hot pixels: 95 % is told from 65 %."""
    hits = []
    for i in range(40):
        rng = np.random.default_rng([11, i])
        array = replace(Array.draw(rng), readout="planes", light=0.6, side=14, frames=200)
        found = array.calibrate(rng).values["prnu"]
        hits.append(found.low <= array.prnu <= found.high)
    assert_share(sum(hits), len(hits), 0.95)
    with pytest.raises(AssertionError):
        assert_share(26, 40, 0.95)


@pytest.mark.slow
def test_prnu_intervals_cover_as_promised():
    """1000 random arrays: 1 ... 30 % PRNU, 0 ... 60 % vignetting, 0 ... 15 % hot pixels, 10 ... 40 pixels a side.

    2 ... 60 frames (20 ... 600 planes). A right interval leaves 93 ... 97 % once in 250 times.
    """
    hits = prnu_hits(1000, 12)
    share = np.mean([hit for one in hits.values() for hit in one])
    assert 0.93 <= share <= 0.97, share
    for one in hits.values():
        assert_share(sum(one), len(one), 0.95, false_alarm=1e-4, checks=len(hits))


@pytest.mark.parametrize("readout", ["qis", "planes", "counts"])
def test_hot_pixels_stay_out_of_prnu(readout):
    """15 % hot pixels hardly move PRNU, and more than double the spread of all pixels; both and the number are told."""
    array = Array(readout, 0.04, 0.3, (0.1, 0.0), 0.15, 30, 600 if readout == "planes" else 60, 1.0)
    found = array.calibrate(np.random.default_rng(0)).values
    prnu, everything, count = (found[name] for name in ("prnu", "prnu_with_hot_pixels", "prnu_left_out"))
    assert prnu.low <= 0.04 <= prnu.high
    assert everything.low > 0.08
    hot = 0.15 * 900
    assert abs(count.value - hot) < 5 * np.sqrt(hot)
    assert count.unit == "of 900 pixels"
    assert 0.02 < found["shading"].value < 0.15


def test_clean_arrays_lose_no_pixel():
    array = Array("planes", 0.1, 0.5, (0.0, 0.0), 0.0, 24, 300, 0.6)
    found = array.calibrate(np.random.default_rng(1)).values
    assert found["prnu_left_out"].value == 0
    assert "prnu_with_hot_pixels" not in found


def test_without_darks_the_flat_tells_hot_pixels():
    """Bright ones only, and a warning says by which rule."""
    array = Array("counts", 0.03, 0.3, (0.0, 0.0), 0.0, 24, 40, 2.0)
    rng = np.random.default_rng(2)
    clean = array.calibrate(rng, darks=False)
    assert clean.values["prnu_left_out"].value == 0
    flat = rng.poisson(2.0 * (1 + 0.03 * rng.standard_normal((24, 24))), (40, 24, 24))
    flat[:, 3, 4] += 40
    flat[:, 7, 9] += 15
    found = calibrate_spad([], [measure([flat], bits=7, exposure=1e-3, photons=None)], bits=7, dead_time=False)
    assert found.values["prnu_left_out"].value == 2
    assert found.values["prnu"].low <= 0.03 <= found.values["prnu"].high
    assert any("left out of PRNU as hot by the flat: 6 robust sigmas" in words for words in found.warnings)


@pytest.mark.parametrize("correlation", [-1.0, 0.0, 1.0])
def test_dark_pattern_that_follows_the_light_does_not_bias_prnu(correlation):
    """Dark counts that rise (or fall) with a pixel's efficiency: variances do not subtract, the pixels' own levels do.

    4 % PRNU and 1.2 % dark spread gave sqrt(4^2 +- 2 x 4 x 1.2) = 5.1 % and 2.5 % where only variances were subtracted.
    """
    rng = np.random.default_rng(4)
    pattern, other = rng.standard_normal((2, 60, 60))
    light, dark = 0.1 * (1 + 0.04 * pattern), 0.004 + 0.0012 * (pattern if correlation else other) * (correlation or 1)
    ones = [
        rng.binomial(60000, -np.expm1(-arrivals)) for arrivals in (np.maximum(dark, 0), light + np.maximum(dark, 0))
    ]
    stacks = [measure_sums([count], planes=60000, exposure=1e-5, photons=None) for count in ones]
    value = calibrate_spad(stacks[:1], stacks[1:], bits=1).values["prnu"]
    assert value.low <= 0.04 <= value.high
    assert value.high - value.low < 0.003


def test_ignored_dead_time_is_flagged_and_the_right_model_is_not():
    rng = np.random.default_rng(3)
    right, _ = COUNTER.calibrate(rng)
    wrong, _ = COUNTER.calibrate(rng, ignore_dead_time=True)
    assert right.p_value > 1e-4
    assert wrong.p_value < 1e-6
    assert any("the model is wrong" in words for words in wrong.warnings)


def test_hidden_peaks_are_announced():
    found, _ = QISCase(read_noise=0.8, frames=10, side=16).calibrate(np.random.default_rng(2))
    assert any("hides the electron peaks" in words for words in found.warnings)
    clear, _ = QISCase(frames=10, side=16).calibrate(np.random.default_rng(2))
    assert not clear.warnings


@pytest.mark.parametrize("paralyzable", [False, True])
def test_matched_variance_inverts_the_exact_mean(paralyzable):
    sensor = CountingSPAD(1.0, 0.0, 0.05, 6, paralyzable)
    arrivals = 4.2
    mean = float(sensor.mean(np.array(arrivals), 1.0))
    found, variance, slope = matched_variance(mean, 6, 0.05, paralyzable)
    assert found == pytest.approx(arrivals, rel=1e-7)
    assert variance == pytest.approx(float(sensor.variance(np.array(arrivals), 1.0)), rel=1e-6)
    h = 1e-3
    steps = [matched_variance(mean + sign * h, 6, 0.05, paralyzable)[1] for sign in (1, -1)]
    assert slope == pytest.approx((steps[0] - steps[1]) / (2 * h), rel=1e-3)


# Statistics, block by block


def test_blocks_do_not_matter():
    codes = np.random.default_rng(0).integers(0, 8, (11, 5, 7))
    whole = measure([codes], bits=3, exposure=1e-3, photons=None)
    parts = measure([codes[:1], codes[1:4], codes[4], codes[5:]], bits=3, exposure=1e-3, photons=None)
    for name in ("total", "square", "lagged", "histogram"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))
    assert whole.frames == parts.frames == 11
    assert whole.variance == pytest.approx(codes.var(axis=0, ddof=1).mean())
    centred = codes - codes.mean(axis=0)
    lag = (centred[1:] * centred[:-1]).sum(axis=0) / 10
    assert whole.lag_covariance == pytest.approx(lag.mean() + whole.variance / 11)


def test_float_frames_are_taken_if_whole():
    codes = np.random.default_rng(0).integers(0, 8, (3, 4, 5))
    assert np.array_equal(
        measure([codes.astype(np.float32)], bits=3, exposure=1.0, photons=0.0).total, codes.sum(axis=0)
    )
    with pytest.raises(ValueError, match=r"dark.npy: 0.5 at \(t, y, x\) = \(0, 0, 0\) is no code of 3 bits"):
        measure([np.full((1, 2, 2), 0.5, np.float32)], bits=3, exposure=1.0, photons=0.0, name="dark.npy")


def test_a_million_frames_take_no_more_memory():
    """The same block a thousand times: what is kept does not grow."""
    block = np.random.default_rng(0).integers(0, 2, (1000, 2, 3)).astype(bool)
    stack = measure((block for _ in range(1000)), bits=1, exposure=1e-5, photons=None)
    assert stack.frames == 1_000_000
    assert stack.mean == pytest.approx(block.mean())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"exposure": 0.0}, "exposure is in seconds and above 0"),
        ({"photons": -1.0}, "photons are a number of at least 0"),
    ],
)
def test_impossible_stacks_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        measure([np.zeros((2, 2, 2), int)], **({"bits": 3, "exposure": 1.0, "photons": 0.0} | change))


# Hard data


def stack(codes: np.ndarray, bits: int = 3, photons: float | None = 0.0):
    return measure([codes], bits=bits, exposure=1e-3, photons=photons)


def noise(frames: int = 8, top: int = 8, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, top, (frames, 6, 7))


def test_all_zero_darks_of_a_qis_are_refused():
    with pytest.raises(ValueError, match="every code of dark 0 is 0"):
        calibrate_qis([stack(noise() * 0)], [stack(noise(), photons=None)], bits=3)


def test_saturated_flats_are_refused_or_announced():
    with pytest.raises(ValueError, match="every code of flat 0 is 7"):
        calibrate_qis([stack(noise(top=3))], [stack(noise() * 0 + 7, photons=None)], bits=3)
    dark, flat = stack(noise(40, 2) * 0, 1), stack(noise(40, 2) * 0 + 1, 1, 3.0)
    found = calibrate_spad([dark], [flat], bits=1)
    assert any("saturated in every frame" in words for words in found.warnings)
    assert np.isfinite(found.values["pde_fill"].value)


def test_one_frame_is_refused_with_the_cure():
    with pytest.raises(ValueError, match="take at least 2 frames"):
        calibrate_qis([stack(noise(1))], [stack(noise(1, seed=1), photons=None)], bits=3)


def test_no_dark_count_gives_a_one_sided_bound():
    """No event in time t: the rate is below -ln(0.025)/t with 97.5 %."""
    found = calibrate_spad([stack(np.zeros((100, 6, 7), int), 1)], [], bits=1)
    rate = found.values["dark_count_rate"]
    assert (rate.value, rate.low) == (0.0, 0.0)
    assert rate.high == pytest.approx(-np.log(0.025) / (100 * 1e-3 * 42))


def test_one_hot_pixel_a_hundred_thousand_times_the_median():
    """It stands in the map and in the share of hot pixels, and leaves the median alone."""
    rng = np.random.default_rng(0)
    rate = np.full((20, 20), 1e-2)
    rate[3, 4] = 1e3  # per frame: always on
    planes = rng.random((400, 20, 20)) < -np.expm1(-rate)
    found = calibrate_spad([stack(planes, 1)], [], bits=1)
    assert np.unravel_index(np.argmax(found.maps["dark_count_rate"]), (20, 20)) == (3, 4)
    assert found.values["dark_count_rate_median"].value < 3e-2 / 1e-3
    assert found.values["hot_pixels"].value == pytest.approx(1 / 400)


def test_calibration_without_frames_is_refused():
    with pytest.raises(ValueError, match="no frames at all"):
        calibrate_spad([], [], bits=1)
    with pytest.raises(ValueError, match="no flat frames"):
        calibrate_qis([stack(noise())], [], bits=3)


# Real detectors


def test_real_photons_fano_one_at_low_flux_and_a_dead_time_near_four_nanoseconds():
    """Five scans of a hazelnut, 6.33 us per pixel. Known: effective dead time 4.0 +- 0.3 ns."""
    counts = np.load(DATA / "hazelnut_gates6.npz")["gates"].astype(np.int64).sum(axis=1)
    edges = (1, 5, 10, 20, 30, 40, 60, 100, 130)
    found = calibrate_static(counts, bits=8, exposure=6.33e-6, edges=edges)
    dead = found.values["dead_time"]
    assert dead.low < 4.0e-9 < dead.high
    assert dead.high - dead.low < 2e-9
    dim = found.values["fano_at_2.19"]
    assert dim.low < 1.0 < dim.high
    bright = found.values["fano_at_111"]
    assert bright.high < 0.9
    assert found.p_value > 1e-3


def test_real_dark_counts():
    """50 x 50 SPADs, 7650 planes of 10.3 us: median 127 counts/s, 1.0 % of the pixels above ten medians."""
    path = Path(__file__).parents[4] / "shared" / "data" / "spad512_darkcounts_YX.npy"
    if not path.exists():
        pytest.skip(f"{path.name} is not part of this repository")
    ones = np.rint(-np.expm1(-np.load(path)) * 7650)
    found = calibrate_spad([measure_sums([ones], planes=7650, exposure=10.3e-6, photons=0.0)], [], bits=1)
    median = found.values["dark_count_rate_median"]
    assert median.low < median.value
    assert median.value == pytest.approx(127, abs=1)
    for percent, known in ((1, 0.00039), (90, 0.00196), (99, 0.01343)):  # per frame, from the data's description
        found_there = found.values[f"dark_count_rate_p{percent}"]
        assert found_there.value * 10.3e-6 == pytest.approx(known, rel=0.02)
        assert found_there.low <= found_there.value <= found_there.high
    assert found.values["hot_pixels"].value == pytest.approx(0.010, abs=0.002)


def test_static_scene_without_dead_time_finds_none():
    rng = np.random.default_rng(0)
    light = np.geomspace(1, 120, 60)[:, None] * np.ones((1, 60))
    found = calibrate_static(rng.poisson(light, (6, 60, 60)), bits=8, exposure=1e-5)
    dead = found.values["dead_time"]
    assert dead.low == 0.0 or dead.low < 3e-9
    with pytest.raises(ValueError, match="at least 2 frames"):
        calibrate_static(rng.poisson(light, (1, 60, 60)), bits=8, exposure=1e-5)


# Files


def test_files_of_a_calibration_load_as_a_device(tmp_path):
    found, _ = SPADCase().calibrate(np.random.default_rng(4))
    path = tmp_path / "mine.toml"
    written = write(found, path, "a test")
    assert {p.suffix for p in written} == {".toml", ".json", ".png", ".npy"}
    loaded = devices.load(path)
    assert loaded == sensor_of(found)
    assert np.load(tmp_path / "mine_dark.npy").shape == (24, 24)
    assert defect_table.from_toml(path) is None
    path.write_text(path.read_text().replace("# [defects]", "[defects]").replace("# dark_map", "dark_map"))
    assert defect_table.from_toml(path).maps == {"dark_map": str(tmp_path / "mine_dark.npy")}


def test_frames_are_read_from_npy_and_from_a_photon_cube(tmp_path):
    planes = np.random.default_rng(0).integers(0, 2, (9, 5, 11)).astype(np.uint8)
    np.save(tmp_path / "codes.npy", planes)
    np.save(tmp_path / "cube.npy", np.packbits(planes, axis=-1))
    one = read_stack(tmp_path / "codes.npy", bits=1, exposure=1e-5, photons=None)
    two = read_stack(tmp_path / "cube.npy", bits=1, exposure=1e-5, photons=None, width=11)
    assert np.array_equal(one.total, planes.sum(axis=0))
    assert np.array_equal(one.total, two.total)
    with pytest.raises(FileNotFoundError, match=r"nothing\.npy"):
        read_stack(tmp_path / "nothing.npy", bits=1, exposure=1e-5, photons=None)
