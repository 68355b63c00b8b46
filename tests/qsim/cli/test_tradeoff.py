"""Tests `qsim tradeoff`: numbers, figure and streams, and one line for a mistake."""

import json

import numpy as np
import pytest
from waves import SIZE, wave_clip

from qsim.cli.program import main
from qsim.streams.clip import Clip
from qsim.streams.storing import replay
from qsim.studies.bit_depth import clip_study


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return wave_clip(tmp_path_factory.mktemp("tradeoff") / "wave", 64, 1)


def test_command_writes_numbers_figure_and_streams(clip, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["tradeoff", str(clip.path), "--ppp", "0.65", "--bits", "1,3", "-o", str(out), "--json", "--streams"]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((out / "tradeoff.json").read_text())
    assert [(row["model"], row["bits"]) for row in found["rows"]] == [
        ("planes", 1),
        ("planes", 3),
        ("multibit", 1),
        ("multibit", 3),
    ]
    assert (out / "tradeoff.png").read_bytes().startswith(b"\x89PNG")
    deep, shallow = (Clip.open(out / "streams" / f"wave_{bits}bit") for bits in (3, 1))
    assert deep.streams == ("multibit", "planes")
    assert deep.shape == (9, *SIZE)
    assert deep.verify() == []
    planes = shallow.stream("planes").codes()[:63].reshape(9, 7, *SIZE).sum(axis=1)
    assert np.array_equal(planes, deep.stream("planes").codes())
    assert np.array_equal(*replay(deep, deep.stream("multibit"), 4))
    assert np.array_equal(deep.sharp(2), clip.radiance(2 * 7 + 3))
    mean = deep.stream("multibit").photons_factor * np.mean([deep.radiance(t) for t in range(9)])
    assert mean == pytest.approx(7 * 0.65, rel=2e-2)
    assert main(words) == 2
    assert "--force" in capsys.readouterr().err


def test_streams_are_replaced_with_force_and_refused_before_the_study_without(clip, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    words = [
        "tradeoff",
        str(clip.path),
        "--ppp",
        "0.65",
        "--bits",
        "1,2",
        "--instants",
        "2",
        "-o",
        str(out),
        "--streams",
    ]
    for extra in ([], ["--force", "--seed", "1"]):
        assert main([*words, *extra]) == 0
    assert Clip.open(out / "streams" / "wave_2bit").stream("multibit").info.seed == 1
    (out / "tradeoff.json").unlink()
    (out / "tradeoff.png").unlink()
    monkeypatch.setattr(clip_study, "study", lambda *_, **__: pytest.fail("was studied first"))
    capsys.readouterr()
    assert main(words) == 2
    assert "wave_1bit: exists; name another, or replace it with --force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--speed", "0.5", "--ppp", "1"], "whole factors only"),
        (["--ppp", "0.1:x"], "numbers above 0"),
        (["--ppp", "1", "--bits", "9"], "render a longer clip"),
        (["--ppp", "1", "--streams"], "-o"),
    ],
)
def test_mistakes_are_one_line(clip, capsys, words, message):
    assert main(["tradeoff", str(clip.path), *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_missing_or_unknown_source_is_refused(capsys, tmp_path):
    assert main(["tradeoff"]) == 2
    assert "give a clip or a scene" in capsys.readouterr().err
    assert main(["tradeoff", "fann", "-o", str(tmp_path)]) == 2
    assert "neither a clip folder nor a scene" in capsys.readouterr().err


def test_bits_that_were_given_are_kept_and_others_widened(clip, capsys):
    words = ["tradeoff", str(clip.path), "--ppp", "0.1", "--instants", "2", "--json"]
    assert main([*words, "--bits", "1,2"]) == 0
    given = json.loads(capsys.readouterr().out)
    assert given["best"]["multibit"]["edge"] == ">="
    assert {row["bits"] for row in given["rows"]} == {1, 2}
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert {row["bits"] for row in found["rows"]} >= {1, 2, 3, 4, 5}
    assert found["answer"].startswith("at 7 px per 3-bit frame and 0.1 photons per plane, one frame, still pixels ")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--table CLIP", "--table is computed without a clip; leave the clip or scene out"),
        ("--table --ppp 1", "--ppp: changes nothing in `tradeoff --table`"),
        ("--table --px 1", "--px: changes nothing in `tradeoff --table`"),
        ("--table --speed 2", "--speed: changes nothing in `tradeoff --table`"),
        ("--table --sensor spad-320x240", "--sensor: changes nothing in `tradeoff --table`"),
        ("--table --plane-sensor quiver-paper", "--plane-sensor: changes nothing in `tradeoff --table`"),
        ("--table --instants 2", "--instants: changes nothing in `tradeoff --table`"),
        ("--table --frames 2", "--frames: changes nothing in `tradeoff --table`"),
        ("--table --seed 0", "--seed: changes nothing in `tradeoff --table`"),
        ("--table --streams", "--streams: changes nothing in `tradeoff --table`"),
        ("--table -o x", "--output: changes nothing in `tradeoff --table`"),
        ("--table --force", "--force: changes nothing in `tradeoff --table`"),
        ("--table --threads 1", "--threads: changes nothing in `tradeoff --table`"),
        ("--table --paper-figure 1", "--paper-figure: changes nothing in `tradeoff --table`"),
        ("CLIP --ppp 1 --read-noise 0", "--read-noise: is of --table; a clip or scene is seen by a sensor"),
        ("CLIP --ppp 1 --motion 10", "--motion: changes nothing in `tradeoff` of a clip or scene"),
        ("CLIP --ppp 1 --size 8x8", "--size: changes nothing in `tradeoff` of a clip"),
        ("CLIP --ppp 1 --base-fps 20000", "--base-fps: changes nothing in `tradeoff` of a clip"),
        ("CLIP --ppp 1 --frames 9", "--frames: changes nothing in `tradeoff` of a clip"),
        ("CLIP --ppp 1 --force", "--force: replaces files of --output"),
        ("CLIP --ppp 1 --px 3 --speed 2", "--px: sets the speed of the motion, and so does --speed"),
        ("CLIP --ppp 1 --px 13.9,14", "need one and the same speed; give fewer"),
        ("CLIP --ppp 1,2 --streams -o x", "--streams: writes one speed and one light level"),
        ("CLIP --ppp 1 --speed 2 --bits 1,2 --streams -o x", "--streams: writes a clip at its own speed"),
        ("--paper-figure 1 --ppp 1 -o x", "--ppp: changes nothing in `tradeoff --paper-figure`"),
        ("--paper-figure 1 --px 1 -o x", "--px: changes nothing in `tradeoff --paper-figure`"),
        ("--paper-figure 1 --bits 1 -o x", "--bits: changes nothing in `tradeoff --paper-figure`"),
        ("--paper-figure 1 --base-fps 1 -o x", "--base-fps: changes nothing in `tradeoff --paper-figure`"),
        ("--paper-figure 1 --sensor a -o x", "--sensor: changes nothing in `tradeoff --paper-figure`"),
        ("--paper-figure 1 --instants 1 -o x", "--instants: changes nothing in `tradeoff --paper-figure`"),
        ("--paper-figure 1 --frames 1 -o x", "--frames: changes nothing in `tradeoff --paper-figure`"),
        ("--paper-figure 1 --streams -o x", "--streams: changes nothing in `tradeoff --paper-figure`"),
        ("--paper-figure 1 --motion 1 -o x", "--motion: changes nothing in `tradeoff --paper-figure`"),
        ("--paper-figure 1 --speed 1,2 -o x", "--paper-figure draws one speed; give one"),
        ("--paper-figure 1 CLIP --speed 2 -o x", "--speed: changes nothing in `tradeoff --paper-figure` of a clip"),
        ("--paper-figure 1 CLIP --size 8x8 -o x", "--size: changes nothing in `tradeoff` of a clip"),
    ],
)
def test_options_that_cannot_act_are_refused(clip, capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    assert main(["tradeoff", *words.replace("CLIP", str(clip.path)).split()]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_no_signal_to_noise_ratio_is_no_number(clip, capsys):
    """Planes that always fire have no slope: null in JSON, which has no infinity, and - in the table."""
    words = ["tradeoff", str(clip.path), "--ppp", "1000", "--bits", "1,2", "--instants", "1"]
    assert main([*words, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(name))["rows"]
    assert [row["snr_db"] is None for row in rows] == [True, True, False, False]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    cells = [line.split() for line in lines if line.split()[0] == "planes"]
    assert [len(row) for row in cells] == [15, 15]
    assert [row[9] for row in cells] == ["-", "-"]


def test_a_sensor_file_of_any_bits_compares_depths(clip, tmp_path, capsys):
    (tmp_path / "spad.toml").write_text('[sensor]\nmodel = "BinarySPAD"\npde = 0.4\ndark_count_rate = 10.0\nbits = 4\n')
    words = ["tradeoff", str(clip.path), "--ppp", "0.65", "--instants", "1", "--json"]
    assert main([*words, "--bits", "1,2", "--sensor", str(tmp_path / "spad.toml")]) == 0
    assert [row["bits"] for row in json.loads(capsys.readouterr().out)["rows"]] == [1, 2, 1, 2]


@pytest.mark.parametrize("option", ["--sensor", "--plane-sensor"])
def test_a_spike_camera_is_refused_before_anything_is_rendered(tmp_path, capsys, option):
    text = '[sensor]\nmodel = "SpikeCamera"\nquantum_efficiency = 0.6\ndark_current = 100.0\nthreshold = 1000\n'
    (tmp_path / "spike.toml").write_text(text)
    words = ["tradeoff", "fan", "--ppp", "500", option, str(tmp_path / "spike.toml"), "-o", str(tmp_path / "out")]
    assert main(words) == 2
    assert "spike.toml: planes of a spike camera depend on each other" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--ppp 0:30", "expected numbers above 0"),
        ("--speed 0:8", "expected numbers above 0"),
        ("--px 3:0", "expected numbers above 0"),
        ("--base-fps 5000", "--base-fps 5000: this study needs at least 10000 planes per second"),
        ("--bits 1,5 --frames 30", "--frames 30: 5 bits need 31; give more, or fewer bits"),
        ("--sensor quiver-published", "quiver-published: its dark electrons are per frame"),
    ],
)
def test_what_no_study_can_use_is_refused_before_rendering(capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("qsim.studies.bit_depth.clips.render", lambda *_, **__: pytest.fail("a clip was rendered"))
    assert main(["tradeoff", "fan", *words.split(), "-o", "x"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_planes_of_a_sensor_with_dark_electrons_per_frame_are_named(clip, capsys):
    words = ["tradeoff", str(clip.path), "--ppp", "0.65", "--bits", "1,2", "--sensor", "quiver-published"]
    assert main([*words, "--plane-sensor", "spad-320x240"]) == 0
