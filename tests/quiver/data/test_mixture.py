"""The noise of training windows follows the streams of the data set, and options replace it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clips import ClipMaker
from sensor_files import COUNTER, QIS, sensor_file

from qsim.sensor.counting import CountingSPAD
from qsim.streams.photons import clip_photons, light_level
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.cli.program import main
from quiver.data.clips import open_clips
from quiver.data.illumination import Illumination
from quiver.data.mixture import choose, describe
from quiver.data.windows import Windows, WindowSettings
from quiver.training.settings import Settings, settled


def lines(data: Path, out: Path, **asked: object) -> list[str]:
    return settled(Settings(str(data), str(out), steps=1, **asked))[1]


def test_the_streams_say_sensor_bits_light_and_defects(data, tmp_path):
    mixture = choose(open_clips(data, "train"))
    assert mixture.lines == ["noise: spad-320x240, 1 bit, 1 and 10 PPP, dark-count map"]
    assert lines(data, tmp_path / "r") == mixture.lines
    assert [(n.sensor, n.bits, n.ppp) for n in mixture.noises] == [("spad-320x240", 1, 1.0), ("spad-320x240", 1, 10.0)]
    assert "noise: spad-320x240, 1 bit, 1 and 10 PPP, dark-count map" in repr(
        Windows(open_clips(data, "train"), WindowSettings(crop=16))
    )


def test_a_data_set_without_streams_has_the_default_and_says_so(tiny_dataset, tmp_path):
    default = "noise: quiver-physical, 3 bits, 3.25 PPP (the default; the data set has no streams)"
    assert lines(tiny_dataset, tmp_path / "r") == [default]


@pytest.mark.parametrize(
    ("asked", "noise"),
    [
        ({"ppp": (5.0,)}, "spad-320x240, 1 bit, 5 PPP, dark-count map"),
        ({"bits": (1, 3)}, "spad-320x240, 1 and 3 bits, 1 and 10 PPP, dark-count map"),
        ({"sensor": "quiver-paper"}, "quiver-paper, 1 bit, 1 and 10 PPP"),
        (
            {"sensor": ("spad-320x240", "quiver-paper"), "bits": (2,), "ppp": (3.0,)},
            "spad-320x240, 2 bits, 3 PPP, dark-count map; quiver-paper, 2 bits, 3 PPP",
        ),
    ],
)
def test_options_replace_what_the_streams_say(data, tmp_path, asked, noise):
    found = lines(data, tmp_path / "r", **asked)
    other = "this differs from the data set's streams: spad-320x240, 1 bit, 1 and 10 PPP, dark-count map"
    assert found == [f"noise: {noise} (as asked for)", other]


def test_two_sensors_among_the_streams_are_kept_apart(data, tmp_path):
    for clip in open_clips(data):
        sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25))
    both = "noise: quiver-physical, 3 bits, 3.25 PPP; spad-320x240, 1 bit, 1 and 10 PPP, dark-count map"
    assert lines(data, tmp_path / "r") == [both]
    assert lines(data, tmp_path / "r", sensor="quiver-physical")[0].startswith(
        "noise: quiver-physical, 3 bits, 3.25 PPP (as"
    )
    clips = open_clips(data)
    two = ["spad-320x240", "quiver-physical"]
    assert set(choose(clips, two).noises) == set(choose(clips).noises)
    assert len(choose(clips, two, bits=[1], ppp=[1.0]).noises) == 2  # the SPAD has its map


def test_a_sensor_file_brings_its_bits_and_defects(tiny_dataset, tmp_path):
    file = sensor_file(tmp_path, QIS + "prnu = 0.02\ndead = 0.01\ndark = {{ spread = 0.3 }}\n", 4)
    found = "noise: mine, 4 bits, 3.25 PPP, dark-current spread, PRNU 2 %, 1 % dead pixels (as asked for)"
    assert lines(tiny_dataset, tmp_path / "r", sensor=file) == [found]
    with pytest.raises(ValueError, match="the file has bits = 4, the request 2"):
        lines(tiny_dataset, tmp_path / "r", sensor=file, bits=(2,))


def test_a_temperature_is_that_of_sensor_files(tiny_dataset, tmp_path):
    law = "dark_doubling = 8.0\ndark_reference = 25.0\n[defects]"
    file = sensor_file(tmp_path, QIS.replace("[defects]", law), 3)
    run = Settings(str(tiny_dataset), str(tmp_path / "r"), steps=1, sensor=file, temperature=49.0)
    found, lines = settled(run)
    assert lines == ["noise: mine, 3 bits, 3.25 PPP, temperature 49 (as asked for)"]
    (noise,) = found.noise
    (own,) = settled(replace(run, temperature=None))[0].noise
    assert noise.device(5e-4).dark_rate == pytest.approx(8 * own.device(5e-4).dark_rate)
    for sensor, message in (
        (None, "temperature: is that of sensor files"),
        ("spad512s", "spad512s: has no law of temp"),
    ):
        with pytest.raises(ValueError, match=message):
            settled(replace(run, sensor=sensor))


def test_what_windows_cannot_have_is_refused(make_clip: ClipMaker, tmp_path):
    counter = sensor_file(tmp_path, COUNTER + "carry_dead_time = true\n", 3)
    with pytest.raises(ValueError, match=r"carry_dead_time and afterpulse of counting pixels.*without them"):
        Windows([make_clip()], WindowSettings(crop=16, lights=(Illumination.of(counter, 3.0, 3),)))
    followed = make_clip("followed")
    sense(followed, Sensing("spad-320x240", bits=2, ppp=3.0, row_delay=1e-6, name="r"))
    assert "row_delay 1e-06" in choose([followed]).lines[0]
    sense(followed, Sensing(CountingSPAD(0.4, 10.0, 1e-6, 3), ppp=3.0, follow=True, name="f"))
    assert len(choose([followed]).noises) == 2  # of one clip frame the closed form is exact


def test_codes_of_several_clip_frames_stay_such_codes(make_clip: ClipMaker, tmp_path):
    """Another sensor, depth or light changes no code's time: trained on clip frames, motion was too slow."""
    sums = make_clip("sums")
    sense(sums, Sensing("spad-320x240", bits=2, ppp=3.0, group=True))
    file = sensor_file(tmp_path, QIS, 4)
    said = {
        "noise: spad-320x240, 2 bits, 3 PPP, 3 planes": choose([sums]),
        "noise: spad-320x240, 2 bits, 1 PPP, 3 planes (as asked for)": choose([sums], None, [1.0]),
        "noise: spad512s, 3 bits, 1 PPP, 7 planes (as asked for)": choose([sums], ["spad512s"], [1.0], [3]),
        "noise: mine, 4 bits, 1 PPP, 3 slices (as asked for)": choose([sums], [file], [1.0]),
        "noise: spad512s, 4 bits, 3 PPP, 15 planes (as asked for)": choose([sums], ["spad512s"], planes=15),
        "noise: spad-320x240, 3 bits, 3 PPP, 7 planes (as asked for)": choose([sums], planes=7),
        "noise: spad-320x240, 4 bits, 3 PPP, 10 planes (as asked for)": choose([sums], planes=10),
        "noise: spad-320x240, 2 bits, 3 PPP (as asked for)": choose([sums], planes=1),
    }
    assert [found.lines[0] for found in said.values()] == list(said)
    with pytest.raises(ValueError, match=r"planes: a sum of 7 planes has 3 bits, and 2 are asked for"):
        choose([sums], ["spad512s"], None, [2], planes=7)


