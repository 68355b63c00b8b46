"""Runs `qsim preview` (a picture, a film, the terminal), `qsim report` and `qsim explore` (pages)."""

from __future__ import annotations

import os
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from qsim import files
from qsim.cli.command import Idle, command
from qsim.cli.console import bar, output, refuse_existing, running
from qsim.clip.manifest import check_outside
from qsim.kinds import Bits, Count, Frames, Text
from qsim.plane_sums import PlaneSums
from qsim.settings import setting
from qsim.terminal import is_lost, printable

PREVIEWS = (".mp4", ".gif", ".png")
FASTEST_GIF = 50  # frames per second; viewers slow down faster ones
SHOWN_RATE = 12.0  # frames per second

ShownRate = Annotated[float, Meta(ge=0.01, le=1000.0)]  # 1/s
Scale = Annotated[int, Meta(ge=1, le=64)]


@dataclass(frozen=True)
class Preview:
    """What `qsim preview` shows, and where."""

    path: Annotated[Path, setting("clip folder, stream (.npy or .json), or array [T, H, W] (.npy)", positional=True)]
    output: Annotated[
        Path | None, setting(".mp4, .gif or .png to write", unset="show it in the terminal", short="o")
    ] = None
    what: Annotated[
        tuple[Literal["sharp", "radiance", "codes", "average", "flow", "depth", "values"], ...] | None,
        setting("views, comma-separated: sharp,radiance,codes,average,flow,depth", shown="WHAT"),
    ] = None
    stream: Annotated[Text | None, setting("stream of a clip to show", unset="the first")] = None
    frame: Annotated[Count | None, setting("frame to show", unset="the middle one; a film: all")] = None
    fps: Annotated[ShownRate | None, setting("frames of a film shown per second", unset="12")] = None
    scale: Annotated[Scale | None, setting("enlargement, a whole factor", unset="so that captions fit")] = None
    bits: Annotated[Bits | None, setting("a bare array holds codes of this many bits")] = None
    width: Annotated[Frames | None, setting("a bare array holds packed binary planes of this many columns")] = None
    play: Annotated[bool, setting("play all frames in the terminal")] = False
    force: Annotated[bool, setting("replace an existing file")] = False

    @property
    def film(self) -> bool:
        """Whether all frames are shown or written."""
        return self.play if self.output is None else self.output.suffix != ".png"


IDLE = (
    Idle(
        lambda asked, _: (
            "" if asked.output is None else "shows frames in the terminal, and --output writes all of them"
        ),
        ("play",),
    ),
    Idle(
        lambda asked, _: "" if asked.output else "acts on a file, and the terminal shows this preview",
        ("force", "scale"),
    ),
    Idle(
        lambda asked, _: "" if asked.film else "one picture has no rate; write a film (.mp4, .gif), use --play",
        ("fps",),
    ),
    Idle(
        lambda asked, _: "shows one frame, and --play and --fps a film of all" if asked.play or asked.fps else "",
        ("frame",),
    ),
)


@command(
    "qsim preview out/fan",
    "qsim preview out/fan --what flow --frame 3",
    "qsim preview out/fan -o out/fan.mp4 --fps 25",
    "qsim preview out/fan.npy -o out/fan.png --frame 10",
    "qsim preview cube.npy --width 320 --planes 7 --from 1000 -o cube.mp4",
    idle=IDLE,
)
def preview(asked: Preview, sums: PlaneSums) -> int:
    """Show pictures in the terminal, or write them as a film or picture."""
    from qsim.report import preview as pictures
    from qsim.report.views import choose, declaration, open_source

    target: Path | None = asked.output
    if target is not None:
        if target.suffix not in PREVIEWS:
            raise ValueError(f"{target}: a preview is a {', '.join(PREVIEWS)} file, as in -o {target.stem}.mp4")
        if target.suffix == ".gif" and (asked.fps or 0) > FASTEST_GIF:
            raise ValueError(
                f"--fps {asked.fps:g}: a GIF plays at most {FASTEST_GIF} frames per second; write {target.stem}.mp4, "
                f"or give --fps {FASTEST_GIF} or less"
            )
        check_outside(target)
        refuse_existing(target, asked.force)
        refuse_existing(pictures.sidecar(target), asked.force)
    rate = asked.fps or SHOWN_RATE
    source = open_source(asked.path, bits=asked.bits, width=asked.width, stream=asked.stream, sums=sums)
    if asked.frame is not None and not 0 <= asked.frame < source.length:
        raise ValueError(f"--frame {asked.frame}: {source.name} has frames 0..{source.length - 1}")
    views = choose(source, list(asked.what) if asked.what else None, several=target is not None)
    if asked.stream is not None and not any(view.kind in ("codes", "average") for view in views):
        raise ValueError(f"--stream {asked.stream}: no picture of codes is shown; add --what codes, or leave it out")
    film = asked.frame is None and (asked.play if target is None else target.suffix != ".png")
    first = source.length // 2 if asked.frame is None else asked.frame
    frames = range(source.length) if film else range(first, first + 1)
    if target is None:
        return _show(asked, source, views, frames)
    shown = f"{frames.start}..{frames.stop - 1}" if film else str(first)
    about = {
        "source": str(asked.path),
        "frames": [frames.start, frames.stop],
        "frame_rate": source.frame_rate,
        "rates": source.rates,
    }
    target.parent.mkdir(parents=True, exist_ok=True)
    with bar(target.name) as progress:
        page = pictures.sheet(views, asked.scale)
        pictures.write(target, page, frames, rate, about | {"shown_fps": rate}, progress)
    rates = f", {source.rates}" if source.rates else ""
    lines = [f"{target}: frame {shown} of {source.name}" + (f" at {rate:g} fps" if film else "") + rates]
    found = about | {"preview": str(target), "views": [declaration(view) for view in views]}
    output(found, lines + [view.declared for view in views])
    return 0


