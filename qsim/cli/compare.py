"""Runs `qsim compare`: readouts of the same light side by side."""

from __future__ import annotations

import argparse
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qsim.cli.console import command, output
from qsim.cli.options import positive, words
from qsim.tables import text_table

if TYPE_CHECKING:
    from qsim.studies.readouts import ReadoutRow

_HEADER = ("stream", "sensor", "bits", "codes", "time [ms]", "photons", "PSNR [dB]", "MB/s")


def add_compare(sub: Any) -> None:
    """Add the command `compare` to a program."""
    parser = command(
        sub,
        "compare",
        _run_compare,
        "Compare the streams of a clip: each averaged over the same span of time.",
        "qsim compare out/readouts/clips/fan_0000\nqsim compare out/fan --streams spike,conventional --span 0.6e-3",
    )
    parser.add_argument("clip", type=Path, help="clip folder with streams")
    parser.add_argument("--streams", type=words, help="names of streams, comma-separated (default: all)")
    parser.add_argument("--span", type=positive, help="seconds that are averaged (default: the longest code)")


def _run_compare(args: argparse.Namespace) -> int:
    from qsim.streams.clip import Clip
    from qsim.studies import readouts

    found = readouts.compare(Clip.open(args.clip), args.streams or (), args.span)
    lines = text_table([_cells(row) for row in found.rows], _HEADER, left=2)
    head = f"{found.clip}: {len(found.instants)} instants, {found.span * 1e3:.4g} ms each, against the sharp light"
    rows = [asdict(row) for row in found.rows]
    for row in rows:
        row["psnr_db"] = row["psnr_db"] if math.isfinite(row["psnr_db"]) else None  # JSON has no infinity
    output(args, asdict(found) | {"rows": rows}, [head, *lines, *found.remarks])
    return 0


def _cells(row: ReadoutRow) -> tuple[str, ...]:
    """Return the cells of a row of the table."""
    light = not row.stream
    return (
        row.stream or "(light, no noise)",
        "" if light else row.model,
        "" if row.bits is None else str(row.bits),
        "" if light else str(row.codes),
        f"{row.seconds * 1e3:.4g}",
        "" if row.ppp is None else f"{row.ppp:.4g}",
        f"{row.psnr_db:.2f}",
        "" if row.megabytes_per_second is None else f"{row.megabytes_per_second:.3g}",
    )
