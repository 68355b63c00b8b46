"""Calibration of a QIS: units, undetermined directions, hot pixels, warnings and refused data."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import QISCase, statistics_of

from qsim.calibration.frame_statistics import measure
from qsim.calibration.qis import calibrate_qis
from qsim.calibration.spad import calibrate_spad

SMALL = QISCase(frames=10, side=16)


def noise(frames: int = 8, top: int = 8, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, top, (frames, 6, 7))


@pytest.mark.parametrize("darks", [1, 2])
def test_the_unit_of_time_scales_every_result_exactly(darks):
    """The same frames stated at 2^-20 ... 2^14 times their exposure: only the dark current scales, bit for bit."""
    rng = np.random.default_rng(1)
    dark, flat = replace(SMALL, gain=1.0, read_noise=2.0, offset=20.0, frames=6).stacks(rng)
    dark = dark[:darks]
    found = []
    for factor in (1.0, 2.0**-20, 2.0**14):
        stated = [[replace(s, exposure=s.exposure * factor) for s in stacks] for stacks in (dark, flat)]
        values = calibrate_qis(*stated, bits=8).values
        scales = {"dark_current": factor, "dark_current_transfer": factor}
        found.append({name: np.array([v.value, v.low, v.high]) * scales.get(name, 1.0) for name, v in values.items()})
    for other in found[1:]:
        assert other.keys() == found[0].keys()
        for name, numbers in found[0].items():
            np.testing.assert_array_equal(other[name], numbers, err_msg=name)


def test_an_undetermined_dark_current_has_a_wide_interval_and_a_sentence():
    """An ordinary camera with one dark exposure: 0.8 e- under 4 e- of read noise."""
    rng = np.random.default_rng(2)
    case = QISCase(gain=0.4, offset=60, read_noise=4, dark_current=800, bits=12, frames=8, side=16, exposures=(1e-3,))
    darks, flats = replace(case, lights=(100.0, 400.0, 1500.0)).stacks(rng)
    found = calibrate_qis(darks, flats, bits=12)
    current = found.values["dark_current"]
    assert current.low == 0
    assert current.high > 800
    assert any(words.startswith("dark current: these data do not tell it from 0") for words in found.warnings)


@pytest.mark.slow
def test_read_noise_below_rounding_is_bounded():
    """One code per electron: the read noise is not told from 0, gain and offset have intervals of some width."""
    rng = np.random.default_rng(3)
    case = QISCase(gain=1, offset=0, read_noise=0.1, dark_current=1.6, prnu=0, bits=3, frames=10, side=20)
    darks, flats = replace(case, lights=(0.5, 1.0, 1.8), exposures=(1e-3, 0.5)).stacks(rng)
    values = calibrate_qis(darks, flats, bits=3).values
    assert values["read_noise"].low == 0
    assert values["read_noise"].high > 0.1
    assert "gain_transfer" not in values
    for name in ("gain", "offset", "dark_current"):
        assert values[name].high - values[name].low > 1e-3, name


def test_hot_pixels_change_no_estimate():
    """Twelve pixels at 30 times the dark current or saturated: the result is nearly that of the others alone."""
    darks = []
    flats = []
    rng = np.random.default_rng(4)
    hot = np.random.default_rng(5).random((20, 20)) < 0.03
    for kind, light, exposure in ((darks, 0, 1e-3), (darks, 0, 5e-2), (flats, 2, 1e-3), (flats, 6, 1e-3)):
        expected = np.full((20, 20), light + 20 * exposure)
        expected[hot] += 29 * 20 * exposure
        expected[np.argwhere(hot)[0][0], np.argwhere(hot)[0][1]] = 1e4
        electrons = rng.poisson(expected, (10, 20, 20)) + 0.25 * rng.standard_normal((10, 20, 20))
        codes = np.clip(np.rint(8 * electrons + 40), 0, 255).astype(np.uint8)
        kind.append(measure([codes], bits=8, exposure=exposure, photons=0.0 if kind is darks else None))
    found = calibrate_qis(darks, flats, bits=8)
    assert not any("model is wrong" in words for words in found.warnings)
    assert found.values["prnu_left_out"].value >= hot.sum()
    for name, truth in {"gain": 8, "offset": 40, "read_noise": 0.25, "dark_current": 20}.items():
        value = found.values[name]
        assert abs(value.value - truth) < 3 * (value.high - value.low), name  # 12 standard errors


def test_clear_data_have_no_warning():
    found, _ = SMALL.calibrate(np.random.default_rng(2))
    assert not found.warnings


def test_all_zero_darks_of_a_qis_are_refused():
    with pytest.raises(ValueError, match="every code of dark 0 is 0"):
        calibrate_qis([statistics_of(noise() * 0)], [statistics_of(noise(), photons=None)], bits=3)


def test_saturated_flats_are_refused_or_announced():
    with pytest.raises(ValueError, match="every code of flat 0 is 7"):
        calibrate_qis([statistics_of(noise(top=3))], [statistics_of(noise() * 0 + 7, photons=None)], bits=3)
    dark = statistics_of(noise(40, 2) * 0, 1)
    full = noise(40, 2) * 0 + 1
    planes = noise(40, 2) % 2
    with pytest.raises(ValueError, match="all frames of flat 0 are alike"):
        calibrate_spad([dark], [statistics_of(full, 1, 3.0)], bits=1)
    planes[:, :3] = 1
    found = calibrate_spad([dark], [statistics_of(planes, 1, 3.0)], bits=1)
    assert any("saturated in every frame" in words for words in found.warnings)
    assert any("efficiency is not printed" in words for words in found.warnings)
    assert "pde_fill" not in found.values


def test_one_frame_is_refused_with_the_cure():
    with pytest.raises(ValueError, match="take at least 2 frames"):
        calibrate_qis([statistics_of(noise(1))], [statistics_of(noise(1, seed=1), photons=None)], bits=3)


def test_flats_darker_than_the_darks_are_refused():
    with pytest.raises(ValueError, match="are dark and flat frames swapped"):
        calibrate_qis([statistics_of(noise(top=8))], [statistics_of(noise(top=3), photons=None)], bits=3)


def test_calibration_without_frames_is_refused():
    with pytest.raises(ValueError, match="no frames at all"):
        calibrate_spad([], [], bits=1)
    with pytest.raises(ValueError, match="no flat frames"):
        calibrate_qis([statistics_of(noise())], [], bits=3)
