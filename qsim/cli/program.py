"""Runs `qsim`: all commands, and the command `doctor`.

Each command is a pair of functions: `add_X` adds its options, `_run_X` runs it and returns the exit code.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

from qsim.cli.calibrate import add_calibrate
from qsim.cli.compare import add_compare
from qsim.cli.completion import add_completion, families, recipes, sensors
from qsim.cli.console import OPTIONAL, Parser, command, output, run
from qsim.cli.convert import add_convert
from qsim.cli.dataset import add_check, add_generate, add_plan, add_recipes, add_sensors
from qsim.cli.demo import add_demo
from qsim.cli.look import add_explore, add_preview, add_report
from qsim.cli.render import add_render
from qsim.cli.sense import add_sense
from qsim.cli.tradeoff import add_tradeoff
from qsim.cli.validate import add_validate
from qsim.files import VERSION


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; return the exit code."""
    return run(parser(), argv)


def parser() -> Parser:
    """Return the parser of all commands."""
    program = Parser(prog="qsim", description="Render moving scenes and turn them into few-bit quanta-sensor streams.")
    program.add_argument("--version", action="version", version=f"qsim {VERSION}")
    sub = program.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for add in (
        _add_doctor,
        add_render,
        add_sense,
        add_generate,
        add_plan,
        add_check,
        add_recipes,
        add_sensors,
        add_convert,
        add_preview,
        add_report,
        add_explore,
        add_tradeoff,
        add_compare,
        add_calibrate,
        add_validate,
        add_demo,
    ):
        add(sub)
    values = {"scene": families, "source": families, "--scenes": families, "recipe": recipes, "--print": recipes}
    add_completion(sub, program, values | {"--sensor": sensors, "--plane-sensor": sensors})
    return program


def _add_doctor(sub: Any) -> None:
    """Add the command `doctor` to a program."""
    parser = command(
        sub,
        "doctor",
        _run_doctor,
        "Print the renderer of this machine, those tested, and missing optional packages.",
        "qsim doctor\nqsim doctor --devices",
    )
    parser.add_argument("--devices", action="store_true", help="list the named sensors and the source of each number")


def _run_doctor(args: argparse.Namespace) -> int:
    if args.devices:
        from qsim.sensor import devices

        listing = devices.listing()
        output(args, {"devices": listing}, [_device_text(device) for device in listing])
        return 0
    from qsim import backend
    from qsim.optics.camera import Camera
    from qsim.optics.diffraction import diffraction_line

    missing = {extra: [p for p in packages if not find_spec(p)] for extra, (packages, _) in OPTIONAL.items()}
    report = backend.report() | {
        "extras": {extra: not packages for extra, packages in missing.items()},
        "lens": diffraction_line(Camera(8e-3, 2.8, 1.1e-6, 512, 1024)),
    }
    width = max(len(key) for key in report)
    extras = [f"{extra}: {_extra_text(extra, packages)}" for extra, packages in missing.items()]
    probes = [f"{p['library'] or p['backend']}: {p['detail']}" for p in report["probes"]]
    words = report | {
        "probes": ("\n" + " " * (width + 2)).join(probes),
        "software": ", ".join(f"{name} {found}" for name, found in report["software"].items()),
        "extras": ("\n" + " " * (width + 2)).join(extras),
    }
    output(args, report, [f"{key:{width}}  {value}" for key, value in words.items()])
    return 0


def _extra_text(extra: str, missing: list[str]) -> str:
    """Return what an extra is for, and how to install the packages of it that are missing."""
    purpose = OPTIONAL[extra][1]
    return f"MISSING (pip install {' '.join(missing)}); for {purpose}" if missing else f"installed; for {purpose}"


def _device_text(device: dict[str, Any]) -> str:
    lines = [f"{device['name']}: {device['what']}"]
    lines += [f"    {key}: {value}" for key, value in device.items() if key not in ("name", "what", "sources")]
    lines += [f"    {key}, source: {text}" for key, text in dict(device.get("sources", {})).items()]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
