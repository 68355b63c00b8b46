"""Runs `qsim tradeoff`: bit depth against motion, light, read noise and data rate."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from qsim import checks, files
from qsim.cli.console import MAKES_AGAIN, PILOT, RESUMES, bar, command, note, output, refuse_existing, refuse_idle
from qsim.cli.options import check_free, checked, count, frame_size, positive, steps, whole_numbers
from qsim.files import Progress
from qsim.time_forecast import TimeForecast


def add_tradeoff(sub: Any) -> None:
    """Add the command `tradeoff` to a program."""
    parser = command(
        sub,
        "tradeoff",
        _run_tradeoff,
        "Bit depth against motion, light, read noise and data rate.",
        "qsim tradeoff --table --size 240x320 --base-fps 10000 --read-noise 0.2 --bits 1,3,5,7,9\n"
        "qsim tradeoff out/fast --ppp 0.65 -o out/bits\n"
        "qsim tradeoff fan --px 3 --ppp 2 -o out/fan_3px\n"
        "qsim tradeoff fan --speed 0.5:8 --ppp 0.1:30 -o out/sweep\n"
        "qsim tradeoff --paper-figure 1 -o out/figure1",
        RESUMES,
        threads="threads of the compiled engine (Dr.Jit)",
    )
    parser.add_argument("source", nargs="?", help="a clip of at least 10000 fps, or a scene (rendered into -o)")
    parser.add_argument(
        "--table", action="store_true", help="print the table of bit depths only, computed without a clip"
    )
    parser.add_argument("--paper-figure", type=int, choices=(1, 2), help="draw a figure of the QUIVER paper")
    parser.add_argument("--size", type=frame_size, help="ROWSxCOLUMNS (default 240x320, rendered scenes 96x128)")
    parser.add_argument("--base-fps", type=positive, help="planes per second (default 10000; a clip has its own)")
    parser.add_argument("--read-noise", type=float, help="table: e- rms per read (default 0.2)")
    bits = "comma-separated (default 1,2,3,4,5, then up to 7 while the deepest is best; table 1,3,5,7,9)"
    parser.add_argument("--bits", type=whole_numbers, help=bits)
    parser.add_argument("--motion", type=float, help="table: image speed, px/s (default 2500)")
    parser.add_argument("--ppp", type=steps, help="photons per pixel and plane: 0.65 or 0.1,1,10 or 0.1:30 (6 steps)")
    moving = parser.add_mutually_exclusive_group()
    moving.add_argument(
        "--speed", type=steps, help="factors on the motion, listed as in --ppp (default 1; of a clip: whole factors)"
    )
    px = (
        "motion of the moving pixels, px per 3-bit frame of 7 planes, listed as in --ppp; sets the speed, and the "
        "moving pixels alone are scored"
    )
    moving.add_argument("--px", type=steps, help=px)
    files_of = "a name of `qsim doctor --devices`, or a file of a SPAD or of a QIS with gain 1, whatever its bits"
    parser.add_argument(
        "--sensor",
        help=f"sensor of the multi-bit read (default quiver-physical): {files_of}; another QIS file at its own --bits",
    )
    parser.add_argument(
        "--plane-sensor",
        help=f"sensor of a binary plane (default: a clocked SPAD of the same efficiency): {files_of}; another QIS file "
        "if it has 1 bit",
    )
    parser.add_argument(
        "--temperature", type=float, help="degrees C of sensor files with dark_doubling (default: the file's own)"
    )
    parser.add_argument("--instants", type=count, help="frames drawn and scored per depth (default 8)")
    parser.add_argument("--frames", type=count, help="frames of a rendered scene (default: enough for the instants)")
    seed = checked(checks.seed)
    parser.add_argument("--seed", type=seed, help="seed of the noise and of a rendered scene (default 0)")
    parser.add_argument("--streams", action="store_true", help="write clips and streams of each depth, for restorers")
    parser.add_argument("-o", "--output", type=Path, help="folder for numbers, figures, clips")
    parser.add_argument("--force", action="store_true", help="replace existing numbers, figures and streams")


TABLE_ONLY = ("read_noise", "motion")
OF_STUDIES = ("px", "ppp", "bits", "base_fps", "sensor", "plane_sensor", "temperature", "instants", "frames", "streams")
PICTURES = {"tradeoff": ("best.png", "tradeoff.png")}  # of a study: which of them depends on its size
OF_FILES = ("seed", "speed", "output", "force")


def _run_tradeoff(args: argparse.Namespace) -> int:
    if args.table:
        if args.source is not None:
            raise ValueError(f"{args.source}: --table is computed without a clip; leave the clip or scene out")
        idle = [name for name in OF_STUDIES if name not in ("bits", "base_fps")]
        refuse_idle(args, "tradeoff --table", ["paper_figure", *idle, *OF_FILES, "threads"])
        return _tradeoff_table(args)
    name = "tradeoff" if args.paper_figure is None else f"figure{args.paper_figure}"
    if args.paper_figure is not None:
        refuse_idle(args, "tradeoff --paper-figure", [*TABLE_ONLY, *OF_STUDIES])
    elif args.source is None:
        raise ValueError("give a clip or a scene, --table, or --paper-figure; see qsim tradeoff --help")
    if args.read_noise is not None:
        raise ValueError(
            f"--read-noise {args.read_noise:g}: is of --table; a clip or scene is seen by a sensor, so state it in a "
            "sensor file (read_noise in [sensor]) and give that with --sensor"
        )
    refuse_idle(args, "tradeoff of a clip or scene", TABLE_ONLY)
    if args.source is not None and (Path(args.source) / "clip.json").is_file():
        refuse_idle(args, "tradeoff of a clip", ["size", "base_fps", "frames"])
        if args.paper_figure is not None:
            refuse_idle(args, "tradeoff --paper-figure of a clip", ["speed"])
    if args.output is None:
        if args.streams or args.paper_figure:
            raise ValueError("give a folder with -o, as in -o out/bits")
        refuse_idle(args, "tradeoff without --output", ["force"])
    else:
        check_free(args.output)
        for written in (f"{name}.json", *PICTURES.get(name, (f"{name}.png",))):
            refuse_existing(args.output / written, args.force)
    args.seed = args.seed or 0
    return _tradeoff_study(args) if args.paper_figure is None else _paper_figure(args)


def _tradeoff_study(args: argparse.Namespace) -> int:
    from qsim.clip.motion_statistics import SLOWEST
    from qsim.studies.bit_depth import clips as study_clips
    from qsim.studies.bit_depth import figures, speed_sweep
    from qsim.studies.bit_depth.answer import WIDEST, answer, widened
    from qsim.studies.bit_depth.clip_study import study
    from qsim.studies.bit_depth.readout import StudySettings

    bits = tuple(args.bits or (1, 2, 3, 4, 5))
    instants = 8 if args.instants is None else args.instants
    sensor = args.sensor or "quiver-physical"
    settings = StudySettings(
        bits, sensor, args.plane_sensor, None, 1, instants, args.seed, bool(args.px), args.temperature
    )
    study_clips.check_sensors(settings, args.streams)  # before anything is rendered
    height, width = args.size or (96, 128)
    widen = args.bits is None
    frames = args.frames or (2**WIDEST - 1 if widen else max(4 * settings.longest, 32))
    rate = 10_000.0 if args.base_fps is None else args.base_fps
    if not (Path(args.source) / "clip.json").is_file():  # refused before anything is rendered
        if rate < SLOWEST:
            raise ValueError(f"--base-fps {rate:g}: this study needs at least {SLOWEST:g} planes per second")
        if frames < settings.longest:
            raise ValueError(f"--frames {frames}: {max(bits)} bits need {settings.longest}; give more, or fewer bits")
    shape = study_clips.ClipShape(frames, height, width, rate, seed=args.seed)
    speeds = _speeds(args, shape)
    levels = args.ppp or [None]
    swept = len(speeds) * len(levels) > 1
    if args.streams and swept:
        raise ValueError("--streams: writes one speed and one light level; give one --ppp and one --speed or --px")
    missing = study_clips.to_render(args.source, speeds, args.output)
    rendering = TimeForecast(f"rendering {_clips(missing)} of {shape.frames} frames", note, unit="frame", parts=missing)
    with bar("rendering", first=PILOT if missing else "") as shown:
        progress = _both(shown, rendering)
        clips = list(study_clips.clips_for(args.source, speeds, shape, args.output, progress))
    first = clips[0].clip
    if args.streams and clips[0].step > 1:
        raise ValueError("--streams: writes a clip at its own speed; leave out --speed and --px, or name a scene")
    if first.camera is None and not args.ppp:
        raise ValueError(f"{first.path}: its radiance is relative; give the light with --ppp, as in --ppp 0.65")
    if args.streams:  # refused before the study, not after it
        for depth in range(1, WIDEST + 1) if widen else settings.bits:
            study_clips.stream_clip(first, args.output / "streams", depth, args.force)
    text: list[str] = []
    with bar("drawing", "study" if swept else "frame") as shown:
        if swept:
            ppps = args.ppp or [first.mean_photons]
            drawing = TimeForecast(f"drawing {len(speeds) * len(ppps)} studies", note, unit="study")
            progress = _both(shown, drawing)
            found = speed_sweep.sweep(clips, ppps, settings, widen=widen, progress=progress)
            result = found.to_dict()
            pictures = {"best.png": figures.sweep_figure(found)}
            text += [line for row in found.studies for one in row for line in speed_sweep.table(one)]
            text.append(speed_sweep.summary(found))
            answers = found.answers
        else:
            asked = replace(settings, ppp=levels[0], speed=clips[0].step)
            progress = _both(shown, TimeForecast("drawing the study", note, unit="frame"))
            one = widened(first, asked, note) if widen else study(first, asked, progress=progress)
            result = speed_sweep.study_dict(one)
            pictures = {"tradeoff.png": figures.study_figure(one)}
            text += speed_sweep.table(one)
            settings = replace(settings, bits=one.bits)
            answers = [answer(one)]
    if args.px:
        result["px_asked"], result["speeds_found"] = args.px, speeds
        text = [f"--px {px:g}: speed factor {speed:g}" for px, speed in zip(args.px, speeds, strict=True)] + text
    if args.streams:
        args.after_interrupt = MAKES_AGAIN
        lit = replace(settings, ppp=levels[0])
        made = study_clips.write_streams(first, args.output / "streams", lit, force=args.force)
        result["streams"] = [str(path) for path in made]
        text += [f"streams 'planes' and 'multibit': {path}" for path in made]
    if args.output is not None:
        text += _write_study(args.output, "tradeoff.json", result, pictures)
    output(args, result, text + answers)
    return 0


def _clips(count: int) -> str:
    return f"{count} clip{'' if count == 1 else 's'}"


def _both(one: Progress, other: Progress) -> Progress:
    """Return a progress that tells both."""

    def told(done: int, total: int) -> None:
        one(done, total)
        other(done, total)

    return told


def _speeds(args: argparse.Namespace, shape: Any) -> list[float]:
    """Return the factors on the motion, found from --px or given."""
    from functools import partial

    from qsim import scenes
    from qsim.streams.clip import Clip
    from qsim.studies.bit_depth import answer as tradeoff_answer

    if not args.px:
        return args.speed or [1.0]
    found: list[tuple[float, float]] = []
    if (Path(args.source) / "clip.json").is_file():
        clip = Clip.open(args.source)
        found = [tradeoff_answer.step_for(px, clip) for px in args.px]
    elif args.source in scenes.FAMILIES or args.source.endswith(".py"):
        motion = partial(_motion, args.source, shape)
        found = [tradeoff_answer.speed_for(px, motion, args.source) for px in args.px]
    if len({speed for speed, _ in found}) < len(found):
        raise ValueError(f"{args.source}: several of --px {args.px} need one and the same speed; give fewer")
    return [speed for speed, _ in found] or [1.0]  # 1: `clips_for` refuses what is neither a clip nor a scene


def _motion(name: str, shape: Any, speed: float) -> float:
    from qsim.studies.bit_depth.answer import scene_motion

    size = (shape.height, shape.width)
    rate = shape.frame_rate
    return scene_motion(name, size, frames=shape.frames, frame_rate=rate, seed=shape.seed, speed=speed)


def _write_study(folder: Path, name: str, result: dict[str, Any], pictures: dict[str, bytes]) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    for picture, content in pictures.items():
        files.write_bytes(folder / picture, content)
    files.write_json(folder / name, result)
    return ["written: " + ", ".join(str(folder / written) for written in [*pictures, name])]


def _paper_figure(args: argparse.Namespace) -> int:
    from qsim.streams.clip import Clip
    from qsim.studies.bit_depth import clips as study_clips
    from qsim.studies.bit_depth import paper_figures

    height, width = args.size or (96, 128)
    number = args.paper_figure
    speeds = args.speed or [1.0]
    if len(speeds) > 1:
        raise ValueError(f"--speed {args.speed}: --paper-figure draws one speed; give one")
    rate, frames = (paper_figures.RATE_1, 201) if number == 1 else (10_000.0, 511)
    shape = study_clips.ClipShape(frames, height, width, rate, seed=args.seed)
    names = [args.source] if args.source else ["fan"] if number == 1 else ["fan", "text"]
    rows = []
    result = []
    for name, ppp in zip(names * (2 // len(names) if number == 2 else 1), (0.51, 0.40), strict=False):
        if (Path(name) / "clip.json").is_file():
            clip = Clip.open(name)
        else:
            with bar(name) as progress:
                path = args.output / "clips" / Path(name).stem
                clip = study_clips.render(name, path, shape, speed=speeds[0], progress=progress)
        panels = (
            paper_figures.figure_1(clip, seed=args.seed)
            if number == 1
            else (paper_figures.figure_2(clip, ppp, seed=args.seed))
        )
        rows.append(panels)
        result.append({"clip": clip.name, "panels": [{"label": p.label, **p.numbers} for p in panels]})
    found = {"figure": number, "rows": result}
    text = [f"{row['clip']}: {panel}" for row in result for panel in row["panels"]]
    text += _write_study(args.output, f"figure{number}.json", found, {f"figure{number}.png": paper_figures.draw(rows)})
    output(args, found, text)
    return 0


def _tradeoff_table(args: argparse.Namespace) -> int:
    from qsim.studies.bit_depth.laws import depths

    height, width = args.size or (240, 320)
    rate = 10_000.0 if args.base_fps is None else args.base_fps
    noise = 0.2 if args.read_noise is None else args.read_noise
    speed = 2500.0 if args.motion is None else args.motion
    rows = depths(
        height=height,
        width=width,
        base_fps=rate,
        read_noise=noise,
        bits=args.bits or [1, 3, 5, 7, 9],
        speed=speed,
    )
    text = [
        f"{height} x {width} px, {rate:g} planes/s, {noise:g} e- per read, {speed:g} px/s",
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
