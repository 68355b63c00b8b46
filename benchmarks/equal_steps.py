"""Trains every network of published width for the same number of steps, all at once, as one GPU can.

    python benchmarks/equal_steps.py out/starter --steps 400                      # the rows that are missing
    python benchmarks/equal_steps.py out/tiny --steps 2 --tiny --out out/rows     # a test of this program

A row is RESULTS/NAME.json. It is written when it is complete and made once. Two trials with a sixth of the steps choose
the learning rate on validation clips, one run uses it, and its weights are scored on test clips at the light of
training. All train by Adam on four windows per step. The row of classical methods needs no training. All rows share a
GPU, so no row has a time; equal_budget.py compares equal times. Networks that learn from the streams which they restore
have no row.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any

import result_page
from equal_budget import APART, FLOOR, HEADER, RECORD, ROWS, classical, learned, mean_of, score_cells
from rows import LIGHTS, TINY, check_row, keep_apart, missing_rows, notes_on, options, scores
from step_rows import Steps, refuse_busy, together

from qsim.files import read_json, write_bytes
from qsim.tables import markdown_table
from qsim.words import count

FORMAT = "quiver-equal-steps-1"
AT = f"{float(LIGHTS[0]):g} PPP, 3 bit"
NAMES = tuple(name for name in ROWS if not name.endswith(RECORD) and not name.startswith(APART))
LIMITS = f"""Every network saw the same number of windows, with as many frames as its design takes. A large one needed
more time for them: the table of [equal time](equal_budget.md) asks the other question. This is still a short training,
so the order can change with a longer one. Windows have 80 x 80 px, those of RVRT 128 x 128 px, because it fills smaller
ones to 132 px. Frames: those of which one is restored, and how many of them lie ahead.
memdeblur has no scores: its weights could not be read on the machine that trained them.
Networks below {FLOOR} have no rank."""


def main(words: list[str] | None = None) -> int:
    parser = options(__doc__, "equal_steps", NAMES)
    parser.add_argument("--steps", type=count, required=True, help="steps of every row")
    args = parser.parse_args(words)
    names = args.rows.split(",")
    crop = TINY.crop if args.tiny else Steps.crop
    budget = Steps(crop=crop, batch=TINY.batch if args.tiny else 4, steps=args.steps)
    unknown = sorted(set(names) - set(NAMES))
    if unknown:
        print(f"equal_steps: no row is called {unknown[0]!r}; known are {', '.join(NAMES)}", file=sys.stderr)
        return 2
    try:
        refuse_busy(args)
        args.work = keep_apart("equal_steps", args.out, args.work, trial=args.tiny) / f"{args.steps}_steps"
        for path in sorted(args.out.glob("*.json")):  # they share a table
            check_row(path, budget, args.data)
        makers = {name: partial(row, name, args, budget) for name in names}
        return together("equal_steps", makers, args, budget, partial(write_table, args.out))
    except (ValueError, OSError) as error:
        print(f"equal_steps: {error}", file=sys.stderr)
        return 2


def row(name: str, args: argparse.Namespace, budget: Steps) -> dict[str, Any]:
    """Return the row of a network, or of the classical methods: scores at the light of training."""
    if name == "classical":
        return classical(args, budget, LIGHTS[:1]) | {"format": FORMAT}
    folder, made = learned(name, args, budget)
    made["settings"] |= {"data": args.data.name, "out": name}  # another machine's paths tell nothing
    scored = scores([str(folder)], args.work / f"{name}_scores", args.data, LIGHTS[:1], budget)
    return {"format": FORMAT} | made | {"scores": scored[name]}


def write_table(out: Path) -> None:
    """Write OUT.md from the rows that exist."""
    rows = [read_json(path) for path in sorted(out.glob("*.json"))]
    plain = {name: found[AT] for one in rows if one["kind"] == "classical" for name, found in one["scores"].items()}
    networks = sorted((one for one in rows if one["kind"] == "network"), key=lambda one: -mean_of(one["scores"][AT]))
    lines = [(mean_of(found), ["", name, *[""] * 5, *score_cells(found)]) for name, found in plain.items()]
    for rank, one in enumerate(networks, 1):
        found = one["scores"][AT]
        below = FLOOR in plain and mean_of(found) < mean_of(plain[FLOOR])
        size = (f"{one['macs_per_pixel'] / 1e6:.3g} M", f"{one['parameters']:,}", f"{one['rate']:g}")
        validated = one["curve"][-1]["psnr_matched"]
        last = "n/a" if validated is None else f"{validated:.2f}"
        frames = f"{one['window']}, {one['look_ahead']}"
        cells = ["none" if below else str(rank), one["name"], frames, *size, last, *score_cells(found)]
        lines.append((mean_of(found), cells))
    header = (*HEADER[:4], *("parameters", "rate", "last validation [dB]"), *HEADER[8:-3])
    budget = rows[0]["budget"] if rows else {"steps": 0, "batch": 0}
    command = f"equal_steps.py out/starter --steps {budget['steps']}"
    windows = f": steps of {budget['batch']} windows"
    text = [
        *result_page.head("Every network after the same steps", command, windows),
        *(LIMITS, "", f"## Published widths, {AT}", ""),
        *markdown_table([cells for _, cells in sorted(lines, key=lambda line: -line[0])], header),
        *("", *missing_rows(NAMES, rows), *notes_on(rows)),
    ]
    write_bytes(out.with_suffix(".md"), "\n".join(text).encode())


if __name__ == "__main__":
    sys.exit(main())
