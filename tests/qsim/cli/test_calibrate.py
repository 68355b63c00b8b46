"""Tests `qsim calibrate`: sums of planes from every kind of file, and options without effect."""

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic import PLANE, draw_planes

from qsim.cli.program import main

H, W = PLANE


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Dark and flat sums of 50 planes as .npy and .mat, and the planes of the dark ones."""
    from scipy.io import savemat

    rng = np.random.default_rng(3)
    monkeypatch.chdir(tmp_path)
    dark = draw_planes(rng, 300, 0.01)
    flat = draw_planes(rng, 300, 0.5, 0.1)
    for name, planes in (("dark", dark), ("flat", flat)):
        np.save(f"{name}_planes.npy", planes.astype(np.uint8))
        sums = planes.reshape(6, 50, H, W).sum(axis=1)
        np.save(f"{name}.npy", sums.astype(np.uint16))
        savemat(f"{name}.mat", {f"{name}_sum": sums.transpose(1, 2, 0).astype(float), "label": "some words"})
    savemat("two.mat", {"a": np.ones((H, W)), "b": np.zeros((H, W, 2))})
    return tmp_path


def calibrated(capsys, words: str) -> dict[str, dict[str, float]]:
    assert main(["calibrate", *words.split(), "--json"]) == 0
    return json.loads(capsys.readouterr().out)["values"]


def test_command_reads_sums_of_every_kind_of_file_alike(folder, capsys):
    found = []
    for n, words in enumerate(("dark.npy flat.npy", "dark.mat flat.mat", "dark.mat flat.npy")):
        dark, flat = words.split()
        found.append(calibrated(capsys, f"--summed 50 --dark {dark} 1e-5 --flat {flat} 1e-5 0.9 -o s{n}.toml"))
    assert found[0] == found[1] == found[2]


def test_what_is_assumed_is_printed(folder, capsys):
    assert main(["calibrate", "--summed", "50", "--dark", "dark.npy", "1e-5", "-o", "a.toml"]) == 0
    assert (
        "taken as: sums of 50 binary planes of a SPAD; seconds and photons are those of one plane"
        in capsys.readouterr().out
    )
    assert main(["calibrate", "--model", "spad", "--bits", "6", "--dark", "dark.npy", "1e-5", "-o", "b.toml"]) == 0
    assert "taken as: counts of one exposure each, 6 bits (for sums of N binary planes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--model spad --bits 13 --dark dark.npy 1e-5", "may be sums of binary planes; give --summed N"),
        ("--model spad --bits 1 --dark dark.npy 1e-5", "sums of N binary planes are calibrated with --summed N"),
        ("--summed 4 --dark dark.npy 1e-5", "is not a sum of 4 planes, 0..4"),
        ("--summed 50 --bits 6 --dark dark.npy 1e-5", "--bits: sums of 50 planes have bits of their own; leave it out"),
        ("--summed 0 --dark dark.npy 1e-5", "--summed: expected a whole number from 1 to 65535, got '0'"),
        ("--summed 50 --model qis --dark dark.npy 1e-5", "--summed: a QIS is calibrated from its own codes"),
        ("--summed 50 --static dark.npy 1e-5", "--summed: binary planes have no dead time"),
        ("--bits 8 --width 14 --static dark.npy 1e-5", "--width: it is for packed binary planes"),
        ("--bits 8 --every 2 --static dark.npy 1e-5", "--every: the counts of --static are used as a whole"),
        ("--summed 50 --to 999 --dark dark.npy 1e-5", "--to: 999: dark.npy has 6 planes; give 6 or less"),
        ("--summed 50 --paralyzable --dark dark.npy 1e-5", "--paralyzable: binary planes have no dead time"),
        ("--summed 50 --ignore-dead-time --dark dark.npy 1e-5", "--ignore-dead-time: binary planes have no dead time"),
        ("--summed 50 --variable x --dark dark.npy 1e-5", "--variable names an array of a .mat file; leave it out"),
        ("--summed 50 --dark two.mat 1e-5", "holds the arrays ['a', 'b']; choose one with --variable a"),
        ("--summed 50 --variable c --dark two.mat 1e-5", "has no array c; it holds ['a', 'b']"),
        ("--dark dark.npy 1e-5", "--bits: is needed, as in --bits 8"),
        ("--bits 8 --paralyzable --dark dark.npy 1e-5", "--paralyzable: it is for --model spad and --static; leave"),
        ("--bits 8 --ignore-dead-time --dark dark.npy 1e-5", "--ignore-dead-time: it is for --model spad"),
        ("--bits 8 --ignore-dead-time --static dark.npy 1e-5", "--ignore-dead-time: it is for --model spad"),
        ("--bits 8 --model qis --static dark.npy 1e-5", "--model: a qis has no dead time for --static to find"),
        ("--bits 8 --width 8 --dark dark.npy 1e-5", "--width: it is for packed binary planes, and --bits is 8"),
        ("--bits 8 --width 8 --static dark.npy 1e-5", "--width: it is for packed binary planes"),
        ("--bits 1 --dark dark_planes.npy 1e-5 --flat flat_planes.npy 1e-5", "1 bit per code cannot tell gain"),
        ("--bits 8 --model spad --paralyzable --ignore-dead-time --dark dark.npy 1e-5", "takes no dead time"),
    ],
)
def test_options_that_cannot_act_are_refused(folder, capsys, words, message):
    assert main(["calibrate", *words.split(), "-o", "x.toml"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (folder / "x.toml").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--bits 8 --static same.npy 1e-5", "all frames are alike, which determines no dead time; are they copies"),
        ("--bits 4 --static full.npy 1e-5", "all frames are alike, which determines no dead time"),
        ("--bits 4 --static none.npy 1e-5", "no pixel has a mean above 1 counts; more light is needed"),
        ("--bits 4 --static one.npy 1e-5", "of at least 2 frames, got [1, 40, 40]"),
        ("--bits 4 --static large.npy 1e-5", "large.npy: 300 at (t, y, x) = (3, 20, 30) is not a code of 4 bits"),
        ("--model spad --bits 8 --dark none.npy 1e-5 --flat same.npy 1e-5 9", "all frames of flat 0 are alike"),
        ("--model spad --bits 4 --dark none.npy 1e-5 --flat full.npy 1e-5", "all frames of flat 0 are alike"),
        ("--model spad --bits 4 --dark full.npy 1e-5", "all frames of dark 0 are alike"),
        ("--model spad --bits 1 --dark none.npy 1e-5 --flat ones.npy 1e-5 1", "all frames of flat 0 are alike"),
        ("--summed 15 --dark full.npy 1e-5", "all frames of dark 0 are alike"),
        ("--model spad --bits 8 --dark noise.npy 1e-5 --flat none.npy 1e-5", "flat 0 holds no count at all"),
        ("--bits 8 --dark noise.npy 1e-5 --flat same.npy 1e-5", "all frames of flat 0 are alike, which determines"),
        ("--bits 8 --dark same.npy 1e-5 --flat same.npy 1e-5", "all frames of dark 0 are alike, which determines"),
        ("--bits 8 --dark noise.npy 1e-5 --flat one.npy 1e-5", "a stack of one frame cannot tell noise"),
    ],
)
def test_frames_that_determine_nothing_are_refused(tmp_path, monkeypatch, capsys, words, message):
    """Copies of one frame gave a dead time of 180 us +- 0.5 %, saturated ones 0 +- 2e147 s, without a warning."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(5)
    one = rng.integers(2, 14, (1, 40, 40), np.uint8)
    stacks = {"one": one, "same": one.repeat(5, axis=0), "noise": rng.integers(0, 4, (5, 40, 40), np.uint8)}
    stacks |= {name: np.full((5, 40, 40), code, np.uint8) for name, code in (("full", 15), ("ones", 1), ("none", 0))}
    stacks["large"] = rng.integers(2, 14, (5, 40, 40), np.uint16)
    stacks["large"][3, 20, 30] = 300
    for name, stack in stacks.items():
        np.save(f"{name}.npy", stack)
    assert main(["calibrate", *words.split(), "-o", "x.toml"]) == 2
    assert message in capsys.readouterr().err
    assert not Path("x.toml").exists()


