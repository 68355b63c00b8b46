"""The noise of a training run: recorded, resumed, and read again from its weights."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from clips import ClipMaker
from sensor_files import QIS, sensor_file

from qsim.sensor.colour_filter import MASKS
from qsim.settings import settings_of
from qsim.streams.exposures import Timing
from qsim.streams.preparation import prepare
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.data.clips import open_clips
from quiver.data.illumination import HONOURED, Illumination, labels, unlike_windows
from quiver.data.windows import Windows, WindowSettings
from quiver.model.unet import UNet, UNetConfig
from quiver.restoration.restorers import restorer
from quiver.training.loop import train
from quiver.training.settings import Settings, settled

# Names in tables


def test_lights_of_one_label_get_names_that_tell_them_apart():
    """Lights of one sensor keep their names, and so do those of a mixture that differ already."""

    def named(*lights: Illumination) -> list[str]:
        return list(labels(lights).values())

    plain = Illumination()
    spad = Illumination.of("spad-320x240")
    assert named(plain, Illumination.of(ppp=9.75)) == ["3.25 PPP, 3 bit", "9.75 PPP, 3 bit"]
    assert named(spad) == ["3.25 PPP, 3 bit"]
    assert named(plain, spad, Illumination.of(ppp=1.0)) == [
        *("3.25 PPP, 3 bit, quiver-physical", "3.25 PPP, 3 bit, spad-320x240", "1 PPP, 3 bit")
    ]
    assert named(*(Illumination.of(f"{folder}/my.toml", 1.0, None) for folder in "ab")) == [
        *("1 PPP, own bits, a/my.toml", "1 PPP, own bits, b/my.toml")
    ]
    noise = Illumination.of("spad-320x240", None, lux=10.0)
    assert named(noise, noise.but(diffraction=True), noise.but(temperature=40.0), replace(noise, defects="{}")) == [
        "10 lx, 3 bit, spad-320x240",
        "10 lx, 3 bit, diffraction",
        "10 lx, 3 bit, temperature 40",
        "10 lx, 3 bit, spad-320x240, defects",
    ]
    with pytest.raises(ValueError, match="two different lights are both called '10 lx, 3 bit, spad-320x240, defects'"):
        labels((replace(noise, defects="{}"), replace(noise, defects='{"prnu": 0.1}')))
    assert labels(()) == {}


def test_the_filters_of_a_sensor_file_are_recorded(tmp_path):
    """A run does not depend on the file; filters that follow qe_curve are known with a clip only, and refused."""
    text = QIS.removesuffix("[defects]\n")
    file = sensor_file(tmp_path, text + '[colour]\nmask = "rggb"\nefficiency.R = 0.5\n', 3)
    with pytest.raises(ValueError, match=r"efficiency: colour G of the mask has none"):
        Illumination.of(file, 3.0, 3).stated()
    file = sensor_file(tmp_path, text + '[colour]\nmask = "quad"\n', 3)
    stated = Illumination.of(file, 3.0, 3).stated()
    assert stated.filters.mask == MASKS["quad"]
    assert Illumination.from_dict(json.loads(json.dumps(stated.to_dict()))) == stated
    assert stated.label == "3 PPP, 3 bit, mask RRGG RRGG GGBB GGBB"
    file = sensor_file(tmp_path, text.replace("quantum_efficiency = 0.8", "qe_curve = [[4e-7, 0.3], [7e-7, 0.8]]"), 3)
    Path(file).write_text(Path(file).read_text() + '[colour]\nmask = "rggb"\n')
    with pytest.raises(ValueError, match="its filters follow qe_curve"):
        Illumination.of(file, 3.0, 3).stated()


# Settings of `qsim sense`

FILE = """[sensor]
model = "QIS"
qe_curve = [[450e-9, 0.3], [700e-9, 0.8]]
median = 900.0
dark_doubling = 8.0
dark_reference = 25.0
read_noise = 0.2
[defects]
dark = {{ spread = 0.4 }}
"""


@pytest.mark.parametrize(
    "settings",
    [
        {"temperature": 60.0},
        {"diffraction": True},
        {"ppp": None, "lux": 40.0},
        {"defects": "other.toml", "temperature": 5.0},
    ],
    ids=str,
)
def test_settings_act_in_windows_as_in_sensing(make_clip: ClipMaker, tmp_path, settings):
    """The same codes as `qsim sense` draws: other ones than without the setting."""
    clip = make_clip()
    file = sensor_file(tmp_path, FILE)
    if "defects" in settings:
        settings = settings | {"defects": sensor_file(tmp_path, QIS + "prnu = 0.2\n", name="other.toml")}
    light = Illumination.of(file, bits=3, **settings)
    drawn = light.stated().draw(clip, seed=5)
    wanted = prepare(clip, replace(light.sensing, seed=5))
    assert drawn.sensor == wanted.sensor
    codes = drawn.frames(clip, 0, 2)
    np.testing.assert_array_equal(codes, wanted.frames(clip, 0, 2))
    assert (codes != Illumination.of(file, bits=3).draw(clip, seed=5).frames(clip, 0, 2)).any()
    assert Illumination.from_dict(json.loads(json.dumps(light.stated().to_dict()))) == light.stated()
    windows = Windows([clip], WindowSettings((light,), crop=16))
    assert windows.noise.noises == (light.stated(),)


def test_every_other_setting_is_refused(make_clip: ClipMaker):
    """A setting that is new is refused until windows honour it."""
    others = {"seed": 3, "planes": 7, "name": "x", "follow": True}
    assert {setting.name for setting in settings_of(Sensing)} == {*others, *HONOURED}
    clip = make_clip()
    for name, value in others.items():
        light = Illumination.of(**{name: value})
        with pytest.raises(ValueError, match=f"quiver-physical: training windows cannot have .*{name}; give sensor="):
            Windows([clip], WindowSettings((light,), crop=16))
    settings = {"seed": 3, "diffraction": True, "colour": "rggb", "later": 1}
    info = SimpleNamespace(planes_per_code=3, settings=settings, sensing=Sensing("spad512s"), bits=3)
    unlike = ["later", "codes of 3 clip frames that its settings do not state"]
    assert unlike_windows(SimpleNamespace(info=info, timing=Timing(3, summed=True))) == unlike


def test_single_planes_are_windows_like_sums_of_them(make_clip: ClipMaker):
    stream = make_clip(frames=4).sense("spad-320x240", planes=1, ppp=0.5)
    assert unlike_windows(stream) == []


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
    assert said[:-1] == ["noise: spad-320x240, 1 bit, 1 and 10 PPP, dark-count map"]
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


def test_a_run_keeps_its_mixture(data, tmp_path):
    """Illumination that the sensor files alone would not give."""
    run = small(data, tmp_path / "r", sensor=("spad-320x240", sensor_file(tmp_path, QIS, 3)))
    begun, _ = settled(run)
    more = (*begun.noise, begun.noise[-1].but(ppp=7.0))
    (tmp_path / "r").mkdir()
    (tmp_path / "r/settings.json").write_text(json.dumps(replace(begun, noise=more).to_dict()))
    assert settled(run)[0].noise == more


def test_weights_tell_their_noise_without_folders(data, tmp_path):
    from safetensors import safe_open

    train(network(), small(data, tmp_path / "r"), progress=False)
    with safe_open(tmp_path / "r/best.safetensors", framework="pt") as file:
        text = file.metadata()["settings"]
    told = json.loads(text)
    assert (told["sensor"], told["ppp"], told["bits"]) == ("spad-320x240", [1.0, 10.0], [1])
    assert str(tmp_path) not in text
    assert restorer(str(tmp_path / "r")).learned, "the map is not there under its bare name, and is not needed"


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


@pytest.mark.parametrize("share", [4, pytest.param(1, marks=pytest.mark.slow)])  # quickly one value in four
@pytest.mark.parametrize("name", ["noise", "sensor", "ppp", "bits", "steps", "seed", "data"])
def test_any_value_in_the_settings_of_a_run(data, tmp_path, name, share):
    """Refused in one line, or a run as before; all settings, and every key of a noise."""
    run = small(data, tmp_path / "r")
    train(network(), run, progress=False)
    path = tmp_path / "r/settings.json"
    good = json.loads(path.read_text())
    refused: list[str] = []
    values: list[object] = [*HOSTILE]
    if name == "noise":
        values += [[*HOSTILE], *([noise | {key: v}] for noise in good["noise"][:1] for key in noise for v in HOSTILE)]
    for value in values[::share]:
        path.write_text(json.dumps(good | {name: value}))
        try:
            assert train(network(), run, progress=False).finished
        except (ValueError, OSError) as error:
            refused.append(str(error))
    assert refused or name in ("sensor", "ppp", "bits")  # those are what was asked for; `noise` is what counts
    assert all("\n" not in text and len(text) < 1500 for text in refused)


def test_the_noise_of_weights_is_read_where_its_maps_are_not(tmp_path):
    """Weights go on without the maps of the camera that they were trained for: no codes are drawn."""
    np.save(tmp_path / "dark.npy", np.ones((4, 5), np.float32))
    text = '[sensor]\nmodel = "BinarySPAD"\npde = 0.5\ndark_count_rate = 10.0\n[defects]\ndark_map = "dark.npy"\n'
    (tmp_path / "own.toml").write_text(text)
    stated = Illumination.of(str(tmp_path / "own.toml"), 3.25, 3).stated()
    (tmp_path / "dark.npy").unlink()
    assert Illumination.from_dict(json.loads(json.dumps(stated.to_dict()))) == stated
