"""The stream that training windows are cut from has the filled codes and the sensor of restoring."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_files import SPAD, sensor_file

from qsim.cli import main
from quiver.data.codes import codes_of, open_stream
from quiver.data.stream_windows import stream_at


def test_hot_pixels_of_an_imported_stream_are_filled(tmp_path):
    """Such a stream states no light; its dark rate is that of the good pixels."""
    dark = np.full((12, 14), 20.0)
    dark[5, 6] = 1e5
    np.save(tmp_path / "dark.npy", dark)
    np.save(tmp_path / "raw.npy", np.random.default_rng(0).integers(0, 4, (6, 12, 14), dtype=np.uint8))
    sensor = sensor_file(tmp_path, SPAD + 'dark_map = "dark.npy"\n', 3)
    words = ["convert", tmp_path / "raw.npy", tmp_path / "imported", "--sensor", sensor, "--frame-rate", "2000"]
    assert main([*map(str, words), "--layout", "codes", "--bits", "3"]) == 0
    path = tmp_path / "imported.npy"
    found = stream_at(path)
    assert found.defective is not None
    assert np.argwhere(found.defective).tolist() == [[5, 6]]
    assert found.sensor == codes_of(open_stream(path)).sensor
    assert found.sensor.dark_rate == pytest.approx(20.0)
