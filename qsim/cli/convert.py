"""Runs `qsim convert`: imports foreign files as clips and streams, and exports ours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from qsim import files
from qsim.cli.command import Idle, command
from qsim.cli.completion import sensors
from qsim.cli.console import MAKES_AGAIN, RESUMES, bar, in_options, note, output, running
from qsim.cli.options import check_free
from qsim.dataset.dataset import Dataset
from qsim.dataset.recipe import SPLITS
from qsim.formats import challenge, detection, exporting, importing, pairs
from qsim.formats.recording import Hints, Recording
from qsim.formats.summing import sum_planes, summed
from qsim.kinds import FrameRate, Positive, Split, Text, Whole
from qsim.plane_sums import AS_STORED, PlaneSums
from qsim.restored_video import describes_restored
from qsim.settings import setting, settings_of
from qsim.streams.clip import Clip
from qsim.streams.event_stream import EventStream, is_events
from qsim.streams.stream import Stream, is_stream

PICTURES = ("mp4", "png", "nerfstudio")  # kinds that show light through a transfer curve
_SUFFIXES = {".npy": "cube", ".mp4": "mp4", ".zarr": "zarr", ".h5": "pairs", ".dat": "spike", ".npz": "photons"}

OTHERS = "writing for others"
KINDS = sorted([*exporting.EXPORTS, "pairs"])


@dataclass(frozen=True)
class Convert:
    """What `qsim convert` reads and writes; the facts of its files are `Hints`."""

    input: Annotated[Path, setting("a file, a folder, a clip, a stream, events or a data set", positional=True)]
    output: Annotated[
        Path, setting("clip folder, stream name, .npy, .mp4 or .zarr, or a folder with --to", positional=True)
    ]
    frame_rate: Annotated[
        Positive | None, setting("frames per second of the capture (not of a video file)", section=Hints.SECTION)
    ] = None
    rate: Annotated[
        FrameRate | None,
        setting(
            "frames per second of the clip; those that a video lacks are estimated",
            unset="frames as they are",
            section=Hints.SECTION,
        ),
    ] = None
    exposure: Annotated[
        Positive | None, setting("seconds of light per frame", unset="the full frame time", section=Hints.SECTION)
    ] = None
    sensor: Annotated[
        Text | None,
        setting(
            "sensor that made the codes, by name or file",
            unset="an ideal binary counter",
            section=Hints.SECTION,
            known=sensors,
        ),
    ] = None
    ppp: Annotated[
        Positive | None, setting("light level for which the sensor's gain was set", section=Hints.SECTION)
    ] = None
    split: Annotated[Split | None, setting("split to store in the clips", section=Hints.SECTION)] = None
    to: Annotated[
        str | None,
        setting(
            "kind of the output, one of those that docs/files.md describes",
            unset="from the suffix of its name",
            section=OTHERS,
            choices=KINDS,
        ),
    ] = None
    window: Annotated[
        Whole | None,
        setting(
            "pairs: codes in each window; challenge: planes in each cube",
            unset=f"pairs {pairs.WINDOW}, challenge {challenge.PLANES}",
            section=OTHERS,
        ),
    ] = None
    lossy: Annotated[bool, setting("write mp4 with FFmpeg's default settings, which lose noise", section=OTHERS)] = (
        False
    )
    force: Annotated[bool, setting("replace an existing output")] = False

    @property
    def source(self) -> Path:
        """The input; of a stream its description, which the .npy of its codes names too."""
        beside = _description(self.input)
        return beside if self.input.suffix == ".npy" and (_is_stream(beside) or _is_events(beside)) else self.input

    @property
    def is_ours(self) -> bool:
        """Whether a clip, a stream or a data set of qsim is written for others."""
        source = self.source
        ours = source.is_dir() and any((source / name).is_file() for name in ("clip.json", "dataset.json"))
        return ours or _is_stream(source) or self.is_events

    @property
    def is_events(self) -> bool:
        """Whether events are written for others."""
        return _is_events(self.source)

    @property
    def kind(self) -> str | None:
        """The kind of the output; None if neither --to nor its name says it."""
        if self.to is None and self.is_events:
            return "events"
        return self.to or _SUFFIXES.get(self.output.suffix)

    @property
    def is_light(self) -> bool:
        """Whether light is written, not codes."""
        return self.source.suffix != ".json"


@dataclass(frozen=True)
class ConvertedSums(PlaneSums):
    """Which planes of a recording `qsim convert` writes; its option --to names a kind of output."""

    stop: Annotated[
        Whole | None, setting("number of the plane (or code) before which to end", unset="all", option="until")
    ] = None


def _is_stream(path: Path) -> bool:
    return path.suffix == ".json" and path.is_file() and is_stream(path)


def _is_events(path: Path) -> bool:
    return path.suffix == ".json" and path.is_file() and is_events(path)


# ---- What cannot act


def _written(asked: Convert, acts: bool) -> str:
    """Return why an option of writing does not act on this kind of output; empty if it does."""
    if acts or not asked.is_ours or asked.kind is None:
        return ""
    if asked.is_events:
        return f"changes nothing in {asked.output}, which holds events"
    return f"changes nothing in {asked.output}, a {asked.kind} of {'light' if asked.is_light else 'codes'}"


_STATED = tuple(one.name for one in settings_of(Hints) if one.name not in ("transfer", "white"))
IDLE = (
    Idle(
        lambda asked, *_: f"{asked.input} is ours and states it" if asked.is_ours else "",
        ("frame_rate", "rate", "exposure", "sensor", "ppp", "split", *_STATED),
    ),
    Idle(
        lambda asked, *_: (
            f"{asked.input} is read, not written for others" if asked.input.exists() and not asked.is_ours else ""
        ),
        ("to", "lossy", "window"),
    ),
    Idle(lambda asked, *_: _written(asked, asked.is_light and asked.kind in PICTURES), ("transfer", "white")),
    Idle(lambda asked, *_: _written(asked, asked.kind == "mp4"), ("lossy",)),
    Idle(lambda asked, *_: _written(asked, asked.kind in ("pairs", "challenge")), ("window",)),
)


# ---- The command


@command(
    "qsim convert ball.npy out/ball --frame-rate 30000 --exposure 20e-6 --transfer linear",
    "qsim convert camera.tif out/camera --frame-rate 1000 --transfer linear --white 4095",
    "qsim convert I2-2000FPS/test out/i2_test --frame-rate 2000 --transfer 'gamma 2.2' --split test",
    "qsim convert phone.mp4 out/phone --rate 2000",
    "qsim convert capture.bin out/capture --layout swissspad2-half --frame-rate 96800",
    "qsim convert out/capture.npy out/capture_7 --planes 7 --from 1000 --until 8000",
    "qsim convert out/starter out/starter_mp4 --to mp4",
    "qsim convert out/starter out/starter.h5 --to pairs",
    "qsim convert out/challenge out/cubes --to challenge",
    "qsim convert out/room out/room_poses --to nerfstudio",
    "qsim convert out/fan/streams/spad.json out/fan_cube.npy",
    "qsim convert out/fan/events/dvs_100ppp.json out/fan_events.h5",
    idle=IDLE,
)
def convert(asked: Convert, hints: Hints, sums: ConvertedSums) -> int:
    """Import what is foreign, export what is ours, and print what was made."""
    if asked.is_ours and sums.any:
        made = _export_sums(asked, hints, sums)
    else:
        made = _export(asked, hints) if asked.is_ours else _import(asked, hints, sums)
    output({"made": [str(path) for path, _ in made]}, [f"{path}: {in_options(about)}" for path, about in made])
    return 0


def _export_sums(asked: Convert, hints: Hints, sums: PlaneSums) -> list[tuple[Path, str]]:
    """Write sums of a stream's planes as a stream, or with a kind of output for others."""
    source = asked.source
    if asked.is_events:
        raise ValueError(f"{source}: holds events, and planes are summed and chosen in streams of codes")
    if asked.kind == "pairs":
        return [_pairs(asked, sums)]
    if asked.is_light:
        raise ValueError(
            f"{source}: planes are summed and chosen in a stream; name one of its streams, as in "
            f"{source / 'streams'}/NAME.npy"
        )
    stream = Stream.open(source)
    if asked.kind in (None, "cube") and asked.to is None:
        with bar("summing") as progress:
            made = sum_planes(stream, sums, asked.output, force=asked.force, progress=progress)
        return [(made.path, f"{_size(made)}, {made.bits}-bit codes, {made.rates}")]
    made = summed(stream, sums)
    path, about = exporting.described(made, asked.output, _wanted(asked, hints), force=asked.force)
    return [(path, f"{about}, {made.rates}")]


