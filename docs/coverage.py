"""Measures how often the 95 % intervals of `qsim calibrate` hold the truth, and writes docs/results/coverage.md.

    python docs/coverage.py [RUNS]      # 1000 calibrations of each synthetic sensor: 25 minutes on one core

The sensors and the draw are those of the tests (tests/support/synthetic.py): codes drawn by NumPy from the definition.
"""

from __future__ import annotations

import sys
from math import sqrt
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "support"))


def main(runs: int) -> None:
    from synthetic import CASES, coverage

    hits: dict[str, dict[str, int]] = {}
    rejected: dict[str, float] = {}
    for n, (name, case) in enumerate(CASES.items(), 1):
        found, p_values = coverage(case, runs, seed=7)
        print(f"{n}/{len(CASES)} {name}: { ({p: round(100 * c / runs, 1) for p, c in found.items()}) }", flush=True)
        rejected[name] = float(np.mean(np.array(p_values) < 0.05)) if np.isfinite(p_values[0]) else np.nan
        for parameter, count in found.items():
            hits.setdefault(parameter, {})[name] = count
    lines = [
        "# Do the intervals of `qsim calibrate` hold what they promise?",
        "",
        f"{runs} calibrations of each of {len(CASES)} synthetic sensors (tests/support/synthetic.py), in percent of",
        f"the 95 % intervals that hold the truth. Made by `python docs/coverage.py {runs}`; a number of one sensor is",
        f"known to +- {100 * sqrt(0.95 * 0.05 / runs):.1f} (one standard deviation).",
        "",
        "| parameter | intervals | all sensors | " + " | ".join(CASES) + " |",
        "|---|--:|--:|" + "--:|" * len(CASES),
    ]
    for parameter, of in hits.items():
        total = runs * len(of)
        cells = [f"{100 * of[name] / runs:.1f}" if name in of else "" for name in CASES]
        lines.append(
            f"| `{parameter}` | {total} | **{100 * sum(of.values()) / total:.1f}** | " + " | ".join(cells) + " |"
        )
    shares = ["" if np.isnan(rejected[name]) else f"{100 * rejected[name]:.1f}" for name in CASES]
    lines.append("| fit rejected at 5 % | | | " + " | ".join(shares) + " |")
    path = ROOT / "docs" / "results" / "coverage.md"
    path.write_text("\n".join(lines) + "\n")
    print(path)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
