"""The noise of training windows: that of the data set's streams, with the defects of the pixels where they lie."""

from __future__ import annotations

import json
import math
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clips import ClipMaker, write_dataset
from numpy import ndarray as Array
from stats import assert_mean

from qsim.clip.clip import Clip
from qsim.clip.photons import clip_photons, light_level
from qsim.clip.sensing import Sensing, sense
from qsim.keys import Key
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.fixed_pattern import DarkSpread, FixedPattern
from qsim.sensor.defects.pixel_array import PixelArray
from quiver.cli.program import main
from quiver.data.clips import open_clips
from quiver.data.code_table import draw_codes
from quiver.data.illumination import Illumination
from quiver.data.mixture import choose, describe
from quiver.data.noise import Noise
from quiver.data.window_noise import WindowPlace, window_codes
from quiver.data.windows import TRAINING, Windows, WindowSettings, turned
from quiver.model.unet import UNet, UNetConfig
from quiver.restoration.restorers import restorer
from quiver.training.loop import train
from quiver.training.settings import Settings, settled

FILES = {  # model -> [sensor] of a file
    "SPAD": 'model = "BinarySPAD"\npde = 0.4\ndark_count_rate = 200.0\n',
    "QIS": 'model = "QIS"\nquantum_efficiency = 0.8\ndark_current = 100.0\nread_noise = 0.2\n',
    "COUNTER": 'model = "CountingSPAD"\npde = 0.5\ndark_count_rate = 50.0\ndead_time = 1e-5\n',
}
SPAD, QIS, COUNTER = (f"[sensor]\n{text}bits = {{bits}}\n[defects]\n" for text in FILES.values())