def _wanted(asked: Convert, hints: Hints) -> exporting.Export:
    """Return the format of what is written for others."""
    if asked.kind is None:
        raise ValueError(f"{asked.output}: name the kind of output with --to: {', '.join(KINDS)}")
    planes = asked.window or challenge.PLANES
    return exporting.Export(asked.kind, hints.transfer or "gamma 2.2", hints.white, not asked.lossy, planes=planes)


def _export(asked: Convert, hints: Hints) -> list[tuple[Path, str]]:
    source = asked.source
    wanted = _wanted(asked, hints)
    if wanted.kind == "pairs" and asked.is_events:
        raise ValueError(f"{source}: holds events, and pairs are codes with their truth; name a stream of codes")
    if wanted.kind == "pairs":
        return [_pairs(asked, AS_STORED)]
    if asked.is_events:
        return [exporting.described(EventStream.open(source), asked.output, wanted, force=asked.force)]
    if not (source / "dataset.json").is_file():
        opened = Stream.open(source) if source.suffix == ".json" else Clip.open(source)
        return [exporting.described(opened, asked.output, wanted, force=asked.force)]
    suffix = {"cube": ".npy", "mp4": ".mp4", "zarr": ".zarr", "spike": ".dat", "photons": ".npz"}.get(wanted.kind, "")
    check_free(asked.output)
    running().after_interrupt = MAKES_AGAIN
    made = []
    clips = Dataset.open(source).clips()
    for clip in clips:
        exporting.check(clip, wanted)
    with bar("converting", "clip") as progress:
        for n, clip in enumerate(clips, 1):
            folder = asked.output / (clip.info.split or "all")
            target = folder / f"{files.check_name(clip.name)}{suffix}"
            made.append(exporting.described(clip, target, wanted, force=asked.force))
            progress(n, len(clips))
    return made


