"""Runs `qsim preview` (a picture, a film, the terminal), `qsim report` and `qsim explore` (pages)."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from qsim import files
from qsim.cli.console import bar, command, output, refuse_existing, refuse_idle
from qsim.clip.manifest import check_outside
from qsim.terminal import is_lost, printable

PREVIEWS = (".mp4", ".gif", ".png")
FASTEST_GIF = 50  # frames per second; viewers slow down faster ones


def add_preview(sub: Any) -> None:
    """Add the command `preview` to a program."""
    parser = command(
        sub,
        "preview",
        _run_preview,
        "Show a clip, stream or array: in the terminal, as film or picture.",
        "qsim preview out/fan\n"
        "qsim preview out/fan --what flow --frame 3\n"
        "qsim preview out/fan -o out/fan.mp4 --fps 25\n"
        "qsim preview out/fan.npy -o out/fan.png --frame 10",
    )
    parser.add_argument("path", type=Path, help="clip folder, stream (.npy or .json), or array [T, H, W] (.npy)")
    parser.add_argument(
        "-o", "--output", type=Path, help=".mp4, .gif or .png to write (default: show it in the terminal)"
    )
    parser.add_argument("--what", type=_kinds, help="views, comma-separated: sharp,radiance,codes,average,flow,depth")
    parser.add_argument("--stream", help="stream of a clip to show (default: the first)")
    parser.add_argument("--frame", type=int, help="frame to show (default: the middle one; a film: all)")
    parser.add_argument("--fps", type=float, help="frames of a film shown per second (default 12)")
    parser.add_argument("--scale", type=int, help="enlargement, a whole factor (default: so that captions fit)")
    parser.add_argument("--bits", type=int, help="a bare array holds codes of this many bits")
    parser.add_argument("--width", type=int, help="a bare array holds packed binary planes of this many columns")
    parser.add_argument("--play", action="store_true", help="play all frames in the terminal")
    parser.add_argument("--force", action="store_true", help="replace an existing file")


def _kinds(text: str) -> list[str]:
    from qsim.report.views import KINDS

    kinds = [word.strip() for word in text.split(",")]
    for kind in kinds:
        if kind not in (*KINDS, "values"):
            raise argparse.ArgumentTypeError(f"unknown picture {kind!r}; there are: {', '.join(KINDS)}")
    return kinds


def _run_preview(args: argparse.Namespace) -> int:
    from qsim.report import preview
    from qsim.report.views import choose, declaration, open_source

    target: Path | None = args.output
    if target is not None:
        if target.suffix not in PREVIEWS:
            raise ValueError(f"{target}: a preview is a {', '.join(PREVIEWS)} file, as in -o {target.stem}.mp4")
        if target.suffix == ".gif" and (args.fps or 0) > FASTEST_GIF:
            raise ValueError(
                f"--fps {args.fps:g}: a GIF plays at most {FASTEST_GIF} frames per second; write {target.stem}.mp4, "
                f"or give --fps {FASTEST_GIF} or less"
            )
        check_outside(target)
        refuse_existing(target, args.force)
        refuse_existing(preview.sidecar(target), args.force)
    if args.fps is not None and not 0.01 <= args.fps <= 1000:
        raise ValueError(f"--fps: expected frames per second between 0.01 and 1000, got {args.fps:g}")
    if args.scale is not None and not 1 <= args.scale <= 64:
        raise ValueError(f"--scale: expected a whole factor of 1 to 64, got {args.scale}")
    if args.play and target is not None:
        raise ValueError("--play: shows frames in the terminal; leave it out with --output, which writes all of them")
    if target is None:
        refuse_idle(args, "preview in the terminal", ["force", "scale"])
    if args.fps is not None and (not args.play if target is None else target.suffix == ".png"):
        raise ValueError("--fps: one picture has no rate; leave it out, write a film (.mp4, .gif), or use --play")
    if args.frame is not None and (args.play or args.fps is not None):
        raise ValueError("--frame: shows one frame; leave out --play and --fps, or leave it out for a film of all")
    args.fps = 12.0 if args.fps is None else args.fps
    source = open_source(args.path, bits=args.bits, width=args.width, stream=args.stream)
    if args.frame is not None and not 0 <= args.frame < source.length:
        raise ValueError(f"--frame {args.frame}: {source.name} has frames 0..{source.length - 1}")
    views = choose(source, args.what, several=target is not None)
    if args.stream is not None and not any(view.kind in ("codes", "average") for view in views):
        raise ValueError(f"--stream {args.stream}: no picture of codes is shown; add --what codes, or leave it out")
    film = args.frame is None and (args.play if target is None else target.suffix != ".png")
    first = source.length // 2 if args.frame is None else args.frame
    frames = range(source.length) if film else range(first, first + 1)
    if target is None:
        return _show(args, source, views, frames)
    shown = f"{frames.start}..{frames.stop - 1}" if film else str(first)
    about = {"source": str(args.path), "frames": [frames.start, frames.stop], "frame_rate": source.frame_rate}
    target.parent.mkdir(parents=True, exist_ok=True)
    with bar(target.name) as progress:
        page = preview.sheet(views, args.scale)
        preview.write(target, page, frames, args.fps, about | {"shown_fps": args.fps}, progress)
    lines = [f"{target}: frame {shown} of {source.name}" + (f" at {args.fps:g} fps" if film else "")]
    found = about | {"preview": str(target), "views": [declaration(view) for view in views]}
    output(args, found, lines + [view.declared for view in views])
    return 0


def _show(args: argparse.Namespace, source: Any, views: list[Any], frames: range) -> int:
    """Print pictures: in colour on a terminal (unless NO_COLOR is set), else as text."""
    from qsim.report import preview
    from qsim.report.views import declaration

    found = {"source": str(args.path), "frames": [frames.start, frames.stop]}
    if args.json:
        output(args, found | {"views": [declaration(view) for view in views]}, "")
        return 0
    coloured = sys.stdout.isatty() and not os.environ.get("NO_COLOR")
    window = shutil.get_terminal_size()
    draw = preview.half_blocks if coloured else preview.shades
    for view in views:
        for t in frames:
            text = draw(preview.fit_terminal(view.picture(t), window.columns, max(window.lines - 4, 8)))
            print(text, flush=True)
            if is_lost(sys.stdout):
                return 0
            if t + 1 < frames.stop:
                time.sleep(1 / args.fps)
                print(preview.cursor_up(text) if coloured else "")
        if view.legend is not None:
            print(draw(preview.fit_terminal(view.legend, 24, 12)))
        stretched = "" if coloured else ", contrast stretched"
        print(printable(f"frame {frames[-1]} of {source.name}, {view.declared}{stretched}"))
    return 0


def add_report(sub: Any) -> None:
    """Add the command `report` to a program."""
    parser = command(
        sub,
        "report",
        _run_report,
        "Write one self-contained page of clips, data sets, runs, restored video, scores.",
        "qsim report out/fan\nqsim report out/fan out/fan.npy -o fan.html\n"
        "qsim report out/demo -o out/demo/index.html --title 'My run'",
    )
    kinds = "clips, data sets, training runs, restored video, evaluations, or folders of some"
    parser.add_argument("paths", type=Path, nargs="+", metavar="PATH", help=kinds)
    parser.add_argument(
        "-o", "--output", type=Path, help=".html file to write (default: NAME.html here; report.html for several paths)"
    )
    parser.add_argument("--title", help="title of the page")
    parser.add_argument("--note", action="append", default=[], help="a line for the top of the page; may be repeated")
    parser.add_argument("--force", action="store_true", help="replace an existing page")


def _run_report(args: argparse.Namespace) -> int:
    from qsim.report import report

    only = _name_of(args.paths[0]) if len(args.paths) == 1 else ""
    target = _page_target(args, f"{only or 'report'}.html")
    with bar("drawing", "thing") as progress:
        page = report.build_page(*args.paths, title=args.title, notes=args.note, progress=progress)
    return _write_page(args, target, page)


def add_explore(sub: Any) -> None:
    """Add the command `explore` to a program."""
    parser = command(
        sub,
        "explore",
        _run_explore,
        "Write a page on which sliders set light and sensor, and the codes of a clip are drawn live in the browser.",
        "qsim explore out/fan\nqsim explore out/fan -o out/fan_explore.html",
    )
    parser.add_argument("path", type=Path, metavar="CLIP", help="clip folder")
    parser.add_argument("-o", "--output", type=Path, help=".html file to write (default: NAME_explore.html here)")
    parser.add_argument("--force", action="store_true", help="replace an existing page")


def _run_explore(args: argparse.Namespace) -> int:
    from qsim.report.explore import explore_page
    from qsim.streams.clip import Clip

    if (args.path / "dataset.json").is_file():
        raise ValueError(f"{args.path}: is a data set; name one of its clips, as in {args.path / 'clips'}/NAME")
    target = _page_target(args, f"{_name_of(args.path)}_explore.html")
    return _write_page(args, target, explore_page(Clip.open(args.path)))


def _name_of(path: Path) -> str:
    """Return the name of a folder, which may hold dots, or of a file without its ending."""
    path = path.resolve()
    return path.name if path.is_dir() else path.stem


def _page_target(args: argparse.Namespace, default: str) -> Path:
    target: Path = args.output or Path(default)
    if target.suffix not in (".html", ".htm"):
        raise ValueError(f"{target}: a page is a .html file, as in -o {target.stem}.html")
    refuse_existing(target, args.force)
    return target


def _write_page(args: argparse.Namespace, target: Path, page: str) -> int:
    content = page.encode()
    target.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(target, content)
    found = {"page": str(target), "bytes": len(content)}
    output(args, found, f"{target}: {len(content) / 1e6:.1f} MB, self-contained; open it in a browser")
    return 0