def _show(asked: Preview, source: Any, views: list[Any], frames: range) -> int:
    """Print pictures: in colour on a terminal (unless NO_COLOR is set), else as text."""
    from qsim.report import preview as pictures
    from qsim.report.views import declaration

    found = {"source": str(asked.path), "frames": [frames.start, frames.stop]}
    if running().printing.json:
        output(found | {"views": [declaration(view) for view in views]}, "")
        return 0
    coloured = sys.stdout.isatty() and not os.environ.get("NO_COLOR")
    window = shutil.get_terminal_size()
    draw = pictures.half_blocks if coloured else pictures.shades
    rates = f", {source.rates}" if source.rates else ""
    for view in views:
        for t in frames:
            text = draw(pictures.fit_terminal(view.picture(t), window.columns, max(window.lines - 4, 8)))
            print(text, flush=True)
            if is_lost(sys.stdout):
                return 0
            if t + 1 < frames.stop:
                time.sleep(1 / (asked.fps or SHOWN_RATE))
                print(pictures.cursor_up(text) if coloured else "")
        if view.legend is not None:
            print(draw(pictures.fit_terminal(view.legend, 24, 12)))
        stretched = "" if coloured else ", contrast stretched"
        print(printable(f"frame {frames[-1]} of {source.name}{rates}, {view.declared}{stretched}"))
    return 0


@dataclass(frozen=True)
class Report:
    """What is on a page, and where it is written."""

    paths: Annotated[
        tuple[Path, ...],
        setting(
            "clips, data sets, training runs, restored video, evaluations, or folders of some",
            shown="PATH",
            positional=True,
        ),
    ]
    output: Annotated[
        Path | None, setting(".html file to write", unset="NAME.html here; report.html for several paths", short="o")
    ] = None
    title: Annotated[Text | None, setting("title of the page")] = None
    note: Annotated[
        tuple[Text, ...], setting("a line for the top of the page; may be repeated", several="repeated")
    ] = ()
    force: Annotated[bool, setting("replace an existing page")] = False


@command(
    "qsim report out/fan",
    "qsim report out/fan out/fan.npy -o fan.html",
    "qsim report out/demo -o out/demo/index.html --title 'My run'",
)
def report(asked: Report) -> int:
    """Write the page."""
    from qsim.report.report import build_page

    only = _name_of(asked.paths[0]) if len(asked.paths) == 1 else ""
    target = _page_target(asked, f"{only or 'report'}.html")
    with bar("drawing", "thing") as progress:
        page = build_page(*asked.paths, title=asked.title, notes=list(asked.note), progress=progress)
    return _write_page(target, page)


@dataclass(frozen=True)
class Explore:
    """The clip of a page, and where it is written."""

    path: Annotated[Path, setting("clip folder", shown="CLIP", positional=True)]
    output: Annotated[Path | None, setting(".html file to write", unset="NAME_explore.html here", short="o")] = None
    force: Annotated[bool, setting("replace an existing page")] = False


@command("qsim explore out/fan", "qsim explore out/fan -o out/fan_explore.html")
def explore(asked: Explore) -> int:
    """Write the page."""
    from qsim.report.explore import explore_page
    from qsim.streams.clip import Clip

    if (asked.path / "dataset.json").is_file():
        raise ValueError(f"{asked.path}: is a data set; name one of its clips, as in {asked.path / 'clips'}/NAME")
    target = _page_target(asked, f"{_name_of(asked.path)}_explore.html")
    return _write_page(target, explore_page(Clip.open(asked.path)))


def _name_of(path: Path) -> str:
    """Return the name of a folder, which may hold dots, or of a file without its ending."""
    path = path.resolve()
    return path.name if path.is_dir() else path.stem


def _page_target(asked: Report | Explore, default: str) -> Path:
    target: Path = asked.output or Path(default)
    if target.suffix not in (".html", ".htm"):
        raise ValueError(f"{target}: a page is a .html file, as in -o {target.stem}.html")
    refuse_existing(target, asked.force)
    return target


def _write_page(target: Path, page: str) -> int:
    content = page.encode()
    target.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(target, content)
    found = {"page": str(target), "bytes": len(content)}
    output(found, f"{target}: {len(content) / 1e6:.1f} MB, self-contained; open it in a browser")
    return 0
