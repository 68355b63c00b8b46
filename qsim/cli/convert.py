"""Runs `qsim convert`: imports foreign files as clips and streams, and exports ours."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from qsim import files, records
from qsim.cli.console import MAKES_AGAIN, RESUMES, bar, command, note, output, refuse_idle
from qsim.cli.options import check_free, count, positive
from qsim.cli.reader_options import LAYOUT, add_reader_options, hints_of
from qsim.clip.source import Times
from qsim.dataset.dataset import Dataset
from qsim.dataset.recipe import SPLITS
from qsim.formats import challenge, detection, exporting, importing, pairs
from qsim.formats.recording import Recording
from qsim.restored_video import describes_restored
from qsim.streams.clip import Clip
from qsim.streams.stream import Stream

PICTURES = ("mp4", "png", "nerfstudio")  # kinds that show light through a transfer curve
_SUFFIXES = {".npy": "cube", ".mp4": "mp4", ".zarr": "zarr", ".h5": "pairs", ".dat": "spike", ".npz": "photons"}


def add_convert(sub: Any) -> None:
    """Add the command `convert` to a program."""
    parser = command(
        sub,
        "convert",
        _run_convert,
        "Read foreign recordings as clips or streams; write ours for others.",
        "qsim convert ball.npy out/ball --frame-rate 30000 --exposure 20e-6 --transfer linear\n"
        "qsim convert camera.tif out/camera --frame-rate 1000 --transfer linear --white 4095\n"
        "qsim convert I2-2000FPS/test out/i2_test --frame-rate 2000 --transfer 'gamma 2.2' --split test\n"
        "qsim convert capture.bin out/capture --layout swissspad2-half --frame-rate 96800\n"
        "qsim convert out/starter out/starter_mp4 --to mp4\n"
        "qsim convert out/starter out/starter.h5 --to pairs\n"
        "qsim convert out/challenge out/cubes --to challenge\n"
        "qsim convert out/room out/room_poses --to nerfstudio\n"
        "qsim convert out/fan/streams/spad.json out/fan_cube.npy",
    )
    parser.add_argument("input", type=Path, help="a file, a folder, a clip, a stream (its .npy or .json), a data set")
    parser.add_argument(
        "output", type=Path, help="clip folder, stream name, .npy, .mp4 or .zarr, or a folder with --to"
    )
    reading = parser.add_argument_group("what a foreign file may not state")
    add_reader_options(reading, [*LAYOUT, "bits", "transfer", "stretched", "flip", "columns", "black", "keep_gaps"])
    reading.add_argument("--frame-rate", type=positive, help="frames per second of the capture (not of a video file)")
    reading.add_argument("--exposure", type=positive, help="seconds of light per frame (default: the full frame time)")
    reading.add_argument(
        "--sensor", help="sensor that made the codes, by name or file (default: an ideal binary counter)"
    )
    reading.add_argument("--ppp", type=positive, help="light level for which the sensor's gain was set")
    reading.add_argument("--split", choices=SPLITS, help="split to store in the clips")
    writing = parser.add_argument_group("writing for others")
    writing.add_argument(
        "--to",
        choices=sorted([*exporting.EXPORTS, "pairs"]),
        help="kind of the output (default: from the suffix of its name); pairs: codes, truth and flow in one .h5; "
        "challenge: cubes of colour planes with their truth; nerfstudio: pictures and their poses, transforms.json",
    )
    writing.add_argument(
        "--window",
        type=count,
        help=f"pairs: codes in each window (default {pairs.WINDOW}); challenge: planes in each cube (default "
        f"{challenge.PLANES})",
    )
    writing.add_argument(
        "--lossy", action="store_true", help="write mp4 with FFmpeg's default settings, which lose noise"
    )
    add_reader_options(parser, ["white"])
    parser.add_argument("--force", action="store_true", help="replace an existing output")


def _run_convert(args: argparse.Namespace) -> int:
    source = args.input
    if source.suffix == ".npy" and _is_stream(source.with_suffix(".json")):  # its codes name a stream too
        source = args.input = source.with_suffix(".json")
    ours = source.is_dir() and any((source / name).is_file() for name in ("clip.json", "dataset.json"))
    made = _export(args) if ours or _is_stream(source) else _import(args)
    output(args, {"made": [str(path) for path, _ in made]}, [f"{path}: {about}" for path, about in made])
    return 0


def _is_stream(path: Path) -> bool:
    return path.suffix == ".json" and path.is_file() and "ppp_factor" in files.read_json(path)


_READING = (
    *LAYOUT,
    "frame_rate",
    "exposure",
    "bits",
    "stretched",
    "columns",
    "black",
    "keep_gaps",
    "sensor",
    "ppp",
    "split",
)


def _refuse_what_cannot_act(args: argparse.Namespace, kind: str, light: bool) -> None:
    """Raise `ValueError` for options of writing without effect on this kind of output."""
    where = f"{args.output}, a {kind} of {'light' if light else 'codes'}"
    if not (light and kind in PICTURES):
        refuse_idle(args, where, ["transfer"])
    if kind != "mp4":
        refuse_idle(args, where, ["lossy"])
    if kind not in ("pairs", "challenge"):
        refuse_idle(args, where, ["window"])


def _export(args: argparse.Namespace) -> list[tuple[Path, str]]:
    refuse_idle(args, f"{args.input} is ours and states it", _READING)
    if args.flip != "none":
        raise ValueError(f"{args.input} is ours and states it: --flip changes nothing here; leave it out")
    kind = args.to or _SUFFIXES.get(args.output.suffix)
    if kind is None:
        known = ", ".join(sorted([*exporting.EXPORTS, "pairs"]))
        raise ValueError(f"{args.output}: name the kind of output with --to: {known}")
    _refuse_what_cannot_act(args, kind, args.input.suffix != ".json")
    planes = args.window or challenge.PLANES
    wanted = exporting.Export(kind, args.transfer or "gamma 2.2", args.white, not args.lossy, planes=planes)
    if args.white is not None and (kind not in PICTURES or args.input.suffix == ".json"):
        raise ValueError("--white: acts on light written as mp4, png or nerfstudio; leave it out")
    if kind == "pairs":
        return [_pairs(args)]
    if not (args.input / "dataset.json").is_file():
        opened = Stream.open(args.input) if args.input.suffix == ".json" else Clip.open(args.input)
        return [exporting.described(opened, args.output, wanted, force=args.force)]
    suffix = {"cube": ".npy", "mp4": ".mp4", "zarr": ".zarr", "spike": ".dat", "photons": ".npz"}.get(kind, "")
    check_free(args.output)
    args.after_interrupt = MAKES_AGAIN
    made = []
    clips = Dataset.open(args.input).clips()
    for clip in clips:
        exporting.check(clip, wanted)
    with bar("converting", "clip") as progress:
        for n, clip in enumerate(clips, 1):
            folder = args.output / (clip.info.split or "all")
            target = folder / f"{files.check_name(clip.name)}{suffix}"
            made.append(exporting.described(clip, target, wanted, force=args.force))
            progress(n, len(clips))
    return made


def _pairs(args: argparse.Namespace) -> tuple[Path, str]:
    """Write the windows of a data set or a clip."""
    if args.input.suffix == ".json":
        raise ValueError(f"{args.input}: pairs are made of a data set or a clip, with all its streams; name its folder")
    if (args.input / "dataset.json").is_file():
        data = Dataset.open(args.input)
        splits = {split: data.clips(split) for split in SPLITS}
    else:
        splits = {"all": [Clip.open(args.input)]}
    with bar("converting", "window") as progress:
        about = pairs.write(splits, args.output, args.window or pairs.WINDOW, force=args.force, progress=progress)
    return args.output, about


def _import(args: argparse.Namespace) -> list[tuple[Path, str]]:
    refuse_idle(args, f"{args.input} is read, not written for others", ["to", "lossy", "window"])
    restored = _restored(args.input)
    args.frame_rate = args.frame_rate or restored.get("frame_rate")
    args.exposure = args.exposure or restored.get("exposure")
    args.transfer = args.transfer or ("linear" if restored else None)
    hints = hints_of(args)
    found = detection.recordings(args.input, args.layout)
    if args.layout is None:
        detection.check_one_kind(args.input, found)
    pairs = [(source, args.output / files.check_name(_flat_name(source, args.input))) for source in found]
    if pairs:
        _check_names(args.input, pairs)
        check_free(args.output)
        args.after_interrupt = MAKES_AGAIN
    made = []
    with bar("converting") as progress:
        for source, target in pairs or [(args.input, args.output)]:
            recording = importing.read(source, hints)
            rate = args.frame_rate or recording.frame_rate
            if rate is None:
                raise ValueError(f"{args.input}: files do not state the capture rate; add --frame-rate, as in 2000")
            capture = importing.Import(rate, args.exposure, args.sensor, args.ppp, args.split)
            if recording.is_light:
                if target.suffix in _SUFFIXES:
                    raise ValueError(
                        f"{target}: light is read into a clip, a folder; name it without {target.suffix}, or write a "
                        "film with `qsim preview`"
                    )
                args.after_interrupt = args.after_interrupt if pairs else RESUMES
                clip = importing.to_clip(recording, target, capture, force=args.force, progress=progress)
                made.append(
                    (clip.path, f"{_size(clip)}, light of {recording.format}; {importing.saturation_line(clip)}")
                )
                _tell_reading(source, recording)
                continue
            stream = importing.to_stream(recording, target, capture, force=args.force, progress=progress)
            made.append((stream.path, f"{_size(stream)}, {stream.bits}-bit codes, {recording.format}"))
            _tell_reading(source, recording)
    return made


def _tell_reading(source: Path, recording: Recording) -> None:
    """Print how the bytes or axes of a file that was converted were read."""
    if recording.reading:
        note(f"{source}: {recording.reading}")


def _check_names(folder: Path, pairs: list[tuple[Path, Path]]) -> None:
    """Raise `ValueError` if two recordings of a folder become one output."""
    taken: dict[Path, Path] = {}
    for source, target in pairs:
        other = taken.setdefault(target, source)
        if other != source:
            raise ValueError(f"{folder}: {other} and {source} would both become {target}; rename one of them")


def _restored(source: Path) -> dict[str, Any]:
    """Return the description of restored video (`quiver restore`), which states its rates; else an empty one."""
    beside = source.with_suffix(".json")
    found = files.read_json(beside) if source.suffix == ".npy" and beside.is_file() else {}
    return found if describes_restored(found) else {}


def _size(made: Clip | Stream) -> str:
    frames, height, width = made.shape
    rate = made.frame_rate if isinstance(made, Clip) else float(made.meta["frame_rate"])
    exposure = made.exposure
    said = f"{frames} frames of {height} x {width} pixels at {rate:g} per second, exposure {exposure * 1e6:.4g} us"
    if isinstance(made, Clip):
        times = made.info.times
    else:
        times = records.convert(made.meta["times"], Times, "times") if "times" in made.meta else None
    if times is None:
        return said
    return f"{said}, times {times.values[0]:.10g} to {times.values[-1]:.10g} {times.unit} ({times.source})"


def _flat_name(file: Path, folder: Path) -> str:
    """Return `scene/clip.mp4` (or the folder `scene/clip`) below `folder` as `scene_clip`."""
    inside = file.relative_to(folder)
    return "_".join((inside if file.is_dir() else inside.with_suffix("")).parts).replace(" ", "_")
