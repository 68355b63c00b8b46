"""Tests tables [defects] from files to streams: strict, off at zero, drawn as by PixelArray, replayed."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip

from qsim.cli import program
from qsim.keys import Key, hash_name
from qsim.sensor import devices
from qsim.sensor.defects import defect_table, event_simulation, fixed_pattern
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.streams.photons import clip_photons
from qsim.streams.preparation import assemble, prepare
from qsim.streams.sensing import Sensing
from qsim.streams.storing import replay, sense

BINARY = '[sensor]\nmodel = "BinarySPAD"\npde = 0.5\ndark_count_rate = 200.0\nbits = 1\n'
COUNTING = '[sensor]\nmodel = "CountingSPAD"\npde = 0.5\ndark_count_rate = 10.0\ndead_time = 5e-5\nbits = 3\n'
QUANTA = '[sensor]\nmodel = "QIS"\nquantum_efficiency = 0.8\ndark_current = 1.6\nread_noise = 0.2\nbits = 3\n'


def device(tmp_path: Path, sensor: str, table: str | None = None) -> str:
    path = tmp_path / "mine.toml"
    path.write_text(sensor + ("" if table is None else f"[defects]\n{table}\n"))
    return str(path)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return write_clip(tmp_path_factory.mktemp("clips") / "moving", frames=6, height=10, width=13)


def drawn(clip, sensor: str, **settings):
    return sense(clip, Sensing(sensor, ppp=2.0, name="test", **settings), force=True)


@pytest.mark.parametrize("sensor", [BINARY, COUNTING, QUANTA])
@pytest.mark.parametrize("table", [None, "", "device_seed = 9", "prnu = 0.0\ndead = 0\ncrosstalk = 0.0"])
def test_defects_that_are_off_change_no_bit_and_are_not_stored(clip, tmp_path, sensor, table):
    plain = drawn(clip, device(tmp_path, sensor))[0].codes()
    stream, _ = drawn(clip, device(tmp_path, sensor, table))
    np.testing.assert_array_equal(stream.codes(), plain)
    assert not stream.info.defects


def test_a_stream_holds_the_codes_that_the_device_draws(clip, tmp_path):
    """Maps, dead pixels and crosstalk: codes of `PixelArray.sample`, in one block or several, and in a replay."""
    table = "device_seed = 4\nprnu = 0.2\ndark = { spread = 0.3, hot_share = 0.1 }\ndead = 0.1\ncrosstalk = 0.05"
    sensor = device(tmp_path, BINARY, table)
    stream, _ = drawn(clip, sensor)
    found = fixed_pattern.FixedPattern(4, 0.2, fixed_pattern.DarkSpread(spread=0.3, hot_share=0.1), 0.1)
    light = np.stack([clip_photons(clip, t, stream.photons_factor) for t in range(6)])
    maps = fixed_pattern.draw_maps(found, (10, 13))
    array = PixelArray(devices.load(sensor), maps, defect_table.Defects(crosstalk=0.05))
    expected = array.sample(light, clip.exposure, key=Key(0, hash_name(clip.name)))
    np.testing.assert_array_equal(stream.codes(), expected)
    assert (expected != devices.load(sensor).sample(light, clip.exposure, key=Key(0, hash_name(clip.name)))).any()
    for frame in (0, 3):
        np.testing.assert_array_equal(*replay(clip, stream, frame))


def test_afterpulses_continue_across_blocks_and_in_a_replay(clip, tmp_path):
    sensor = device(tmp_path, BINARY, "afterpulse = 0.5")
    stream, _ = drawn(clip, sensor)
    draw = prepare(clip, Sensing(sensor, ppp=2.0))
    for step in (1, 2, 6):
        np.testing.assert_array_equal(np.concatenate(list(draw.blocks(clip, 0, 6, step))), stream.codes())
    assert (stream.codes() != drawn(clip, device(tmp_path, BINARY))[0].codes()).any()
    device(tmp_path, BINARY, "afterpulse = 0.5")
    stream, _ = drawn(clip, sensor)
    np.testing.assert_array_equal(*replay(clip, stream, 5))


def test_planes_of_a_sum_are_disturbed_one_by_one(clip, tmp_path):
    sensor = device(tmp_path, BINARY.replace("bits = 1", "bits = 2"), "afterpulse = 0.3\nprnu = 0.1")
    stream, _ = drawn(clip, sensor, bits=2, group=True)
    planes = prepare(clip, Sensing(device(tmp_path, BINARY, "afterpulse = 0.3\nprnu = 0.1"), ppp=2.0 / 3))
    np.testing.assert_array_equal(stream.codes(), planes.frames(clip, 0, 6).reshape(2, 3, 10, 13).sum(axis=1))


def test_measured_maps_are_used_checked_and_replayed(clip, tmp_path):
    """A dark map [1/s] larger than the frame: its mean is the sensor's rate, a hot pixel fires, a change is refused."""
    rates = np.full((12, 20), 10.0)
    rates[2, 3] = 1e7
    bad = np.zeros((12, 20), bool)
    bad[5, 6] = True
    np.save(tmp_path / "dark.npy", rates)
    np.save(tmp_path / "bad.npy", bad)
    stream, _ = drawn(clip, device(tmp_path, BINARY, 'dark_map = "dark.npy"\ndead_map = "bad.npy"'))
    assert stream.codes()[:, 2, 3].all()
    assert not stream.codes()[:, 5, 6].any()
    assert stream.sensor.dark_rate == pytest.approx(rates.mean())
    np.testing.assert_array_equal(*replay(clip, stream, 2))
    np.save(tmp_path / "dark.npy", rates + 1)
    with pytest.raises(ValueError, match="has changed since the stream was drawn"):
        replay(clip, stream, 2)
    np.save(tmp_path / "dark.npy", rates[:3])
    with pytest.raises(ValueError, match="the dark_map has 3 x 20 pixels, the frames 10 x 13"):
        drawn(clip, device(tmp_path, BINARY, 'dark_map = "dark.npy"'))


