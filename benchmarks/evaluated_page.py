"""Writes the measured parts of the pages `starter` and `sums` from evaluations; their words are written by hand.

    python benchmarks/evaluated_page.py starter out/results
    python benchmarks/evaluated_page.py sums out/sums --flow out/sum_flow.json --windows out/sum_windows.json

A part stands between `<!-- measured: NAME -->` and `<!-- end -->`. Sentences beside it that name numbers are to be read
again after a run.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypedDict

from PIL import Image

from qsim.files import read_json, write_bytes
from qsim.report.stored_results import EvaluatedMethod
from qsim.tables import markdown_table
from quiver.evaluation.breakdown import bin_names

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "results"
QUALITY = 88  # of JPEG


class Flow(TypedDict):
    """A row of composed_flow.py."""

    scene: str
    planes: int
    mean_px: float
    median_error_px: float
    rms_error_px: float
    p99_error_px: float
    lost: float


class Windows(TypedDict):
    """A row of sum_windows.py."""

    planes: int
    windows_per_second: float
    ms: float
    ms_of_light: float


class Asked(NamedTuple):
    """The files that a page is made of."""

    evaluation: Path  # folder of `quiver evaluate`
    flow: Path | None
    windows: Path | None


def complete(asked: Asked) -> str:
    """Return the page of an evaluation without its title, and put its pictures beside the page `starter`."""
    text = (asked.evaluation / "evaluation.md").read_text(encoding="utf-8")
    write_bytes(PAGES / "starter.png", (asked.evaluation / "evaluation.png").read_bytes())
    for sheet in asked.evaluation.glob("crops_*PPP*.png"):
        light = re.match(r"crops_([\d.]+PPP)", sheet.name)
        assert light is not None
        with Image.open(sheet) as picture:
            picture.convert("RGB").save(PAGES / f"crops_{light[1]}.jpg", quality=QUALITY, optimize=True)
    return "![Matched PSNR of all methods](starter.png)\n" + text.partition("\n")[2]


def scores(asked: Asked) -> str:
    """Return the table of matched scores and seconds of each method."""
    rows = [
        (
            f"`{line['method']}`",
            _interval(line, "psnr_matched", 2),
            _interval(line, "ssim_matched", 3),
            "-" if line["seconds_per_frame"] is None else f"{line['seconds_per_frame']:.3g}",
        )
        for line in _lines(asked)
    ]
    return "\n".join(markdown_table(rows, ("method", "PSNR matched", "SSIM matched", "s/code")))


def motion(asked: Asked) -> str:
    """Return the table of matched PSNR by motion, without bins in which no method has pixels."""
    found = read_json(asked.evaluation / "evaluation.json")["table"]
    names = bin_names()
    seen = [i for i in range(len(names)) if any(line["psnr_by_motion"][i] is not None for line in found)]
    rows = [
        (f"`{line['method']}`", *("-" if (one := line["psnr_by_motion"][i]) is None else f"{one:.2f}" for i in seen))
        for line in found
    ]
    return "\n".join(markdown_table(rows, ("method", *(names[i].replace("-", "–") for i in seen))))


def flow(asked: Asked) -> str:
    """Return the table of errors of composed flow."""
    found: list[Flow] = _rows(asked.flow)
    rows = [
        (
            row["scene"],
            str(row["planes"]),
            f"{row['mean_px']:.2f}",
            f"{row['median_error_px']:.1e}",
            f"{row['rms_error_px']:.3f}",
            f"{row['p99_error_px']:.2f}",
            f"{100 * row['lost']:.1f} %",
        )
        for row in found
    ]
    errors = ("median error [px]", "rms error [px]", "99 % below [px]")
    return "\n".join(markdown_table(rows, ("scene", "planes", "mean motion [px]", *errors, "points lost")))


def windows(asked: Asked) -> str:
    """Return the table of training windows."""
    found: list[Windows] = _rows(asked.windows)
    rows = [
        (str(row["planes"]), f"{row['windows_per_second']:.0f}", f"{row['ms']:.1f}", f"{row['ms_of_light']:.1f}")
        for row in found
    ]
    return "\n".join(
        markdown_table(rows, ("planes of a code", "windows per second", "ms per window", "of them its light"))
    )


PARTS: dict[str, Callable[[Asked], str]] = {
    "evaluation": complete,
    "scores": scores,
    "motion": motion,
    "flow": flow,
    "windows": windows,
}


def _lines(asked: Asked) -> list[EvaluatedMethod]:
    found: list[EvaluatedMethod] = read_json(asked.evaluation / "evaluation.json")["table"]
    return found


def _interval(line: EvaluatedMethod, name: str, digits: int) -> str:
    """Return `17.14 ± 2.28`; `n/a` for a score that no clip has."""
    found = line["scores"][name]
    if found["mean"] is None:
        return "n/a"
    half = found["half_width"]
    return f"{float(found['mean']):.{digits}f}" + ("" if half is None else f" ± {float(half):.{digits}f}")


def _rows(path: Path | None) -> list:
    """Return the rows that a program of benchmarks/ has stored."""
    if path is None:
        raise ValueError("the page sums needs --flow and --windows")
    found: list = json.loads(path.read_text(encoding="utf-8"))
    return found


def filled(text: str, asked: Asked) -> str:
    """Return a page with its measured parts; `ValueError` if it has none."""
    pattern = re.compile(r"<!-- measured: (\w+) -->\n.*?<!-- end -->", re.DOTALL)
    if not pattern.search(text):
        raise ValueError("the page has no measured part")
    return pattern.sub(
        lambda part: f"<!-- measured: {part[1]} -->\n\n{PARTS[part[1]](asked).strip()}\n\n<!-- end -->", text
    )


def main(words: list[str] | None = None) -> int:
    """Write the page that is asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("page", choices=("starter", "sums"))
    parser.add_argument("evaluation", type=Path, help="folder of `quiver evaluate`")
    parser.add_argument("--flow", type=Path, help="rows of composed_flow.py")
    parser.add_argument("--windows", type=Path, help="rows of sum_windows.py")
    parser.add_argument("--to", type=Path, help="page to fill (default: the one in docs/results)")
    args = parser.parse_args(words)
    page = args.to or PAGES / f"{args.page}.md"
    asked = Asked(args.evaluation, args.flow, args.windows)
    write_bytes(page, filled(page.read_text(encoding="utf-8"), asked).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
