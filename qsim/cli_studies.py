"""Commands that look and study: `report`, `tradeoff`. The pairs `add_X` and `_run_X` of cli.py."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from qsim import files
from qsim.console import command, output

# report


def add_report(sub: Any) -> None:
    parser = command(
        sub, "report", _run_report, "Draw one self-contained page of clips, data sets, training, restored video and scores.",
        "qsim report out/fan -o out/fan.html\nqsim report out/demo -o out/demo/index.html --title 'My run'",
    )  # fmt: skip
    parser.add_argument("path", type=Path, help="clip, data set, or any folder with such things in it")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".html file to write")
    parser.add_argument("--title", help="of the page")
    parser.add_argument("--note", action="append", default=[], help="a line for the top of the page; may be repeated")
    parser.add_argument("--force", action="store_true", help="replace an existing page")


def _run_report(args: argparse.Namespace) -> int:
    from qsim import report

    if args.output.exists() and not args.force:
        raise FileExistsError(f"{args.output}: exists; name another with -o, or use --force to replace it")
    page = report.build(args.path, title=args.title, notes=args.note).encode()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(args.output, page)
    found = {"page": str(args.output), "bytes": len(page)}
    output(args, found, f"{args.output}: {len(page) / 1e6:.1f} MB, loads nothing from elsewhere; open it in a browser")
    return 0


# tradeoff


def add_tradeoff(sub: Any) -> None:
    parser = command(
        sub, "tradeoff", _run_tradeoff, "Bit depth against motion, read noise and data rate at equal exposure.",
        "qsim tradeoff --table --size 240x320 --base-fps 10000 --read-noise 0.2 --bits 1,3,5,7,9",
    )  # fmt: skip
    parser.add_argument("--table", action="store_true", required=True, help="print the table of bit depths")
    parser.add_argument("--size", type=size, default=(240, 320), help="ROWSxCOLUMNS (default 240x320)")
    parser.add_argument("--base-fps", type=float, default=10_000.0, help="planes per second (default 10000)")
    parser.add_argument("--read-noise", type=float, default=0.2, help="e- rms per read (default 0.2)")
    parser.add_argument("--bits", type=integers, default=[1, 3, 5, 7, 9], help="with commas (default 1,3,5,7,9)")
    parser.add_argument("--motion", type=float, default=2500.0, help="image speed, px/s (default 2500)")


def _run_tradeoff(args: argparse.Namespace) -> int:
    from qsim.tradeoff import depths

    height, width = args.size
    rows = depths(
        height=height,
        width=width,
        base_fps=args.base_fps,
        read_noise=args.read_noise,
        bits=args.bits,
        speed=args.motion,
    )
    text = [
        f"{height} x {width} px, {args.base_fps:g} planes/s, {args.read_noise:g} e- per read, {args.motion:g} px/s",
        "bits         fps  px/frame  read noise x fps  in quadrature  data rate",
        "                              [e-/s, linear]   [e- in 1 s]     [MB/s]",
    ]
    text += [
        f"{r.bits:4d}  {r.fps:10.2f}  {r.motion_px_per_frame:8.2f}  {r.read_noise_per_second:16.2f}"
        f"  {r.read_noise_quadrature:13.2f}  {r.data_rate_megabytes_per_second:9.3f}"
        for r in rows
    ]
    output(args, {"rows": [asdict(r) for r in rows]}, text)
    return 0


def size(text: str) -> tuple[int, int]:
    """`240x320` -> (240, 320): rows, columns."""
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal() and int(height) > 0 and int(width) > 0):
        raise argparse.ArgumentTypeError(f"a size is ROWSxCOLUMNS, as in 240x320; got {text!r}")
    return int(height), int(width)


def integers(text: str) -> list[int]:
    """`1,3,5` -> [1, 3, 5]."""
    words = text.split(",")
    if not all(word.strip().isdecimal() for word in words):
        raise argparse.ArgumentTypeError(f"whole numbers with commas, as in 1,3,5; got {text!r}")
    return [int(word) for word in words]