def test_dark_frames_without_a_count_bound_the_dark_counts(tmp_path, monkeypatch, capsys):
    """They are alike, and determine an upper bound; one pixel that always counts changes nothing in that."""
    monkeypatch.chdir(tmp_path)
    stuck = np.zeros((5, 40, 40), np.uint8)
    np.save("none.npy", stuck)
    stuck[:, 3, 4] = 1
    np.save("stuck.npy", stuck)
    none, one = (
        calibrated(capsys, f"--model spad --bits 1 --dark {name}.npy 1e-5 -o {name}.toml") for name in ("none", "stuck")
    )
    assert none["dark_count_rate"]["high"] > 0
    assert one["dark_count_rate"]["high"] is None  # its rate is a lower limit
    assert one["dark_count_rate_good"]["high"] == pytest.approx(none["dark_count_rate"]["high"] * 1600 / 1599)
    assert one["hot_pixels"]["value"] == 1


@pytest.mark.parametrize("word", ["--paralyzable", "--ignore-dead-time"])
def test_each_word_on_dead_time_changes_the_answer(folder, capsys, word):
    rng = np.random.default_rng(5)
    for name, mean in (("few_dark", 0.2), ("few_flat", 4.0)):  # binomial counts vary less, as those with dead time do
        np.save(f"{name}.npy", rng.binomial(24, mean / 24, (30, H, W)).astype(np.uint16))
    words = "--model spad --bits 4 --dark few_dark.npy 1e-5 --flat few_flat.npy 1e-5 6"
    plain = calibrated(capsys, f"{words} -o a.toml")
    assert calibrated(capsys, f"{words} {word} -o b.toml") != plain


