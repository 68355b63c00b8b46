"""Runs `qsim calibrate`: measures a sensor from dark and flat frames and writes its file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from qsim import checks
from qsim.cli.console import command, output, refuse_existing
from qsim.cli.options import checked
from qsim.cli.reader_options import LAYOUT, add_reader_options, hints_of


def add_calibrate(sub: Any) -> None:
    """Add the command `calibrate` to a program."""
    parser = command(
        sub,
        "calibrate",
        _run_calibrate,
        "Measure a sensor from dark and flat frames; write its file.",
        "qsim calibrate --bits 8 --dark d1.npy 1e-3 --dark d2.npy 0.1 --flat f.npy 1e-3 --flat g.npy 1e-3 -o my.toml\n"
        "qsim calibrate --model spad --bits 1 --dark dark.npy 1e-5 --flat flat.npy 1e-5 0.8 -o spad.toml\n"
        "qsim calibrate --bits 8 --static counts.npy 6.33e-6 -o counter.toml",
    )
    for option, names, what in (
        ("--dark", ("FILE", "SECONDS"), "frames without light, and their exposure"),
        ("--flat", ("FILE", "SECONDS"), "evenly lit frames, their exposure, and the photons per pixel if known"),
    ):
        parser.add_argument(option, metavar=names, help=what, action="append", nargs="+", default=[])
    parser.add_argument(
        "--static",
        nargs=2,
        metavar=("FILE", "SECONDS"),
        help="counts of a static scene, instead of dark and flat frames: measures the dead time from Fano factors",
    )
    parser.add_argument(
        "--bits",
        type=checked(checks.bits),
        help="bits per code; 1 for binary planes (default with --planes of 2 or more: 1)",
    )
    parser.add_argument(
        "--planes",
        type=checked(checks.planes),
        help="spad: every value is the sum of this many binary planes, SECONDS and PHOTONS are those of one plane; "
        "1: values are single exposures",
    )
    parser.add_argument("--model", choices=("qis", "spad"), help="kind of sensor (default qis; spad with --planes)")
    parser.add_argument("--paralyzable", action="store_true", help="spad: every arrival restarts the dead time")
    parser.add_argument("--ignore-dead-time", action="store_true", help="spad: model the counts as Poisson")
    reading = parser.add_argument_group("where the values of the files lie")
    add_reader_options(reading, LAYOUT, width="pixels of a row of packed planes: .npy files are photon cubes")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".toml to write; .json and .png beside it")
    parser.add_argument("--force", action="store_true", help="replace existing files")


def _run_calibrate(args: argparse.Namespace) -> int:
    from qsim.calibration import sensor_file
    from qsim.calibration.qis import calibrate_qis
    from qsim.calibration.spad import calibrate_spad

    if args.output.suffix != ".toml":
        raise ValueError(f"{args.output}: the sensor file is a .toml, as in -o my_sensor.toml")
    model, bits = _calibration_kind(args)
    _check_outputs(args, model)
    darks = [_stack(words, args, bits, dark=True) for words in args.dark]
    flats = [_stack(words, args, bits, dark=False) for words in args.flat]
    if args.static:
        found = _static(args, bits)
    elif model == "qis":
        found = calibrate_qis(darks, flats, bits=bits)
    else:
        found = calibrate_spad(
            darks, flats, bits=bits, dead_time=not args.ignore_dead_time, paralyzable=args.paralyzable
        )
    args.output.parent.mkdir(parents=True, exist_ok=True)
    stacks = f"{len(darks)} dark and {len(flats)} flat stacks"
    origin = f"counts of the static scene {Path(args.static[0]).name}" if args.static else stacks
    written = sensor_file.write(found, args.output, f"calibrated from {origin}")
    width = max(len(name) for name in found.values)
    assumed = _assumed(args, model, bits)
    text = [f"taken as: {assumed}"]
    text += [f"{name:{width}}  {value}  ({value.method})" for name, value in found.values.items()]
    text += [f"warning: {words}" for words in found.warnings]
    text += ["written: " + ", ".join(str(path) for path in written)]
    output(args, sensor_file.as_dict(found) | {"assumed": assumed, "files": [str(path) for path in written]}, text)
    return 0


def _check_outputs(args: argparse.Namespace, model: str) -> None:
    """Raise an `OSError` if a file to write exists without --force, or is an input."""
    from qsim.calibration.sensor_file import beside, stream_of

    written = beside(args.output)
    if not (model == "spad" and args.dark):
        written.pop("dark_count_rate")
        written.pop("hot_pixels")
    inputs = [Path(words[0]) for words in [*args.dark, *args.flat, *([args.static] if args.static else [])]]
    inputs += [path.with_suffix(end) for path in inputs if stream_of(path) is not None for end in (".npy", ".json")]
    for path in (args.output, *written.values()):
        places = (path, *path.resolve().parents) if path.exists() else ()
        for given in inputs:
            if given.exists() and any(place.samefile(given) for place in places):
                raise FileExistsError(f"{path}: would replace a file of the input {given}; name another with -o")
        refuse_existing(path, args.force)


COUNTS = 8  # bits; larger codes of a SPAD may be sums of planes, which the user must state


def _calibration_kind(args: argparse.Namespace) -> tuple[str, int]:
    """Return (qis or spad, bits of a code); `ValueError` for options that exclude each other."""
    if args.static and (args.dark or args.flat):
        raise ValueError("--static: a static scene replaces dark and flat frames; leave out --dark and --flat")
    sums = args.planes is not None and args.planes > 1
    model = args.model or ("spad" if args.static or args.planes is not None else "qis")
    for option, given, acts, why in (
        ("--model qis", args.static and args.model == "qis", False, "--static finds the dead time of a counting SPAD"),
        (
            "--planes",
            args.planes is not None and model == "qis",
            False,
            "a QIS is calibrated from its own codes; for sums of binary planes add --model spad",
        ),
        ("--planes", sums and args.static, False, "binary planes have no dead time for --static to find"),
        (
            "--ignore-dead-time",
            args.ignore_dead_time,
            model == "spad" and not args.static,
            "it is for --model spad with dark and flat frames",
        ),
        ("--paralyzable", args.paralyzable, model == "spad", "it is for --model spad and --static"),
        ("--paralyzable", args.paralyzable and args.ignore_dead_time, False, "--ignore-dead-time takes no dead time"),
        (
            "--width",
            args.width is not None and _packed(args) and (sums or args.static is not None),
            False,
            "it is for packed binary planes, which are read one by one",
        ),
    ):
        if given and not acts:
            raise ValueError(f"{option}: {why}; leave it out")
    if sums and args.bits not in (None, 1):
        raise ValueError(f"--bits {args.bits}: --planes {args.planes} are 1-bit planes; leave --bits out")
    if args.bits is None and not sums:
        raise ValueError("--bits: is needed, as in --bits 8; for sums of binary planes give --planes instead")
    bits = 1 if sums else int(args.bits)
    if bits == 1:
        for option, given in (("--ignore-dead-time", args.ignore_dead_time), ("--paralyzable", args.paralyzable)):
            if given:
                raise ValueError(f"{option}: binary planes have no dead time in this model; leave it out")
    if args.width is not None and bits > 1 and _packed(args):
        raise ValueError(f"--width: it is for packed binary planes, and --bits is {bits}; leave it out")
    if model == "spad" and bits > COUNTS and args.planes is None and not args.static:
        raise ValueError(
            f"--bits {bits}: values this large may be sums of binary planes; give --planes N for sums of N planes, or "
            "--planes 1 if every value counts one exposure"
        )
    return model, bits


def _packed(args: argparse.Namespace) -> bool:
    """Return whether --width states the packed planes of .npy files, not the size of raw frames."""
    return args.layout in (None, "cube")


def _assumed(args: argparse.Namespace, model: str, bits: int) -> str:
    """Return a line that states how the numbers in the files are interpreted."""
    if args.planes is not None and args.planes > 1:
        return f"sums of {args.planes} binary planes of a SPAD; seconds and photons are those of one plane"
    if args.static:
        return f"counts of one exposure each, {bits} bits, of a static scene (for sums of planes: --planes)"
    if model == "spad" and bits > 1:
        return f"counts of one exposure each, {bits} bits (for sums of N binary planes: --planes N)"
    return f"{'binary planes of a SPAD' if model == 'spad' else f'{bits}-bit codes of a QIS'}"


def _static(args: argparse.Namespace, bits: int) -> Any:
    from qsim.calibration.dead_time import calibrate_static
    from qsim.calibration.sensor_file import read_counts

    path = Path(args.static[0])
    exposure = _number(args.static[1])
    counts = read_counts(path, hints_of(args, LAYOUT), bits, exposure)
    return calibrate_static(counts, bits=bits, exposure=exposure, paralyzable=args.paralyzable, name=str(path))


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"{word!r} is not a number; give seconds, as in 1e-3") from None


def _stack(words: list[str], args: argparse.Namespace, bits: int, *, dark: bool) -> Any:
    from qsim.calibration.sensor_file import read_stack

    kind, most = ("--dark", 2) if dark else ("--flat", 3)
    if not 2 <= len(words) <= most:
        raise ValueError(
            f"{kind} {' '.join(words)}: give a file and its exposure in seconds, as in {kind} frames.npy 1e-3"
        )
    numbers = [_number(word) for word in words[1:]]
    photons = 0.0 if dark else numbers[1] if len(numbers) > 1 else None
    return read_stack(
        Path(words[0]),
        bits=bits,
        exposure=numbers[0],
        photons=photons,
        hints=hints_of(args, LAYOUT),
        planes=args.planes if args.planes != 1 else None,
    )
