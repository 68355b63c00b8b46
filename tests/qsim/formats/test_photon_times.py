"""Photon times: the counts of their stream, exact dead times, laws of waiting, clocked codes, damaged files."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip
from hostile import VALUES, one_line
from scipy.stats import kstest
from stats import assert_histogram, assert_share

from qsim.cli.program import main
from qsim.formats import importing, photon_times
from qsim.formats.recording import Hints
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.spad import BinarySPAD
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons
from qsim.streams.rows import Rows
from qsim.streams.stream import Stream

EXPOSURE = 5e-4
FALSE_ALARM = 1e-6


def followed(clip: Clip, sensor: CountingSPAD, ppp: float, **more) -> Stream:
    return clip.sense(sensor, ppp=ppp, name="p", follow=True, force=True, **more)


def static(path: Path, frames: int, height: int, width: int) -> Clip:
    return write_clip(path, radiance=np.ones((frames, height, width)), sharp=False)


def moving(path: Path) -> Clip:
    return write_clip(path, frames=5, height=6, width=7)


@pytest.mark.parametrize("case", range(8))
def test_counts_are_the_codes_and_dead_times_hold_exactly(tmp_path, case: int):
    """Random dead times (both kinds), afterpulses and carried dead time, one and two slices, on a moving scene."""
    rng = np.random.default_rng([5, case])
    dead = EXPOSURE * 10 ** rng.uniform(-3, -0.7)
    sensor = CountingSPAD(rng.uniform(0.2, 0.9), 500.0, dead, int(rng.integers(2, 9)), paralyzable=bool(case % 2))
    text = "[defects]\ncarry_dead_time = true\nafterpulse = 0.2\nafterpulse_delay = 2e-5\n" if case % 4 > 1 else ""
    (tmp_path / "d.toml").write_text(text or "[defects]\n")
    clip = moving(tmp_path / "c")
    stream = followed(clip, sensor, 9.0, defects=str(tmp_path / "d.toml") if text else None, slices=1 + case // 4)
    assert stream.info.drawn_by == "events"
    assert photon_times.write(stream, tmp_path / "p.npz") > 100
    found = photon_times.read(tmp_path / "p.npz")
    np.testing.assert_array_equal(np.minimum(found.counts(), sensor.levels - 1), stream.codes())
    for y, x in np.ndindex(*found.shape[1:]):
        gaps = np.diff(found.detections(y, x)) if text else found.intervals(y, x)
        assert (gaps >= dead * (1 - 1e-9)).all()
    first = found.first_photons()
    assert (np.isnan(first) == (found.counts() == 0)).all()
    known = first[~np.isnan(first)]
    assert ((known >= -1e-12) & (known <= stream.exposure * (1 + 1e-9))).all()


def test_times_are_those_of_a_renewal_process(tmp_path):
    """Static light: first photons are exponential within the exposure, and intervals are, beyond the dead time."""
    dead = EXPOSURE / 100
    sensor = CountingSPAD(1.0, 0.0, dead, 16)
    clip = static(tmp_path / "c", 4, 12, 13)
    photon_times.write(followed(clip, sensor, 40.0), tmp_path / "p.npz")
    found = photon_times.read(tmp_path / "p.npz")
    rate = 40.0 / EXPOSURE
    first = found.first_photons().ravel()
    assert kstest(first, "expon", args=(0, 1 / rate)).pvalue > FALSE_ALARM
    early = np.concatenate([found.intervals(y, x)[:8] for y, x in np.ndindex(12, 13)])  # long ones are not cut off
    assert kstest(early - dead, "expon", args=(0, 1 / rate)).pvalue > FALSE_ALARM
    assert kstest(early, "expon", args=(0, 1 / rate)).pvalue < FALSE_ALARM, "the dead time would be noticed"


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_clocked_codes_have_the_law_of_the_clocked_sensor(tmp_path, bits: int):
    """Static light, a long dead time: codes of the same photons are those of BinarySPAD; planes are independent."""
    sensor = CountingSPAD(0.5, 800.0, EXPOSURE / 5, 4)
    clip = static(tmp_path / "c", 6, 15, 17)
    photon_times.write(followed(clip, sensor, 6.0), tmp_path / "p.npz")
    codes = importing.read(tmp_path / "p.npz", Hints(bits=bits)).read(0, 6)
    light = clip_photons(clip, 0, clip.stream("p").photons_factor)
    pmf = BinarySPAD(0.5, 800.0, bits).pmf(light[:1, :1], EXPOSURE)[0, 0]
    assert_histogram(codes.ravel(), pmf)
    planes = photon_times.read(tmp_path / "p.npz").clocked(2**bits - 1)
    p = 1 - pmf[0] ** (1 / (2**bits - 1))
    neighbours = planes[1:] & planes[:-1]
    assert_share(int(neighbours.sum()), neighbours.size, p * p, false_alarm=1e-9)


def test_the_clocked_sensor_ignores_dead_time_and_afterpulses(tmp_path):
    """By hand: an arrival while the counter is dead fires a plane, a released carrier does not."""
    times = np.array([1e-5, 2e-5, 3e-4, 6.5e-4])
    kind = np.array([1, 0, 3, 1], np.uint8)
    found = photon_times.PhotonTimes((2, 1, 1), 5e-4, 2000.0, times, kind, np.array([0, 4]))
    assert found.counts().ravel().tolist() == [2, 1]
    assert found.clocked(1).ravel().tolist() == [True, True]
    assert found.clocked(5).reshape(2, 5).astype(int).tolist() == [[1, 0, 0, 0, 0], [0, 1, 0, 0, 0]]
    np.testing.assert_allclose(found.first_photons().ravel(), [1e-5, 1.5e-4])
    np.testing.assert_allclose(found.intervals(0, 0), [2.9e-4])
    with pytest.raises(ValueError, match=r"pixel \(0, 1\) does not exist"):
        found.detections(0, 1)


def test_codes_that_were_not_followed_have_no_times(tmp_path, capsys):
    clip = moving(tmp_path / "c")
    clip.sense(CountingSPAD(0.5, 10.0, 0.0, 4), ppp=3.0, name="closed")
    assert clip.stream("closed").info.drawn_by == "closed form"
    assert main(["convert", str(clip.path / "streams" / "closed.json"), str(tmp_path / "x.npz")]) == 2
    said = capsys.readouterr().err
    assert "were not drawn photon by photon; sense a CountingSPAD with --follow" in said
    assert not list(tmp_path.glob("x*"))


def test_one_command_writes_times_and_another_reads_clocked_codes(tmp_path, capsys):
    clip = moving(tmp_path / "c")
    followed(clip, CountingSPAD(0.5, 10.0, 1e-6, 4), 5.0)
    assert main(["convert", str(clip.path / "streams" / "p.json"), str(tmp_path / "p.npz")]) == 0
    assert json.loads((tmp_path / "p.npz.json").read_text())["events"] > 0
    words = ["convert", str(tmp_path / "p.npz"), str(tmp_path / "clocked"), "--frame-rate", "2000"]
    assert main([*words, "--bits", "2"]) == 0
    assert Stream.open(tmp_path / "clocked.json").bits == 2
    assert main([*words, "--bits", "9", "--force"]) == 2
    assert "1 to 8 are made of photon times" in capsys.readouterr().err


def test_rates_in_the_file_are_used_and_none_may_contradict(tmp_path, capsys):
    meta = {"format": photon_times.FORMAT, "shape": [2, 4, 4], "exposure": 4e-4, "frame_rate": 1e3}
    text = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    kind = np.ones(16, np.uint8)
    np.savez(tmp_path / "p.npz", times=np.linspace(0, 3e-4, 16), kind=kind, first=np.arange(17), meta=text)
    words = ["convert", str(tmp_path / "p.npz"), str(tmp_path / "clocked"), "--bits", "2", "--force"]
    for agreeing in ([], ["--frame-rate", "1000"], ["--exposure", "4e-4", "--frame-rate", "1e3"]):
        assert main([*words, *agreeing]) == 0
        assert "at 1000 per second, exposure 400 us" in capsys.readouterr().out
        stream = Stream.open(tmp_path / "clocked.json")
        assert (stream.info.frame_rate, stream.exposure) == (1e3, 4e-4)
    for other, said in [
        (["--frame-rate", "2000"], "--frame-rate 2000: photon times state 1000; leave it out"),
        (["--exposure", "1e-3"], "--exposure 0.001: photon times state 0.0004; leave it out"),
    ]:
        assert main([*words, *other]) == 2
        assert said in capsys.readouterr().err


def test_rows_at_their_own_time_are_stated(tmp_path):
    """In the file, and in the description of the codes that are read from it."""
    rows = {"row_delay": 5e-5, "row_order": "up"}
    photon_times.write(
        followed(moving(tmp_path / "c"), CountingSPAD(0.5, 10.0, 1e-6, 4), 5.0, **rows), tmp_path / "p.npz"
    )
    assert photon_times.read(tmp_path / "p.npz").rows == Rows(5e-5, "up")
    assert main(["convert", str(tmp_path / "p.npz"), str(tmp_path / "clocked")]) == 0
    source = Stream.open(tmp_path / "clocked.json").info.source
    assert (source.format, source.row_delay, source.row_order) == ("photon times", 5e-5, "up")


def test_damaged_files_are_refused_in_one_line(tmp_path):
    clip = moving(tmp_path / "c")
    photon_times.write(followed(clip, CountingSPAD(0.5, 10.0, 1e-6, 4), 5.0), tmp_path / "p.npz")
    good = (tmp_path / "p.npz").read_bytes()
    path = tmp_path / "q.npz"

    def refused(content: bytes) -> bool:
        path.write_bytes(content)
        try:
            found = photon_times.read(path)
        except ValueError as error:
            one_line(error, path)
            return True
        assert found.counts().shape == found.shape  # what is read is whole
        return False

    assert all(refused(good[:length]) for length in (0, 3, 100, len(good) // 2, len(good) - 1))
    rng = np.random.default_rng(1)
    wrong = 0
    for _ in range(200):
        changed = bytearray(good)
        changed[rng.integers(len(good))] ^= 1 << rng.integers(8)
        wrong += refused(bytes(changed))
    assert wrong > 150
    arrays = dict(np.load(tmp_path / "p.npz"))
    meta = json.loads(arrays["meta"].tobytes())
    for key in ("format", "shape", "exposure", "frame_rate", "rows"):
        for value in VALUES:
            right = not isinstance(value, bool) and isinstance(value, int | float) and 1e-30 <= value <= 1e30
            if key in ("exposure", "frame_rate") and right:  # another clock, of which a file can be
                continue
            text = np.frombuffer(json.dumps(meta | {key: value}).encode(), np.uint8)
            packed = io.BytesIO()
            np.savez(packed, **(arrays | {"meta": text}))
            assert refused(packed.getvalue()), (key, value)
    for name, array in (
        ("times", arrays["times"][::-1]),
        ("times", arrays["times"] + 1),
        ("times", arrays["times"] * np.nan),
        ("kind", arrays["kind"] + np.uint8(8)),
        ("kind", arrays["kind"][1:]),
        ("first", arrays["first"][:-1]),
        ("first", arrays["first"] + 1),
        ("times", arrays["times"].astype(np.float32)),
    ):
        packed = io.BytesIO()
        np.savez(packed, **(arrays | {name: array}))
        assert refused(packed.getvalue()), name
