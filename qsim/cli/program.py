"""Runs `qsim`: its commands, each a typed function in a module that is imported when the command is used."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from qsim.cli.console import run
from qsim.cli.usage import Program
from qsim.files import VERSION

PROGRAM = Program(
    "qsim",
    "Render moving scenes and turn them into few-bit quanta-sensor streams.",
    VERSION,
    {
        "doctor": (
            "qsim.cli.doctor:doctor",
            "Print the renderer of this machine, those tested, and missing optional packages.",
        ),
        "render": (
            "qsim.cli.render:render",
            "Render a scene into a clip: radiance, sharp frames, flow, depth, body ids.",
        ),
        "sense": ("qsim.cli.sense:sense", "Turn clips into few-bit streams, or draw one frame again and compare."),
        "events": ("qsim.cli.events:events", "Draw what event cameras report of clips: changes of log light."),
        "generate": ("qsim.cli.dataset:generate", "Make a data set from a recipe; finished jobs are kept."),
        "plan": (
            "qsim.cli.dataset:plan",
            "Render one small job of each kind and print the forecast of a recipe's cost.",
        ),
        "check": ("qsim.cli.dataset:check", "Compare files with their checksums; exit code 1 if one is damaged."),
        "publish": (
            "qsim.cli.publish:publish",
            "Write a data set as WebDataset, Parquet, HDF5 or zarr, with a data card; to a folder or s3://.",
        ),
        "recipes": ("qsim.cli.dataset:recipes", "List the shipped recipes and what each one makes, or print one."),
        "sensors": ("qsim.cli.dataset:sensors", "List the named sensors, or the keys of a sensor file."),
        "convert": ("qsim.cli.convert:convert", "Read foreign recordings as clips or streams; write ours for others."),
        "preview": ("qsim.cli.look:preview", "Show a clip, stream or array: in the terminal, as film or picture."),
        "report": (
            "qsim.cli.look:report",
            "Write one self-contained page of clips, data sets, runs, restored video, scores.",
        ),
        "explore": (
            "qsim.cli.look:explore",
            "Write a page on which sliders set light and sensor; the codes of a clip are drawn live in the browser.",
        ),
        "tradeoff": ("qsim.cli.tradeoff:tradeoff", "Bit depth against motion, light, read noise and data rate."),
        "compare": (
            "qsim.cli.compare:compare",
            "Compare the streams and events of a clip: each over the same span of time.",
        ),
        "calibrate": ("qsim.cli.calibrate:calibrate", "Measure a sensor from dark and flat frames; write its file."),
        "validate": (
            "qsim.cli.validate:validate",
            "Measure speed and error of sensor engines, of the renderer or of reading.",
        ),
        "demo": (
            "qsim.cli.demo:demo",
            "Render, sense, train, restore and score small scenes; write one page of the results.",
        ),
        "completion": (
            "qsim.cli.completion:completion",
            "Print a script that completes commands and options in your shell.",
        ),
    },
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; return the exit code."""
    return run(PROGRAM, argv)


if __name__ == "__main__":
    sys.exit(main())
