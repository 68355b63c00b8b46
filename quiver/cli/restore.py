"""The command `quiver restore`: its options and its action."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from qsim import checks, records
from qsim.cli.console import bar, note, output
from qsim.cli.options import checked, count, positive
from quiver.cli.options import (
    add_light,
    add_running,
    add_strict,
    check_domain,
    command,
    running_options,
    use_threads,
)
from quiver.restoration.interface import DEFAULT_METHOD


def add_restore(sub: Any) -> None:
    parser = command(
        sub,
        "restore",
        _run_restore,
        "Restore a stream, a clip or a photon cube; no ground truth is needed.",
        "quiver restore out/starter/clips/fan_0003 -o out/fan.npy\n"
        "quiver restore out/fan/streams/quiver-physical_3bit_3.25ppp.npy -o out/fan.npy --method out/mine\n"
        "quiver restore out/fan --ppp 3.25 -o out/fan.npy --method moment\n"
        "quiver restore cube.npy --width 320 --planes 7 --sensor spad-320x240 --frame-rate 1428 -o out/cube.npy\n"
        "quiver restore out/cubes/test -o out/submission.zip --planes 7",
        resumes=True,
    )
    parser.add_argument(
        "source",
        type=Path,
        help="stream (.npy with its .json), clip folder, bare .npy array, or (with -o OUT.zip) cubes of the challenge",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        help=".npy to write, or .zip: the pictures of a submission to the challenge; a .json appears beside it",
    )
    parser.add_argument(
        "--method",
        default=DEFAULT_METHOD,
        help="classical method, shipped weights, weights file or run folder; auto: mergenet, or the classical method "
        f"that was measured to be better at this sensor, depth and light (default {DEFAULT_METHOD})",
    )
    parser.add_argument("--stream", help="stream of a clip to restore (default: the only one)")
    add_light(parser, several=False, default="that of the stored stream")
    parser.add_argument(
        "--seed", type=checked(checks.seed), help="seed of the noise, if a clip is sensed now (default 0)"
    )
    parser.add_argument("--width", type=count, help="bare array: packed binary planes of this many pixels per row")
    parser.add_argument(
        "--planes", type=count, help="packed planes and cubes: 2^b - 1 are summed to one code (default 1)"
    )
    parser.add_argument("--frame-rate", type=positive, help="bare array: codes per second (default 2000)")
    parser.add_argument(
        "--defects", type=Path, help="map of defective pixels, .npy [H, W], true where hot or dead: they are filled"
    )
    add_running(parser)
    add_strict(parser)
    parser.add_argument("--force", action="store_true", help="replace an existing result")


def _run_restore(args: argparse.Namespace) -> int:
    from quiver import threads
    from quiver.data.clips import check_outside
    from quiver.restoration.automatic import chosen
    from quiver.restoration.restored_file import restore_to_file, unnamed
    from quiver.restoration.sources import assumed, codes_to_restore, refuse_idle

    target: Path = args.output
    if target.suffix == ".zip":
        return _restore_cubes(args)
    if target.suffix != ".npy":
        raise ValueError(f"{target}: restored video is written as .npy; name a .npy file")
    check_outside(target)
    codes = codes_to_restore(args)
    for path in (target, target.with_suffix(".json")):
        if path.exists() and not args.force and not unnamed(target):  # restore_to_file finishes its naming
            raise FileExistsError(f"{path}: exists; name another with -o, or use --force to replace it")
    threads.check(args.threads)
    method, why = chosen(args.method, codes, running_options(args))
    refuse_idle(vars(args), [method])
    check_domain(args, [method], [codes])
    used = use_threads(args, threads.recorded(target.with_name(f"{target.name}.part.json")))
    if why is not None:
        note(why)
    target.parent.mkdir(parents=True, exist_ok=True)
    lines = [assumed(codes, method)]
    started = time.monotonic()
    with bar(method.name) as progress:

        def shown(done: int, total: int) -> None:
            while lines and time.monotonic() > started + 2:  # as the bar: an early error stays one line
                note(lines.pop())
            progress(done, total)

        info = restore_to_file(codes, method, target, shown, force=args.force, note=note, threads=used)
    for line in lines:
        note(line)
    length, height, width = codes.shape
    size = f"{height} x {width}" + ("" if codes.colour is None else " in R, G, B")
    output(
        args,
        {"restored": str(target)} | records.plain(info, complete=True),
        f"{target}: {length} frames of {size} by {method.name}, "
        f"{info.seconds_per_frame:.3g} s per frame; photons, white of the sensor = {codes.white:.4g}",
    )
    return 0


def _restore_cubes(args: argparse.Namespace) -> int:
    """Restore cubes of the Single Photon Challenge into the zip of a submission."""
    from quiver.data.challenge import COLOURS, band_codes, cubes
    from quiver.restoration.automatic import chosen_for_all
    from quiver.restoration.sources import assumed, refuse, refuse_idle
    from quiver.restoration.submission import check_target, restore_cubes

    target: Path = args.output
    idle = ("stream", "sensor", "ppp", "bits", "seed", "width", "frame_rate", "defects")
    refuse(args, idle, f"{target} is a submission, whose layout states it")
    check_target(target, args.force)
    found = cubes(args.source)
    planes = args.planes or 1
    bands = [band_codes(cube, colour, planes) for cube in found for colour in range(len(COLOURS))]
    method, why = chosen_for_all(args.method, bands, running_options(args))
    refuse_idle(vars(args), [method])
    check_domain(args, [method], bands, shown=1)
    use_threads(args)
    for text in (why, assumed(bands[0], method)):
        if text is not None:
            note(text)
    target.parent.mkdir(parents=True, exist_ok=True)
    with bar(method.name) as progress:
        info = restore_cubes(found, method, planes, target, progress, force=args.force)
    score = "no truth beside them" if info.psnr is None else f"PSNR {info.psnr:.2f} dB"
    output(
        args,
        {"submission": str(target)} | records.plain(info, complete=True),
        f"{target}: {len(found)} pictures by {method.name}, {planes} planes per code, {score}, "
        f"{info.seconds_per_picture:.3g} s per picture",
    )
    return 0
