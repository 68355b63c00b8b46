"""The command `qsim`: parse, call, print. Each command is a pair `_add_X` (its options) and `_run_X` (what it does);
most are in cli_data.py, cli_look.py, cli_studies.py, cli_validate.py and convert.py.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import sys
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from qsim import checks
from qsim.cli.calibrate import add_calibrate
from qsim.cli.completion import add_completion
from qsim.cli.console import EXTRAS, GOES_ON, Parser, bar, checked, command, note, output, refuse_idle, run
from qsim.cli.convert import add_convert
from qsim.cli.dataset import add_check, add_generate, add_plan
from qsim.cli.look import add_preview, add_report
from qsim.cli.tradeoff import add_tradeoff
from qsim.cli.validate import add_validate
from qsim.files import VERSION


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit code."""
    parser = Parser(prog="qsim", description="Render moving scenes and turn them into few-bit quanta-sensor streams.")
    parser.add_argument("--version", action="version", version=f"qsim {VERSION}")
    sub = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for add in (
        _add_doctor,
        _add_render,
        _add_sense,
        add_generate,
        add_plan,
        add_check,
        add_convert,
        add_preview,
        add_report,
        add_tradeoff,
        add_calibrate,
        add_validate,
    ):
        add(sub)
    add_completion(sub, parser)
    return run(parser, argv)


# doctor


def _add_doctor(sub: Any) -> None:
    parser = command(
        sub, "doctor", _run_doctor, "Say what this machine renders with, what was tried, and which extras are missing.",
        "qsim doctor\nqsim doctor --devices",
    )  # fmt: skip
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

    extras = {extra: all(find_spec(m) for m in EXTRAS if EXTRAS[m] == extra) for extra in sorted(set(EXTRAS.values()))}
    report = backend.report() | {
        "extras": extras,
        "lens": diffraction_line(Camera(8e-3, 2.8, 1.1e-6, 512, 1024)),
    }
    width = max(len(key) for key in report)
    missing = ", ".join(f"{extra} (pip install 'qsim[{extra}]')" for extra, there in extras.items() if not there)
    probes = [f"{p['library'] or p['backend']}: {p['detail']}" for p in report["probes"]]
    words = report | {
        "probes": ("\n" + " " * (width + 2)).join(probes),
        "software": ", ".join(f"{name} {found}" for name, found in report["software"].items()),
        "extras": ", ".join(extra for extra, there in extras.items() if there) + (missing and f"; missing: {missing}"),
    }
    output(args, report, [f"{key:{width}}  {value}" for key, value in words.items()])
    return 0


def _device_text(device: dict[str, Any]) -> str:
    lines = [f"{device['name']}: {device['what']}"]
    lines += [f"    {key}: {value}" for key, value in device.items() if key not in ("name", "what", "sources")]
    lines += [f"    {key}, source: {text}" for key, text in dict(device.get("sources", {})).items()]
    return "\n".join(lines)


# render