def test_every_window_is_normalised_by_its_own_sensor(make_clip: ClipMaker):
    """Codes over their top code, targets over the white of the sensor that drew them, mixed in one batch."""
    lights = (
        Illumination.of("quiver-paper", 3.0, 2),
        Illumination.of("spad-320x240", 1.0, 1),
        Illumination.of("quiver-physical", 9.0, 5),
    )
    data = Windows([make_clip()], WindowSettings(crop=16, lights=lights, flips=False, reverse=False))
    seen = set()
    for n in range(12):
        sample = data[n]
        place = data.place(n)
        light = lights[place.light]
        clip = data.clips[0]
        sensor = light.device(clip.exposure)
        codes = sample["codes"].numpy() * (2**light.bits - 1)
        assert np.allclose(codes, np.rint(codes), atol=1e-5)
        assert sample["white"] == sensor.white(clip.exposure)
        factor = light_level(clip, ppp=light.ppp).factor
        crop = (place.y, place.x, 16, 16)
        sharp = np.stack([clip_photons(clip, place.start + i, factor, crop, sharp=True) for i in range(11)])
        top = max(2.0 * sample["white"], 2.5 * light.ppp)  # the peak of the scores is never cut
        expected = np.minimum(sharp, top) / sample["white"]
        np.testing.assert_allclose(sample["target"][:, 0], expected, rtol=1e-6)
        seen.add(place.light)
    assert seen == {0, 1, 2}


def test_the_command_says_its_noise_in_one_line(data, tmp_path, capsys):
    words = ["train", data, "-o", tmp_path / "r", "--steps", 1, "--crop", 16, "--batch", 1, "--preset", "unet"]
    assert main([str(word) for word in [*words, "--json"]]) == 0
    noise, start = capsys.readouterr().err.splitlines()
    assert noise == "noise: spad-320x240, 1 bit, 1 and 10 PPP, dark-count map"
    assert start.startswith("starts at step 0 of 1; ")


def test_describe_says_every_effect():
    table = {"dark_map": "a", "gain_map": "b", "dead_map": "c", "crosstalk": 0.1, "afterpulse": 0.01}
    noise = replace(Illumination.of("spad512s", 2.0, 1), defects=json.dumps(table))
    said = "spad512s, 1 bit, 2 PPP, dark-count map, gain map, map of dead pixels, crosstalk, afterpulses"
    assert describe([noise]) == said
    assert (
        describe([Illumination.of("spad512s", None, 1, lux=5.0, diffraction=True)])
        == "spad512s, 1 bit, 5 lx, diffraction"
    )
