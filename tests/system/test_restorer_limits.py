"""The restorer outside of its grid: streams are what they say, known faults are found again, mistakes are one line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from stats import assert_mean

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import restorer_limits

from quiver.data.illumination import Illumination


def test_a_flat_field_has_the_light_that_it_states():
    """The gain is that of another level: codes follow the field's light."""
    codes = restorer_limits.flat(Illumination.of(ppp=3.25, bits=3), 1.5, 64, 0)
    table = codes.sensor.response(codes.exposure)
    mean, variance = (float(np.interp(1.5, table.photons, x)) for x in (table.mean, table.variance))
    assert_mean(codes.read(0, 11), mean, variance)
    assert codes.ppp == 1.5


@pytest.mark.parametrize("frames", [1, 2, 11])
def test_what_moves_has_its_light_and_its_middle(frames: int):
    codes, target = restorer_limits.moving(2.0, 3.25, 48, 1, frames)
    table = codes.sensor.response(codes.exposure)
    drawn = codes.read(frames // 2, frames // 2 + 1)[0]
    expected = np.interp(target, table.photons, table.mean)
    assert_mean(drawn - expected, 0.0, float(np.interp(target, table.photons, table.variance).mean()))
    assert codes.shape == (frames, 48, 48)


def test_light_that_changes_has_its_middle_frame():
    """The frame that is scored is as in constant light; the first and the last are 40 % darker and brighter."""
    (_, constant), (codes, target) = (restorer_limits.moving(0.0, 26.0, 48, 2, change=c) for c in (0.0, 0.8))
    np.testing.assert_allclose(target, constant, rtol=1e-12)
    means = codes.read(0, 11).mean(axis=(1, 2))
    assert 0.5 < means[0] / means[5] < 0.7  # 0.6 but for noise
    assert means[10] > means[5]


def test_patterns_slide_round_and_have_a_mean_of_one():
    for name, frames in restorer_limits.patterns(48).items():
        assert frames.shape == (11, 48, 48)
        assert frames.mean() == pytest.approx(1.0)
        assert set(np.round(np.unique(frames), 9)) == {0.2, 1.8}
        speed = 0 if "still" in name else int(name.split(", ")[1].split(" ")[0])
        np.testing.assert_array_equal(frames[6], np.roll(frames[5], speed, axis=1))


def test_a_method_without_bias_is_bright_as_the_field():
    codes = restorer_limits.flat(Illumination.of(ppp=3.25, bits=7), 3.25, 64, 3)
    table = codes.sensor.response(codes.exposure)
    slope = float(np.interp(3.25, table.photons, np.gradient(table.mean, table.photons)))
    noise = float(np.interp(3.25, table.photons, table.variance)) / slope**2 / 3.25**2
    pixels = (64 - 2 * restorer_limits.EDGE) ** 2
    sample = np.full(11 * pixels, restorer_limits.brightness("moment", codes, 3.25))
    assert_mean(sample, 1.0, noise)


def test_the_program_writes_page_and_numbers(tmp_path, monkeypatch):
    """With small lists: faulty pixels cost more without their map, and every list is on the page."""
    monkeypatch.setattr(restorer_limits, "BITS", (3,))
    monkeypatch.setattr(restorer_limits, "LEVELS", (3.25,))
    monkeypatch.setattr(restorer_limits, "PLANES", (1.0,))
    monkeypatch.setattr(restorer_limits, "DARK", (1.0,))
    monkeypatch.setattr(restorer_limits, "SHORT", (1, 2))
    monkeypatch.setattr(restorer_limits, "MOTION", (2.0,))
    monkeypatch.setattr(restorer_limits, "TEXTURES", (3.0,))
    monkeypatch.setattr(restorer_limits, "LIGHTS", (26.0,))
    monkeypatch.setattr(restorer_limits, "RIVAL", "moment")
    monkeypatch.setattr(restorer_limits, "SEEN", (("spad-320x240", 1.0, 1),))
    monkeypatch.setattr(restorer_limits, "CHANGES", (0.8,))
    monkeypatch.setattr(restorer_limits, "SLOW", (0.0,))
    monkeypatch.setattr(restorer_limits, "CLASSICAL", ("moment",))
    monkeypatch.setattr(restorer_limits, "CHECKS", (2,))
    monkeypatch.setattr(restorer_limits, "STRIPES", ())
    monkeypatch.setattr(restorer_limits, "POINTS", ((3.0, 8.0),))
    monkeypatch.setattr(restorer_limits, "SPEEDS", (0,))
    words = ["--draws", "2", "--size", "48", "--out", str(tmp_path / "limits")]
    assert restorer_limits.main(words) == 0
    found = json.loads((tmp_path / "limits.json").read_text())
    row = found["defects"]["26 PPP, 2 px/frame"]
    assert np.mean(row["no map"]) > np.mean(row["map"]) > 0
    assert min(found["faults"]["white, 26 PPP"]) > 0
    assert np.mean(found["textures"]["3 PPP, 2 px/frame"]) == pytest.approx(1, abs=0.1)
    assert 0 < np.mean(found["ends"]["26 PPP, 2 px/frame"]["mergenet"]) < 4  # half of the frames are missing
    text = (tmp_path / "limits.md").read_text()
    for name in (
        "3 bit, gain of 3.25 PPP",
        "moment, 1 PPP",
        "3 PPP, 2 px/frame",
        "26 PPP, 2 px/frame",
        "black, 26 PPP",
        "| 2 |",
    ):
        assert name in text
    for name in ("0 px/frame, 80 %", "checkerboard of 2 px, still, 26 PPP", "points of 8 on 3 photons, 0 px/frame"):
        assert name in text
    assert min(found["changing"]["26 PPP, 0 px/frame, 80 %"]["found"]) > 0.2


@pytest.mark.parametrize("words", [["--draws", "1"], ["--size", "31"], ["--size", "257"]])
def test_mistakes_are_one_sentence(tmp_path, capsys, words):
    assert restorer_limits.main([*words, "--out", str(tmp_path / "limits")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())
