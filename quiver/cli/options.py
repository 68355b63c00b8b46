"""Shares options between the commands, and handles folders to replace and signals."""

from __future__ import annotations

import argparse
import contextlib
import shutil
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from qsim.cli import console
from qsim.cli.console import note
from qsim.cli.options import count, memory_size, numbers, positive, whole_numbers, words
from qsim.files import check_ours
from quiver.device import DEVICES
from quiver.restoration.interface import AUTO, MODES

LEVELS = 16  # of a range of light in training: from 0.3 to 100 photons they are a factor 1.47 apart
PROTOCOLS = ("quick", "control", "published", "paper", "spad-sum")  # see quiver/training/settings.py


def add_light(parser: argparse.ArgumentParser, several: bool, default: str = "3.25") -> None:
    """Add --sensor, --ppp and --bits; `several` allows lists of light levels and bits, `default` is that of --ppp."""
    kind, many = (numbers, "; several: 3.25,9.75,26") if several else (positive, "")
    whole = whole_numbers if several else count
    parser.add_argument("--sensor", help="a name of `qsim doctor --devices`, or a .toml file (default quiver-physical)")
    parser.add_argument("--ppp", type=kind, help=f"mean photons per pixel and exposure (default {default}){many}")
    parser.add_argument("--bits", type=whole, help="bits per code (default 3; of a .toml file its own)")


def add_preset(parser: argparse.ArgumentParser, default: str, known: Sequence[str]) -> None:
    """Add --preset."""
    parser.add_argument("--preset", default=default, choices=known, help=f"network (default {default})")


def light_levels(text: str) -> tuple[float, ...]:
    """Return light levels [photons] of a list, in which LOW..HIGH stands for LEVELS of them at equal ratios.

    Levels, not a continuum: the sensor follows the light, and each one has a table of its law.
    """
    import numpy as np

    found: list[float] = []
    for part in text.split(","):
        ends = numbers(part.replace("..", ","))
        if ".." in part and not (len(ends) == 2 and ends[0] < ends[1]):
            raise argparse.ArgumentTypeError(f"expected LOW..HIGH with LOW below HIGH, got {part!r}")
        found += [float(f"{level:.3g}") for level in np.geomspace(ends[0], ends[1], LEVELS)] if ".." in part else ends
    return tuple(found)


def add_noise(parser: argparse.ArgumentParser) -> None:
    """Add --sensor, --ppp and --bits of training.

    Values that are not given are those of the protocol, if it has any; else those of the streams of the data set.
    """
    parser.add_argument(
        "--sensor",
        type=words,
        help="names of `qsim doctor --devices` or .toml files, comma-separated (default: the protocol's, which "
        "mergenet states, else those of the data set's streams)",
    )
    parser.add_argument(
        "--ppp",
        type=light_levels,
        help=f"mean photons per pixel and exposure; several: 1,10, or {LEVELS} in a range: 0.3..100 (default: the "
        "protocol's, else those of the streams)",
    )
    parser.add_argument(
        "--bits",
        type=whole_numbers,
        help="bits per code; several: 1,3 (default: the protocol's, else those of the streams)",
    )


def add_running(parser: argparse.ArgumentParser, *, resumed: bool = True) -> None:
    """Add the options of how methods run; `resumed` as in `add_threads`."""
    parser.add_argument(
        "--memory",
        type=memory_size,
        help="working memory, as in 500MB (default 2GB; on a GPU half of its memory for networks other than mergenet)",
    )
    parser.add_argument("--mode", choices=MODES, help="networks: how frames share work (default exact)")
    parser.add_argument("--device", choices=DEVICES, help="networks: where they run (default auto)")
    parser.add_argument("--precision", choices=("float32", "bfloat16"), help="networks: precision (default float32)")
    add_threads(parser, resumed=resumed)


def add_threads(parser: argparse.ArgumentParser, *, resumed: bool = True) -> None:
    """Add --threads; `resumed` if the command keeps the number when it resumes its work."""
    kept = "; resumed work keeps its number" if resumed else ""
    parser.add_argument(
        "--threads",
        type=count,
        help=f"torch threads on the CPU (default: measured at start{kept})",
    )


def use_threads(args: argparse.Namespace, earlier: int | None = None) -> int:
    """Set the number of torch's threads, and print it with --verbose."""
    from quiver import threads

    chosen = threads.use(args.threads, earlier)
    if args.verbose:
        note(f"threads: {chosen}")
    return chosen.number


def add_strict(parser: argparse.ArgumentParser) -> None:
    """Add --strict."""
    parser.add_argument("--strict", action="store_true", help="networks: refuse a stream outside their measured domain")


def check_domain(
    args: argparse.Namespace, methods: Sequence[Any], streams: Iterable[Any], shown: int | None = None
) -> list[str]:
    """Print a line for each network outside of what it was measured for; `ValueError` with --strict.

    Of many lines only the first `shown` are printed, and how many follow.
    """
    from quiver.restoration.interface import measured_at, refuse_outside, remarks

    found: list[str] = []
    for codes in streams:
        found += [text for text in remarks(methods, codes) if text not in found]
        if args.strict:
            refuse_outside(methods, found, "--strict", named=getattr(args, "method", None) != AUTO)
        if args.verbose:
            for text in filter(None, (measured_at(method, codes) for method in methods)):
                note(f"quiver: {text}")
    for text in found[:shown]:
        note(f"quiver: warning: {text}")
    if shown is not None and len(found) > shown:
        note(f"quiver: warning: {len(found) - shown} more lines of this kind, for other streams")
    return found


def running_options(args: argparse.Namespace) -> Any:
    """Return the options of `add_running` as `RestoreOptions`."""
    from quiver.restoration.interface import RestoreOptions

    return RestoreOptions(args.memory, args.mode or "exact", args.device or "auto", args.precision or "float32")


def renew(folder: Path, mark: str, ours: str) -> None:
    """Empty a folder whose lock the caller holds; the lock stays, and the file `mark`, by which it is known, goes last.

    `FileExistsError` if it holds files whose names do not match the pattern `ours`.
    """
    check_ours(folder, ours)
    for path in sorted(folder.iterdir(), key=lambda path: path.name == mark):
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != "lock":
            path.unlink()


def command(
    sub: Any, name: str, action: Any, what: str, example: str, *, resumes: bool = False
) -> argparse.ArgumentParser:
    """Return a command's parser from `qsim.cli.console.command`."""
    return console.command(sub, name, action, what, example, console.RESUMES if resumes else console.STARTS_AGAIN)


@contextlib.contextmanager
def handling(handler: Callable[[int, Any], Any], *numbers: signal.Signals) -> Iterator[None]:
    """Send signals to `handler` inside the block; in other threads than the main one nothing changes."""
    main_thread = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, handler) for number in numbers if main_thread}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
