"""The program that times merging in batches beside the plain one: it runs both, and states ratios of medians."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import merge_cost  # noqa: E402  (docs are not a package)


def test_the_ratio_is_that_of_the_medians():
    found = {"a frame": {"plain": [3.0, 9.0, 2.0], "batches": [2.0, 1.0, 8.0]}}
    text = merge_cost.page(found, 2, busy=True)
    assert "| a frame | 3000 | 2000 | 1.50 |" in text
    assert "with 2 threads." in text
    assert "Measured beside other programs." in text
    assert "beside other programs" not in merge_cost.page(found, 1, busy=False)


def test_mistakes_are_one_sentence(tmp_path, capsys):
    for words in (["--runs", "0"], ["--threads", "0"], ["--height", "8"], ["--height", "600"]):
        assert merge_cost.main(["--busy", *words, "--out", str(tmp_path / "cost.md")]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_both_programs_run(tmp_path):
    words = ["--busy", "--runs", "1", "--height", "32", "--threads", "1", "--out", str(tmp_path / "cost.md")]
    assert merge_cost.main(words) == 0
    assert "a training window of 11 x 64 x 64" in (tmp_path / "cost.md").read_text()
