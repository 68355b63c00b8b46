"""Sensor files: a written file loads as a device; frames are read from several kinds of files."""

import numpy as np
import pytest
from synthetic import SPADCase, statistics_of

from qsim.calibration.sensor_file import read_stack, sensor_of, to_toml, write
from qsim.calibration.spad import calibrate_spad
from qsim.sensor import devices
from qsim.sensor.defects import defect_table


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


def test_parameters_that_were_not_measured_are_named():
    """A dead time of 0 was written without a word."""
    counts = np.random.default_rng(0).poisson(1.0, (6, 8, 9))
    found = calibrate_spad([statistics_of(counts, 8)], [], bits=8)
    assert any("dead time is not measured" in words for words in found.warnings)
    assert 'dead_time = "0, not measured"' in to_toml(found, "a test")
    ignored = calibrate_spad([statistics_of(counts, 8)], [], bits=8, dead_time=False)
    assert not any("dead time is not measured" in words for words in ignored.warnings)
    flat = calibrate_spad([], [statistics_of(counts, 8, None)], bits=8)
    assert 'dark_count_rate = "0, not measured"' in to_toml(flat, "a test")
