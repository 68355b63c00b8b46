"""Sums of binary planes: the same answer as from the planes, and no other reading of them without a word."""

import json

import numpy as np
import pytest

from qsim.calibration.frame_statistics import measure, measure_sums
from qsim.calibration.spad import calibrate_spad
from qsim.cli.program import main
from qsim.formats import importing
from qsim.formats.mat_files import mat_array
from qsim.formats.recording import Hints

H, W = 12, 14


def draw(rng: np.random.Generator, planes: int, rate: float, prnu: float = 0.0) -> np.ndarray:
    """Planes [T, H, W] of a SPAD array with a spread of dark counts."""
    arrivals = rate * np.maximum(1 + prnu * rng.standard_normal((H, W)), 0) * rng.lognormal(0, 0.3, (H, W))
    return rng.random((planes, H, W)) < -np.expm1(-arrivals)


@pytest.mark.parametrize("seed", range(12))
def test_sums_are_calibrated_exactly_as_their_planes(seed):
    """Random numbers of planes, sums, light and dark: every value, interval and map is equal to the last bit.

    Afterpulsing alone needs the order of the planes, which sums do not keep.
    """
    rng = np.random.default_rng(seed)
    planes = int(rng.integers(1, 40))
    stacks = []
    for rate, photons in ((0.01, 0.0), (float(rng.uniform(0.05, 3)), 0.8), (float(rng.uniform(0.05, 3)), 1.6)):
        frames = int(rng.integers(2, 9))
        bits = draw(rng, frames * planes, rate, 0.1)
        exposure = 1e-5
        sums = bits.reshape(frames, planes, H, W).sum(axis=1)
        kind = rng.choice([np.uint16, np.float64, np.int64])
        one = measure([bits], bits=1, exposure=exposure, photons=photons)
        stacks.append((one, measure_sums([sums[:1].astype(kind), sums[1:].astype(kind)], planes=planes,
                                         exposure=exposure, photons=photons)))  # fmt: skip
    for one, many in stacks:
        assert np.array_equal(one.total, many.total)
        assert np.array_equal(one.square, many.square)
        assert np.array_equal(one.histogram, many.histogram)
        assert one.frames == many.frames
    found = [calibrate_spad([pair[i] for pair in stacks[:1]], [pair[i] for pair in stacks[1:]], bits=1) for i in (0, 1)]
    kept = {name: value for name, value in found[0].values.items() if name != "afterpulsing"}
    assert found[1].values == kept
    assert np.array_equal(found[0].maps["dark_count_rate"], found[1].maps["dark_count_rate"])
    assert any("afterpulsing is not measured" in words for words in found[1].warnings)


def test_one_frame_of_sums_is_enough():
    ones = np.random.default_rng(0).binomial(4096, 0.3, (H, W))
    one = measure_sums([ones], planes=4096, exposure=1e-5, photons=None)
    assert np.array_equal(one.total, ones)
    assert one.frames == 4096
    assert one.histogram.tolist() == [4096 * ones.size - ones.sum(), ones.sum()]


def test_another_number_of_planes_is_noticed():
    """4096 planes at 30 %: taken as 8192 the binomial would be 0.70 / 0.85 of what it is."""
    sums = np.random.default_rng(1).binomial(4096, 0.3, (30, H, W))
    right, wrong = (measure_sums([sums], planes=n, exposure=1e-5, photons=None) for n in (4096, 8192))
    sigma = np.sqrt(2 / (29 * H * W))
    assert abs(right.dispersion - 1) < 5 * sigma
    assert abs(wrong.dispersion - 0.7 / 0.85) < 5 * sigma
    assert not any("scatter" in words for words in calibrate_spad([], [right], bits=1).warnings)
    assert any("scatter 0.8" in words for words in calibrate_spad([], [wrong], bits=1).warnings)


def test_values_above_the_planes_name_their_place():
    with pytest.raises(ValueError, match=r"5 at \(t, y, x\) = \(1, 0, 0\) is no sum of 4 planes, 0..4"):
        measure_sums([np.zeros((1, H, W), int), np.full((1, H, W), 5)], planes=4, exposure=1e-5, photons=None)
    with pytest.raises(ValueError, match="sums of N binary planes are calibrated with --planes N"):
        measure([np.full((1, H, W), 19)], bits=1, exposure=1e-5, photons=None)