def test_light_that_changes_inside_an_exposure_is_followed_photon_by_photon(tmp_path):
    """Slices of one exposure: codes of `event_simulation.sample`; the effect is reported; one frame is replayed."""
    radiance = np.full((6, 4, 5), 0.01)
    radiance[::3] = 1.0
    clip = write_clip(tmp_path / "flash", radiance=radiance)
    sensor = device(tmp_path, COUNTING.replace("5e-5", "3e-4"), "carry_dead_time = true")
    stream, line = drawn(clip, sensor, slices=3)
    assert len(stream) == 2
    assert stream.exposure == pytest.approx(3 * clip.exposure)
    assert stream.info.drawn_by == "events"
    assert "varying flux" in line
    assert "photon by photon" in line
    light = np.stack([clip_photons(clip, t, stream.photons_factor) for t in range(6)]).reshape(2, 3, 4, 5)
    expected, found, who = event_simulation.sample(
        devices.load(sensor),
        light,
        3 * clip.exposure,
        frame_time=3 / 2000,
        key=Key(0, hash_name("flash")),
        memory=event_simulation.Memory(carry=True),
    )
    assert who == "events"
    assert vars(stream.info.dead_time_effects) == pytest.approx(vars(found))
    np.testing.assert_array_equal(stream.codes(), expected)
    np.testing.assert_array_equal(*replay(clip, stream, 1))


def test_followed_photons_have_crosstalk_too(clip, tmp_path):
    """It was stated as applied, and no code had it."""
    plain = drawn(clip, device(tmp_path, COUNTING), follow=True)[0].codes()
    stream, line = drawn(clip, device(tmp_path, COUNTING, "crosstalk = 0.2"), follow=True)
    assert "defects: crosstalk" in line
    assert stream.info.drawn_by == "events"
    assert (stream.codes() >= plain).all()
    assert stream.codes().mean() > 1.2 * plain.mean()
    np.testing.assert_array_equal(*replay(clip, stream, 3))


def test_effects_below_the_tolerance_take_the_closed_form(tmp_path):
    clip = write_clip(tmp_path / "still", radiance=np.ones((6, 4, 5)))
    sensor = device(tmp_path, COUNTING.replace("5e-5", "1e-9"), "carry_dead_time = true")
    stream, line = drawn(clip, sensor, slices=2)
    assert stream.info.drawn_by == "closed form"
    assert "closed form" in line
    light = np.stack([clip_photons(clip, t, stream.photons_factor) for t in range(6)]).reshape(3, 2, 4, 5)
    expected = devices.load(sensor).sample(light.sum(axis=1), 2 * clip.exposure, key=Key(0, hash_name("still")))
    np.testing.assert_array_equal(stream.codes(), expected)


@pytest.mark.parametrize(
    ("sensor", "table", "message"),
    [
        (BINARY, "prnuu = 0.1", "unknown key 'prnuu' (did you mean 'prnu'?)"),
        (BINARY, "prnu = -1", "[defects]: prnu is a number"),
        (BINARY, "crosstalk = 1.0", "crosstalk must be a probability below 1, got 1.0"),
        (BINARY, 'dark_map = "none.npy"', "none.npy: no such file"),
        (BINARY, "dark = { spreed = 1.0 }", "unknown key 'dark.spreed' (did you mean 'spread'?)"),
        (BINARY, "offset = 1.0", "a BinarySPAD has no read-out"),
        (BINARY, "carry_dead_time = true", "are for a CountingSPAD, this is a BinarySPAD"),
        (BINARY, "carry_dead_time = 1", "carry_dead_time: expected true or false, got 1"),
        (QUANTA, "crosstalk = 0.1", "a QIS has no avalanches"),
        (COUNTING, "afterpulse = 0.1", "needs afterpulse_delay in seconds"),
        (COUNTING, 'prnu = 0.1\ngain_map = "x.npy"', "prnu and gain_map state the same defect twice"),
    ],
)
def test_mistakes_are_named(clip, tmp_path, sensor, table, message):
    with pytest.raises((ValueError, OSError), match=re.escape(message)):
        drawn(clip, device(tmp_path, sensor, table))


@pytest.mark.parametrize(
    ("sensor", "table", "message"),
    [
        (QUANTA.replace("1.6", "0.0"), "dark.hot_share = 0.022", "dark spreads the sensor's dark rate, which is 0"),
        (QUANTA.replace("0.2", "0.0"), "read_noise = 0.1", "read_noise spreads the sensor's read noise, which is 0"),
    ],
)
def test_defects_that_would_change_nothing_are_refused(clip, tmp_path, sensor, table, message):
    """They were printed and stored as applied; a stream that was stored so is still drawn again."""
    path = device(tmp_path, sensor, table)
    with pytest.raises(ValueError, match=message):
        drawn(clip, path)
    assert assemble(clip, Sensing(path, ppp=2.0), defect_table.from_toml(path)).defects is not None


def test_the_command_takes_defects_for_any_sensor(clip, tmp_path, capsys):
    table = tmp_path / "bad.toml"
    table.write_text("[defects]\ndead = 0.3\n")
    arguments = ["sense", str(clip.path), "--ppp", "3", "--bits", "3", "-o", "dead", "--defects", str(table), "--json"]
    assert program.main(arguments) == 0
    json.loads(capsys.readouterr().out)
    never = ~clip.stream("dead").codes().any(axis=0)
    assert never.mean() > 0.1
    assert program.main(["sense", str(clip.path), "-o", "dead", "--replay", f"{clip.name}:4"]) == 0
