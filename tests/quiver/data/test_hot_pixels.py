"""Hot pixels that no map states: found by their own codes, and never a star; on an independent camera."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import spad_camera
from numpy import ndarray as Array

import quiver
from qsim import BinarySPAD
from qsim.formats import importing
from qsim.formats.recording import Hints
from quiver.cli.program import main
from quiver.data.codes import Codes, array_codes
from quiver.data.hot_pixels import scan
from quiver.data.stream_windows import StreamWindows, stream_at
from quiver.data.windows import WindowSettings

SHAPE = (48, 64)
PLANES = 7
SENSOR = BinarySPAD(1.0, 0.0).of_planes(PLANES)
PICTURE = spad_camera.texture(160, 5)


def codes_of(scene: spad_camera.Scene, light: float, dark: Array, codes: int = 96) -> Codes:
    found = spad_camera.Camera(dark).codes(scene, light, codes, PLANES, 3)
    return array_codes(found, SENSOR, PLANES * 1e-4)


@pytest.mark.parametrize("light", [0.5, 4.0])
@pytest.mark.parametrize(
    "scene",
    [
        spad_camera.panned(PICTURE, SHAPE, 0.5),
        spad_camera.turned(PICTURE, SHAPE, 0.02),
        spad_camera.passing(PICTURE, SHAPE, 1.0),
    ],
    ids=["pan", "turn", "disc"],
)
def test_hot_pixels_of_a_moving_scene_are_found(scene, light):
    """All that fire as often as the mean light gives, and no other pixel; of the same clip without them none."""
    hot, dark = spad_camera.hot_map(SHAPE, 0.01, 1)
    found = scan(codes_of(scene, light, dark)).hot
    assert not (found & ~hot).any()
    bright = dark > max(light / PLANES, 0.3)
    assert found[bright].mean() >= 0.8
    assert not scan(codes_of(scene, light, 0 * dark)).hot.any()


def dusk(scene: spad_camera.Scene) -> spad_camera.Scene:
    return lambda time: scene(time) + 0.005 * time


def shadow(scene: spad_camera.Scene) -> spad_camera.Scene:
    return lambda time: scene(time) * (1 - 0.7 / (1 + np.exp(-(0.8 * time - np.arange(SHAPE[1])) / 3)))


def flicker(scene: spad_camera.Scene) -> spad_camera.Scene:
    return lambda time: scene(time) * (1 + 0.5 * np.sin(time))


@pytest.mark.parametrize("light", [0.5, 2.0, 8.0])
@pytest.mark.parametrize(
    "changed", [lambda scene: scene, dusk, shadow, flicker], ids=["still", "dusk", "shadow", "lamp"]
)
def test_a_still_star_field_loses_none_of_its_stars(changed, light):
    """Stars of one pixel each, beside light that changes; restored as without a scan."""
    scene, where = spad_camera.stars(SHAPE, 0.01, 2)
    codes = codes_of(changed(scene), light, np.zeros(SHAPE))
    assert where.sum() > 15
    assert not scan(codes).hot.any()


@pytest.mark.parametrize(("light", "speed"), [(0.1, 0.5), (0.3, 0.1), (0.3, 0.5), (1.0, 0.1)])
def test_hot_pixels_are_found_in_little_light(light, speed):
    """Sums of 7 planes of a pan: most of what is brighter than the mean light, and nothing else."""
    hot, dark = spad_camera.hot_map(SHAPE, 0.01, 4)
    scene = spad_camera.panned(PICTURE, SHAPE, speed)
    found = scan(codes_of(scene, light, dark)).hot
    bright = PLANES * dark > 2 * light
    assert not (found & ~hot).any()
    assert found[bright].mean() >= 0.9
    assert not scan(codes_of(scene, light, 0 * dark)).hot.any()


def test_lamps_of_one_pixel_before_a_pan_are_no_hot_pixels():
    """Each hides what passes behind it, and its light does not change; hot pixels add to what passes, and are found."""
    hot, dark = spad_camera.hot_map(SHAPE, 0.01, 1)
    rng = np.random.default_rng(6)
    lamps = (rng.random(SHAPE) < 0.01) & ~hot
    light = np.exp(rng.uniform(0, np.log(8.0), SHAPE))
    moved = spad_camera.panned(PICTURE, SHAPE, 0.5)
    found = scan(codes_of(lambda time: np.where(lamps, light, moved(time)), 3.0, 0 * dark)).hot
    assert found[lamps].mean() <= 0.25
    found = scan(codes_of(lambda time: np.where(lamps, light, moved(time)), 3.0, dark)).hot
    assert found[dark > 0.6].mean() >= 0.8


def test_a_mosaic_is_compared_colour_by_colour():
    """Filters that pass half the light to every second pixel are no hot pixels, and hide none."""
    from dataclasses import replace

    from qsim.sensor import colour_filter

    hot, dark = spad_camera.hot_map(SHAPE, 0.01, 1)
    filters = np.where(np.add.outer(np.arange(48), np.arange(64)) % 2, 0.3, 1.0)
    moved = spad_camera.panned(PICTURE, SHAPE, 0.5)
    for rate in (dark, 0 * dark):
        codes = replace(codes_of(lambda time: filters * moved(time), 4.0, rate), colour=colour_filter.load("rggb"))
        found = scan(codes).hot
        assert not (found & ~hot).any()
        assert found[rate > 1].mean() > 0.7 if rate.any() else not found.any()


@pytest.fixture
def recording(tmp_path, monkeypatch) -> Array:
    """A bare array with hot pixels; returns where they are."""
    monkeypatch.chdir(tmp_path)
    hot, dark = spad_camera.hot_map(SHAPE, 0.01, 1)
    moved = spad_camera.panned(PICTURE, SHAPE, 0.5)
    np.save("capture.npy", spad_camera.Camera(dark).codes(moved, 4.0, 96, PLANES, 3))
    return hot


def test_a_recording_without_a_map_is_scanned(recording, capsys):
    """On by default and told; --no-scan leaves the codes, and a map takes its place."""
    line = "restore capture.npy --sensor spad-320x240 --bits 3 --method moment:1 --frame-rate 1000 -o {} --json"
    assert main(line.format("a.npy").split()) == 0
    said = json.loads(capsys.readouterr().out)["scan"]
    assert "hot pixels found by the scan" in said
    assert main([*line.format("b.npy").split(), "--no-scan"]) == 0
    assert "scan" not in json.loads(capsys.readouterr().out)["scan"]
    changed = (np.load("a.npy") != np.load("b.npy")).any(axis=0)
    assert changed.any()
    assert not (changed & ~recording).any()
    np.save("hot.npy", recording)
    assert main([*line.format("c.npy").split(), "--defects", "hot.npy", "--no-scan"]) == 2
    assert "the map of defective pixels is given; leave it out" in capsys.readouterr().err
    sensor = BinarySPAD(1.0, 0.0, 3)
    with pytest.warns(UserWarning, match="hot pixels found by the scan"):
        video = quiver.restore(np.load("capture.npy"), "moment:1", sensor=sensor, exposure=1e-3)
    np.testing.assert_array_equal(video, np.load("a.npy"))
    plain = quiver.restore(np.load("capture.npy"), "moment:1", sensor=sensor, exposure=1e-3, scan=False)
    np.testing.assert_array_equal(plain, np.load("b.npy"))


def test_a_network_learns_from_filled_codes(recording):
    """The windows of bit2bit, also in a worker, which opens the recording again."""
    importing.to_stream(
        importing.read("capture.npy", Hints(layout="codes", bits=3)), Path("own"), importing.Import(1000.0)
    )
    window = WindowSettings(frames=11, crop=48)
    filled, plain = (StreamWindows(stream_at(Path("own.npy"), scan), window) for scan in (None, False))
    assert "hot pixels found" in filled.codes.scan
    for windows in (filled, plain):
        again = pickle.loads(pickle.dumps(windows))
        np.testing.assert_array_equal(again[0]["codes"], windows[0]["codes"])
    assert not np.array_equal(filled[0]["codes"], plain[0]["codes"])


def test_clips_too_short_tell_nothing():
    _, dark = spad_camera.hot_map(SHAPE, 0.01, 1)
    moved = spad_camera.panned(PICTURE, SHAPE, 0.5)
    assert not scan(codes_of(moved, 4.0, dark, codes=5)).hot.any()
