"""The rows about codes that sum planes: errors without those of the reference, and a page that compares costs."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from stats import critical_z

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))
import planes_rows  # noqa: E402


def test_the_noise_of_the_reference_is_not_in_an_error():
    """Errors of 0.1, and a reference three times as noisy: products of halves have a spread of about 0.3^2."""
    rng = np.random.default_rng(3)
    truth = np.full((200, 200), 0.5)
    light = truth + 0.1 * rng.standard_normal(truth.shape)
    reference = truth + 0.3 * rng.standard_normal((2, *truth.shape))
    found = planes_rows.squared_error(light, reference, math.inf)
    assert found == pytest.approx(0.01, abs=critical_z() * 0.1 / math.sqrt(truth.size))
    assert planes_rows.squared_error(truth, reference, -9.0) == 0
    assert planes_rows.decibels(2.0, 4e-4) == pytest.approx(40)
    assert planes_rows.decibels(2.0, -1.0) == pytest.approx(80)


def test_the_page_compares_codes_with_sharp_frames():
    side = {
        "samples": 8,
        "sharp_samples": 0,
        "denoise": True,
        "processor_seconds": 0.5,
        "reached": [40.0, 41.0],
        "neighbours": 0,
    }
    summed = side | {
        "samples": 2,
        "sharp_samples": 8,
        "processor_seconds": 1.0,
        "stated": [39.0, 39.0],
        "light_seconds": 0.75,
    }
    page = planes_rows.table({"fan": {"sharp": side, "summed": summed, "quiet": False}})
    assert "| fan \\* | 8, denoised | 0.50 | 2, denoised | 8 | 1.00 | 2.00 | 1.50 | 40.5 | 40.5 | 39.0 |" in page
    assert "Median ratio of 1 rows: 2.00;" in page


def test_an_unknown_family_is_one_sentence(capsys, tmp_path):
    assert planes_rows.main(["--rows", "fens", "--tiny", "--out", str(tmp_path / "rows")]) == 2
    found = capsys.readouterr()
    assert (found.out, found.err.count("\n")) == ("", 1)
