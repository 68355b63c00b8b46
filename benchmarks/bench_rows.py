"""Measures what a restored frame costs, one row for each method, and writes the page of all rows.

    python benchmarks/bench_rows.py                             # the rows that are missing; hours of quiet cores
    python benchmarks/bench_rows.py --rows mergenet,qbp-bm3d    # these alone
    python benchmarks/bench_rows.py --tiny --out out/bench_rows # frames of 32 x 32 px on any cores: tries this program

A row is RESULTS/NAME.json, made once by `quiver bench` with two threads and no GPU. Frames have 512 x 1024 px; networks
of a million multiply-adds per pixel and frame stand beside smaller ones of published width. The row `modes` compares
the three modes of QUIVER and half precision on small frames. Busy cores are refused (rows.py); --busy makes rows
there, which are marked.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import result_page
from rows import (
    ROOT,
    Budget,
    Watch,
    is_made,
    keep_apart,
    machine,
    missing_rows,
    notes_on,
    quiver,
    starred,
    store,
    wait_for_quiet,
)

from qsim.files import read_json, write_bytes
from qsim.tables import markdown_table
from quiver.device import default_memory
from quiver.model.names import EQUAL_COST
from quiver.model.presets import build
from quiver.restoration.pieces import cut_pieces

CLASSICAL = ("moment", "transform-denoise", "qbp", "qbp-bm3d", "path-merge")
SMALL = ("emvd", "unet", "fastdvdnet", "student-teacher")  # of published width, with fewer multiply-adds than a million
MODES = "modes"
RESULTS = ROOT / "docs" / "results" / "bench"
ROWS = (*CLASSICAL, "mergenet", *SMALL, *EQUAL_COST, MODES)
HEADER = ("method", "seconds/frame", "frames/s", "memory [MB]", "GMAC/frame", "PSNR matched [dB]")


@dataclass(frozen=True)
class Plan:
    """The options of one `quiver bench`."""

    methods: str
    size: str = "512x1024"
    modes: str | None = "exact"
    precisions: str | None = "float32"
    threads: int = 2


def plan_of(name: str, *, tiny: bool) -> Plan:
    """Return what a row measures."""
    if name == MODES:
        plan = Plan("quiver-s", "64x64", "exact,streaming,windows", "float32,bfloat16")
    else:
        plan = Plan(name, modes="exact" if name.startswith("quiver") else None)
        plan = replace(plan, precisions=None if name in CLASSICAL else plan.precisions)
    return replace(plan, size="32x32", threads=1) if tiny else plan


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default=",".join(ROWS), help="comma-separated (default all)")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the rows")
    parser.add_argument("--tiny", action="store_true", help="frames of 32x32 px, on any cores")
    parser.add_argument("--busy", action="store_true", help="make rows on busy cores too, and mark them")
    args = parser.parse_args(words)
    names = args.rows.split(",")
    unknown = sorted(set(names) - set(ROWS))
    if unknown:
        print(f"bench_rows: no row is called {unknown[0]!r}; known are {', '.join(ROWS)}", file=sys.stderr)
        return 2
    try:
        keep_apart("bench", args.out, trial=args.tiny)
        for path in sorted(args.out.glob("*.json")):  # they share a page
            if path.stem in ROWS:
                is_made(path, plan_of(path.stem, tiny=args.tiny))
        for name in names:
            make(args.out / f"{name}.json", plan_of(name, tiny=args.tiny), busy=args.busy or args.tiny)
            write_page(args.out)
    except ValueError as error:
        print(f"bench_rows: {error}", file=sys.stderr)
        return 2
    except subprocess.CalledProcessError as failed:
        print(f"bench_rows: {name} has no row: `quiver bench` failed with {failed.returncode}", file=sys.stderr)
        return 1
    return 0


def make(path: Path, plan: Plan, *, busy: bool) -> None:
    """Write a row, unless it exists. `ValueError` if it exists with other options, and on busy cores unless `busy`."""
    if is_made(path, plan):
        return
    if not busy:
        wait_for_quiet()
    watch = Watch.now()
    given = ((f"--{name}", value) for name, value in vars(plan).items() if value is not None and name != "threads")
    with tempfile.TemporaryDirectory() as folder:
        words = [word for pair in given for word in pair]
        place = () if plan.methods in CLASSICAL else ("--device", "cpu")  # classical methods have no other
        quiver("bench", *words, *place, "-o", folder, "-q", budget=Budget(threads=plan.threads), problems=True)
        costs = read_json(Path(folder) / "bench.json")["costs"]
    path.parent.mkdir(parents=True, exist_ok=True)
    store(path, plan, watch, {"name": path.stem, "machine": machine(), "costs": costs})


def write_page(out: Path) -> None:
    """Write OUT.md from the rows that exist."""
    rows = {path.stem: read_json(path) for path in sorted(out.glob("*.json"))}
    modes = rows.pop(MODES, None)
    text = result_page.head("What a restored frame costs", "bench_rows.py")
    if rows:
        size = next(iter(rows.values()))["plan"]["size"]
        text += [f"## Frames of {size.replace('x', ' x ')} px", "", NOTES, *tiles_line(rows, size), ""]
        found = [[starred(row), *cells(row["costs"][0])] for row in sorted(rows.values(), key=seconds)]
        text += [*markdown_table(found, HEADER), ""]
    if modes is not None:
        text += [f"## Modes and half precision of {modes['plan']['methods']}, {modes['plan']['size']} px", ""]
        text += [MODE_NOTES, ""]
        found = [[cost["mode"], cost["precision"], *cells(cost)[:-1]] for cost in modes["costs"]]
        text += [*markdown_table(found, ("mode", "precision", *HEADER[1:-1])), ""]
    known = [row for row in (*rows.values(), modes) if row is not None]
    text += [*missing_rows(ROWS, known), *notes_on(known)]
    write_bytes(out.with_suffix(".md"), "\n".join(text).encode())


NOTES = """The fixed clip of `quiver bench` at 3.25 PPP and 3 bits. Memory is what restoring adds to the process.
Networks of a million multiply-adds per pixel and frame end in `-1m`; their weights are random, so that they have no
PSNR. Those that restore a clip in parts are charged with the frames around a part, too. Methods that search motion take
another time on other clips."""
MODE_NOTES = "`exact` shares work between windows and gives the numbers of `windows`; `streaming` keeps its state."


def tiles_line(names: Iterable[str], size: str) -> list[str]:
    """Return a line on the networks whose frames the memory bound cuts into tiles that overlap; none without any."""
    import torch

    height, width = (int(side) for side in size.split("x"))
    cuts = {}
    for name in sorted({*names} - {*CLASSICAL}):
        with torch.device("meta"):
            cuts[name] = len(cut_pieces(build(name), height, width, default_memory("cpu")).tiles)
    cut = ", ".join(f"{name} {tiles}" for name, tiles in cuts.items() if tiles > 1)
    bound = f"{default_memory('cpu') / 1e9:g} GB"
    text = f"The bound of {bound} cuts a frame into tiles, whose overlap is counted, too: {cut}."
    return textwrap.wrap(text, 118, break_on_hyphens=False) if cut else []


def seconds(row: dict[str, Any]) -> float:
    """Return the seconds per frame of a row, infinite where it failed."""
    found = row["costs"][0]["seconds_per_frame"]
    return math.inf if found is None else float(found)


def cells(cost: dict[str, Any]) -> list[str]:
    """Return seconds, frames per second, memory, multiply-accumulates and PSNR of a line of `quiver bench`."""
    if cost["failure"] is not None:
        return [f"failed: {cost['failure']}", *[""] * 4]
    taken = cost["seconds_per_frame"]
    macs = cost["gmac_per_frame"]
    psnr = cost["psnr_matched"]
    return [
        *(f"{taken:.3g}", f"{1 / taken:.3g}", f"{cost['peak_bytes'] / 1e6:.0f}"),
        *("" if macs is None else f"{float(f'{macs:.3g}'):g}", "" if psnr is None else f"{psnr:.2f}"),
    ]


if __name__ == "__main__":
    sys.exit(main())
