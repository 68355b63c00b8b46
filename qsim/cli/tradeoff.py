"""Runs `qsim tradeoff`: bit depth against motion, light, read noise and data rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from qsim import files
from qsim.cli.command import Idle, command
from qsim.cli.completion import families, sensors
from qsim.cli.console import MAKES_AGAIN, PILOT, RESUMES, bar, note, output, refuse_existing, running
from qsim.cli.options import check_free
from qsim.files import Progress
from qsim.kinds import Bits, Frames, NotNegative, Number, Positive, Seed, Whole
from qsim.sensor.colour_filter import MASKS
from qsim.settings import setting
from qsim.time_forecast import TimeForecast
from qsim.words import frame_size, steps

_SENSORS = "a name of `qsim doctor --devices`, or a sensor file"


@dataclass(frozen=True)
class Tradeoff:
    """The study, table or figure that `qsim tradeoff` makes."""

    source: Annotated[
        str | None,
        setting("a clip of at least 10000 fps, or a scene (rendered into -o)", positional=True, known=families),
    ] = None
    table: Annotated[bool, setting("print the table of bit depths only, computed without a clip")] = False
    paper_figure: Annotated[Literal[1, 2] | None, setting("draw a figure of the QUIVER paper")] = None
    size: Annotated[
        tuple[int, int] | None,
        setting("ROWSxCOLUMNS", unset="240x320, rendered scenes 96x128", read=frame_size),
    ] = None
    base_fps: Annotated[Positive | None, setting("planes per second", unset="10000; a clip has its own")] = None
    read_noise: Annotated[NotNegative | None, setting("table: e- rms per read", unset="0.2")] = None
    bits: Annotated[
        tuple[Bits, ...] | None,
        setting("comma-separated", unset="1,2,3,4,5, then up to 7 while the deepest is best; table 1,3,5,7,9"),
    ] = None
    motion: Annotated[Number | None, setting("table: image speed, px/s", unset="2500")] = None
    ppp: Annotated[
        list[float] | None,
        setting("photons per pixel and plane: 0.65 or 0.1,1,10 or 0.1:30 (6 steps)", read=steps),
    ] = None
    speed: Annotated[
        list[float] | None,
        setting("factors on the motion, listed as in --ppp", unset="1; of a clip: whole factors", read=steps),
    ] = None
    px: Annotated[
        list[float] | None,
        setting(
            "motion of the pixels that are scored, px per 3-bit frame; sets the speed",
            read=steps,
        ),
    ] = None
    sensor: Annotated[
        str | None,
        setting(
            f"sensor of the multi-bit read: {_SENSORS}",
            unset="quiver-physical",
            known=sensors,
        ),
    ] = None
    plane_sensor: Annotated[
        str | None,
        setting(
            f"sensor of a binary plane: {_SENSORS}",
            unset="a clocked SPAD of the same efficiency",
            known=sensors,
        ),
    ] = None
    temperature: Annotated[
        Number | None, setting("degrees C of sensor files with dark_doubling", unset="the file's own")
    ] = None
    colour: Annotated[
        str | None, setting("what pixels of a colour clip see: the mask of its filters", choices=tuple(MASKS))
    ] = None
    instants: Annotated[Whole | None, setting("frames drawn and scored per depth", unset="8")] = None
    frames: Annotated[Frames | None, setting("frames of a rendered scene", unset="enough for the instants")] = None
    seed: Annotated[Seed | None, setting("seed of the noise and of a rendered scene", unset="0")] = None
    streams: Annotated[bool, setting("write clips and streams of each depth, for restorers")] = False
    output: Annotated[Path | None, setting("folder for numbers, figures, clips", short="o")] = None
    force: Annotated[bool, setting("replace existing numbers, figures and streams")] = False

    @property
    def of_clip(self) -> bool:
        """Whether a stored clip is studied, not a scene."""
        return self.source is not None and (Path(self.source) / "clip.json").is_file()

    @property
    def named(self) -> str:
        """The clip or scene."""
        assert self.source is not None  # checked by the command
        return self.source

    @property
    def draws(self) -> int:
        """The seed."""
        return self.seed or 0

    @property
    def folder(self) -> Path:
        """The folder of results; a study without one renders nothing."""
        assert self.output is not None
        return self.output


OF_STUDIES = (
    *("px", "ppp", "bits", "base_fps", "sensor", "plane_sensor", "temperature", "colour", "instants", "frames"),
    "streams",
)
PICTURES = {"tradeoff": ("best.png", "tradeoff.png")}  # of a study: which of them depends on its size
OF_FILES = ("seed", "speed", "output", "force")
_OF_TABLE = (
    "paper_figure",
    *(name for name in OF_STUDIES if name not in ("bits", "base_fps")),
    *OF_FILES,
    "threads",
)


def _without_output(asked: Tradeoff) -> str:
    return "" if asked.output or asked.streams or asked.paper_figure else "replaces files of --output"


IDLE = (
    Idle(lambda asked: "changes nothing in `tradeoff --table`" if asked.table else "", _OF_TABLE),
    Idle(lambda asked: "sets the speed of the motion, and so does --speed" if asked.speed else "", ("px",)),
    Idle(
        lambda asked: "changes nothing in `tradeoff --paper-figure`" if asked.paper_figure else "",
        ("motion", "read_noise", *OF_STUDIES),
    ),
    Idle(
        lambda asked: (
            ""
            if asked.table
            else "is of --table; a clip or scene is seen by a sensor, so state it in a sensor file (read_noise in "
            "[sensor]) and give that with --sensor"
        ),
        ("read_noise",),
    ),
    Idle(lambda asked: "" if asked.table else "changes nothing in `tradeoff` of a clip or scene", ("motion",)),
    Idle(
        lambda asked: "changes nothing in `tradeoff` of a clip" if asked.of_clip else "", ("size", "base_fps", "frames")
    ),
    Idle(
        lambda asked: (
            "changes nothing in `tradeoff --paper-figure` of a clip" if asked.of_clip and asked.paper_figure else ""
        ),
        ("speed",),
    ),
    Idle(_without_output, ("force",)),
)


@command(
    "qsim tradeoff --table --size 240x320 --base-fps 10000 --read-noise 0.2 --bits 1,3,5,7,9",
    "qsim tradeoff out/fast --ppp 0.65 -o out/bits",
    "qsim tradeoff fan --px 3 --ppp 2 -o out/fan_3px",
    "qsim tradeoff fan --speed 0.5:8 --ppp 0.1:30 -o out/sweep",
    "qsim tradeoff --paper-figure 1 -o out/figure1",
    after_interrupt=RESUMES,
    threads="threads of the compiled engine (Dr.Jit)",
    idle=IDLE,
)
def tradeoff(asked: Tradeoff) -> int:
    """Print the table, or make the study or the figure."""
    if asked.table:
        if asked.source is not None:
            raise ValueError(f"{asked.source}: --table is computed without a clip; leave the clip or scene out")
        return _tradeoff_table(asked)
    name = "tradeoff" if asked.paper_figure is None else f"figure{asked.paper_figure}"
    if asked.paper_figure is None and asked.source is None:
        raise ValueError("give a clip or a scene, --table, or --paper-figure; see qsim tradeoff --help")
    if asked.output is None:
        if asked.streams or asked.paper_figure:
            option = "--streams" if asked.streams else "--paper-figure"
            raise ValueError(f"{option}: writes files; give a folder with -o, as in -o out/bits")
    else:
        check_free(asked.output)
        for written in (f"{name}.json", *PICTURES.get(name, (f"{name}.png",))):
            refuse_existing(asked.output / written, asked.force)
    return _tradeoff_study(asked) if asked.paper_figure is None else _paper_figure(asked)


def _tradeoff_study(asked: Tradeoff) -> int:
    from qsim.clip.motion_statistics import SLOWEST
    from qsim.studies.bit_depth import clips as study_clips
    from qsim.studies.bit_depth.answer import WIDEST
    from qsim.studies.bit_depth.readout import StudySettings

    bits = tuple(asked.bits or (1, 2, 3, 4, 5))
    instants = 8 if asked.instants is None else asked.instants
    sensor = asked.sensor or "quiver-physical"
    settings = StudySettings(
        bits,
        sensor,
        asked.plane_sensor,
        instants=instants,
        seed=asked.draws,
        moving=bool(asked.px),
        temperature=asked.temperature,
        colour=asked.colour,
    )
    _check_colour(asked)
    study_clips.check_sensors(settings, asked.streams)  # before anything is rendered
    height, width = asked.size or (96, 128)
    widen = asked.bits is None
    frames = asked.frames or (2**WIDEST - 1 if widen else max(4 * settings.longest, 32))
    rate = 10_000.0 if asked.base_fps is None else asked.base_fps
    if not (Path(asked.named) / "clip.json").is_file():  # refused before anything is rendered
        if rate < SLOWEST:
            raise ValueError(f"--base-fps {rate:g}: this study needs at least {SLOWEST:g} planes per second")
        if frames < settings.longest:
            raise ValueError(f"--frames {frames}: {max(bits)} bits need {settings.longest}; give more, or fewer bits")
    shape = study_clips.ClipShape(frames, height, width, rate, seed=asked.draws)
    speeds = _speeds(asked, shape)
    levels: list[float | None] = [*asked.ppp] if asked.ppp else [None]
    swept = len(speeds) * len(levels) > 1
    if asked.streams and swept:
        raise ValueError("--streams: writes one speed and one light level; give one --ppp and one --speed or --px")
    missing = study_clips.to_render(asked.named, speeds, asked.output)
    rendering = TimeForecast(f"rendering {_clips(missing)} of {shape.frames} frames", note, unit="frame", parts=missing)
    with bar("rendering", first=PILOT if missing else "") as shown:
        progress = _both(shown, rendering)
        clips = list(study_clips.clips_for(asked.named, speeds, shape, asked.output, progress))
    first = clips[0].clip
    _check_rendered(asked, first, clips[0].step, [*range(1, WIDEST + 1)] if widen else settings.bits)
    with bar("drawing", "study" if swept else "frame") as shown:
        if swept:
            done = _sweep(clips, asked.ppp or [first.mean_photons], settings, widen, shown)
        else:
            done = _single(first, replace(settings, ppp=levels[0], speed=clips[0].step), widen, shown)
    result = done.result
    text = done.text
    if asked.px:
        result["px_asked"] = asked.px
        result["speeds_found"] = speeds
        text = [f"--px {px:g}: speed factor {speed:g}" for px, speed in zip(asked.px, speeds, strict=True)] + text
    if asked.streams:
        running().after_interrupt = MAKES_AGAIN
        lit = replace(settings, ppp=levels[0], bits=done.bits)
        made = study_clips.write_streams(first, asked.folder / "streams", lit, force=asked.force)
        result["streams"] = [str(path) for path in made]
        text += [f"streams 'planes' and 'multibit': {path}" for path in made]
    if asked.output is not None:
        text += _write_study(asked.folder, "tradeoff.json", result, done.pictures)
    output(result, text + done.answers)
    return 0


def _check_colour(asked: Tradeoff) -> None:
    """Raise `ValueError` for a mask where no colour clip is studied."""
    if asked.colour is None:
        return
    if not asked.of_clip:
        raise ValueError("--colour: is of a colour clip; render the scene with `qsim render --bands rgb`, and name it")
    if asked.streams:
        raise ValueError("--streams: writes streams of one band; leave it out with --colour")


@dataclass
class _Done:
    """What a study found: numbers, pictures by name, lines of its table, and its answers."""

    result: dict[str, object]
    pictures: dict[str, Any]
    text: list[str]
    answers: list[str]
    bits: tuple[int, ...]


def _check_rendered(asked: Tradeoff, first: Any, step: int, depths: Sequence[int]) -> None:
    """Raise `ValueError` or `FileExistsError` for what a clip shows to be impossible, before the study."""
    from qsim.studies.bit_depth import clips as study_clips

    if asked.streams and step > 1:
        raise ValueError("--streams: writes a clip at its own speed; leave out --speed and --px, or name a scene")
    if first.camera is None and not asked.ppp:
        raise ValueError(f"{first.path}: its radiance is relative; give the light with --ppp, as in --ppp 0.65")
    if asked.streams:
        for depth in depths:
            study_clips.stream_clip(first, asked.folder / "streams", depth, asked.force)


def _sweep(clips: list[Any], ppps: list[float], settings: Any, widen: bool, shown: Progress) -> _Done:
    """Study every speed at every light level."""
    from qsim.studies.bit_depth import figures, speed_sweep

    drawing = TimeForecast(f"drawing {len(clips) * len(ppps)} studies", note, unit="study")
    found = speed_sweep.sweep(clips, ppps, settings, widen=widen, progress=_both(shown, drawing))
    text = [line for row in found.studies for one in row for line in speed_sweep.table(one)]
    text.append(speed_sweep.summary(found))
    return _Done(found.to_dict(), {"best.png": figures.sweep_figure(found)}, text, found.answers, settings.bits)


def _single(first: Any, settings: Any, widen: bool, shown: Progress) -> _Done:
    """Study one clip at one light level."""
    from qsim.studies.bit_depth import figures, speed_sweep
    from qsim.studies.bit_depth.answer import answer, widened
    from qsim.studies.bit_depth.clip_study import study

    progress = _both(shown, TimeForecast("drawing the study", note, unit="frame"))
    one = widened(first, settings, note) if widen else study(first, settings, progress=progress)
    pictures = {"tradeoff.png": figures.study_figure(one)}
    return _Done(speed_sweep.study_dict(one), pictures, speed_sweep.table(one), [answer(one)], one.bits)


def _clips(count: int) -> str:
    return f"{count} clip{'' if count == 1 else 's'}"


def _both(one: Progress, other: Progress) -> Progress:
    """Return a progress that tells both."""

    def told(done: int, total: int) -> None:
        one(done, total)
        other(done, total)

    return told


def _speeds(asked: Tradeoff, shape: Any) -> list[float]:
    """Return the factors on the motion, found from --px or given."""
    from functools import partial

    from qsim import scenes
    from qsim.streams.clip import Clip
    from qsim.studies.bit_depth import answer as tradeoff_answer

    if not asked.px:
        return asked.speed or [1.0]
    found: list[tuple[float, float]] = []
    if (Path(asked.named) / "clip.json").is_file():
        clip = Clip.open(asked.named)
        found = [tradeoff_answer.step_for(px, clip) for px in asked.px]
    elif asked.named in scenes.FAMILIES or asked.named.endswith(".py"):
        motion = partial(_motion, asked.named, shape)
        found = [tradeoff_answer.speed_for(px, motion, asked.named) for px in asked.px]
    if len({speed for speed, _ in found}) < len(found):
        raise ValueError(f"{asked.named}: several of --px {asked.px} need one and the same speed; give fewer")
    return [speed for speed, _ in found] or [1.0]  # 1: `clips_for` refuses what is neither a clip nor a scene


def _motion(name: str, shape: Any, speed: float) -> float:
    from qsim.studies.bit_depth.answer import scene_motion

    size = (shape.height, shape.width)
    rate = shape.frame_rate
    return scene_motion(name, size, frames=shape.frames, frame_rate=rate, seed=shape.seed, speed=speed)


def _write_study(folder: Path, name: str, result: Mapping[str, object], pictures: dict[str, bytes]) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    for picture, content in pictures.items():
        files.write_bytes(folder / picture, content)
    files.write_json(folder / name, result)
    return ["written: " + ", ".join(str(folder / written) for written in [*pictures, name])]


def _paper_figure(asked: Tradeoff) -> int:
    from qsim.streams.clip import Clip
    from qsim.studies.bit_depth import clips as study_clips
    from qsim.studies.bit_depth import paper_figures

    height, width = asked.size or (96, 128)
    number = asked.paper_figure
    speeds = asked.speed or [1.0]
    if len(speeds) > 1:
        raise ValueError(f"--speed {asked.speed}: --paper-figure draws one speed; give one")
    rate = paper_figures.RATE_1 if number == 1 else 10_000.0
    frames = 201 if number == 1 else 511
    shape = study_clips.ClipShape(frames, height, width, rate, seed=asked.draws)
    names = ["fan"] if number == 1 else ["fan", "text"]
    if asked.source:
        names = [asked.source]
    rows = []
    result = []
    for name, ppp in zip(names * (2 // len(names) if number == 2 else 1), (0.51, 0.40), strict=False):
        if (Path(name) / "clip.json").is_file():
            clip = Clip.open(name)
        else:
            with bar(name) as progress:
                path = asked.folder / "clips" / Path(name).stem
                clip = study_clips.render(name, path, shape, speed=speeds[0], progress=progress)
        panels = (
            paper_figures.figure_1(clip, seed=asked.draws)
            if number == 1
            else (paper_figures.figure_2(clip, ppp, seed=asked.draws))
        )
        rows.append(panels)
        result.append({"clip": clip.name, "panels": [{"label": p.label, **p.numbers} for p in panels]})
    found = {"figure": number, "rows": result}
    text = [f"{row['clip']}: {panel}" for row in result for panel in row["panels"]]
    text += _write_study(asked.folder, f"figure{number}.json", found, {f"figure{number}.png": paper_figures.draw(rows)})
    output(found, text)
    return 0


def _tradeoff_table(asked: Tradeoff) -> int:
    from qsim.studies.bit_depth.laws import depths

    height, width = asked.size or (240, 320)
    rate = 10_000.0 if asked.base_fps is None else asked.base_fps
    noise = 0.2 if asked.read_noise is None else asked.read_noise
    speed = 2500.0 if asked.motion is None else asked.motion
    rows = depths(
        height=height,
        width=width,
        base_fps=rate,
        read_noise=noise,
        bits=asked.bits or [1, 3, 5, 7, 9],
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
    output({"rows": [asdict(r) for r in rows]}, text)
    return 0
