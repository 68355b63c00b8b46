"""Tests the layout of the Single Photon Challenge: golden bytes, the published way to read it, truth, damaged files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clips import colour_clip, write_clip
from hostile import VALUES, one_line
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from recordings import everything
from stats import assert_share

from qsim.cli.program import main
from qsim.formats import challenge, exporting
from qsim.formats.exporting import Export
from qsim.sensor.spad import BinarySPAD
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons

SENSOR = BinarySPAD(pde=0.5, dark_count_rate=20.0)


def three_bands(path: Path, frames: int = 9, height: int = 5, width: int = 13, ppp: float = 0.4, **more) -> Clip:
    clip = write_clip(path, frames=frames, height=height, width=width, **more)
    for seed, name in enumerate(challenge.COLOURS):
        clip.sense(SENSOR, ppp=ppp, seed=seed, name=name)
    return clip


@settings(max_examples=25, deadline=None)
@given(frames=st.integers(1, 70), height=st.integers(1, 6), width=st.integers(1, 30), data=st.data())
def test_cubes_are_read_as_the_benchmark_says(tmp_path_factory, frames: int, height: int, width: int, data):
    """np.unpackbits(cube, axis=2) of every cube holds the planes of the streams, in order; the rest is left out."""
    planes = data.draw(st.integers(1, frames))
    folder = tmp_path_factory.mktemp("c")
    clip = three_bands(folder / "fan", frames, height, width)
    exporting.export(clip, folder / "out", Export("challenge", planes=planes))
    bands = np.stack([clip.stream(name).codes() for name in challenge.COLOURS], axis=-1)
    found = challenge.cubes(folder / "out")
    assert len(found) == frames // planes
    for n, cube in enumerate(found):
        raw = np.load(folder / "out" / f"{n:06d}.npy", mmap_mode="r")
        assert raw.shape == (planes, height, -(-width // 8), 3)
        assert raw.dtype == np.uint8
        expected = bands[n * planes : (n + 1) * planes]
        np.testing.assert_array_equal(np.unpackbits(raw, axis=2)[:, :, :width], expected)
        np.testing.assert_array_equal(cube.planes(0, planes), expected)
        assert (cube.name, cube.shape) == (f"out/{n:06d}", (planes, height, width))
    meta = json.loads((folder / "out" / "meta.json").read_text())
    assert (meta["cubes"], meta["left_out"], meta["width"]) == (len(found), frames % planes, width)
    assert (meta["transfer"], meta["benchmark"]) == ("srgb", False)


def test_an_exported_cube_is_imported_with_its_width(tmp_path):
    """Up to seven dark columns came with it; the description of another program does not count."""
    clip = three_bands(tmp_path / "fan", frames=4, width=10)
    exporting.export(clip, tmp_path / "out", Export("challenge", planes=4))
    cube = tmp_path / "out" / "000000.npy"
    for channel, name in enumerate(challenge.COLOURS):
        np.testing.assert_array_equal(everything(cube, channel=channel), clip.stream(name).codes())
    (tmp_path / "out" / "meta.json").write_text('{"shape": [4, 5, 10], "width": 10}')
    assert everything(cube, channel=1).shape == (4, 5, 16)


def test_golden_bytes(tmp_path):
    """Red fires in the first pixel of row 0, blue in the tenth of row 1: bit 0x80 of byte 0, bit 0x40 of byte 1."""
    clip = three_bands(tmp_path / "c", frames=1, height=2, width=10)
    for name, place in (("red", (0, 0, 0)), ("green", None), ("blue", (0, 1, 9))):
        codes = np.zeros((1, 2, 10), np.uint8)
        if place is not None:
            codes[place] = 1
        stream = clip.stream(name)
        np.save(stream.path, np.packbits(codes, axis=2))
    exporting.export(clip, tmp_path / "out", Export("challenge", planes=1))
    expected = np.zeros((1, 2, 2, 3), np.uint8)
    expected[0, 0, 0, 0] = 0x80
    expected[0, 1, 1, 2] = 0x40
    np.testing.assert_array_equal(np.load(tmp_path / "out" / "000000.npy"), expected)


def test_truth_is_the_sharp_light_of_the_last_plane(tmp_path):
    """x = 2 PDE photons of the last plane's sharp light, as sRGB of 8 bits; what exceeds white is counted."""
    clip = three_bands(tmp_path / "c", frames=8, height=7, width=9, ppp=0.5, sharp=True)
    exporting.export(clip, tmp_path / "out", Export("challenge", planes=4))
    meta = json.loads((tmp_path / "out" / "meta.json").read_text())
    above = []
    for n, cube in enumerate(challenge.cubes(tmp_path / "out")):
        stream = clip.stream("red")
        light = 2 * SENSOR.pde * stream.truth(4 * n + 3, 4 * n + 4)[0]
        above.append((light > 1).mean())
        light = light.clip(0, 1)
        srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        truth = cube.truth()
        assert truth is not None
        for colour in range(3):
            assert np.abs(truth[..., colour] - 255 * srgb).max() <= 0.5 + 1e-6
    assert 0 < np.mean(above) < 1
    assert meta["clipped"] == pytest.approx(np.mean(above))


