"""Tests that the page of networks on mosaics is made from its rows."""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import colour_rows


def test_the_page_is_made_from_its_rows():
    found = json.loads(colour_rows.ROWS.read_text())
    page = colour_rows.page(found)
    assert colour_rows.PAGE.read_text() == page, "run `python benchmarks/colour_rows.py --page`"
    assert "+0.73 ± 0.56" in page
    found["rows"][0]["psnr"] += 1
    assert colour_rows.page(found) != page
