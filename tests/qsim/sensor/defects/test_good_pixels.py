"""The dark rate of good pixels is theirs, and the defects that one response leaves out are named."""

from __future__ import annotations

import numpy as np
import pytest
from clips import write_clip
from sensor_files import QIS, SPAD, sensor_file

from qsim.sensor import devices
from qsim.sensor.defects import defect_table, good_pixels

# 1 % of the pixels are hot
PPP = 3.0
SIZE = (40, 40)
HOT = slice(None, None, 101)


def hot_stream(folder, more: str = "", model: str = QIS):
    """Return a stream of an even still field: 20 dark counts per second, hot pixels 100 in a frame of 0.5 ms."""
    rates = np.full(SIZE, 20.0)
    rates.flat[HOT] = 2e5
    np.save(folder / "rates.npy", rates)
    clip = write_clip(folder / "c", radiance=np.full((11, *SIZE), 0.5), relative=True)
    path = sensor_file(folder, f'{model}dark_map = "rates.npy"\n{more}', bits=4)
    return clip.sense(path, ppp=PPP, name="hot")


def test_light_of_good_pixels_is_found_beside_hot_ones(tmp_path):
    """Within five sigma of photon noise; the mean rate of all pixels makes it 1.2 of 3 photons too low."""
    stream = hot_stream(tmp_path)
    sensor, left = stream.good_pixels()
    assert left == "not inverted: dark rates of single pixels"
    assert sensor.dark_rate == pytest.approx(20.0)
    good = np.ones(SIZE, bool)
    good.flat[HOT] = False
    codes = stream.codes()[:, good]
    found = sensor.response(stream.exposure).invert(codes.mean(), codes.size)
    assert abs(found - PPP) < 5 * np.sqrt(PPP / sensor.efficiency * 1.3 / codes.size)  # with read noise and rounding
    assert abs(stream.sensor.response(stream.exposure).invert(codes.mean(), codes.size) - PPP) > 1


def test_the_rest_is_named(tmp_path):
    stream = hot_stream(tmp_path, "crosstalk = 0.05\ndead = 0.1\ndevice_seed = 3\n", SPAD)
    _, left = stream.good_pixels()
    assert left == "not inverted: crosstalk, dark rates of single pixels, dead"
    np.save(tmp_path / "rates.npy", np.ones(SIZE))
    sensor, left = stream.good_pixels()
    assert sensor == stream.sensor
    assert left.startswith("no defect is inverted: ")
    assert left.endswith("rates.npy has changed since the stream was drawn")


def test_a_stream_without_defects_keeps_its_sensor(tmp_path):
    stream = write_clip(tmp_path / "c", frames=2, height=6, width=7).sense("spad512s", ppp=1.0, name="s")
    assert stream.good_pixels() == (stream.sensor, "")


@pytest.mark.parametrize("origin", [(0, 0), (7, 3)])
def test_a_map_larger_than_the_frames_gives_the_rate_of_those_it_covers(tmp_path, origin):
    """Hot pixels lie outside of the frames alone: their dark counts were taken off everywhere, one per frame."""
    height = 20
    width = 24
    rates = np.full((60, 70), 2e5)
    rates[: origin[0] + height, : origin[1] + width] = 20.0
    np.save(tmp_path / "rates.npy", rates)
    table = defect_table.from_toml(sensor_file(tmp_path, f'{QIS}dark_map = "rates.npy"\n', bits=4))
    sensor = devices.load(tmp_path / "mine.toml")
    bad = good_pixels.defective(table, sensor, 5e-4, PPP, (height, width), origin)
    assert bad is None
    found = good_pixels.behind(bad, table, sensor, (height, width), origin)
    assert found.dark_rate == pytest.approx(20.0)
