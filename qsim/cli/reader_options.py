"""Declares once the options that say what a foreign file does not state, for every command that reads one.

    add_reader_options(parser, NAMES) -> --width ...        hints_of(args, NAMES) -> Hints(width=...)

Each name is a field of `qsim.formats.recording.Hints`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import Any

from qsim import checks
from qsim.cli.options import checked, count, nonnegative, positive
from qsim.formats import detection
from qsim.formats.raw_layout import ENDIANS, ORDERS
from qsim.formats.recording import TRANSFERS, Hints

# Where the values of a file lie: for frames of light and for codes.
LAYOUT = (
    "layout",
    "height",
    "width",
    "order",
    "endian",
    "skip_bytes",
    "row_padding",
    "axes",
    "channel",
    "slice",
    "dataset",
    "variable",
)

OPTIONS: dict[str, dict[str, Any]] = {
    "layout": {"help": f"kind of the input: {', '.join(detection.LAYOUTS)}"},
    "transfer": {"help": f"how pictures code light: {', '.join(TRANSFERS)} (also for writing)"},
    "height": {"type": count, "help": "pixels"},
    "width": {"type": count, "help": "pixels per row, before packing"},
    "bits": {"type": checked(checks.bits), "help": "the input holds codes of this many bits"},
    "stretched": {"action": "store_true", "help": "codes were stretched to 0..255"},
    "order": {"choices": ORDERS, "help": "raw: pixels are packed to bits, and this bit of a byte comes first"},
    "endian": {"choices": ENDIANS, "help": "raw: pixels fill whole bytes, and this byte comes first"},
    "skip_bytes": {"type": nonnegative, "metavar": "N", "help": "raw: bytes before the first frame of a file"},
    "row_padding": {
        "type": nonnegative,
        "metavar": "N",
        "help": "raw: rows begin at a byte, and N bytes follow each (default: rows follow bit by bit)",
    },
    "axes": {"help": "names of the axes of an array, an HDF5 dataset or a TIFF, as in TCYX or YXT"},
    "channel": {"type": nonnegative, "metavar": "N", "help": "index of an axis C to read, from 0"},
    "slice": {"type": nonnegative, "metavar": "N", "help": "index of an axis Z to read, from 0"},
    "dataset": {
        "metavar": "PATH",
        "help": "HDF5: path of the array in the file, as in entry/data (default: the only one)",
    },
    "variable": {"help": "array of a .mat file (default: OUTPUT, or the only one)"},
    "flip": {
        "choices": ("none", "lr", "ud", "both"),
        "default": "none",
        "help": "mirror the frames: left-right, up-down or both",
    },
    "columns": {"type": count, "help": "keep only the first columns (Vidar dumps: 400 of 416)"},
    "white": {
        "type": positive,
        "help": "reading: pixel value at which the camera saturates, as in 4095 (default: the largest that whole "
        "numbers hold); writing pictures: light that becomes full scale (default: the 99.9th percentile)",
    },
    "black": {"type": positive, "help": "pixel value without light, as in 64, which is subtracted (default: 0)"},
    "keep_gaps": {
        "action": "store_true",
        "help": "store lost frames, which numbers or time stamps show, as frames without valid pixels (light)",
    },
}


def add_reader_options(parser: Any, names: Iterable[str], /, **helps: str) -> None:
    """Add the options of these names to a parser or group; `helps` replaces texts of a command with its own meaning."""
    for name in names:
        settings = OPTIONS[name] | ({"help": helps[name]} if name in helps else {})
        parser.add_argument(f"--{name.replace('_', '-')}", **settings)


def hints_of(args: argparse.Namespace, names: Iterable[str] = tuple(OPTIONS)) -> Hints:
    """Return the facts that the options of these names state."""
    return Hints(**{name: getattr(args, name) for name in names})
