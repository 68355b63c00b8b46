"""Planes of a clip that are summed now: the same codes, light and truth in every command that takes the clip."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip

import quiver
from qsim import BinarySPAD, PlaneSums
from quiver.cli import main
from quiver.data.codes import sensed, stored
from quiver.data.illumination import Illumination

SPAD = "spad-320x240"


@pytest.fixture
def clip(tmp_path, monkeypatch):
    """A clip of 40 frames with a stream of planes and one of their sums of three."""
    monkeypatch.chdir(tmp_path)
    made = write_clip(tmp_path / "c", frames=40, height=8, width=9)
    made.sense(SPAD, ppp=0.5, bits=1, seed=4, name="one")
    made.sense(SPAD, ppp=1.5, planes=3, seed=4, name="three")
    return made


def test_a_restored_clip_has_the_codes_and_the_light_of_its_evaluation(clip, capsys):
    """Any number of planes: `--ppp` is that of a code in both commands, and both rates are printed."""
    rng = np.random.default_rng(7)
    for planes in (1, 2, 3, *(int(n) for n in rng.choice(np.arange(4, 41), 5, replace=False))):
        line = f"restore c -o r.npy --force --method naive --sensor {SPAD} --ppp 2.5 --seed 9 --planes {planes}"
        assert main(line.split()) == 0
        codes, truth = sensed(clip, Illumination.of(SPAD, 2.5, None).over(planes, None), 9)
        expected = quiver.restore(codes.read(0, len(truth)), "naive", sensor=codes.sensor, exposure=codes.exposure)
        assert codes.ppp == pytest.approx(2.5)
        np.testing.assert_array_equal(np.load("r.npy"), expected)
        assert (planes > 1) == (f"{planes} planes per code, 2000 planes/s" in capsys.readouterr().out)


def test_python_senses_a_clip_over_planes_as_the_command_does(clip):
    line = "restore c -o r.npy --method naive --bits 3 --ppp"
    assert main([*line.split(), "2.5", "--planes", "4", "--from", "8"]) == 0
    for source in (clip, clip.path):
        found = quiver.restore(source, "naive", ppp=2.5, planes=PlaneSums(8, planes=4))
        np.testing.assert_array_equal(found, np.load("r.npy"))


def test_planes_of_a_sensed_clip_begin_where_a_code_begins(clip, capsys):
    line = f"restore c -o r.npy --method naive --sensor {SPAD} --ppp 2.5 --planes 3"
    assert main([*line.split(), "--from", "7"]) == 2
    assert "--from: 7: codes of 3 frames of a clip begin at multiples of 3" in capsys.readouterr().err
    assert main([*line.split(), "--from", "6", "--to", "31", "--every", "9"]) == 0
    found = json.loads(Path("r.json").read_text())
    np.testing.assert_allclose(found["times"]["values"], (6 + 1.5 + 9 * np.arange(3)) / 2000)
    assert found["planes"] == {"start": 6, "stop": 27, "every": 9}


def test_stored_planes_are_scored_as_their_sums(clip, capsys):
    """Codes and truth of `--stream one --planes 3` are those of the stored sums of three."""
    codes, truth = stored(clip, "one", 3)
    sums, same = stored(clip, "three")
    np.testing.assert_array_equal(codes.read(0, 13), sums.read(0, 13))
    np.testing.assert_allclose(truth.video(0, 13), same.video(0, 13), rtol=1e-9)
    scores = []
    for n, words in enumerate(("--stream one --planes 3", "--stream three")):
        line = f"evaluate c -o t{n} --split all --methods moment:3 --json {words}"
        assert main(line.split()) == 0
        scores.append(json.loads(capsys.readouterr().out)["table"][0])
    assert scores[0]["light"] == "one, 3 planes"
    assert scores[0]["scores"] == scores[1]["scores"]


def test_windows_of_other_planes_than_the_stored_ones(clip):
    """`planes=10` beside stored sums of three: the sensor of the stream, in sums of ten."""
    only = write_clip(clip.path.parent / "d", frames=40, height=8, width=9)
    only.sense(BinarySPAD(0.4, 1.0).of_planes(3), ppp=1.5, planes=3, name="three")
    data = quiver.windows(only, planes=10, frames=3, crop=8)
    assert data.noise.noises[0].device(5e-4).levels == 11
    assert data[0]["codes"].shape == (3, 1, 8, 8)
