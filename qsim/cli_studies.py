"""Commands that look and study: `report`, `tradeoff`, `calibrate`, `validate`; pairs `add_X`, `_run_X` as in cli.py."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from qsim import files
from qsim.console import command, output

# report


def add_report(sub: Any) -> None:
    parser = command(
        sub, "report", _run_report, "Draw one self-contained page of clips, data sets, runs, restored video, scores.",
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


# calibrate


def add_calibrate(sub: Any) -> None:
    parser = command(
        sub, "calibrate", _run_calibrate, "Dark and flat frames -> a sensor file, numbers with confidence intervals.",
        "qsim calibrate --bits 8 --dark d1.npy 1e-3 --dark d2.npy 0.1 --flat f.npy 1e-3 --flat g.npy 1e-3 -o my.toml\n"
        "qsim calibrate --model spad --bits 1 --dark dark.npy 1e-5 --flat flat.npy 1e-5 0.8 -o spad.toml\n"
        "qsim calibrate --bits 8 --static counts.npy 6.33e-6 -o counter.toml",
    )  # fmt: skip
    for option, names, what in (
        ("--dark", ("FILE", "SECONDS"), "frames without light, and their exposure"),
        ("--flat", ("FILE", "SECONDS"), "evenly lit frames, their exposure, and the photons per pixel if known"),
    ):
        parser.add_argument(option, metavar=names, help=what, action="append", nargs="+", default=[])
    parser.add_argument(
        "--static",
        nargs=2,
        metavar=("FILE", "SECONDS"),
        help="counts of a static scene instead: dead time from Fano factors",
    )
    parser.add_argument("--bits", type=int, required=True, help="of a code; 1 for binary planes")
    parser.add_argument("--model", choices=("qis", "spad"), default="qis", help="default qis")
    parser.add_argument("--paralyzable", action="store_true", help="spad: every arrival restarts the dead time")
    parser.add_argument("--ignore-dead-time", action="store_true", help="spad: take the counts as Poisson")
    parser.add_argument("--width", type=int, help=".npy files are photon cubes (packed planes) of so many pixels")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".toml to write; .json and .png beside it")
    parser.add_argument("--force", action="store_true", help="replace existing files")


def _run_calibrate(args: argparse.Namespace) -> int:
    from qsim import calibrate_files
    from qsim.calibrate import calibrate_qis
    from qsim.calibrate_spad import calibrate_spad

    if args.output.suffix != ".toml":
        raise ValueError(f"{args.output}: the sensor file is a .toml, as in -o my_sensor.toml")
    if args.output.exists() and not args.force:
        raise FileExistsError(f"{args.output}: exists; name another with -o, or use --force to replace it")
    darks = [_stack(words, args, dark=True) for words in args.dark]
    flats = [_stack(words, args, dark=False) for words in args.flat]
    if args.static:
        found = _static(args)
    elif args.model == "qis":
        found = calibrate_qis(darks, flats, bits=args.bits)
    else:
        found = calibrate_spad(
            darks, flats, bits=args.bits, dead_time=not args.ignore_dead_time, paralyzable=args.paralyzable
        )
    args.output.parent.mkdir(parents=True, exist_ok=True)
    written = calibrate_files.write(
        found, args.output, f"calibrated from {len(darks)} dark and {len(flats)} flat stacks"
    )
    width = max(len(name) for name in found.values)
    text = [f"{name:{width}}  {value}  ({value.method})" for name, value in found.values.items()]
    text += [f"warning: {words}" for words in found.warnings]
    text += ["written: " + ", ".join(str(path) for path in written)]
    output(args, calibrate_files.as_dict(found) | {"files": [str(path) for path in written]}, text)
    return 0


def _static(args: argparse.Namespace) -> Any:
    from qsim.calibrate_files import read_counts
    from qsim.calibrate_static import calibrate_static

    if args.dark or args.flat:
        raise ValueError("--static stands alone: a static scene takes the place of dark and flat frames")
    counts = read_counts(Path(args.static[0]))
    return calibrate_static(counts, bits=args.bits, exposure=_number(args.static[1]), paralyzable=args.paralyzable)


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"{word!r} is no number; give seconds, as in 1e-3") from None


def _stack(words: list[str], args: argparse.Namespace, *, dark: bool) -> Any:
    from qsim.calibrate_files import read_stack

    kind, most = ("--dark", 2) if dark else ("--flat", 3)
    if not 2 <= len(words) <= most:
        raise ValueError(
            f"{kind} {' '.join(words)}: give a file and its exposure in seconds, as in {kind} frames.npy 1e-3"
        )
    numbers = [_number(word) for word in words[1:]]
    photons = 0.0 if dark else numbers[1] if len(numbers) > 1 else None
    return read_stack(Path(words[0]), bits=args.bits, exposure=numbers[0], photons=photons, width=args.width)


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


# validate


def add_validate(sub: Any) -> None:
    parser = command(
        sub, "validate", _run_validate, "Measure sensor engines or the renderer here: speed against error, hard cases.",
        "qsim validate sensor --json -o out/sensor.png\nqsim validate render -o out/render.png",
    )  # fmt: skip
    parser.add_argument("what", choices=["sensor", "render"], help="what to validate")
    parser.add_argument("-o", "--output", type=Path, help="figure of speed against error (.png, .svg or .pdf)")
    parser.add_argument("--pixels", type=int, default=1 << 20, help="pixels of a draw (default 1048576)")
    parser.add_argument("--seed", type=int, default=0, help="of the draws (default 0)")
    parser.add_argument("--require-speed", action="store_true", help="a speed below its target is a failure too")
    parser.add_argument("--scenes", nargs="+", metavar="FAMILY", help="render: families (default: four)")
    parser.add_argument("--height", type=int, default=128, help="render: pixels (default 128)")
    parser.add_argument("--width", type=int, default=256, help="render: pixels (default 256)")
    parser.add_argument("--force", action="store_true", help="replace an existing figure")


def _run_validate(args: argparse.Namespace) -> int:
    from qsim import validate

    if args.output is not None:
        validate.check_figure(args.output)
        if args.output.exists() and not args.force:
            raise FileExistsError(f"{args.output}: exists; name another with -o, or use --force to replace it")
    if args.what == "render":
        return _validate_render(args)
    report = validate.run(args.pixels, args.seed, require_speed=args.require_speed)
    if args.output is not None:
        validate.figure(report, args.output)
    output(args, report.to_dict(), validate.table(report))
    return 0 if report.ok else 1


def _validate_render(args: argparse.Namespace) -> int:
    import scenes
    from qsim import validate_render

    families = args.scenes or [name for name in scenes.FAMILIES if name not in validate_render.TUNED][:4]
    chosen = [scenes.load(name, seed=args.seed + 3).resized(args.height, args.width) for name in families]
    report = validate_render.run(chosen, progress=lambda text: print(text, file=sys.stderr))
    if args.output is not None:
        validate_render.figure(report, args.output)
    output(args, report.to_dict(), validate_render.table(report))
    return 0 if report.ok else 1
