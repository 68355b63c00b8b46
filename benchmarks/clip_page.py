"""Writes the page of the rows of clip_rows.py: what a frame of equal error costs, and where its time goes."""

from __future__ import annotations

from statistics import median
from typing import Any

import result_page
from reuse_rows import MARK, how

from qsim.tables import markdown_table

PARTS = ("paths", "carrying", "denoiser", "surfaces", "scene", "choice", "truth", "writing")
WAYS = {  # key in a row: its name on the page
    "naive, white": "naive loop",
    "naive, peak": "naive loop, to the percentile",
    "alone": "frames alone",
    "shared": "frames that share",
}
HEAD = (
    "\n".join(
        result_page.head(
            "What frames of a clip cost", "clip_rows.py", ", which makes missing rows, and marked ones again"
        )
    )
    + """
<!-- not run: needs quiet cores for an hour or two -->
```sh
python benchmarks/clip_rows.py
python benchmarks/clip_rows.py --motion 0.3 --reference 256
python benchmarks/clip_rows.py --size 512x1024 --rows plain,room,lamp,fence,shadow
```

Processor seconds of a frame's radiance, without ground truth and writing, in one run per row: the naive loop (one
`mi.render` per frame), and this program with frames alone and with frames that share samples. **white** is the PSNR
reached in dB below white, picture and truth clamped there. **percentile** is the PSNR in dB below the 99.9th
percentile, without a clamp. The naive loop takes the power of two of samples that reaches the asked PSNR below white,
or below the percentile. It is extrapolated from 64 samples. **times** is the time of the naive loop to white over the
line's. Scenes have a speed at which the median moving pixel moves as stated.
"""
)
REFERENCES = """## The references

**noise** is the noise of the mean of the converged pictures that frames are compared with, in dB below white.
"""
TIME = """## Where the time goes

Processor seconds of a frame by part. **scene** moves bodies and rebuilds what finds their surfaces. **surfaces** are
albedo and normals for the denoiser, **carrying** moves samples of neighbours, **choice** mixes, chooses and states the
error. **truth** is flow, depth, visibility and bodies. **writing** compresses and stores.
"""


def page(rows: dict[str, dict[str, Any]]) -> str:
    """Return the page of the rows, by name."""
    text = [HEAD] if rows else [HEAD, "No row is made yet."]
    if rows:
        text += [*costs(rows), "", *medians(rows), "", REFERENCES, *references(rows), "", TIME]
        text += [*breakdown(rows), ""]
    if any(not row["quiet"] for row in rows.values()):
        text += [f"{MARK} made beside other programs.", ""]
    return "\n".join(text).rstrip() + "\n"


def marked(name: str, row: dict[str, Any]) -> str:
    """Return the name of a row, with a mark if other programs ran."""
    return name if row["quiet"] else name + MARK


def costs(rows: dict[str, dict[str, Any]]) -> list[str]:
    """Return the table of ways to render, one line each."""
    lines = []
    for name, row in rows.items():
        naive = row["ways"]["naive, white"]["processor_seconds"]
        for way, text in WAYS.items():
            if way in row["ways"]:
                told = row["ways"][way]
                budget = str(told["samples"]) if "denoise" not in told else how({"neighbours": 0, **told})
                seconds = told["processor_seconds"]
                found = (f"{told['reached'][unit]:.1f}" for unit in ("white", "peak"))
                lines.append((marked(name, row), text, budget, f"{seconds:.3f}", *found, f"{naive / seconds:.1f}"))
    return markdown_table(lines, ("scene", "way", "samples", "s", "white [dB]", "percentile [dB]", "times"))


def medians(rows: dict[str, dict[str, Any]]) -> list[str]:
    """Return the medians of all rows of one size and motion, and their ratios; a row without a way has the nearest."""
    lines = []
    for kind in dict.fromkeys(map(kind_of, rows.values())):
        chosen = [row["ways"] for row in rows.values() if kind_of(row) == kind]
        every = {way: median(seconds_of(ways, way) for ways in chosen) for way in WAYS}
        for way, seconds in every.items():
            ratios = (f"{every[other] / seconds:.2f}" for other in ("naive, white", "alone"))
            lines.append((kind, str(len(chosen)), WAYS[way], f"{seconds:.3f}", *ratios))
    header = (
        "size and motion",
        "rows",
        "way",
        "median s",
        "naive loop / this",
        "alone / this",
    )
    return ["Ratios of medians over the rows:", "", *markdown_table(lines, header)]


def kind_of(row: dict[str, Any]) -> str:
    """Return size and motion of a row as text."""
    plan = row["plan"]
    return f"{plan['height']} × {plan['width']}, {plan['motion']:g} px/frame"


def seconds_of(ways: dict[str, Any], way: str) -> float:
    """Return the seconds of a way; where frames do not share, those alone."""
    other = "alone" if way == "shared" else way
    return float(ways.get(way, ways[other])["processor_seconds"])


def references(rows: dict[str, dict[str, Any]]) -> list[str]:
    """Return the table of speeds and converged pictures."""
    lines = [
        (
            marked(name, row),
            f"{row['speed']:g}",
            f"{row['motion']:.2f}",
            f"{row['references']['noise']:.1f}",
        )
        for name, row in rows.items()
    ]
    return markdown_table(lines, ("scene", "speed", "px/frame", "noise [dB]"))


def breakdown(rows: dict[str, dict[str, Any]]) -> list[str]:
    """Return the table of parts."""
    lines = [
        (marked(name, row), text, *(f"{row['ways'][way]['parts'].get(part, 0.0):.3f}" for part in PARTS))
        for name, row in rows.items()
        for way, text in WAYS.items()
        if "parts" in row["ways"].get(way, {})
    ]
    return markdown_table(lines, ("scene", "way", *PARTS))
