"""Sensor files: a written file loads as a device; frames are read from several kinds of files."""

import numpy as np
import pytest
from clips import write_clip
from synthetic import SPADCase, statistics_of

from qsim.calibration.sensor_file import read_counts, read_stack, sensor_of, to_toml, write
from qsim.calibration.spad import calibrate_spad
from qsim.formats import photon_times
from qsim.formats.recording import Hints
from qsim.plane_sums import PlaneSums
from qsim.sensor import devices
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects import defect_table
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD


def test_files_of_a_calibration_load_as_a_device(tmp_path):
    found, _ = SPADCase().calibrate(np.random.default_rng(4))
    path = tmp_path / "mine.toml"
    written = write(found, path, "a test")
    assert {p.name for p in written} == {"mine.toml", "mine.json", "mine.png", "mine_dark.npy", "mine_hot.npy"}
    loaded = devices.load(path, bits=found.bits)
    assert loaded == sensor_of(found)
    assert "bits" not in path.read_text()
    assert np.load(tmp_path / "mine_dark.npy").shape == (24, 24)
    assert defect_table.from_toml(path) is None
    path.write_text(path.read_text().replace("# [defects]", "[defects]").replace("# dark_map", "dark_map"))
    assert defect_table.from_toml(path).maps == {"dark_map": str(tmp_path / "mine_dark.npy")}


def test_frames_are_read_from_npy_and_from_a_photon_cube(tmp_path):
    planes = np.random.default_rng(0).integers(0, 2, (9, 5, 11)).astype(np.uint8)
    np.save(tmp_path / "codes.npy", planes)
    np.save(tmp_path / "cube.npy", np.packbits(planes, axis=-1))
    one = read_stack(tmp_path / "codes.npy", bits=1, exposure=1e-5, photons=None)
    two = read_stack(tmp_path / "cube.npy", bits=1, exposure=1e-5, photons=None, hints=Hints(width=11))
    assert np.array_equal(one.total, planes.sum(axis=0))
    assert np.array_equal(one.total, two.total)
    with pytest.raises(FileNotFoundError, match=r"nothing\.npy"):
        read_stack(tmp_path / "nothing.npy", bits=1, exposure=1e-5, photons=None)


def test_the_packed_codes_of_a_stream_are_unpacked(tmp_path):
    """Every byte of a row of 12 bits per pixel was taken as a pixel, without a word."""
    clip = write_clip(tmp_path / "c", frames=4, height=5, width=11)
    stream = clip.sense(QIS(0.6, 100.0, 5.0, 12, 0.4), ppp=900.0, name="camera_900.5ppp")
    side = stream.path.with_suffix(".json")
    for path in (stream.path, side):
        found = read_stack(path, bits=12, exposure=5e-4, photons=None)
        assert np.array_equal(found.total, stream.codes().sum(axis=0, dtype=float))
        assert np.array_equal(found.last, stream.codes()[-1])
        assert np.array_equal(read_counts(path), stream.codes())
        for bits in (8, 13):
            with pytest.raises(ValueError, match=f"is a stream of 12 bits per code, not {bits}; give what it states"):
                read_stack(path, bits=bits, exposure=5e-4, photons=None)
            with pytest.raises(ValueError, match="is a stream of 12 bits"):
                read_counts(path, bits=bits)


def test_planes_of_a_stream_need_no_width(tmp_path):
    """Packed planes were taken as bytes, or read with the width; sums of planes are those that the stream states."""
    clip = write_clip(tmp_path / "c", frames=9, height=5, width=11)
    one = clip.sense(BinarySPAD(0.5, 200.0), ppp=0.7, name="one")
    sums = clip.sense(BinarySPAD(0.5, 200.0, 2), ppp=2.1, group=True, name="sums")
    for width in (None, 11):
        found = read_stack(one.path, bits=1, exposure=5e-4, photons=None, hints=Hints(width=width))
        assert np.array_equal(found.total, one.codes().sum(axis=0, dtype=float))
    with pytest.raises(ValueError, match="is a stream of 11 pixels per row, not 12; leave width= out"):
        read_stack(one.path, bits=1, exposure=5e-4, photons=None, hints=Hints(width=12))
    found = read_stack(sums.path, bits=1, exposure=5e-4, photons=None, sums=PlaneSums(summed=3))
    assert (found.frames, found.mean) == (9, pytest.approx(sums.codes().mean() / 3))


def test_photon_times_are_calibrated_as_the_counts_of_their_pixels(tmp_path):
    """Sums of clocked planes were read, which have the dead time of the clock; the exposure was not compared."""
    clip = write_clip(tmp_path / "c", frames=4, height=6, width=7)
    stream = clip.sense(CountingSPAD(0.5, 500.0, 2e-5, 8), ppp=40.0, name="p", follow=True)
    path = tmp_path / "p.npz"
    photon_times.write(stream, path)
    found = read_stack(path, bits=8, exposure=5e-4, photons=None)
    assert np.array_equal(found.total, stream.codes().sum(axis=0, dtype=float))
    assert np.array_equal(read_counts(path, bits=8, exposure=5e-4), stream.codes())
    few = read_stack(path, bits=3, exposure=5e-4, photons=None)
    assert np.array_equal(few.total, np.minimum(stream.codes(), 7).sum(axis=0, dtype=float))
    planes = photon_times.read(path).clocked(50)
    sums = read_stack(path, bits=1, exposure=1e-5, photons=None, sums=PlaneSums(summed=50))
    assert (sums.frames, sums.mean) == (200, pytest.approx(planes.mean()))
    fired = read_stack(path, bits=1, exposure=5e-4, photons=None)
    assert np.array_equal(fired.total, photon_times.read(path).clocked(1).sum(axis=0, dtype=float))
    for seconds, more, message in (
        (1e-3, {"bits": 8}, "an exposure of 0.001 s; the photon times state 0.0005 s, give that"),
        (
            5e-4,
            {"bits": 1, "sums": PlaneSums(summed=50)},
            "an exposure of 0.0005 s; the photon times state 1e-05 s, give that",
        ),
        (5e-4 / 300, {"bits": 1, "sums": PlaneSums(summed=300)}, "of photon times sums of at most 255 are made"),
        (5e-4, {"bits": 1, "hints": Hints(width=7)}, "width= changes nothing for photon times; leave it out"),
    ):
        with pytest.raises(ValueError, match=message):
            read_stack(path, exposure=seconds, photons=None, **more)


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


def test_a_stream_has_the_exposure_that_it_states(tmp_path):
    """Dark counts of codes of 0.5 ms were divided by the 1 ms that was typed."""
    clip = write_clip(tmp_path / "c", frames=8, height=6, width=7)
    stream = clip.sense("spad-320x240", ppp=1.0, bits=1, name="s")
    side = stream.path.with_suffix(".json")
    for path in (stream.path, side):
        with pytest.raises(ValueError, match=r"a stream of codes of 0\.0005 s, not of 0\.001 s; give what it states"):
            read_stack(path, bits=1, exposure=1e-3, photons=0.0)
    sums = clip.sense("spad-320x240", ppp=1.0, bits=3, name="sums")
    found = read_stack(sums.path, bits=3, exposure=5e-4 / 7, photons=0.0, sums=PlaneSums(summed=7))
    assert found.exposure == pytest.approx(5e-4 / 7)
    with pytest.raises(ValueError, match=r"is a stream of codes of 0\.0005 s"):
        read_stack(sums.path, bits=3, exposure=5e-4, photons=0.0, sums=PlaneSums(summed=7))
