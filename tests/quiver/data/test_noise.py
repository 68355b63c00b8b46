"""The noise of a training run: recorded, resumed, and read again from its weights."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from sensor_files import QIS, sensor_file

from qsim.streams.sensing import Sensing, sense
from quiver.data.clips import open_clips
from quiver.data.illumination import Illumination
from quiver.data.noise import Noise, labels
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
    spad = Illumination("spad-320x240")
    assert named(plain, Illumination(ppp=9.75)) == ["3.25 PPP, 3 bit", "9.75 PPP, 3 bit"]
    assert named(spad) == ["3.25 PPP, 3 bit"]
    assert named(plain, Noise.of(spad)) == ["3.25 PPP, 3 bit", "3.25 PPP, 3 bit, spad-320x240"]
    assert named(plain, spad, Illumination(ppp=1.0)) == [
        *("3.25 PPP, 3 bit, quiver-physical", "3.25 PPP, 3 bit, spad-320x240", "1 PPP, 3 bit")
    ]
    assert named(*(Illumination(f"{folder}/my.toml", 1.0, None) for folder in "ab")) == [
        *("1 PPP, own bits, a/my.toml", "1 PPP, own bits, b/my.toml")
    ]
    noise = Noise("spad-320x240", lux=10.0)
    assert named(noise, replace(noise, diffraction=True), replace(noise, defects="{}")) == [
        f"10 lx, 3 bit, spad-320x240{effects}" for effects in ("", ", diffraction", ", defects")
    ]
    with pytest.raises(ValueError, match="two different lights are both called '10 lx, 3 bit, spad-320x240, defects'"):
        labels((replace(noise, defects="{}"), replace(noise, defects='{"prnu": 0.1}')))
    assert labels(()) == {}


def test_a_sensor_file_with_colour_filters_is_refused(tmp_path):
    """Training windows have one band, and their sensor is recorded without filters."""
    file = sensor_file(tmp_path, QIS.removesuffix("[defects]\n") + '[colour]\nmask = "rggb"\n', 3)
    with pytest.raises(ValueError, match=r"mine\.toml: training windows have one band; leave its table \[colour\] out"):
        Noise.of(Illumination(file, 3.0, 3))


# From streams and options to a mixture


# Defects in windows


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
    """Noise that the sensor files alone would not give."""
    run = small(data, tmp_path / "r", sensor=("spad-320x240", sensor_file(tmp_path, QIS, 3)))
    begun, _ = settled(run)
    more = (*begun.noise, replace(begun.noise[-1], ppp=7.0))
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