def _pairs(asked: Convert, sums: PlaneSums) -> tuple[Path, str]:
    """Write the windows of a data set, a clip, or one stream of a clip."""
    if (asked.source / "dataset.json").is_file():
        data = Dataset.open(asked.source)
        streams = {split: pairs.streams_of(data.clips(split)) for split in SPLITS}
    elif asked.is_light:
        streams = {"all": pairs.streams_of([Clip.open(asked.source)])}
    else:
        stream = Stream.open(asked.source)
        folder = stream.clip
        streams = {"all": [(Clip(folder.path, folder.info, folder.keeps), stream)]}
    frames = asked.window or pairs.WINDOW
    with bar("converting", "window") as progress:
        about = pairs.write(streams, asked.output, frames, sums=sums, force=asked.force, progress=progress)
    return asked.output, about


def _import(asked: Convert, hints: Hints, sums: PlaneSums) -> list[tuple[Path, str]]:
    restored = _restored(asked.input)
    frame_rate = asked.frame_rate or restored.get("frame_rate")
    exposure = asked.exposure or restored.get("exposure")
    if restored and hints.transfer is None:
        hints = replace(hints, transfer="linear")
    found = detection.recordings(asked.input, hints.layout)
    if hints.layout is None:
        detection.check_one_kind(asked.input, found)
    pairs = [(source, asked.output / files.check_name(_flat_name(source, asked.input))) for source in found]
    if pairs:
        _check_names(asked.input, pairs)
        check_free(asked.output)
        running().after_interrupt = MAKES_AGAIN
    made = []
    with bar("converting") as progress:
        for source, target in pairs or [(asked.input, asked.output)]:
            if asked.rate is None:
                recording = importing.read(source, hints)
            else:
                recording = importing.read_at_rate(source, hints, asked.rate, frame_rate)
            rate = asked.rate or frame_rate or recording.frame_rate
            if rate is None:
                raise ValueError(f"{asked.input}: files do not state the capture rate; add --frame-rate, as in 2000")
            capture = importing.Import(rate, exposure, asked.sensor, asked.ppp, asked.split)
            if recording.is_light:
                if sums.any:
                    raise ValueError(f"{source}: is light, and planes are summed and chosen in recordings of codes")
                if target.suffix in _SUFFIXES:
                    raise ValueError(
                        f"{target}: light is read into a clip, a folder; name it without {target.suffix}, or write a "
                        "film with `qsim preview`"
                    )
                running().after_interrupt = MAKES_AGAIN if pairs else RESUMES
                clip = importing.to_clip(recording, target, capture, force=asked.force, progress=progress)
                made.append(
                    (clip.path, f"{_size(clip)}, light of {recording.format}; {importing.saturation_line(clip)}")
                )
                _tell_reading(source, recording)
                continue
            stream = importing.to_stream(recording, target, capture, sums=sums, force=asked.force, progress=progress)
            about = f"{stream.bits}-bit codes, {recording.format}, {stream.rates}"
            made.append((stream.path, f"{_size(stream)}, {about}"))
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


def _description(path: Path) -> Path:
    """Return the file that describes an array of ours, beside it."""
    return path.parent / f"{path.stem}.json"


def _restored(source: Path) -> dict[str, Any]:
    """Return the description of restored video (`quiver restore`), which states its rates; else an empty one."""
    beside = _description(source)
    found = files.read_json(beside) if source.suffix == ".npy" and beside.is_file() else {}
    return found if describes_restored(found) else {}


def _size(made: Clip | Stream) -> str:
    frames, height, width = made.shape
    rate = made.info.frame_rate
    exposure = made.exposure
    said = f"{frames} frames of {height} x {width} pixels at {rate:g} per second, exposure {exposure * 1e6:.4g} us"
    times = made.info.times
    if times is None:
        return said
    return f"{said}, times {times.values[0]:.10g} to {times.values[-1]:.10g} {times.unit} ({times.source})"


def _flat_name(file: Path, folder: Path) -> str:
    """Return `scene/clip.mp4` (or the folder `scene/clip`) below `folder` as `scene_clip`."""
    inside = file.relative_to(folder)
    return "_".join((inside if file.is_dir() else inside.with_suffix("")).parts).replace(" ", "_")
