"""Tests that the page of networks on mosaics is made from its rows."""

import json
import sys
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import colour_rows


def gain(rows: list[dict], method: str, stream: str) -> str:
    """The mean gain of a method over the control with its 95 % interval, by Student's t over scenes."""
    psnr = {(row["method"], row["scene"]): row["psnr"] for row in rows if row["stream"] == stream}
    scenes = {row["scene"] for row in rows}
    apart = np.array([psnr[method, scene] - psnr[colour_rows.CONTROL, scene] for scene in scenes])
    half = stats.t.ppf(0.975, len(apart) - 1) * stats.sem(apart)
    return f"{apart.mean():+.2f} ± {half:.2f}"


def test_the_page_is_made_from_its_rows():
    found = json.loads(colour_rows.ROWS.read_text())
    page = colour_rows.page(found)
    assert colour_rows.PAGE.read_text() == page, "run `python benchmarks/colour_rows.py --page`"
    row = found["rows"][0]
    assert row["method"] != colour_rows.CONTROL
    before = gain(found["rows"], row["method"], row["stream"])
    assert before in page
    row["psnr"] += 1
    after = gain(found["rows"], row["method"], row["stream"])
    assert after != before
    assert after in colour_rows.page(found)
