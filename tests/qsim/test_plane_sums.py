"""Planes of recordings become codes: against plain loops, with both rates in every output."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray as Array

import quiver
from qsim import BinarySPAD, PlaneSums, Stream
from qsim.cli import main
from qsim.frame_times import Times
from quiver.cli import main as quiver_main

RATE = 10000.0


@pytest.fixture
def planes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Array:
    """Planes [60, 5, 13] as a bare array, packed, and imported."""
    monkeypatch.chdir(tmp_path)
    drawn = np.random.default_rng(0).integers(0, 2, (60, 5, 13), dtype=np.uint8)
    np.save("flat.npy", drawn)
    np.save("cube.npy", np.packbits(drawn, axis=2))
    assert main(f"convert cube.npy cap --layout cube --width 13 --frame-rate {RATE} -q".split()) == 0
    return drawn


def by_hand(planes: Array, sums: PlaneSums) -> list[Array]:
    """The sums of planes by a plain loop."""
    count = sums.planes or 1
    at = sums.start or 0
    stop = len(planes) if sums.stop is None else sums.stop
    found = []
    while at + count <= stop:
        found.append(planes[at : at + count].sum(axis=0))
        at += sums.every or count
    return found


def test_random_sums_are_those_of_a_loop():
    rng = np.random.default_rng(1)
    drawn = rng.integers(0, 2, (80, 2, 3), dtype=np.uint8)
    for _ in range(60):
        count = int(rng.integers(1, 12))
        asked = PlaneSums(int(rng.integers(0, 20)), int(rng.integers(40, 81)), count + int(rng.integers(0, 5)), count)
        taken = asked.over(80, "planes")
        expected = by_hand(drawn, asked)
        assert taken.codes == len(expected)
        np.testing.assert_array_equal(taken.of(lambda a, b: drawn[a:b])(0, taken.codes), expected)
        stamps = taken.times(1000.0, Times(tuple(np.arange(80.0) * 3), "us", "clock")).values
        middles = [3 * (asked.start + t * asked.every + (count - 1) / 2) for t in range(taken.codes)]
        np.testing.assert_allclose(stamps, middles)


LINE = "--planes 10 --from 3 --{} 58 --every 11"
ASKED = PlaneSums(3, 58, 11, 10)
SAID = "10 planes per code, one code every 11 planes, 10000 planes/s, 909.091 codes/s"


@pytest.mark.parametrize("source", ["cap.npy", "flat.npy --frame-rate 1e4", "cube.npy --width 13 --frame-rate 1e4"])
def test_a_recording_is_restored_from_its_sums(planes, source, capsys):
    own = "" if source == "cap.npy" else "--sensor spad-320x240"
    line = f"restore {source} {own} -o r.npy --method moment:3 {LINE.format('to')}"
    assert quiver_main(line.split()) == 0
    said = capsys.readouterr()
    assert SAID in said.out
    assert SAID in said.err
    codes = np.array(by_hand(planes, ASKED)).astype(np.uint8)
    sensor = BinarySPAD(1.0, 0.0).of_planes(10)
    np.testing.assert_array_equal(np.load("r.npy"), quiver.restore(codes, "moment:3", sensor=sensor, exposure=1e-3))
    found = json.loads(Path("r.json").read_text())
    assert (found["plane_rate"], found["planes_per_code"], found["exposure"]) == (RATE, 10, 1e-3)
    np.testing.assert_allclose(found["times"]["values"], (3 + 5 + 11 * np.arange(5)) / RATE)


def test_sums_are_converted_and_shown(planes, capsys):
    """From a foreign file and from our stream: the same codes, and both rates of each."""
    line = LINE.format("until")
    assert main(f"convert cap.npy ours {line}".split()) == 0
    assert main(f"convert cube.npy theirs --layout cube --width 13 --frame-rate {RATE} {line}".split()) == 0
    assert main(f"preview cap.npy -o p.png {LINE.format('to')}".split()) == 0
    assert capsys.readouterr().out.count(SAID) == 3
    for name in ("ours", "theirs"):
        stream = Stream.open(f"{name}.json")
        np.testing.assert_array_equal(stream.codes(0, 5), by_hand(planes, ASKED))
        assert (stream.sensor.levels, stream.exposure, stream.rates) == (11, 1e-3, SAID)
    assert quiver_main(["restore", "ours.npy", "-o", "r.npy", "--method", "moment", "-q"]) == 0
    assert SAID in capsys.readouterr().out
    assert main(["convert", "cap.npy", "e.png", "--to", "png", "--planes", "7"]) == 0
    assert "7 planes per code, 10000 planes/s, 1428.57 codes/s" in capsys.readouterr().out


def test_a_sensor_file_clashes_with_its_own_bits_alone(planes, capsys):
    """A file of no bits serves every depth; one of a plane or of the sum fits; another gives the cure."""
    text = '[sensor]\nmodel = "BinarySPAD"\npde = 0.5\ndark_count_rate = 10.0\n'
    line = "restore cube.npy --width 13 --sensor {}.toml --planes 7 -o r.npy --method moment --force -q"
    for bits in ("", "bits = 1", "bits = 3"):
        Path("a.toml").write_text(f"{text}{bits}\n")
        assert quiver_main(line.format("a").split()) == 0
    Path("b.toml").write_text(f"{text}bits = 4\n")
    assert quiver_main(line.format("b").split()) == 2
    assert "--bits: 4 in b.toml: a plane has 1 bit and a sum of 7 has 3; leave it out" in capsys.readouterr().err
    words = ["restore", "flat.npy", "--sensor", "b.toml", "--bits", "3", "-o", "s.npy", "--method", "moment", "-q"]
    assert quiver_main(words) == 2
    assert "or delete the line of bits: such a file serves every depth" in capsys.readouterr().err


def test_single_planes_are_calibrated_as_sums(planes, capsys):
    """`--planes 3` of planes finds the rate of `--summed 3` of their sums; both rates are printed."""
    np.save("sums.npy", planes.reshape(20, 3, 5, 13).sum(axis=1).astype(np.uint8))
    found = []
    for source, words in (
        ("sums.npy", "--summed 3"),
        ("flat.npy", "--planes 3 --bits 1"),
        ("cap.npy", "--planes 3"),
        ("cube.npy --width 13", "--planes 3"),
    ):
        name, *more = source.split()
        line = f"calibrate {words} --dark {name} 1e-4 {' '.join(more)} -o s.toml --json --force"
        assert main(line.split()) == 0
        told = json.loads(capsys.readouterr().out)
        found.append(told["values"]["dark_count_rate"])
        rate = "10000 planes/s, 3333.33 codes/s" if name == "cap.npy" else "rate not stated"
        assert told["rates"] == {name: f"3 planes per code, {rate}"}
    assert all(value == found[0] for value in found)
    assert "bits" not in Path("s.toml").read_text().split("[sources]")[0]


def test_sums_of_a_still_scene_are_scored_against_the_light_behind_their_saturation(tmp_path, capsys):
    """The mean of all planes as the reference: unbiased by saturation, so `moment` has the factor 1 and `naive` not."""
    light = 0.3 + 0.25 * np.sin(np.arange(20) / 3)
    drawn = np.random.default_rng(2).random((1500, 24, 20)) < -np.expm1(-light)
    np.save(tmp_path / "still.npy", np.packbits(drawn, axis=2))
    line = f"evaluate --static {tmp_path}/still.npy --width 20 --planes 10 --methods moment,naive --json"
    assert quiver_main(line.split()) == 0
    moment, naive = json.loads(capsys.readouterr().out)["scores"]
    assert abs(moment["scale"] - 1) < 0.05  # 11 codes of 10 planes: 2 % in the mean of 480 pixels, at most
    assert naive["scale"] > 1.1


@pytest.fixture
def camera_sums(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Array:
    """Sums of 200 planes that a camera made, uint8 [12, 5, 13], bare and as raw bytes."""
    monkeypatch.chdir(tmp_path)
    drawn = np.random.default_rng(3).binomial(200, 0.4, (12, 5, 13)).astype(np.uint8)
    np.save("sums.npy", drawn)
    drawn.tofile("sums.bin")
    return drawn


RAW = "--layout raw --height 5 --width 13 --bits 8 --frame-rate 100"
OF_200 = "200 planes per code, one code every 400 planes, 20000 planes/s, 50 codes/s"


def test_sums_that_a_camera_made_are_told_to_every_command(camera_sums, capsys):
    """200 planes in bytes are 200, not 255: converted, restored, scored, shown and calibrated alike."""
    assert main(f"convert sums.bin cap {RAW} --summed 200 --from 2 --every 2".split()) == 0
    assert OF_200 in capsys.readouterr().out
    stream = Stream.open("cap.json")
    np.testing.assert_array_equal(stream.codes(), camera_sums[2::2])
    assert (stream.sensor.levels, stream.info.planes_per_code, stream.exposure) == (201, 200, 0.01)
    np.testing.assert_allclose(stream.times, (2.5 + 2 * np.arange(5)) / 100)
    assert stream.info.times.source == "middles of codes, counted at 20000 planes per second"
    sensor = BinarySPAD(1.0, 0.0).of_planes(200)
    expected = quiver.restore(camera_sums[2::2], "moment:3", sensor=sensor, exposure=0.01)
    spad = "--sensor spad-320x240 --summed 200 --frame-rate 100 --from 2 --every 2"
    for name, source in (("a", "cap.npy"), ("b", f"sums.npy {spad}")):
        assert quiver_main(f"restore {source} -o {name}.npy --method moment:3".split()) == 0
        assert OF_200 in capsys.readouterr().out
        np.testing.assert_array_equal(np.load(f"{name}.npy"), expected)
    all_codes = "sums.npy -o all.npy --method moment:1 --sensor spad-320x240 --summed 200 --frame-rate 100 -q"
    assert quiver_main(["restore", *all_codes.split()]) == 0
    times = json.loads(Path("all.json").read_text())["times"]["values"]
    np.testing.assert_allclose(times, (np.arange(12) + 0.5) / 100)
    capsys.readouterr()
    assert main(["preview", "sums.npy", "-o", "p.png", "--summed", "200"]) == 0
    assert "0 black, 200 white" in capsys.readouterr().out
    dark = "calibrate --dark sums.npy 1e-4 -o s.toml --json --summed 200"
    assert main(dark.split()) == 0
    rate = json.loads(capsys.readouterr().out)["values"]["dark_count_rate"]["value"]
    assert rate == pytest.approx(-np.log1p(-camera_sums.mean() / 200) / 1e-4, rel=0.02)
    found = []
    for source in ("cap.npy", "sums.npy --summed 200 --from 2 --every 2"):
        line = f"evaluate --static {source} --frames 2 --methods moment --json --splits 1"
        assert quiver_main(line.split()) == 0
        found.append(json.loads(capsys.readouterr().out)["scores"][0]["psnr"])
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("convert sums.bin cap {RAW} --summed 100", "is no sum of 100 planes; give the right --summed"),
        (
            "convert sums.bin cap {RAW} --summed 300",
            "--summed: raw holds 8-bit codes (binary_sum), no sums of 300",
        ),
        ("convert sums.bin cap {RAW} --summed 200 --planes 3", "--planes: sums single planes, and with --summed 200"),
        ("preview sums.npy -o p.png --summed 100", "is no sum of 100 planes; give the right --summed"),
        ("preview sums.npy -o p.png --summed 200 --bits 8", "leave out --bits"),
        ("calibrate --dark sums.npy 1e-4 -o s.toml --summed 100", "is not a sum of 100 planes, 0..100"),
        (
            "restore sums.npy -o r.npy --summed 200 --sensor quiver-paper",
            "--summed: quiver-paper: only a clocked SPAD sums",
        ),
        (
            "restore sums.npy -o r.npy --summed 200 --width 99 --sensor spad-320x240",
            "--summed: sums.npy: packed planes",
        ),
        ("restore sums.npy -o r.npy --summed 70 --sensor spad-320x240", "has 0..70; give the right --summed"),
        ("preview sums.npy -o p.png --summed 200 --from 7 --to 3", "--to: 3: ends before the first plane, 7; give"),
        ("evaluate --static sums.npy --summed 200 --bits 8", "--bits: sums of 200 planes are not clipped"),
    ],
)
def test_what_contradicts_a_camera_s_sums_is_one_line(camera_sums, capsys, line, message):
    run = quiver_main if line.split()[0] in ("restore", "evaluate") else main
    before = sorted(Path.cwd().iterdir())
    assert run(line.replace("{RAW}", RAW).split()) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert sorted(Path.cwd().iterdir()) == before


def test_some_codes_of_a_stored_sum_and_truth_values_are_restored(planes, capsys):
    """`--from` of sums counts codes and names no other option; truth values are planes."""
    assert main(["convert", "cap.npy", "sums", "--planes", "6", "-q"]) == 0
    capsys.readouterr()
    assert (
        quiver_main(["restore", "sums.npy", "-o", "r.npy", "--method", "moment:1", "--from", "3", "--every", "2"]) == 0
    )
    assert "6 planes per code, one code every 12 planes, 10000 planes/s, 833.333 codes/s" in capsys.readouterr().out
    found = json.loads(Path("r.json").read_text())
    np.testing.assert_allclose(found["times"]["values"], (18 + 3 + 12 * np.arange(4)) / RATE)
    np.save("true.npy", planes.astype(bool))
    videos = []
    for name, words in (("true.npy", ""), ("flat.npy", "--bits 1")):
        line = f"restore {name} -o v.npy --method moment:3 --sensor spad-320x240 --force -q {words}"
        assert quiver_main(line.split()) == 0
        videos.append(np.load("v.npy"))
    np.testing.assert_array_equal(*videos)
    np.save("map.npy", np.eye(5, 13, dtype=bool))
    assert quiver_main(["restore", "cap.npy", "-o", "n.npy", "--no-scan", "--defects", "map.npy"]) == 2
    assert "--no-scan: the map of defective pixels is given; leave it out" in capsys.readouterr().err


def test_random_choices_keep_the_times_of_their_codes(planes):
    """The middle of each code after the recording began, in two steps as in one; the rates are those of the codes."""
    rng = np.random.default_rng(5)
    for n in range(8):
        start = int(rng.integers(1, 9))
        every = int(rng.integers(1, 4))
        count = int(rng.integers(1, 5))
        line = f"convert cap.npy a{n} --from {start} --every {every} -q"
        assert main(line.split()) == 0
        one = Stream.open(f"a{n}.json")
        np.testing.assert_allclose(one.times, (start + 0.5 + every * np.arange(len(one))) / RATE)
        assert main(f"convert a{n}.npy b{n} --planes {count} -q".split()) == 0
        two = Stream.open(f"b{n}.json")
        middles = start + 0.5 + every * (count * np.arange(len(two)) + (count - 1) / 2)
        np.testing.assert_allclose(two.times, middles / RATE)
        assert two.info.frame_rate == pytest.approx(RATE / every / count)
        assert ("10000 planes/s" in two.rates) == (every * count > 1)
        np.testing.assert_array_equal(two.codes(), by_hand(planes[start::every], PlaneSums(planes=count))[: len(two)])
