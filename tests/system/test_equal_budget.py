"""The program of the table at equal budgets: rows are made once, and tables hold what the rows hold."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "support"))

PROGRAM = [sys.executable, str(ROOT / "docs" / "equal_budget.py")]


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*PROGRAM, *map(str, words)], capture_output=True, text=True, cwd=ROOT, check=False)


def test_an_unknown_row_is_one_sentence():
    found = run("data", "--rows", "emdv", "--tiny")
    assert (found.returncode, found.stdout, found.stderr.count("\n")) == (2, "", 1)
    assert "no row is called 'emdv'; known are classical, nano" in found.stderr


@pytest.mark.slow
def test_rows_are_made_once_and_shown(tmp_path):
    from clips import write_dataset

    data = write_dataset(tmp_path / "data", {"train": 2, "val": 1, "test": 2})
    out, work = tmp_path / "rows", tmp_path / "work"
    common = [data, "--tiny", "--out", out, "--work", work]
    first = run(*common, "--rows", "classical,unet")
    assert first.returncode == 0, first.stderr
    row = json.loads((out / "unet.json").read_text())
    assert set(row["scores"]) == {f"{ppp} PPP, 3 bit" for ppp in ("3.25", "1", "9.75", "26")}
    assert row["rate"] in (3e-4, 1e-3)
    assert row["trials"][f"{row['rate']:g}".replace("0.0003", "3e-4").replace("0.001", "1e-3")] == max(
        row["trials"].values()
    )
    assert row["steps"] == row["curve"][-1]["step"] > 0
    assert row["parameters"] == 911_841
    assert row["cost"]["macs_per_pixel"] > 1e5
    assert row["reference_convolution_ms"] > 0
    written = (out / "unet.json").stat().st_mtime_ns
    second = run(*common, "--rows", "classical,unet,emvd")
    assert second.returncode == 0, second.stderr
    assert (out / "unet.json").stat().st_mtime_ns == written
    assert "--preset unet" not in second.stdout
    table = out.with_suffix(".md").read_text()
    assert "| unet |" in table
    assert "| emvd |" in table
    assert "| qbp-bm3d |" in table
    assert out.with_suffix(".png").stat().st_size > 1000
    other = run(*common, "--rows", "unet", "--budget-seconds", "9")
    assert (other.returncode, other.stderr.count("\n")) == (2, 1)
    assert "was made with" in other.stderr