def test_a_colour_clip_is_sensed_behind_one_filter_at_a_time(tmp_path, capsys):
    """The red picture is that of the red photons, and so on; a mosaic is refused with its mask."""
    clip = colour_clip(tmp_path / "c", frames=4)
    for seed, name in enumerate(challenge.COLOURS):
        clip.sense(SENSOR, ppp=0.3, seed=seed, name=name, colour=name)
    exporting.export(clip, tmp_path / "out", Export("challenge", planes=4))
    (cube,) = challenge.cubes(tmp_path / "out")
    truth = cube.truth()
    assert truth is not None
    light = 2 * SENSOR.pde * clip_photons(clip, 3, clip.stream("red").photons_factor, sharp=True)
    for band, name in enumerate(challenge.COLOURS):
        np.testing.assert_array_equal(truth[..., band], challenge.picture(light)[band])
        np.testing.assert_array_equal(cube.planes(0, 4)[..., band], clip.stream(name).codes())
    clip.sense(SENSOR, ppp=0.3, seed=1, name="green", colour="rggb", force=True)
    assert main(["convert", str(clip.path), str(tmp_path / "x"), "--to", "challenge", "--window", "4"]) == 2
    assert "its filters are RG, GB, not green; sense it with --colour green" in capsys.readouterr().err


def test_planes_fire_by_the_law_of_the_layout(tmp_path):
    """A static scene: the share of planes that fired is 1 - exp(-0.5 x) plus dark counts; colours are independent."""
    still = np.broadcast_to(np.linspace(0.2, 2.0, 77).reshape(7, 11), (600, 7, 11))
    clip = three_bands(tmp_path / "c", ppp=0.4, radiance=still)
    exporting.export(clip, tmp_path / "out", Export("challenge", planes=600))
    (cube,) = challenge.cubes(tmp_path / "out")
    fired = cube.planes(0, 600)
    x = clip.stream("red").truth(0, 1)[0] * SENSOR.pde / challenge.DETECTIONS
    p = -np.expm1(-challenge.DETECTIONS * x - SENSOR.dark_count_rate * clip.exposure)
    checks = 4 * p.size
    for place in np.ndindex(*p.shape):
        for colour in range(3):
            assert_share(int(fired[:, *place, colour].sum()), 600, p[place], checks=checks)
        both = int((fired[:, *place, 0] & fired[:, *place, 2]).sum())
        assert_share(both, 600, p[place] ** 2, checks=checks)


