"""Trains the restorer that ships on single cells of its grid, and compares both on the test clips of these cells.

    python benchmarks/restorer_tuned.py out/photos out/restorer out/restorer_val out/restorer_test
    python benchmarks/restorer_tuned.py out/tiny out/tiny out/tiny out/tiny --tiny --out out/rows  # a test of this

One set of weights serves all cells. The cost of that is what a cell gains from weights for it alone: STEPS steps from
the shipped ones, an estimated 20 minutes on two quiet cores, with windows of this cell alone. Busy cores change no
score. A row is RESULTS/CELL.json, made once; an interrupted training resumes from WORK.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import result_page
from restorer_cells import Place
from restorer_grid import FRAMES, measured, places
from rows import keep_apart, restorer_options

from qsim.files import VERSION, read_json, write_bytes, write_json
from qsim.streams.clip import Clip
from qsim.tables import markdown_table
from quiver.data.clips import open_clips
from quiver.model.weights import digest
from quiver.restoration.restorers import weights_path

FORMAT = "quiver-restorer-tuned-1"
CELLS = ("qis-3-3.25", "qis-1-0.5", "qis-7-26")  # the paper's, the least won and the best lit
START = "mergenet"


@dataclass(frozen=True)
class Size:
    """How much every cell gets."""

    steps: int = 4000
    validate_every: int = 500
    learning_rate: float = 1.5e-3  # of the last stage of the shipped weights
    crop: int = 96  # px
    batch: int = 6
    frames: int = FRAMES  # restored of every test clip


TINY = Size(steps=2, validate_every=1, crop=32, batch=2, frames=1)


def main(words: list[str] | None = None) -> int:
    args = options().parse_args(words)
    size = TINY if args.tiny else Size()
    known = {place.name: place for place in places()}
    try:
        args.work = keep_apart("restorer_tuned", args.out, args.work, trial=args.tiny)
        for name in args.cells.split(","):
            if name not in known:
                raise ValueError(f"no cell is called {name!r}; known are {', '.join(known)}")
        clips = open_clips(args.test, "test")
        if not clips:
            raise ValueError(f"{args.test}: no finished clip in split 'test'; finish `qsim generate`")
        for name in args.cells.split(","):
            path = args.out / f"{name}.json"
            same = {"format": FORMAT, "quiver": VERSION, "start": digest(weights_path(START)), "size": vars(size)}
            if not path.exists():
                row = compared(known[name], clips, args, size)
                args.out.mkdir(parents=True, exist_ok=True)
                write_json(path, {"name": name, **same, **row})
                print(f"{path}: written", flush=True)
            changed = [key for key, value in same.items() if read_json(path).get(key) != value]
            if changed:
                raise ValueError(
                    f"{path}: was made with another {', '.join(changed)}; remove it, or choose another --out"
                )
            write_table(args.out)
    except subprocess.CalledProcessError as error:
        print(f"restorer_tuned: {shlex.join(map(str, error.cmd[2:]))} failed; its message is above", file=sys.stderr)
        return 2
    except (ValueError, OSError) as error:
        print(f"restorer_tuned: {error}", file=sys.stderr)
        return 2
    return 0


def options() -> argparse.ArgumentParser:
    data = {
        "photographs": "data set of warped photographs, with a train split",
        "rendered": "data set of scenes/restorer.toml, with a train split",
        "validation": "data set of scenes/restorer_val.toml, with a val split",
        "test": "data set of scenes/restorer_test.toml",
    }
    parser = restorer_options(__doc__, "restorer_tuned", data)
    parser.add_argument("--cells", default=",".join(CELLS), help="comma-separated cells of the grid")
    return parser


def compared(place: Place, clips: list[Clip], args: argparse.Namespace, size: Size) -> dict[str, Any]:
    """Train on one cell and return the matched PSNR [dB] of every test clip with the shipped and the tuned weights."""
    run = args.work / place.name
    light = place.light
    words = ["train", args.photographs, args.rendered, args.validation, "-o", run, "--preset", "mergenet"]
    words += ["--start", START, "--steps", size.steps, "--validate-every", size.validate_every]
    words += ["--sensor", light.sensor, "--bits", light.bits, "--ppp", light.ppp, "--crop", size.crop]
    words += ["--batch", size.batch, "--learning-rate", size.learning_rate, "--workers", args.workers]
    words += ["--threads", 1, "--precision", "bfloat16"]
    print(f"\n$ quiver {shlex.join(map(str, words))}", flush=True)
    subprocess.run([sys.executable, "-m", "quiver", *map(str, words)], check=True)
    scores: dict[str, list[float]] = {"shipped": [], "tuned": []}
    for clip in clips:
        for name, weights in (("shipped", START), ("tuned", str(run))):
            how = argparse.Namespace(restorer=weights, frames=size.frames)
            row = measured(clip, ["restorer"], light, how)["restorer"]
            assert row is not None  # a network restores every stream
            scores[name].append(row["psnr"])
    return {"clips": [clip.name for clip in clips], "psnr": scores}


def write_table(out: Path) -> None:
    """Write OUT.md from the rows that exist."""
    rows = [read_json(path) for path in sorted(out.glob("*.json"))]
    table = []
    for row in rows:
        shipped, tuned = (np.array(row["psnr"][name]) for name in ("shipped", "tuned"))
        gain = tuned - shipped
        spread = f"{gain.min():+.2f} to {gain.max():+.2f}"
        table.append((row["name"], f"{shipped.mean():.2f}", f"{tuned.mean():.2f}", f"{gain.mean():+.2f}", spread))
    size = rows[0]["size"]
    command = "restorer_tuned.py out/photos out/restorer out/restorer_val out/restorer_test"
    text = result_page.head("The restorer beside weights for one cell", command)
    text += [
        f"{size['steps']} steps from the shipped weights with windows of one cell alone. Mean matched PSNR in dB "
        f"over {len(rows[0]['clips'])} test clips, {size['frames']} frames of each.",
        "",
    ]
    text += [*markdown_table(table, ("cell", "shipped", "tuned", "difference", "of single clips")), ""]
    write_bytes(out.with_suffix(".md"), "\n".join(text).encode())


if __name__ == "__main__":
    sys.exit(main())
