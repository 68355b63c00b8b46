"""Writes docs/results/coverage.md from what coverage_cameras.py and coverage_spad.py have stored in out/."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]


def cell(held: list[bool], sensors: int) -> str:
    """Return the share of the intervals that hold the truth, in percent; their number if some sensors have none."""
    if not held:
        return ""
    share = f"{100 * np.mean(held):.1f}"
    return share if len(held) == sensors else f"{share} ({len(held)})"


def write_page() -> None:
    """Write the page from what both benchmarks have stored."""
    import coverage_cameras
    import coverage_spad

    lines = [
        "# Intervals of a calibration",
        "",
        "How many of the 95 % intervals of `qsim calibrate` hold the truth, in percent.",
        "The frames come from `benchmarks/calibration_simulator.py`, which shares no code with qsim.",
        "",
        "## Cameras",
        "",
        "Made by `python benchmarks/coverage_cameras.py`.",
        *coverage_cameras.table(stored("coverage_cameras")),
        "",
        "## SPAD arrays",
        "",
        "Made by `python benchmarks/coverage_spad.py`.",
        *coverage_spad.table(stored("coverage_spad")),
        "",
        "## Other frames",
        "",
        "Made by `python benchmarks/coverage_real.py DATA CASES`.",
        "The camera's frames were made elsewhere; its truth is known. The SPADs are 50 x 50 pixels of a real array, in",
        "7650 planes of 10.3 µs. The photon counts are of a real detector that scanned a hazelnut; its dead time was",
        "known from its brightest pixels.",
        "",
        "| frames | value | found | known |",
        "|---|---|---|---|",
        *(f"| {what} | `{name}` | {found} | {known} |" for what, name, found, known in stored("coverage_real")),
    ]
    path = ROOT / "docs" / "results" / "coverage.md"
    path.write_text("\n".join(lines) + "\n")
    print(path)


def stored(name: str) -> Any:
    """Return what a benchmark has stored in out/."""
    path = ROOT / "out" / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    return json.loads(path.read_text()) if path.exists() else {}


def store(name: str, rows: Any) -> None:
    """Store what a benchmark found in out/."""
    (ROOT / "out" / f"{name}.json").write_text(json.dumps(rows))
