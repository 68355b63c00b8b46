"""Runs `qsim sense`: draws few-bit streams of clips, or draws one frame again."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from qsim import checks
from qsim.cli.console import MAKES_AGAIN, bar, command, note, output, refuse_idle
from qsim.cli.options import checked, numbers


def add_sense(sub: Any) -> None:
    """Add the command `sense` to a program."""
    parser = command(
        sub,
        "sense",
        _run_sense,
        "Turn clips into few-bit streams, or draw one frame again and compare.",
        "qsim sense out/fan --bits 3 --ppp 3.25\n"
        "qsim sense out/starter --sensor spad-320x240 --bits 1 --ppp 0.5,3.25,26\n"
        "qsim sense out/starter --name quiver-physical_3bit_3.25ppp --replay fan_0003:7",
        "the same command resumes with the missing streams",
        threads="threads of the compiled engine (Dr.Jit) that draws codes; codes do not depend on it",
    )
    parser.add_argument("paths", nargs="+", type=Path, metavar="PATH", help="clips or data sets")
    parser.add_argument(
        "--sensor", help="a name of `qsim doctor --devices`, or a .toml file (default: quiver-physical)"
    )
    parser.add_argument("--bits", type=checked(checks.bits), help="bits per code (default: the sensor's own)")
    light = "mean photons per pixel and code over the clip; several: 3.25,26 (default: the clip's own light)"
    parser.add_argument("--ppp", type=numbers, help=light)
    parser.add_argument("--lux", type=numbers, help="faceplate lux at 555 nm instead of --ppp")
    pitch = "metres, of a clip without a camera (imported video), so that --lux is known: 1.1e-6"
    parser.add_argument("--pixel-pitch", type=checked(checks.positive), help=pitch)
    parser.add_argument("--seed", type=checked(checks.seed), default=0, help="seed of the noise (default 0)")
    parser.add_argument("-o", "--name", help="name of the stream (default: made from sensor, bits and light)")
    parser.add_argument(
        "--group", action="store_true", help="sum 2^bits - 1 clip frames, as binary planes, to one code"
    )
    parser.add_argument("--diffraction", action="store_true", help="blur light with the lens's Airy pattern")
    parser.add_argument(
        "--defects",
        metavar="FILE.toml",
        help="table [defects]: hot and dead pixels, PRNU, offsets, measured maps, afterpulses, crosstalk, dead time "
        "that is carried over (default: that of the sensor's own .toml file)",
    )
    parser.add_argument(
        "--colour",
        metavar="MASK",
        help="colour filters: rggb, quad, rgbw, red, green, blue, or a .toml with a table [colour]",
    )
    parser.add_argument(
        "--slices",
        type=int,
        default=1,
        help="counting SPAD or QIS: clip frames per exposure, so that light may change within it (motion blur)",
    )
    parser.add_argument(
        "--row-delay", type=checked(checks.positive), help="seconds from one row to the next (default: all at once)"
    )
    parser.add_argument(
        "--row-order", choices=checks.ROW_ORDERS, help="direction of rows (down, the default, or up) or of columns"
    )
    parser.add_argument(
        "--exposures",
        type=numbers,
        help="shares of a code's time with light, in turn, as in 1,0.25,0.0625; light levels are of full exposures",
    )
    parser.add_argument(
        "--follow", action="store_true", help="counting SPAD: draw photon by photon, so that their times are known"
    )
    parser.add_argument(
        "--temperature", type=float, help="degrees C of a sensor file with dark_doubling (default: the file's own)"
    )
    parser.add_argument(
        "--replay", metavar="CLIP:FRAME", help="draw one frame again and compare it with the stored one"
    )
    parser.add_argument("--force", action="store_true", help="replace a stream of the same name")


def _run_sense(args: argparse.Namespace) -> int:
    from qsim.streams.sensing import Sensing, sense

    if args.force:
        args.after_interrupt = MAKES_AGAIN
    if args.ppp and args.lux:
        raise ValueError("give the light level as --ppp or as --lux, not both")
    levels = [{"ppp": ppp} for ppp in args.ppp or []] + [{"lux": lux} for lux in args.lux or []] or [{}]
    if args.name and len(levels) > 1:
        raise ValueError(f"--name {args.name}: one name for {len(levels)} light levels; leave it out")
    if args.replay and len(levels) > 1:
        raise ValueError(f"--replay {args.replay}: is of one stream, not of {len(levels)} light levels; give one")
    wanted = [
        Sensing(
            args.sensor or "quiver-physical",
            args.bits,
            seed=args.seed,
            name=args.name,
            group=args.group,
            diffraction=args.diffraction,
            defects=args.defects,
            slices=args.slices,
            row_delay=args.row_delay,
            row_order=args.row_order,
            colour=args.colour,
            exposures=args.exposures,
            follow=args.follow,
            temperature=args.temperature,
            pixel_pitch=args.pixel_pitch,
            **level,
        )
        for level in levels
    ]
    clips = [clip for path in args.paths for clip in _clips(path)]
    if args.replay:
        return _replay(args, clips, wanted[0])
    made = []
    frames = sum(len(clip) for clip in clips) * len(wanted)
    before = 0
    with bar("sensing") as progress:
        for clip in clips:
            for sensing in wanted:
                drawn: list[int] = []

                def count(done: int, _: int, start: int = before, drawn: list[int] = drawn) -> None:
                    drawn.append(done)
                    progress(start + done, frames)

                waiting = partial(note, f"{clip.path}: waiting for another process that senses this clip")
                found, line = sense(clip, sensing, force=args.force, progress=count, on_wait=waiting)
                before += len(clip)
                facts = {"clip": str(clip.path), "stream": found.name, "file": str(found.path), "made": bool(drawn)}
                facts["light"] = line
                made.append(facts | _light(found.meta))
    if len(levels) > 1:
        note("streams of a clip with the same --seed share their random numbers: another --seed makes them independent")
    lines = [_line(m) for m in made]
    output(args, {"streams": made}, lines)
    return 0


def _line(made: dict[str, Any]) -> str:
    """Return what was written where: `wrote STREAM.npy: 21 codes of 3 bits, 128 x 128 pixels; light ...`."""
    frames, height, width = made["shape"]
    kind = f"{frames} codes of {made['bits']} bit{'s' if made['bits'] > 1 else ''}, {height} x {width} pixels"
    return f"{'wrote' if made['made'] else 'exists already:'} {made['file']}: {kind}; {made['light']}"


def _light(meta: dict[str, Any]) -> dict[str, Any]:
    keys = ("ppp", "ppp_factor", "mean_photons_before", "equivalent_lux_555nm", "bits", "shape", "code_model")
    return {key: meta[key] for key in keys}


def _replay(args: argparse.Namespace, clips: list[Any], sensing: Any) -> int:
    from qsim.streams.sensing import replay

    unused = [
        "group",
        "diffraction",
        "defects",
        "row_delay",
        "row_order",
        "exposures",
        "follow",
        "temperature",
        "pixel_pitch",
        "force",
    ]
    refuse_idle(args, "--replay draws what is stored", unused)
    if args.slices != 1:
        raise ValueError("--replay draws what is stored: --slices changes nothing here; leave it out")
    if args.name:
        where = f"--replay of --name {args.name}"
        refuse_idle(args, where, ["sensor", "bits", "ppp", "lux", "colour"])
        if args.seed:
            raise ValueError(f"{where}: --seed changes nothing here; leave it out")
    name, _, number = args.replay.rpartition(":")
    if not number.isdigit() or (not name and len(clips) != 1):
        raise ValueError(f"--replay {args.replay}: expected CLIP:FRAME, as in fan_0003:7")
    chosen = [clip for clip in clips if not name or clip.name == name]
    if not chosen:
        raise ValueError(f"--replay {args.replay}: no clip {name} among {', '.join(clip.name for clip in clips)}")
    clip = chosen[0]
    known = clip.streams
    named = (
        args.sensor or args.bits or args.ppp or args.lux or args.seed or args.colour
    )  # each is part of a stream's name
    if len(known) > 1 and not args.name and not named and sensing.stream_name not in known:
        raise ValueError(f"{clip.path}: choose one of its streams with --name: {', '.join(known)}")
    stored = clip.stream(known[0] if len(known) == 1 and not args.name and not named else sensing.stream_name)
    drawn, kept = replay(clip, stored, int(number))
    differ = int((drawn != kept).sum())
    found = {"clip": clip.name, "stream": stored.name, "frame": int(number), "pixels": drawn.size, "differ": differ}
    verdict = (
        "equal to the stored frame" if differ == 0 else f"{differ} of {drawn.size} pixels DIFFER from the stored frame"
    )
    output(args, found, f"{clip.name}, {stored.name}, frame {number} drawn again: {verdict}")
    return 0 if differ == 0 else 1


def _clips(path: Path) -> list[Any]:
    """Return the clips of a data set, or the one clip of a folder."""
    from qsim.dataset.dataset import Dataset
    from qsim.streams.clip import Clip

    if (path / "dataset.json").is_file():
        clips = Dataset.open(path).clips()
        if not clips:
            raise ValueError(f"{path}: this data set has no finished clip yet; run `qsim generate`")
        return list(clips)
    return [Clip.open(path)]