def sensor_file(folder: Path, text: str, bits: int = 1, name: str = "mine.toml") -> str:
    (folder / name).write_text(text.format(bits=bits))
    return str(folder / name)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Two clips to train on, one to validate, with streams of a SPAD at two light levels and a dark-count map."""
    path = write_dataset(tmp_path / "data", {"train": 2, "val": 1})
    np.save(tmp_path / "dark.npy", np.random.default_rng(0).lognormal(4, 1, (40, 50)))
    (tmp_path / "map.toml").write_text('[defects]\ndark_map = "dark.npy"\n')
    for clip in open_clips(path):
        for ppp in (10.0, 1.0):
            sense(clip, Sensing("spad-320x240", bits=1, ppp=ppp, defects=str(tmp_path / "map.toml")))
    return path


# From streams and options to a mixture


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


def test_a_sensor_file_brings_its_bits_and_defects(tiny_dataset, tmp_path):
    file = sensor_file(tmp_path, QIS + "prnu = 0.02\ndead = 0.01\ndark = {{ spread = 0.3 }}\n", 4)
    found = "noise: mine, 4 bits, 3.25 PPP, dark-current spread, PRNU 2 %, 1 % dead pixels (as asked for)"
    assert lines(tiny_dataset, tmp_path / "r", sensor=file) == [found]
    with pytest.raises(ValueError, match="the file says bits = 4, asked for 2"):
        lines(tiny_dataset, tmp_path / "r", sensor=file, bits=(2,))


def test_what_windows_cannot_have_is_refused(make_clip: ClipMaker, tmp_path):
    counter = sensor_file(tmp_path, COUNTER + "carry_dead_time = true\n", 3)
    with pytest.raises(ValueError, match=r"carry_dead_time and afterpulse of counting pixels.*without them"):
        Windows([make_clip()], WindowSettings(crop=16, lights=(Illumination(counter, 3.0, 3),)))
    sums = make_clip("sums")
    sense(sums, Sensing("spad-320x240", bits=2, ppp=3.0, group=True))
    with pytest.raises(ValueError, match="a code takes 3 clip frames, a training window one for each; give --sensor"):
        choose([sums])
    assert choose([sums], ["spad-320x240"], [1.0], [2]).lines[0].startswith("noise: spad-320x240, 2 bits, 1 PPP")


def test_every_window_is_normalised_by_its_own_sensor(make_clip: ClipMaker):
    """Codes over their top code, targets over the white of the sensor that drew them, mixed in one batch."""
    lights = (
        Illumination("quiver-paper", 3.0, 2),
        Illumination("spad-320x240", 1.0, 1),
        Illumination("quiver-physical", 9.0, 5),
    )
    data = Windows([make_clip()], WindowSettings(crop=16, lights=lights, flips=False, reverse=False))
    seen = set()
    for n in range(12):
        sample, place = data[n], data.place(n)
        light, clip = lights[place.light], data.clips[0]
        sensor = light.device(clip.exposure)
        codes = sample["codes"].numpy() * (2**light.bits - 1)
        assert np.allclose(codes, np.rint(codes), atol=1e-5)
        assert sample["white"] == sensor.white(clip.exposure)
        factor = light_level(clip, ppp=light.ppp).factor
        crop = (place.y, place.x, 16, 16)
        sharp = np.stack([clip_photons(clip, place.start + i, factor, crop, sharp=True) for i in range(11)])
        expected = np.minimum(sharp / sample["white"], 2.0)
        np.testing.assert_allclose(sample["target"][:, 0], expected, rtol=1e-6)
        seen.add(place.light)
    assert seen == {0, 1, 2}


# Defects in windows


def random_defects(rng: random.Random, qis: bool, spad: bool) -> Defects:
    """One or more defects that a window can have."""
    some = lambda value: value if rng.random() < 0.5 else 0.0  # noqa: E731
    pattern = FixedPattern(
        device_seed=rng.randrange(100),
        prnu=some(0.2),
        dark=DarkSpread() if rng.random() < 0.5 else None,
        dead=some(0.1),
        offset=some(0.4) if qis else 0.0,
        read_noise=some(0.3) if qis else 0.0,
    )
    return Defects(pattern, crosstalk=0.0 if qis else some(0.1), afterpulse=some(0.2) if spad else 0.0)


def whole_frames(noise: Noise, clip: Clip, key: Key, light: Array) -> Array:
    """Codes of whole frames from the first one on, by the reference engine: what `qsim sense` stores."""
    draw = noise.draw(clip)
    array = PixelArray.of(draw.defects, draw.plane, *clip.shape[1:])
    return next(array.blocks([light], clip.exposure, key, engine="reference"))


@pytest.mark.parametrize("cases", [12, pytest.param(200, marks=pytest.mark.slow)])
def test_a_window_is_the_crop_of_the_sensed_frames(make_clip: ClipMaker, tmp_path, cases):
    """Random defects, sensors, light, places: under the key of a stream the same codes, to the last one.

    A sum of planes without afterpulses and crosstalk is drawn from other numbers than by `qsim sense`; the next test
    compares its distribution.
    """
    rng, clip = random.Random(cases), make_clip(frames=16, height=20, width=26)
    for number in range(cases):
        model, bits = rng.choice([(SPAD, 1), (SPAD, 2), (QIS, 3), (COUNTER, 3)])
        found = random_defects(rng, model is QIS, model is SPAD)
        if found.none or (bits == 2 and not (found.crosstalk or found.afterpulse)):
            continue
        file = sensor_file(tmp_path, model, bits)
        light = Illumination(file, rng.choice([0.3, 2.0, 20.0]), bits)
        noise = replace(Noise.of(light), defects=json.dumps(found.to_dict()))
        key = Key(seed=number, clip=3, stage=TRAINING)
        place = WindowPlace(
            0, rng.randrange(12), rng.choice([0, 1, 2, 9]), rng.choice([0, 3, 4, 18]), (0, 0), 0, 0, False, key
        )
        side = min(8, 20 - place.y, 26 - place.x)
        frames = min(4, 16 - place.start)
        draw = noise.draw(clip)
        photons = np.stack([clip_photons(clip, t, draw.level.factor) for t in range(16)])
        whole = whole_frames(noise, clip, key, photons)
        part = window_codes(noise, draw, clip, place, frames, side)
        crop = (slice(place.y, place.y + side), slice(place.x, place.x + side))
        np.testing.assert_array_equal(part, whole[place.start : place.start + frames][(slice(None), *crop)])


def test_sums_of_planes_have_the_distribution_of_their_pixels(make_clip: ClipMaker, tmp_path):
    """Flat light on hot and dull pixels: the mean code of each kind over many windows is that of its own cdf."""
    gain = np.tile([1.0, 0.25, 0.0], (20, 9))[:, :26]
    np.save(tmp_path / "gain.npy", gain)
    file = sensor_file(tmp_path, SPAD + 'gain_map = "gain.npy"\n', 3)
    clip = make_clip(radiance=np.full((14, 20, 26), 0.5), relative=True)
    data = Windows([clip], WindowSettings(crop=12, lights=(Illumination(file, 5.0, 3),), frames=11, flips=False))
    sums, counts = np.zeros(3), np.zeros(3)
    for n in range(12):
        codes, x = data[n]["codes"].numpy() * 7, data.place(n).x
        for kind in range(3):
            chosen = codes[..., (np.arange(x, x + 12) % 3) == kind]
            sums[kind], counts[kind] = sums[kind] + chosen.sum(), counts[kind] + chosen.size
    sensor = Noise.of(Illumination(file, 5.0, 3)).draw(clip).sensor
    for kind, level in enumerate((5.0, 1.25, 0.0)):
        light = np.array([level])
        spread = math.sqrt(sensor.variance(light, clip.exposure)[0] / counts[kind])
        assert abs(sums[kind] / counts[kind] - sensor.mean(light, clip.exposure)[0]) < 5 * spread


def test_a_window_is_turned_with_its_defects(make_clip: ClipMaker, tmp_path):
    """Dead pixels of a turned and reversed window lie where the turn brings them, in codes and in the target."""
    dead = np.zeros((20, 26))
    dead[:, 4] = dead[7] = 1
    np.save(tmp_path / "dead.npy", dead)
    file = sensor_file(tmp_path, QIS + 'dead_map = "dead.npy"\n', 3)
    clip = make_clip(radiance=np.full((14, 20, 26), 0.5), relative=True)
    data = Windows([clip], WindowSettings(crop=16, lights=(Illumination(file, 60.0, 3),)))
    for n in range(40):
        place = data.place(n)
        window = np.broadcast_to(dead[place.y : place.y + 16, place.x : place.x + 16], (11, 16, 16))
        assert ((data[n]["codes"].numpy()[:, 0] == 0) == (turned(window, place) == 1)).all()
    assert {data.place(n).turn for n in range(40)} == set(range(8))


def test_a_drifting_window_keeps_its_pixels(make_clip: ClipMaker, tmp_path):
    """The scene moves through the window; the sensor under it does not, and its neighbours are within the frame."""
    dead = np.random.default_rng(0).random((48, 40)) < 0.2
    np.save(tmp_path / "dead.npy", dead)
    file = sensor_file(tmp_path, SPAD + 'dead_map = "dead.npy"\ncrosstalk = 0.1\nafterpulse = 0.1\n', 1)
    clip = make_clip(radiance=np.full((30, 48, 40), 0.5), relative=True)
    settings = WindowSettings(crop=16, lights=(Illumination(file, 60.0, 1),), flips=False, drift=2)
    data, moved = Windows([clip], settings), 0
    for n in range(30):
        place = data.place(n)
        moved += place.drift != (0, 0)
        crop = dead[place.y : place.y + 16, place.x : place.x + 16]
        assert ((data[n]["codes"].numpy()[:, 0] == 0).all(axis=0) == crop).all()
    assert moved > 5


def test_afterpulses_of_a_reversed_window_follow_its_own_time(make_clip: ClipMaker, tmp_path):
    """Light that ends at once: afterpulses come after it in the order in which the window is seen, never before."""
    radiance = np.zeros((24, 20, 26))
    radiance[:12] = 1.0
    clip = make_clip(radiance=radiance, relative=True)
    file = sensor_file(tmp_path, SPAD.replace("200.0", "0.0") + "afterpulse = 0.5\n", 1)
    noise = Noise.of(Illumination(file, 20.0, 1))
    draw = noise.draw(clip)
    forward = window_codes(noise, draw, clip, WindowPlace(0, 8, 2, 2, (0, 0), 0, 0, False, Key(1, 2)), 11, 16)
    back = window_codes(noise, draw, clip, WindowPlace(0, 8, 2, 2, (0, 0), 0, 0, True, Key(1, 2)), 11, 16)
    assert_mean(forward[4].astype(float), 0.5, 0.25)  # frame 12, the first dark one
    assert back[:7].max() == 0  # frames 18 ... 12, before the light
    assert back[7:].mean() > 0.9


def test_no_defects_change_no_bit(make_clip: ClipMaker, tmp_path):
    """A sensor file draws what its sensor draws, and a plain window what it always drew."""
    clip = make_clip()
    file = sensor_file(tmp_path, QIS + "prnu = 0.0\n", 3)
    data = Windows([clip], WindowSettings(crop=16, lights=(Illumination(file, 3.25, 3),)))
    place, noise = data.place(0), data.noise.noises[0]
    assert noise.defects is None
    sensor = noise.draw(clip).sensor
    factor = light_level(clip, ppp=3.25).factor
    crop = (place.y, place.x, 16, 16)
    photons = np.stack([clip_photons(clip, place.start + i, factor, crop) for i in range(11)])
    codes = draw_codes(sensor, turned(photons, place), clip.exposure, place.key)
    np.testing.assert_array_equal(np.rint(data[0]["codes"].numpy()[:, 0] * 7), codes)


# Runs


def small(data: Path, out: Path, **changes: object) -> Settings:
    return Settings(str(data), str(out), **{"steps": 1, "crop": 16, "batch": 2, "validation_windows": 2} | changes)


def network() -> UNet:
    torch.manual_seed(0)
    return UNet(UNetConfig(2))


def test_a_run_records_its_whole_mixture_and_keeps_it(data, tmp_path):
    said: list[str] = []
    train(network(), small(data, tmp_path / "r"), progress=False, note=said.append)
    written = json.loads((tmp_path / "r/settings.json").read_text())
    assert [(n["sensor"], n["bits"], n["ppp"]) for n in written["noise"]] == [
        ("spad-320x240", 1, 1.0),
        ("spad-320x240", 1, 10.0),
    ]
    assert all("dark_map" in n["defects"] for n in written["noise"])
    assert said == ["noise: spad-320x240, 1 bit, 1 and 10 PPP, dark-count map"]
    for clip in open_clips(data):
        sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25))
    said.clear()
    train(network(), small(data, tmp_path / "r"), progress=False, note=said.append)
    assert said[0] == "noise: spad-320x240, 1 bit, 1 and 10 PPP, dark-count map (as this run began)"
    assert said[1].startswith("this differs from the data set's streams: quiver-physical, 3 bits, 3.25 PPP; spad")
    with pytest.raises(FileExistsError, match=r"holds a run with bits as in its data set, now it is \[3\]"):
        train(network(), small(data, tmp_path / "r", bits=(3,)), progress=False)


def test_a_sensor_file_that_changed_is_another_run(tiny_dataset, tmp_path):
    file = sensor_file(tmp_path, QIS + "prnu = 0.02\n", 3)
    train(network(), small(tiny_dataset, tmp_path / "r", sensor=file), progress=False)
    sensor_file(tmp_path, QIS + "prnu = 0.03\n", 3)
    with pytest.raises(
        FileExistsError, match=r"holds a run with noise: mine, 3 bits, 3\.25 PPP, PRNU 2 %; .*mine.toml"
    ):
        train(network(), small(tiny_dataset, tmp_path / "r", sensor=file), progress=False)


def test_weights_tell_their_noise_without_folders(data, tmp_path):
    from safetensors import safe_open

    train(network(), small(data, tmp_path / "r"), progress=False)
    with safe_open(tmp_path / "r/best.safetensors", framework="pt") as file:
        text = file.metadata()["settings"]
    told = json.loads(text)
    assert (told["sensor"], told["ppp"], told["bits"]) == ("spad-320x240", [1.0, 10.0], [1])
    assert str(tmp_path) not in text
    assert restorer(str(tmp_path / "r")).learned, "the map is not there under its bare name, and is not needed"


def test_a_run_of_an_earlier_version_is_resumed(data, tmp_path):
    """Its settings have no `noise` and no `threads`; it keeps sensor, bits and light, and draws the same windows."""
    asked = {"sensor": "quiver-physical", "ppp": (3.25,), "bits": (3,)}
    before = network()
    train(before, small(data, tmp_path / "r", steps=2, **asked), progress=False)
    path = tmp_path / "r/settings.json"
    old = {k: v for k, v in json.loads(path.read_text()).items() if k not in ("noise", "threads")}
    path.write_text(json.dumps(old))
    (tmp_path / "r/checkpoint.pt").unlink()
    said: list[str] = []
    again = network()
    train(again, small(data, tmp_path / "r", steps=2), progress=False, note=said.append)
    assert said[0] == "noise: quiver-physical, 3 bits, 3.25 PPP (as this run began)"
    assert all(torch.equal(a, b) for a, b in zip(before.parameters(), again.parameters(), strict=True))


HOSTILE = (
    0,
    -1,
    10**9,
    10**400,
    math.nan,
    1e300,
    "",
    "x" * 3000,
    "a\nb",
    None,
    True,
    [],
    {},
    [1],
    {"model": 3},
    {"prnu": -1},
)


@pytest.mark.parametrize("name", ["noise", "sensor", "ppp", "bits", "steps", "seed", "data"])
def test_any_value_in_the_settings_of_a_run(data, tmp_path, name):
    """Refused in one line, or a run as before; whole settings, and every key of a noise."""
    run = small(data, tmp_path / "r")
    train(network(), run, progress=False)
    path = tmp_path / "r/settings.json"
    good = json.loads(path.read_text())
    refused: list[str] = []
    values: list[object] = [*HOSTILE]
    if name == "noise":
        values += [[*HOSTILE], *([noise | {key: v}] for noise in good["noise"][:1] for key in noise for v in HOSTILE)]
    for value in values:
        path.write_text(json.dumps(good | {name: value}))
        try:
            assert train(network(), run, progress=False).finished
        except (ValueError, OSError) as error:
            refused.append(str(error))
    assert refused or name in ("sensor", "ppp", "bits")  # those are what was asked for; `noise` is what counts
    assert all("\n" not in text and len(text) < 1500 for text in refused)


def test_the_command_says_its_noise_in_one_line(data, tmp_path, capsys):
    words = ["train", data, "-o", tmp_path / "r", "--steps", 1, "--crop", 16, "--batch", 1, "--preset", "unet"]
    assert main([str(word) for word in [*words, "--json"]]) == 0
    assert capsys.readouterr().err.splitlines() == ["noise: spad-320x240, 1 bit, 1 and 10 PPP, dark-count map"]


def test_describe_says_every_effect():
    table = {"dark_map": "a", "gain_map": "b", "dead_map": "c", "crosstalk": 0.1, "afterpulse": 0.01}
    noise = Noise("spad512s", 2.0, 1, defects=json.dumps(table))
    said = "spad512s, 1 bit, 2 PPP, dark-count map, gain map, map of dead pixels, crosstalk, afterpulses"
    assert describe([noise]) == said
    assert (
        describe([replace(noise, defects=None, ppp=None, lux=5.0, diffraction=True)])
        == "spad512s, 1 bit, 5 lx, diffraction"
    )