def test_each_option_changes_the_answer(folder, capsys):
    """Every option against the same run without it."""
    pair = "--dark dark.npy 1e-5 --flat flat.npy 1e-5 0.9"
    plain = calibrated(capsys, f"--model spad --bits 6 {pair} -o a.toml")
    deeper = calibrated(capsys, f"--model spad --bits 7 {pair} -o c.toml")
    assert deeper["dark_count_rate"]["value"] == pytest.approx(plain["dark_count_rate"]["value"], rel=1e-6)
    assert calibrated(capsys, f"--model spad --summed 1 --bits 6 {pair} -o d.toml") == plain
    assert calibrated(capsys, f"--summed 50 {pair} -o e.toml") != plain
    both = [calibrated(capsys, f"--summed 50 --variable {name} --dark two.mat 1e-5 -o of_{name}.toml") for name in "ab"]
    assert both[0] != both[1]


def test_an_efficiency_that_cannot_be_is_not_written_without_a_word(folder, capsys):
    """Photons too few by 100 gave a sensor of efficiency 1 without a warning; swapped files gave an error about pde."""
    line = "--summed 50 --dark {} 1e-5 --flat {} 1e-5 {} -o e.toml --force"
    for photons, odd in ((0.9, False), (0.006, True)):
        assert main(["calibrate", *line.format("dark.npy", "flat.npy", photons).split()]) == 0
        assert ("above 1, and the sensor file holds 1: are photons" in capsys.readouterr().out) == odd
    (folder / "e.toml").unlink()
    assert main(["calibrate", *line.format("flat.npy", "dark.npy", 0.9).split()]) == 2
    assert "hold no more counts than the dark frames; are dark and flat frames swapped" in capsys.readouterr().err
    assert not (folder / "e.toml").exists()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("force", [[], ["--force"]])
@pytest.mark.parametrize(
    ("dark", "output", "replaced"),
    [
        ("spad_dark.npy", "spad.toml", "spad_dark.npy"),
        ("link.npy", "spad.toml", "spad_dark.npy"),
        ("frames", "frames/one.toml", "frames/one.png"),
    ],
)
def test_a_recording_is_never_replaced(folder, capsys, dark, output, replaced, force):
    """The map of dark counts took the place of the dark frames spad_dark.npy."""
    Path("dark_planes.npy").rename("spad_dark.npy")
    Path("link.npy").symlink_to("spad_dark.npy")
    Path("frames").mkdir()
    Path("frames/one.png").touch()
    before = contents(folder)
    words = f"--model spad --bits 1 --dark {dark} 1e-5 --flat flat_planes.npy 1e-5 0.9 -o {output}"
    assert main(["calibrate", *words.split(), *force]) == 2
    error = capsys.readouterr().err
    assert f"{replaced}: would replace a file of the input" in error
    assert error.count("\n") == 1
    assert contents(folder) == before


@pytest.mark.parametrize("name", ["a.json", "a.png", "a_dark.npy"])
def test_files_beside_the_sensor_file_are_replaced_with_force_only(folder, capsys, name):
    """And only beside the values of a calibration: others are somebody else's."""
    Path(name).touch()
    words = "calibrate --model spad --bits 1 --dark dark_planes.npy 1e-5 --flat flat_planes.npy 1e-5 0.9 -o a.toml"
    before = contents(folder)
    assert main(words.split()) == 2
    assert f"{name}: exists; name another, or replace it with --force" in capsys.readouterr().err
    assert main([*words.split(), "--force"]) == 2
    assert f"{name}: was not written by a calibration" in capsys.readouterr().err
    assert contents(folder) == before
    Path(name).unlink()
    assert main(words.split()) == 0
    made = contents(folder)
    assert main([*words.split(), "--force"]) == 0
    assert contents(folder) == made


def test_packed_planes_without_a_count_are_read_by_their_width(folder, capsys):
    """They are alike in every layout of uint8, and the error named an option that the command does not have."""
    np.save("none.npy", np.zeros((5, H, W), np.uint8))
    np.save("packed.npy", np.packbits(np.load("none.npy"), axis=-1))
    words = "--model spad --bits 1 --dark"
    plain = calibrated(capsys, f"{words} none.npy 1e-5 -o a.toml")
    assert calibrated(capsys, f"{words} packed.npy 1e-5 --width {W} -o b.toml") == plain
