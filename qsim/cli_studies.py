"""The command `tradeoff`: `add_X`, `_run_X` as in cli.py."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from qsim import files
from qsim.console import bar, command, output

# tradeoff


def add_tradeoff(sub: Any) -> None:
    parser = command(
        sub, "tradeoff", _run_tradeoff, "Bit depth against motion, light, read noise and data rate.",
        "qsim tradeoff --table --size 240x320 --base-fps 10000 --read-noise 0.2 --bits 1,3,5,7,9\n"
        "qsim tradeoff out/fast --ppp 0.65 -o out/bits\n"
        "qsim tradeoff fan --speed 0.5:8 --ppp 0.1:30 -o out/sweep\n"
        "qsim tradeoff --paper-figure 1 -o out/figure1",
        threads="of the compiled engine (Dr.Jit)",
    )  # fmt: skip
    parser.add_argument("source", nargs="?", help="a clip of at least 10000 fps, or a scene (rendered into -o)")
    parser.add_argument("--table", action="store_true", help="only print the table of bit depths, from numbers alone")
    parser.add_argument("--paper-figure", type=int, choices=(1, 2), help="draw a figure of the QUIVER paper")
    parser.add_argument("--size", type=size, help="ROWSxCOLUMNS (default 240x320, rendered scenes 96x128)")
    parser.add_argument("--base-fps", type=float, default=10_000.0, help="planes per second (default 10000)")
    parser.add_argument("--read-noise", type=float, default=0.2, help="table: e- rms per read (default 0.2)")
    parser.add_argument("--bits", type=integers, help="with commas (default 1,2,3,4,5; table 1,3,5,7,9)")
    parser.add_argument("--motion", type=float, default=2500.0, help="table: image speed, px/s (default 2500)")
    parser.add_argument("--ppp", type=steps, help="photons per pixel and plane: 0.65 or 0.1,1,10 or 0.1:30 (6 steps)")
    parser.add_argument("--speed", type=steps, default=[1.0], help="factors on the motion, as --ppp (a clip: whole)")
    parser.add_argument("--sensor", default="quiver-physical", help="of the multi-bit read (default quiver-physical)")
    parser.add_argument("--plane-sensor", help="of a binary plane (default: a clocked SPAD of the same efficiency)")
    parser.add_argument("--instants", type=int, default=8, help="frames drawn and scored per depth (default 8)")
    parser.add_argument("--frames", type=int, help="of a rendered scene (default: enough for the instants)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise and of a rendered scene (default 0)")
    parser.add_argument("--streams", action="store_true", help="write clips and streams of each depth for restorers")
    parser.add_argument("-o", "--output", type=Path, help="folder for numbers, figures, clips")
    parser.add_argument("--force", action="store_true", help="replace existing numbers and figures")


def _run_tradeoff(args: argparse.Namespace) -> int:
    if args.table:
        return _tradeoff_table(args)
    name = "tradeoff" if args.paper_figure is None else f"figure{args.paper_figure}"
    if args.output is None and (args.streams or args.paper_figure):
        raise ValueError("give a folder with -o, as in -o out/bits")
    if args.output is not None and (args.output / f"{name}.json").exists() and not args.force:
        raise FileExistsError(f"{args.output / name}.json: exists; name another folder with -o, or use --force")
    if args.paper_figure is not None:
        return _paper_figure(args)
    if args.source is None:
        raise ValueError("give a clip or a scene, --table, or --paper-figure; see qsim tradeoff --help")
    return _tradeoff_study(args)


def _tradeoff_study(args: argparse.Namespace) -> int:
    from qsim import tradeoff_sweep
    from qsim.tradeoff_study import Question, study

    bits = tuple(args.bits or (1, 2, 3, 4, 5))
    question = Question(bits, args.sensor, args.plane_sensor, None, 1, args.instants, args.seed)
    height, width = args.size or (96, 128)
    frames = args.frames or max(4 * question.longest, 32)
    shape = tradeoff_sweep.Shape(frames, height, width, args.base_fps, seed=args.seed)
    with bar("rendering") as progress:
        clips = list(tradeoff_sweep.clips_for(args.source, args.speed, shape, args.output, progress))
    first = clips[0].clip
    if first.camera is None and not args.ppp:
        raise ValueError(f"{first.path}: its radiance is relative; give the light with --ppp, as in --ppp 0.65")
    levels = args.ppp or [None]
    swept = len(clips) * len(levels) > 1
    with bar("drawing", "study") as progress:
        if swept:
            found = tradeoff_sweep.sweep(clips, args.ppp or [first.mean_photons], question, progress=progress)
            result, pictures = found.to_dict(), {"best.png": tradeoff_sweep.sweep_figure(found)}
            text = [line for row in found.studies for one in row for line in tradeoff_sweep.table(one)]
            text.append(tradeoff_sweep.summary(found))
        else:
            one = study(first, replace(question, ppp=levels[0], speed=clips[0].step), progress=progress)
            result, pictures = tradeoff_sweep.study_dict(one), {"tradeoff.png": tradeoff_sweep.study_figure(one)}
            text = tradeoff_sweep.table(one)
    if args.streams:
        lit = replace(question, ppp=levels[0])
        made = tradeoff_sweep.write_streams(first, args.output / "streams", lit)
        result["streams"] = [str(path) for path in made]
        text += [f"streams 'planes' and 'multibit': {path}" for path in made]
    if args.output is not None:
        text += _write_study(args.output, "tradeoff.json", result, pictures)
    output(args, result, text)
    return 0


def _write_study(folder: Path, name: str, result: dict[str, Any], pictures: dict[str, bytes]) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    for picture, content in pictures.items():
        files.write_bytes(folder / picture, content)
    files.write_json(folder / name, result)
    return ["written: " + ", ".join(str(folder / written) for written in [*pictures, name])]


def _paper_figure(args: argparse.Namespace) -> int:
    from qsim import tradeoff_paper, tradeoff_sweep
    from qsim.clip import Clip

    height, width = args.size or (96, 128)
    number = args.paper_figure
    rate, frames = (tradeoff_paper.RATE_1, 201) if number == 1 else (10_000.0, 511)
    shape = tradeoff_sweep.Shape(frames, height, width, rate, seed=args.seed)
    names = [args.source] if args.source else ["fan"] if number == 1 else ["fan", "text"]
    rows, result = [], []
    for name, ppp in zip(names * (2 // len(names) if number == 2 else 1), (0.51, 0.40), strict=False):
        if (Path(name) / "clip.json").is_file():
            clip = Clip.open(name)
        else:
            with bar(name) as progress:
                path = args.output / "clips" / Path(name).stem
                clip = tradeoff_sweep.render(name, path, shape, speed=args.speed[0], progress=progress)
        panels = tradeoff_paper.figure_1(clip, seed=args.seed) if number == 1 else (
            tradeoff_paper.figure_2(clip, ppp, seed=args.seed)
        )  # fmt: skip
        rows.append(panels)
        result.append({"clip": clip.name, "panels": [{"label": p.label, **p.numbers} for p in panels]})
    found = {"figure": number, "rows": result}
    text = [f"{row['clip']}: {panel}" for row in result for panel in row["panels"]]
    text += _write_study(args.output, f"figure{number}.json", found, {f"figure{number}.png": tradeoff_paper.draw(rows)})
    output(args, found, text)
    return 0


def _tradeoff_table(args: argparse.Namespace) -> int:
    from qsim.tradeoff import depths

    height, width = args.size or (240, 320)
    rows = depths(
        height=height,
        width=width,
        base_fps=args.base_fps,
        read_noise=args.read_noise,
        bits=args.bits or [1, 3, 5, 7, 9],
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


def steps(text: str) -> list[float]:
    """`3.25`, `0.5,3,26`, `0.1:30` (six geometric steps) or `0.5:8:5` (five of them) -> numbers above 0."""
    import numpy as np

    words = text.split(":")
    try:
        if len(words) == 1:
            found = [float(word) for word in text.split(",")]
        else:
            low, high = float(words[0]), float(words[1])
            count = int(words[2]) if len(words) == 3 else _doublings(low, high)
            found = [float(f"{v:.4g}") for v in np.geomspace(low, high, count)]
    except (ValueError, IndexError):
        found = []
    if not found or len(words) > 3 or not all(0 < v < float("inf") for v in found):
        raise argparse.ArgumentTypeError(f"numbers above 0, as in 0.65 or 0.1,1,10 or 0.1:30 or 0.5:8:5; got {text!r}")
    return found


def _doublings(low: float, high: float) -> int:
    """Steps of 2 if the range is so many times 2 (up to 32), else six steps."""
    from math import isclose, log2

    octaves = log2(high / low)
    return round(octaves) + 1 if 0 < octaves < 5.5 and isclose(octaves, round(octaves)) else 6
