"""Runs `quiver`: its commands, each a typed function in a module that is imported when the command is used."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import shorten

from qsim.cli.command import Command
from qsim.cli.console import run, running
from qsim.cli.usage import Program
from qsim.files import VERSION


@contextlib.contextmanager
def _within_memory(command: Command) -> Iterator[None]:
    """Say in one sentence that memory is exhausted, about which torch raises a `RuntimeError`."""
    from quiver.device import out_of_memory

    try:
        yield
    except RuntimeError as error:
        if not out_of_memory(error):
            raise
        names = {setting.name for setting in command.settings}
        option = next((name for name in ("batch", "memory") if name in names), "size")
        target = running().target
        kept = target is not None and Path(f"{target.resolve()}.part.json").exists()
        more = ", which may start again; or free some, and the same command resumes" if kept else ""
        raise ValueError(
            f"memory is exhausted ({shorten(str(error), 100)}); give a smaller --{option}{more}"
        ) from error


PROGRAM = Program(
    "quiver",
    "Restore blur-free video from few-bit quanta streams; train and compare.",
    VERSION,
    {
        "train": (
            "quiver.cli.train:train",
            "Train a network on the clips of a data set; rerun the same command to resume.",
        ),
        "restore": (
            "quiver.cli.restore:restore",
            "Restore a stream, a clip or a photon cube; no ground truth is needed.",
        ),
        "evaluate": (
            "quiver.cli.evaluate:evaluate",
            "Compare methods on held-out clips, or on real photons of a static object.",
        ),
        "domain": (
            "quiver.cli.domain:domain",
            "Measure where weights are better than the classical methods and store it in their file, or show it.",
        ),
        "ablate": (
            "quiver.cli.train:ablate",
            "Train the network in six versions, without some of its parts, and compare them.",
        ),
        "bench": ("quiver.cli.evaluate:bench", "Measure what a restored frame costs, beside its PSNR."),
        "convert-weights": (
            "quiver.cli.convert_weights:convert",
            "Turn a checkpoint of the published network into ours.",
        ),
        "completion": (
            "quiver.cli.completion:completion",
            "Print a script that completes commands and options in your shell.",
        ),
    },
    guard=_within_memory,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line and return the exit code."""
    from quiver.threads import wait_without_spinning

    wait_without_spinning()
    return run(PROGRAM, argv)
