"""The checks beside the restorer's grid: pixelwise methods pass the shift, mistakes are one line."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from clips import write_dataset
from PIL import Image
from stats import critical_z

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import restorer_checks

from quiver.data.clips import open_clips
from quiver.data.photon_counts import Counts
from quiver.restoration.restorers import restorer, weights_path


def test_methods_of_single_pixels_do_not_depend_on_the_grid(tmp_path):
    write_dataset(tmp_path / "data", {"test": 1})
    clip = open_clips(tmp_path / "data", "test")[0]
    found = restorer_checks.shift(clip, restorer_checks.SHIFTED[0], restorer("moment"))
    assert found["difference"] == 0
    assert found["error"] > 0
    assert restorer_checks.shift(clip, restorer_checks.SHIFTED[0], restorer("mergenet"))["difference"] > 0


def test_the_program_writes_page_numbers_and_crops(tmp_path, monkeypatch):
    write_dataset(tmp_path / "data", {"test": 1})
    name = open_clips(tmp_path / "data", "test")[0].name
    counts = np.random.default_rng(0).poisson(3.0, (13, 24, 24)).astype(np.uint8)
    np.save(tmp_path / "counts.npy", counts)
    monkeypatch.setattr(restorer_checks, "SHOWN", (0.5, 26.0))
    monkeypatch.setattr(restorer_checks, "CLASSICAL", ("naive",))
    monkeypatch.setattr(restorer_checks, "RIVAL", "moment")
    words = [str(tmp_path / "data"), str(tmp_path / "counts.npy"), "--shown", name, "--out", str(tmp_path / "checks")]
    assert restorer_checks.main(words) == 0
    text = (tmp_path / "checks.md").read_text()
    assert "| mergenet, 3.25 PPP, 3 bit |" in text
    assert "| moment, 3.25 PPP, 3 bit | 0.000 | 0.000 |" in text
    assert "`counts.npy`" in text
    with Image.open(tmp_path / "checks.jpg") as picture:
        clip = open_clips(tmp_path / "data", "test")[0]
        assert picture.size == (4 * clip.shape[2], 2 * (clip.shape[1] + restorer_checks.CAPTION))


def test_a_run_folder_has_its_brightness_under_the_name_of_the_method(tmp_path):
    """Its name in scores is that of the folder, without the folders above."""
    weights = tmp_path / "mine" / "best.safetensors"
    weights.parent.mkdir()
    weights.write_bytes(weights_path("mergenet").read_bytes())
    counts = Counts(np.ones((13, 16, 16), np.uint8), np.ones(13), "ones")
    assert list(restorer_checks.brightness(counts, [str(weights.parent)], 3)) == [restorer(str(weights.parent)).name]


def test_brightness_is_that_of_the_truth():
    """Thinned photons of 16 x 16 levels up to 2.4, at 5 bits: `moment` has no bias."""
    levels = np.linspace(0.1, 2.4, 256).reshape(16, 16)
    frames = np.random.default_rng(1).poisson(levels, (40, 16, 16)).astype(np.uint8)
    counts = Counts(frames, np.ones(40), "levels")
    shares = restorer_checks.brightness(counts, ["moment"], 5)["moment"]
    sigma = (1 / 11 + 1 / 29) ** 0.5 * (levels.sum() ** 0.5) / levels.sum()
    assert len(shares) == restorer_checks.SPLITS
    assert max(abs(share - 1) for share in shares) < critical_z(checks=restorer_checks.SPLITS) * sigma


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["none", "c.npy"], "no such data set"),
        (["data", "c.npy", "--shown", "x"], "no test clip x; give --shown one of"),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, monkeypatch, capsys, words, told):
    monkeypatch.chdir(tmp_path)
    write_dataset(tmp_path / "data", {"test": 1})
    assert restorer_checks.main([*words, "--out", "checks"]) == 2
    printed = capsys.readouterr()
    assert told in printed.err
    assert printed.err.count("\n") == 1
    assert not list(tmp_path.glob("checks*"))
