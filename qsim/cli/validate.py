"""Runs `qsim validate`: speed against error of sensors, renderer, engines and reading."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from qsim import checks
from qsim.cli.console import bar, command, note, output, refuse_existing, refuse_idle
from qsim.cli.options import checked
from qsim.figures import check_figure

# defaults
PIXELS = 1 << 22
HEIGHT = 128
WIDTH = 256
PSNR = 36.0

# Options that act, beside --seed, --json, --quiet and --verbose.
ACTING = {
    "sensor": ("output", "force", "pixels", "require_speed"),
    "render": ("output", "force", "scenes", "height", "width"),
    "light": ("scenes", "height", "width", "psnr"),
    "engines": ("scenes", "height", "width"),
    "reading": (),
}


def add_validate(sub: Any) -> None:
    """Add the command `validate` to a program."""
    parser = command(
        sub,
        "validate",
        _run_validate,
        "Measure speed and error of sensor engines, of the renderer or of reading.",
        "qsim validate sensor --json -o out/sensor.png\nqsim validate render -o out/render.png\n"
        "qsim validate light --scenes glossy room --height 64 --width 96\n"
        "qsim validate engines --scenes fan glass\nqsim validate reading",
        threads="threads of the compiled engine (Dr.Jit)",
    )
    parser.add_argument("what", choices=list(ACTING), help="what to validate")
    parser.add_argument("-o", "--output", type=Path, help="sensor, render: figure (.png, .svg or .pdf)")
    parser.add_argument("--pixels", type=int, help=f"sensor: pixels per draw (default {PIXELS})")
    parser.add_argument("--seed", type=checked(checks.seed), default=0, help="seed of the draws (default 0)")
    parser.add_argument("--require-speed", action="store_true", help="sensor: fail if a speed is below its target")
    families = (
        "render, engines, light: families or own scenes (default: four; light: all that were not used for tuning)"
    )
    parser.add_argument("--scenes", nargs="+", metavar="FAMILY", help=families)
    whole = checked(checks.whole)
    psnr = checked(checks.psnr)
    parser.add_argument("--height", type=whole, help=f"render, engines, light: pixels (default {HEIGHT})")
    parser.add_argument("--width", type=whole, help=f"render, engines, light: pixels (default {WIDTH})")
    parser.add_argument("--psnr", type=psnr, help=f"light: required error, dB below white (default {PSNR:g})")
    parser.add_argument("--force", action="store_true", help="replace an existing figure")


def _run_validate(args: argparse.Namespace) -> int:
    acting = ACTING[args.what]
    every = {option for options in ACTING.values() for option in options}
    refuse_idle(args, f"validate {args.what}", sorted(every - set(acting)))
    if args.output is None:
        refuse_idle(args, f"validate {args.what} without --output", ["force"] if "force" in acting else [])
    args.height, args.width = args.height or HEIGHT, args.width or WIDTH
    if args.output is not None:
        check_figure(args.output)
        refuse_existing(args.output, args.force)
    run = {"sensor": _sensor, "render": _render, "light": _light, "engines": _engines, "reading": _reading}
    return run[args.what](args)


def _sensor(args: argparse.Namespace) -> int:
    from qsim.studies.validation import sensors

    pixels = PIXELS if args.pixels is None else args.pixels
    with bar("measuring", "model") as progress:
        report = sensors.run(pixels, args.seed, require_speed=args.require_speed, progress=progress)
    if args.output is not None:
        sensors.figure(report, args.output)
    output(args, report.to_dict(), sensors.table(report))
    return 0 if report.ok else 1


def _reading(args: argparse.Namespace) -> int:
    from qsim.studies.validation import reading

    report = reading.run(seed=args.seed)
    output(args, report.to_dict(), report.lines())
    return 0 if report.ok else 1


def _engines(args: argparse.Namespace) -> int:
    from qsim.studies.validation import backends

    names = _families(args)[:4] if args.scenes is None else args.scenes
    report = backends.run(names, height=args.height, width=args.width, seed=args.seed + 3, progress=note)
    output(args, report.to_dict(), backends.table(report))
    return 0 if report.ok else 1


def _families(args: argparse.Namespace) -> list[str]:
    """The given scenes, or those that were not used to tune the budget."""
    from qsim import scenes
    from qsim.studies.validation import rendering

    return args.scenes or [name for name in scenes.FAMILIES if name not in rendering.TUNED]


def _scenes(args: argparse.Namespace, names: list[str]) -> list[Any]:
    from qsim import scenes

    return [scenes.load(name, seed=args.seed + 3).resized(args.height, args.width) for name in names]


def _render(args: argparse.Namespace) -> int:
    from qsim.studies.validation import rendering

    names = _families(args)[:4] if args.scenes is None else args.scenes
    report = rendering.run(_scenes(args, names), progress=note)
    if args.output is not None:
        rendering.figure(report, args.output)
    output(args, report.to_dict(), rendering.table(report))
    return 0 if report.ok else 1


def _light(args: argparse.Namespace) -> int:
    from qsim.studies.validation import light

    levels = (PSNR if args.psnr is None else args.psnr,)
    report = light.run(_scenes(args, _families(args)), levels=levels, seed=args.seed, progress=note)
    output(args, report.to_dict(), light.table(report))
    return 0 if report.ok else 1