def test_a_data_set_becomes_scenes_by_split_and_one_line_says_what_was_written(tmp_path, capsys):
    clip = three_bands(tmp_path / "clip", frames=7)
    words = ["convert", str(clip.path), str(tmp_path / "out"), "--to", "challenge", "--window", "3"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "2 cubes of 3 planes of 5 x 13 pixels in three colours (the benchmark's are 1024 of 800 x 800)" in said
    assert "planes that fill no cube (1)" in said
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        *("000000.npy", "000000.png", "000001.npy", "000001.png", "meta.json")
    ]
    assert main(words) == 2
    assert main([*words, "--force"]) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("no blue", "has no stream called blue"),
        ("two bits", "2-bit codes"),
        ("same seed", "has the same seed 0, and so the same noise, as red"),
        ("QIS", "1-bit codes [9, 5, 13] of a QIS"),
    ],
)
def test_streams_that_are_not_three_bands_are_refused(tmp_path, capsys, change: str, message: str):
    clip = three_bands(tmp_path / "clip")
    if change == "no blue":
        (clip.path / "streams" / "blue.json").unlink()
    elif change == "QIS":
        clip.sense("quiver-physical", bits=1, ppp=0.4, seed=5, name="green", force=True)
    else:
        sensor = replace(SENSOR, bits=2) if change == "two bits" else SENSOR
        clip.sense(sensor, ppp=0.4, seed=0 if change == "same seed" else 9, name="green", force=True)
    before = sorted(tmp_path.rglob("*"))
    assert main(["convert", str(clip.path), str(tmp_path / "new" / "out"), "--to", "challenge", "--window", "9"]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_damaged_cubes_are_refused_in_one_line(tmp_path):
    """Every shortened file and every wrong width is refused; a changed header is refused or read as an array."""
    clip = three_bands(tmp_path / "clip")
    exporting.export(clip, tmp_path / "out", Export("challenge", planes=9))
    path = tmp_path / "out" / "000000.npy"
    side = tmp_path / "out" / "meta.json"
    good = path.read_bytes()
    stated = json.loads(side.read_text())
    for length in (0, 1, 60, 127, 128, len(good) - 1):
        path.write_bytes(good[:length])
        with pytest.raises(ValueError, match=r"000000\.npy") as caught:
            challenge.read_cube(path)
        one_line(caught.value, path)
    rng = np.random.default_rng(3)
    for _ in range(150):
        changed = bytearray(good)
        changed[rng.integers(0, 128)] = rng.integers(256)
        path.write_bytes(bytes(changed))
        try:
            cube = challenge.read_cube(path)
        except ValueError as error:
            assert "\n" not in str(error)  # noqa: PT017
        else:
            assert cube.planes(0, 1).shape[1:] == (*cube.shape[1:], 3)
    path.write_bytes(good)
    for value in VALUES:
        side.write_text(json.dumps(stated | {"width": value}))
        if type(value) is int and 9 <= value <= 16:
            continue
        with pytest.raises(ValueError, match=r"meta\.json") as caught:
            challenge.read_cube(path)
        assert "\n" not in str(caught.value)
    for array in (np.zeros((2, 3, 4), np.uint8), np.zeros((2, 3, 4, 3), np.int8), np.zeros((2, 3, 4, 1), np.uint8)):
        np.save(path, array)
        with pytest.raises(ValueError, match="a cube of the challenge is uint8"):
            challenge.read_cube(path)


def test_a_truth_of_another_size_is_refused(tmp_path):
    clip = three_bands(tmp_path / "clip")
    exporting.export(clip, tmp_path / "out", Export("challenge", planes=9))
    (cube,) = challenge.cubes(tmp_path / "out")
    Image.fromarray(np.zeros((5, 12, 3), np.uint8)).save(tmp_path / "out" / "000000.png")
    with pytest.raises(ValueError, match="its cube needs RGB of 5 x 13"):
        cube.truth()
    (tmp_path / "out" / "000000.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"000000\.png"):
        cube.truth()
    (tmp_path / "out" / "000000.png").unlink()
    assert cube.truth() is None
    with pytest.raises(ValueError, match="holds no cubes of the challenge"):
        challenge.cubes(tmp_path / "clip")