def _add_render(sub: Any) -> None:
    parser = command(
        sub, "render", _run_render, "Render a scene into a clip: radiance, sharp frames, flow, depth, body ids.",
        "qsim render fan -o out/fan --frames 21 --height 128 --width 128\n"
        "qsim render fan --explain", GOES_ON,
        threads="of the renderer (Dr.Jit); the picture does not depend on it",
    )  # fmt: skip
    parser.add_argument(
        "scene", help="a family of scenes/, a .py file with scene(seed, speed=...), Mitsuba .xml, a folder of assets"
    )
    parser.add_argument("-o", "--output", type=Path, help="clip folder to make (may be left out with --explain)")
    parser.add_argument(
        "--explain", action="store_true", help="say what is modelled, what is left out and how large it would have been"
    )
    whole = checked(checks.whole)
    parser.add_argument("--seed", type=checked(checks.seed), default=0, help="of the scene and its samples (default 0)")
    parser.add_argument("--speed", type=checked(checks.positive), default=1.0, help="factor on all motions (default 1)")
    parser.add_argument("--frames", type=whole, default=21, help="default 21")
    parser.add_argument("--height", type=whole, default=128, help="pixels (default 128)")
    parser.add_argument("--width", type=whole, default=128, help="pixels (default 128)")
    rate, shutter, psnr = (checked(check) for check in (checks.frame_rate, checks.shutter, checks.psnr))
    parser.add_argument("--frame-rate", type=rate, default=2000.0, help="frames per second (default 2000)")
    parser.add_argument("--shutter", type=shutter, default=0.0, help="open share of a frame, 0..1 (default 0: sharp)")
    parser.add_argument(
        "--psnr",
        type=psnr,
        default=40.0,
        help="wanted error of the radiance, dB below white, clamped there (default 40)",
    )
    light = checked(checks.positive)
    parser.add_argument("--ppp", type=light, help="brightest light level that will be sensed, photons per pixel")
    parser.add_argument(
        "--engine", choices=("cuda", "llvm", "scalar"), help="insist on one (default: QSIM_ENGINE, else the fastest)"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing clip")


def _run_render(args: argparse.Namespace) -> int:
    from qsim import backend
    from qsim.clip.clamped_error import stated
    from qsim.dataset import scene_files
    from qsim.optics.diffraction import diffraction_line
    from qsim.rendering import fidelity
    from qsim.rendering.budget import explain
    from qsim.rendering.clip_rendering import render_clip

    if args.output is None and not args.explain:
        raise ValueError("the following arguments are required: -o/--output; only --explain does without")
    if args.output is None:
        refuse_idle(args, "render without --output", ["force"])
    if args.output is not None and args.output.exists() and not args.force:
        raise FileExistsError(f"{args.output}: exists; name another with -o, or use --force to replace it")
    if args.engine is not None:
        os.environ["QSIM_ENGINE"] = args.engine
        backend.choose()
    loaded, read = scene_files.load(args.scene, seed=args.seed, speed=args.speed)
    scene = loaded.resized(args.height, args.width)
    with bar(args.output.name if args.output else "pilot") as progress:
        chosen = fidelity.choose_budget(
            scene,
            frame_rate=args.frame_rate,
            shutter=args.shutter,
            frames=args.frames,
            psnr=args.psnr,
            ppp=args.ppp,
            seed=args.seed,
        )
        if args.output is None:
            output(args, {"render": dataclasses.asdict(chosen)}, explain(chosen))
            return 0
        clip = render_clip(
            scene,
            args.output,
            frames=args.frames,
            frame_rate=args.frame_rate,
            shutter=args.shutter,
            seed=args.seed,
            budget=chosen,
            progress=progress,
            extra={"reads": read} if read else None,
            force=args.force,
        )
    found = stated(clip.meta)
    text = f"{clip.path}: {len(clip)} frames of {args.height} x {args.width}"
    text += f", mean radiance {clip.mean_radiance:.4g} W/m2/sr"
    text += f", {clip.mean_photons:.4g} photons per pixel"
    text += "" if found is None else f"\nerror: {found.line}"
    text += (missed := fidelity.shortfall(found, args.psnr)) and f"\nerror: {missed}"
    if "fireflies_per_frame" in clip.meta:
        fireflies, pixels = sum(clip.meta["fireflies_per_frame"]), math.prod(clip.shape)
        how = "counted before denoising" if chosen.denoise else "counted and left in"
        text += f"\nfireflies: {fireflies} of {pixels} pixels, {how}"
    text += "\n" + (explain(chosen) if args.explain else diffraction_line(scene.camera))
    output(args, {"clip": str(clip.path)} | {k: v for k, v in clip.meta.items() if k != "checksums"}, text)
    return 0


# sense


def _add_sense(sub: Any) -> None:
    parser = command(
        sub, "sense", _run_sense, "Turn clips into few-bit streams, or draw one frame again and compare.",
        "qsim sense out/fan --bits 3 --ppp 3.25\n"
        "qsim sense out/starter --sensor spad-320x240 --bits 1 --ppp 0.5,3.25,26\n"
        "qsim sense out/starter --name quiver-physical_3bit_3.25ppp --replay fan_0003:7",
        "the same command goes on with the streams that are missing",
        threads="of the compiled engine (Dr.Jit) that draws codes; codes do not depend on it",
    )  # fmt: skip
    parser.add_argument("paths", nargs="+", type=Path, metavar="PATH", help="clips or data sets")
    parser.add_argument(
        "--sensor", help="a name of `qsim doctor --devices`, or a .toml file (default: quiver-physical)"
    )
    parser.add_argument("--bits", type=checked(checks.bits), help="bits per code (default: the sensor's own)")
    parser.add_argument("--ppp", type=_numbers, help="photons per pixel and code over the whole clip; several: 3.25,26")
    parser.add_argument("--lux", type=_numbers, help="faceplate lux at 555 nm instead of --ppp")
    parser.add_argument("--seed", type=checked(checks.seed), default=0, help="of the noise (default 0)")
    parser.add_argument("-o", "--name", help="name of the stream (default: made from sensor, bits and light)")
    parser.add_argument("--group", action="store_true", help="codes sum 2^bits - 1 clip frames as binary planes")
    parser.add_argument("--diffraction", action="store_true", help="blur by the lens's Airy pattern")
    parser.add_argument(
        "--defects",
        metavar="FILE.toml",
        help="table [defects]: hot and dead pixels, PRNU, offsets, measured maps, afterpulses, crosstalk, dead time "
        "that is carried over (default: that of the sensor's own .toml file)",
    )
    parser.add_argument(
        "--slices", type=int, default=1, help="counting SPAD: clip frames in one exposure, whose light may change"
    )
    parser.add_argument(
        "--replay", metavar="CLIP:FRAME", help="draw one frame again and compare it with the stored one"
    )
    parser.add_argument("--force", action="store_true", help="replace a stream of the same name")


def _run_sense(args: argparse.Namespace) -> int:
    from qsim.clip.sensing import Sensing, sense

    if args.ppp and args.lux:
        raise ValueError("give the light level as --ppp or as --lux, not both")
    levels = [{"ppp": ppp} for ppp in args.ppp or []] + [{"lux": lux} for lux in args.lux or []] or [{}]
    if args.name and len(levels) > 1:
        raise ValueError(f"--name {args.name}: one name for {len(levels)} light levels; leave it out")
    wanted = [
        Sensing(args.sensor or "quiver-physical", args.bits, seed=args.seed, name=args.name, group=args.group,
                       diffraction=args.diffraction, defects=args.defects, slices=args.slices, **level)
        for level in levels
    ]  # fmt: skip
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
                facts = {"clip": str(clip.path), "stream": found.name, "made": bool(drawn), "light": line}
                made.append(facts | _light(found.meta))
    if len(levels) > 1:
        note("streams of a clip with the same --seed share their random numbers: another --seed makes them independent")
    lines = [f"{m['light']}; {'made' if m['made'] else 'there already'}: stream {m['stream']}" for m in made]
    output(args, {"streams": made}, lines)
    return 0


def _light(meta: dict[str, Any]) -> dict[str, Any]:
    keys = ("ppp", "ppp_factor", "mean_photons_before", "equivalent_lux_555nm", "bits", "shape", "code_model")
    return {key: meta[key] for key in keys}


def _replay(args: argparse.Namespace, clips: list[Any], sensing: Any) -> int:
    from qsim.clip.sensing import replay

    refuse_idle(args, "--replay draws what is stored", ["group", "diffraction", "defects", "force"])
    if args.slices != 1:
        raise ValueError("--replay draws what is stored: --slices changes nothing here; leave it out")
    name, _, number = args.replay.rpartition(":")
    if not number.isdigit() or (not name and len(clips) != 1):
        raise ValueError(f"--replay {args.replay}: expected CLIP:FRAME, as in fan_0003:7")
    chosen = [clip for clip in clips if not name or clip.name == name]
    if not chosen:
        raise ValueError(f"--replay {args.replay}: no clip {name} among {', '.join(clip.name for clip in clips)}")
    clip = chosen[0]
    known = clip.streams
    named = args.sensor or args.bits or args.ppp or args.lux or args.seed  # each is part of a stream's name
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
    """The clips of a data set, or the one clip of a folder."""
    from qsim.clip.clip import Clip
    from qsim.dataset.dataset import Dataset

    if (path / "dataset.json").is_file():
        clips = Dataset.open(path).clips()
        if not clips:
            raise ValueError(f"{path}: this data set has no finished clip yet; run `qsim generate`")
        return list(clips)
    return [Clip.open(path)]


def _numbers(text: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected numbers such as 3.25 or 0.5,3.25,26, got {text!r}") from None
    if not all(0 < number < float("inf") for number in numbers):
        raise argparse.ArgumentTypeError(f"expected numbers above 0, got {text!r}")
    return numbers


if __name__ == "__main__":
    sys.exit(main())
