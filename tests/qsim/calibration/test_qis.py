"""Calibration of a QIS: warnings and refused data."""

import numpy as np
import pytest
from synthetic import QISCase, statistics_of

from qsim.calibration.qis import calibrate_qis
from qsim.calibration.spad import calibrate_spad


def noise(frames: int = 8, top: int = 8, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, top, (frames, 6, 7))


def test_hidden_peaks_are_announced():
    found, _ = QISCase(read_noise=0.8, frames=10, side=16).calibrate(np.random.default_rng(2))
    assert any("hides the electron peaks" in words for words in found.warnings)
    clear, _ = QISCase(frames=10, side=16).calibrate(np.random.default_rng(2))
    assert not clear.warnings


def test_all_zero_darks_of_a_qis_are_refused():
    with pytest.raises(ValueError, match="every code of dark 0 is 0"):
        calibrate_qis([statistics_of(noise() * 0)], [statistics_of(noise(), photons=None)], bits=3)


def test_saturated_flats_are_refused_or_announced():
    with pytest.raises(ValueError, match="every code of flat 0 is 7"):
        calibrate_qis([statistics_of(noise(top=3))], [statistics_of(noise() * 0 + 7, photons=None)], bits=3)
    dark, full, planes = statistics_of(noise(40, 2) * 0, 1), noise(40, 2) * 0 + 1, noise(40, 2) % 2
    with pytest.raises(ValueError, match="all frames of flat 0 are alike"):
        calibrate_spad([dark], [statistics_of(full, 1, 3.0)], bits=1)
    planes[:, :3] = 1
    found = calibrate_spad([dark], [statistics_of(planes, 1, 3.0)], bits=1)
    assert any("saturated in every frame" in words for words in found.warnings)
    assert np.isfinite(found.values["pde_fill"].value)


def test_one_frame_is_refused_with_the_cure():
    with pytest.raises(ValueError, match="take at least 2 frames"):
        calibrate_qis([statistics_of(noise(1))], [statistics_of(noise(1, seed=1), photons=None)], bits=3)


def test_calibration_without_frames_is_refused():
    with pytest.raises(ValueError, match="no frames at all"):
        calibrate_spad([], [], bits=1)
    with pytest.raises(ValueError, match="no flat frames"):
        calibrate_qis([statistics_of(noise())], [], bits=3)
