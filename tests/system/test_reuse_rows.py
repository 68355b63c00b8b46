"""The program of rows about frames that share samples: spectra, flicker, honesty, and rows that are made once."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from stats import critical_z

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))
import reuse_rows  # noqa: E402

SIZE = (64, 80)  # px


def errors(seed: int, mean_of: int, frames: int = 8) -> np.ndarray:
    """Return errors [2, frames, H, W], means of independent ones of neighbours, with the noise of references."""
    rng = np.random.default_rng([71, seed])
    each = rng.standard_normal((frames + mean_of - 1, *SIZE))
    ours = np.stack([each[t : t + mean_of].mean(axis=0) for t in range(frames)])
    return ours + 0.5 * rng.standard_normal((2, frames, *SIZE))


@pytest.mark.parametrize("mean_of", [1, 3, 5])
def test_flicker_falls_with_the_frames_that_errors_share(mean_of):
    """The mean of m errors changes by 2 / m^2 from frame to frame, and has 1 / m of their square: a flicker of 1 / m.

    Of 35840 steps and 40960 squares, with the noise of references in both: a standard deviation of about 2 % of 1.
    """
    assert reuse_rows.flicker(errors(1, mean_of)) == pytest.approx(1 / mean_of, abs=0.02 * critical_z())


def test_independent_errors_have_an_even_spectrum():
    """Eight frames: the lowest and the highest frequency have an eighth, the others, of two signs, a quarter."""
    found = reuse_rows.spectrum(errors(2, 1))
    np.testing.assert_allclose(found, [1 / 8, 1 / 4, 1 / 4, 1 / 4, 1 / 8], atol=0.02 * critical_z(checks=5) / 2)
    assert sum(found) == pytest.approx(1)
    assert sum(reuse_rows.spectrum(errors(2, 5))[:2]) > 0.7
    assert len(reuse_rows.spectrum(errors(3, 1, frames=7))) == 4


def test_decibels_of_a_product_below_zero_are_bounded():
    assert reuse_rows.decibels(2.0, 4e-4) == pytest.approx(40)
    assert reuse_rows.decibels(2.0, -1.0) == pytest.approx(80)


def test_a_line_counts_frames_whose_error_is_stated_well():
    line = reuse_rows.honesty("alone", [0.2, -0.9, 1.5, 2.5])
    assert "2 of 4 state their error within 1 dB, 1 state more than 2 dB too much; worst +2.50 dB" in line


def test_an_unknown_family_is_one_sentence(capsys, tmp_path):
    assert reuse_rows.main(["--rows", "fens", "--tiny", "--out", str(tmp_path / "rows")]) == 2
    found = capsys.readouterr()
    assert (found.out, found.err.count("\n")) == ("", 1)


@pytest.mark.slow
def test_rows_are_made_once_and_the_table_holds_what_they_hold(tmp_path, capsys):
    line = ["--rows", "plain", "--tiny", "--out", str(tmp_path / "rows")]
    assert reuse_rows.main(line) == 0
    assert "plain-24x32.json: written" in capsys.readouterr().out
    row = json.loads((tmp_path / "rows" / "plain-24x32.json").read_text())
    assert len(row["alone"]["reached"]) == len(row["alone"]["stated"]) == 6
    assert row["reuse"].startswith("off, each frame alone")
    assert reuse_rows.main(line) == 0
    assert capsys.readouterr().out == ""
    page = (tmp_path / "rows.md").read_text()
    assert f"| {row['alone']['processor_seconds']:.2f} |" in page
    assert "Median ratio of 1 rows: 1.00." in page
