"""The benchmark of large data sets: its page from rows, and one small size measured for real."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "benchmarks"))

import million_clips  # noqa: E402


def test_the_page_is_that_of_its_rows():
    rows = json.loads(million_clips.ROWS.read_text())
    assert million_clips.PAGE.read_text() == million_clips.page(rows), "run `python benchmarks/million_clips.py --page`"


def test_what_was_measured_keeps_its_bounds():
    """A clip of a shard begins as fast at every size, and a million clips open within 5 s in constant memory."""
    rows = {row["clips"]: row for row in json.loads(million_clips.ROWS.read_text())["rows"]}
    first = rows[1000]["one shard"]["seconds"]
    for row in rows.values():
        assert row["one shard"]["seconds"] < first + 1.0
        assert row["open"]["seconds"] < 5.0
        assert row["fullest_folder"] <= 1000
        assert row["window"]["growth_MB"] < 20.0
        assert row["two at once, one killed"]["problems"] == []
        assert row["two at once, one killed"]["exit_codes"] == [0, 0]


def test_slopes_and_costs_are_computed(monkeypatch: pytest.MonkeyPatch):
    rows = json.loads(million_clips.ROWS.read_text())["rows"][:2]
    for row, seconds in zip(rows, (0.1, 1.0), strict=True):
        row["open"]["seconds"] = seconds
    text = million_clips.page({"rows": rows})
    (line,) = [line for line in text.splitlines() if line.startswith("| open [s]")]
    assert line == "| open [s] | 0.10 | 1.00 | 1.00 |"
    before = [line for line in text.splitlines() if "core hours |" in line]
    monkeypatch.setattr(million_clips, "CLIPS", 10 * million_clips.CLIPS)
    after = [line for line in million_clips.page({"rows": rows}).splitlines() if "core hours |" in line]
    assert before != after


def test_rows_of_other_sizes_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rows = tmp_path / "rows.json"
    monkeypatch.setattr(million_clips, "measure", lambda clips, *_: {"clips": clips})
    for sizes in ("30,10", "20"):
        monkeypatch.setattr(sys, "argv", ["million_clips.py", "--sizes", sizes, "--out", str(rows)])
        million_clips.main()
    assert [row["clips"] for row in json.loads(rows.read_text())["rows"]] == [10, 20, 30]


@pytest.mark.slow
def test_a_small_size_is_measured(tmp_path: Path):
    row = million_clips.measure(20, 10, 20, tmp_path)
    assert row["two at once, one killed"]["problems"] == []
    assert set(million_clips.COMMANDS) < set(row)
