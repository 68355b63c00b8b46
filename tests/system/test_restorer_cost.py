"""The program that times the restorer beside QBP + BM3D: it runs both, and states the ratio of medians."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import restorer_cost  # noqa: E402  (docs are not a package)


def test_the_ratio_is_that_of_the_medians():
    found = {"old": [(6.0, 1e9), (9.0, 1e9), (6.6, 1e9)], "own": [(2.0, 5e8), (2.2, 5e8), (8.0, 5e8)]}
    text = restorer_cost.page(found, 950_000_000, "512x1024", busy=False)
    assert "takes 950 MB" in text
    assert "Ratio of the medians: 3.00." in text
    assert "| own | 2.20 | 2.00 2.20 8.00 | 500 MB |" in text
    assert "beside other programs" not in text
    assert "Measured beside other programs." in restorer_cost.page(found, 1, "512x1024", busy=True)


def test_mistakes_are_one_sentence(tmp_path, capsys):
    for words in (["--size", "32"], ["--size", "600x1024"], ["--size", "axb"], ["--size", "8x8"], ["--runs", "0"]):
        assert restorer_cost.main(["--busy", *words, "--out", str(tmp_path / "cost.md")]) == 2
        told = capsys.readouterr().err
        assert " ".join(words) + ": give" in told
        assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_memory_of_the_command_is_that_of_its_process():
    """At least what Python and torch take; nothing of this process, which a child's `ru_maxrss` would count."""
    held = np.ones(1 << 28)  # 2 GiB
    assert 1e8 < restorer_cost.command_memory((16, 16)) < 2e9
    assert held[-1] == 1


@pytest.mark.slow
def test_both_programs_run(tmp_path):
    words = ["--busy", "--runs", "1", "--size", "32x32", "--out", str(tmp_path / "cost.md")]
    assert restorer_cost.main(words) == 0
    assert "Ratio of the medians" in (tmp_path / "cost.md").read_text()