# The command


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Dark and flat sums of 50 planes as .npy and .mat, and the planes of the dark ones."""
    from scipy.io import savemat

    rng = np.random.default_rng(3)
    monkeypatch.chdir(tmp_path)
    dark, flat = draw(rng, 300, 0.01), draw(rng, 300, 0.5, 0.1)
    for name, planes in (("dark", dark), ("flat", flat)):
        np.save(f"{name}_planes.npy", planes.astype(np.uint8))
        sums = planes.reshape(6, 50, H, W).sum(axis=1)
        np.save(f"{name}.npy", sums.astype(np.uint16))
        savemat(f"{name}.mat", {f"{name}_sum": sums.transpose(1, 2, 0).astype(float), "label": "some words"})
    savemat("two.mat", {"a": np.ones((H, W)), "b": np.zeros((H, W, 2))})
    return tmp_path


def calibrated(capsys, words: str) -> dict[str, dict[str, float]]:
    assert main(["calibrate", *words.split(), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["values"]
    found.pop("afterpulsing", None)
    return found


def test_command_reads_sums_of_every_kind_of_file_alike(folder, capsys):
    planes = calibrated(
        capsys, "--model spad --bits 1 --dark dark_planes.npy 1e-5 --flat flat_planes.npy 1e-5 0.9 -o a.toml"
    )
    for n, words in enumerate(("dark.npy flat.npy", "dark.mat flat.mat", "dark.mat flat.npy")):
        dark, flat = words.split()
        found = calibrated(capsys, f"--planes 50 --dark {dark} 1e-5 --flat {flat} 1e-5 0.9 -o s{n}.toml")
        assert found == planes


def test_what_is_assumed_is_printed(folder, capsys):
    assert main(["calibrate", "--planes", "50", "--dark", "dark.npy", "1e-5", "-o", "a.toml"]) == 0
    assert (
        "taken as: sums of 50 binary planes of a SPAD; seconds and photons are those of one plane"
        in capsys.readouterr().out
    )
    assert main(["calibrate", "--model", "spad", "--bits", "6", "--dark", "dark.npy", "1e-5", "-o", "b.toml"]) == 0
    assert "taken as: counts of one exposure each, 6 bits (for sums of N binary planes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--model spad --bits 13 --dark dark.npy 1e-5", "may be sums of binary planes; say --planes N"),
        ("--model spad --bits 1 --dark dark.npy 1e-5", "sums of N binary planes are calibrated with --planes N"),
        ("--planes 4 --dark dark.npy 1e-5", "is no sum of 4 planes, 0..4"),
        ("--planes 50 --bits 6 --dark dark.npy 1e-5", "--bits 6: --planes 50 are 1-bit planes; leave --bits out"),
        ("--planes 0 --dark dark.npy 1e-5", "expected the number of binary planes in one value"),
        ("--planes 50 --model qis --dark dark.npy 1e-5", "--planes: a QIS is calibrated from its own codes"),
        ("--planes 50 --static dark.npy 1e-5", "--planes: binary planes have no dead time"),
        ("--planes 50 --width 14 --dark dark.npy 1e-5", "--width: it is for packed binary planes"),
        ("--planes 50 --paralyzable --dark dark.npy 1e-5", "--paralyzable: binary planes have no dead time"),
        ("--planes 50 --ignore-dead-time --dark dark.npy 1e-5", "--ignore-dead-time: binary planes have no dead time"),
        ("--planes 50 --variable x --dark dark.npy 1e-5", "--variable names an array of a .mat file; leave it out"),
        ("--planes 50 --dark two.mat 1e-5", "holds the arrays ['a', 'b']; choose one with --variable a"),
        ("--planes 50 --variable c --dark two.mat 1e-5", "has no array c; it holds ['a', 'b']"),
        ("--dark dark.npy 1e-5", "--bits: is needed, as in --bits 8"),
        ("--bits 8 --paralyzable --dark dark.npy 1e-5", "--paralyzable: it is for --model spad and --static; leave"),
        ("--bits 8 --ignore-dead-time --dark dark.npy 1e-5", "--ignore-dead-time: it is for --model spad"),
        ("--bits 8 --ignore-dead-time --static dark.npy 1e-5", "--ignore-dead-time: it is for --model spad"),
        ("--bits 8 --model qis --static dark.npy 1e-5", "--model qis: --static finds the dead time of a counting SPAD"),
        ("--bits 8 --width 8 --dark dark.npy 1e-5", "--width: it is for packed binary planes, and --bits is 8"),
        ("--bits 8 --width 8 --static dark.npy 1e-5", "--width: it is for packed binary planes"),
        ("--bits 1 --dark dark_planes.npy 1e-5 --flat flat_planes.npy 1e-5", "1 bit per code cannot tell gain"),
        ("--bits 8 --model spad --paralyzable --ignore-dead-time --dark dark.npy 1e-5", "takes no dead time"),
    ],
)  # fmt: skip
def test_options_that_cannot_act_are_refused(folder, capsys, words, message):
    assert main(["calibrate", *words.split(), "-o", "x.toml"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (folder / "x.toml").exists()


def test_each_option_changes_the_answer(folder, capsys):
    """Every option against the same run without it."""
    pair = "--dark dark.npy 1e-5 --flat flat.npy 1e-5 0.9"
    plain = calibrated(capsys, f"--model spad --bits 6 {pair} -o a.toml")
    for n, words in enumerate(("--paralyzable", "--ignore-dead-time")):
        assert calibrated(capsys, f"--model spad --bits 6 {pair} {words} -o b{n}.toml") != plain
    assert calibrated(capsys, f"--model spad --bits 7 {pair} -o c.toml")["dark_count_rate"] == plain["dark_count_rate"]
    assert calibrated(capsys, f"--model spad --planes 1 --bits 6 {pair} -o d.toml") == plain
    assert calibrated(capsys, f"--planes 50 {pair} -o e.toml") != plain
    both = [calibrated(capsys, f"--planes 50 --variable {name} --dark two.mat 1e-5 -o of_{name}.toml") for name in "ab"]
    assert both[0] != both[1]


# Arrays of .mat files


@pytest.mark.parametrize("level", ["5", "7.3"])
def test_the_only_array_of_a_mat_is_taken(tmp_path, level):
    codes = np.random.default_rng(0).integers(0, 9, (4, 5, 7)).astype(np.uint16)
    path = tmp_path / "a.mat"
    if level == "5":
        from scipy.io import savemat

        savemat(path, {"counts": codes.transpose(1, 2, 0), "gate": 3.0})
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w", userblock_size=512) as file:
            file["counts"] = codes.transpose(0, 2, 1)
            file["gate"] = np.ones((1, 1))
    assert np.array_equal(mat_array(path), codes)
    assert np.array_equal(mat_array(path, "counts"), codes)
    recording = importing.read(path, Hints(bits=4))
    assert np.array_equal(recording.read(0, 4), codes)
    with pytest.raises(ValueError, match="has no array OUTPUT; it holds"):
        mat_array(path, "OUTPUT")


def test_a_name_of_an_array_is_refused_elsewhere(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((2, 3, 4), bool))
    with pytest.raises(ValueError, match="--variable changes nothing for codes; leave it out"):
        importing.read(tmp_path / "a.npy", Hints(variable="x"))


def test_values_that_are_no_counts_are_refused(tmp_path):
    from scipy.io import savemat

    for name, value in (("half", 0.5), ("negative", -1.0), ("nothing", np.nan)):
        savemat(tmp_path / f"{name}.mat", {"x": np.full((3, 4), value)})
        with pytest.raises(ValueError, match="expected whole numbers from 0 up"):
            mat_array(tmp_path / f"{name}.mat")


def test_an_efficiency_that_cannot_be_is_not_written_without_a_word(folder, capsys):
    """Photons too few by 100 gave a sensor of efficiency 1 in silence; swapped files spoke of BinarySPAD.pde."""
    line = "--planes 50 --dark {} 1e-5 --flat {} 1e-5 {} -o e.toml --force"
    for photons, odd in ((0.9, False), (0.006, True)):
        assert main(["calibrate", *line.format("dark.npy", "flat.npy", photons).split()]) == 0
        assert ("above 1, and the sensor file holds 1: are photons" in capsys.readouterr().out) == odd
    (folder / "e.toml").unlink()
    assert main(["calibrate", *line.format("flat.npy", "dark.npy", 0.9).split()]) == 2
    assert "hold no more counts than the dark frames; are --dark and --flat swapped" in capsys.readouterr().err
    assert not (folder / "e.toml").exists()
