"""Trains every network for the same time on the same clips, and writes one row per network, tables and curves.

    python benchmarks/equal_budget.py out/starter                       # 30 minutes for each row that is missing
    python benchmarks/equal_budget.py out/starter --rows emvd,unet      # these alone
    python benchmarks/equal_budget.py out/tiny --tiny --out out/rows    # seconds for each row: a test of this program

A row is RESULTS/NAME.json. It is written when it is complete and made once; an interrupted one resumes from WORK. Per
row: two short trials choose the learning rate on validation clips, one run uses it, and its weights are scored on test
clips at four light levels. All train by Adam. The row of classical methods needs no training. A row that fails does
not stop the others. Busy cores are refused (rows.py); --busy makes rows there, which are marked. To make a marked row
again, delete it and all in WORK that bears its name.

The table of record has the networks whose design takes about a million multiply-adds per pixel of one more frame of a
long clip (NAME-1m, quiver/evaluation/macs.py). A second column has those of restoring, as `quiver bench` counts them:
QUIVER restores the published windows, and others restore the frames around each part of a stream again.
"""

from __future__ import annotations

import argparse
import math
import shlex
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import result_page
from rows import (
    LIGHTS,
    TINY,
    Budget,
    best_rate,
    check_row,
    converged,
    cost,
    interval,
    keep_apart,
    make_row,
    missing_rows,
    notes_on,
    options,
    quiver,
    scores,
    starred,
)
from stream_rows import stream_network

from qsim.figures import new_figure, write_figure
from qsim.files import read_json, write_bytes
from qsim.tables import markdown_table
from quiver.evaluation.breakdown import bin_names
from quiver.model.names import NETWORKS

FORMAT = "quiver-equal-budget-3"
CLASSICAL = ("moment:3", "moment", "transform-denoise", "qbp", "qbp-bm3d", "path-merge")
FLOOR = "moment:3"  # a network below it is given no rank
RATES = {"mergenet": ("5e-4", "1.5e-3"), "rvrt": ("1e-4", "3e-4")}  # RVRT as published; at 1e-3 it stays the identity
RATES_OF_OTHERS = ("3e-4", "1e-3")
CROPS = {"rvrt": 128}  # px; it fills smaller ones to 132 px, which costs as much
RECORD = "-1m"  # ends the names of the networks in the table of record
ROWS = ("classical", *(name for name in NETWORKS if not name.endswith("-as-published")))
INTERRUPTED = 130  # exit code of a command that was stopped from outside
LIMITS = """Thirty minutes cannot tell which network is best after days of training. Large networks make fewer steps in
the same time, and recurrent ones learn late. A row states what a design gives for this budget on these clips. All
networks are trained by Adam, mergenet too, whose own protocol has Muon. bit2bit trains on the streams that it restores
and stands apart. The speed of the machine differed from row to row: one with a slower reference convolution made fewer
steps than it could. Earlier versions made the rows flornn-1m (windows of eleven frames) and rvrt-1m (higher rates). The
published RVRT has windows of 128 x 128 px, because it fills smaller ones to 132 px, which costs as much."""
APART = "bit2bit"  # begins the names of networks that learn from the streams they restore


def main(words: list[str] | None = None) -> int:
    args = parser().parse_args(words)
    budget = TINY if args.tiny else Budget()
    names = args.rows.split(",")
    unknown = sorted(set(names) - set(ROWS))
    if unknown:
        print(f"equal_budget: no row is called {unknown[0]!r}; known are {', '.join(ROWS)}", file=sys.stderr)
        return 2
    if args.budget_seconds is not None:
        budget = Budget(args.budget_seconds / 60, args.budget_seconds / 240, budget.threads, budget.crop, budget.batch)
    try:
        args.work = keep_apart("equal_budget", args.out, args.work, trial=args.tiny or args.budget_seconds is not None)
        args.out.mkdir(parents=True, exist_ok=True)
        for path in sorted(args.out.glob("*.json")):  # they share a table
            check_row(path, budget, args.data)
        failures = [failure for name in names if (failure := made(name, args, budget))]
    except (ValueError, OSError) as error:
        print(f"equal_budget: {error}", file=sys.stderr)
        return 2
    except subprocess.CalledProcessError as stopped:
        print(f"equal_budget: stopped at '{shlex.join(stopped.cmd[2:])}'; the same command resumes", file=sys.stderr)
        return stopped.returncode
    for failure in failures:
        print(f"equal_budget: {failure}", file=sys.stderr)
    return 1 if failures else 0


def made(name: str, args: argparse.Namespace, budget: Budget) -> str | None:
    """Make a row and the tables; return a sentence if one of its commands failed, None otherwise."""
    if name == "classical":
        make = partial(classical, args, budget)
    else:
        make = partial(apart if name.startswith(APART) else network, name, args, budget)
    sessions = args.work / f"{name}_sessions.json"
    try:
        make_row(args.out / f"{name}.json", budget, args.data, make, busy=args.busy or args.tiny, sessions=sessions)
    except subprocess.CalledProcessError as failed:
        if failed.returncode == INTERRUPTED:
            raise
        return f"{name} has no row: '{shlex.join(failed.cmd[2:])}' failed with {failed.returncode}"
    write_tables(args.out)
    return None


def parser() -> argparse.ArgumentParser:
    """Return the options of this program."""
    made = options(__doc__, "equal_budget", ROWS)
    made.add_argument("--budget-seconds", type=float, help="another budget than 30 minutes, for trying this program")
    return made


# ---- Rows


def network(name: str, args: argparse.Namespace, budget: Budget) -> dict[str, Any]:
    """Return the row of a network: trials, one run, scores and costs."""
    folder, row = learned(name, args, budget)
    scored: dict[str, Any] = {name: {}}
    lights = lights_of(name, args, budget, row["curve"][-1]["psnr_matched"])
    if lights:
        scored = scores([str(folder)], args.work / f"{name}_scores", args.data, lights, budget)
    spent = cost(str(folder), args.work / f"{name}_bench", budget)
    return {"format": FORMAT} | row | {"scores": scored[name], "cost": spent}


def learned(name: str, args: argparse.Namespace, budget: Budget) -> tuple[Path, dict[str, Any]]:
    """Return the folder of a trained network and its row without scores: two trials choose the rate of the run."""
    trials: dict[str, dict[str, Any]] = {}
    for rate in RATES.get(name.removesuffix("-1m"), RATES_OF_OTHERS):
        trials[rate] = trial(name, rate, args.work / f"{name}_trial_{rate}", args.data, budget)
    rate = best_rate(trials)
    folder = args.work / name
    train(name, rate, folder, args.data, budget)
    found = read_json(folder / "history.json")
    row = {"name": name, "kind": "network", "rate": float(rate), "trials": trials, "settings": found["settings"]}
    row |= {"curve": found["history"], "steps": found["history"][-1]["step"]}
    return folder, row | of_design(folder / "best.safetensors")


def lights_of(name: str, args: argparse.Namespace, budget: Budget, validation: float | None) -> tuple[str, ...]:
    """Return the light levels at which a network is scored.

    One of published width is scored at the light of training alone, and only if its last validation [dB] is above
    that of FLOOR: the largest take hours for what has no rank.
    """
    if name.endswith(RECORD):
        return LIGHTS
    words = ([FLOOR], args.work / f"{name}_floor", args.data, LIGHTS[:1], budget, "val")
    floor = next(iter(scores(*words)[FLOOR].values()))
    return LIGHTS[:1] if validation is not None and validation > mean_of(floor) else ()


def apart(name: str, args: argparse.Namespace, budget: Budget) -> dict[str, Any]:
    """Return the row of a network that learns from each test stream, for a share of the time."""
    found, folder = stream_network(name, RATES_OF_OTHERS, args, budget)
    spent = cost(str(folder), args.work / f"{name}_bench", budget)
    row = {"format": FORMAT, "name": name, "kind": "stream"}
    return row | found | of_design(folder / "best.safetensors") | {"cost": spent}


def trial(name: str, rate: str, folder: Path, data: Path, budget: Budget) -> dict[str, Any]:
    """Return the PSNR [dB] of the last validation of a short run, None if it diverged or has none, and its curve."""
    if not converged(partial(train, name, rate, folder, data, budget, short=True)):
        return {"psnr": None, "curve": []}
    curve = read_json(folder / "history.json")["history"]
    return {"psnr": curve[-1]["psnr_matched"], "curve": curve}


def classical(args: argparse.Namespace, budget: Budget, lights: tuple[str, ...] = LIGHTS) -> dict[str, Any]:
    """Return the row of the classical methods."""
    scored = scores(list(CLASSICAL), args.work / "classical_scores", args.data, lights, budget)
    return {"format": FORMAT, "name": "classical", "kind": "classical", "scores": scored}


def of_design(weights: Path) -> dict[str, Any]:
    """Return the parameters that restore with a weights file, the multiply-accumulates per pixel, and the frames."""
    from quiver.evaluation.macs import design_macs
    from quiver.model.rivals.student_teacher import StudentTeacher
    from quiver.model.weights import load
    from quiver.restoration.restorers import restorer

    found = load(weights)
    method = restorer(str(weights))
    restoring = found.student if isinstance(found, StudentTeacher) else found
    count = sum(parameter.numel() for parameter in restoring.parameters())
    frames = {"window": method.frames_used, "look_ahead": method.look_ahead}
    return {"parameters": count, "macs_per_pixel": design_macs(found.config)} | frames


# ---- Commands


def train(name: str, rate: str, folder: Path, data: Path, budget: Budget, *, short: bool = False) -> None:
    """Train a network, unless it is done; QUIVER with its published loss, by Adam as all others."""
    own = {
        "unet": ["control"],
        "quiver": ["control", "--loss", "published"],
        "quiver-s": ["control", "--loss", "published"],
    }
    design = name.removesuffix("-1m")
    crop = CROPS.get(name, budget.crop) if budget.crop == Budget.crop else budget.crop  # trials have small ones
    quiver(
        *("train", data, "-o", folder, "--preset", name, "--protocol", *own.get(design, ["quick"])),
        *budget.length(trial=short),
        *("--optimiser", "adam", "--learning-rate", rate, "--crop", crop, "--batch", budget.batch),
        *("--sensor", "quiver-physical", "--ppp", LIGHTS[0], "--bits", 3, "-q"),
        budget=budget,
    )


# ---- Tables


def write_tables(out: Path) -> None:
    """Write OUT.md and OUT.png from the rows that exist."""
    rows = [read_json(path) for path in sorted(out.glob("*.json"))]
    networks = [row for row in rows if row["kind"] == "network"]
    at = f"{float(LIGHTS[0]):g} PPP, 3 bit"
    classical = next((row for row in rows if row["kind"] == "classical"), {"scores": {}})
    known: dict[str, Any] = classical["scores"]
    floor = mean_of(known[FLOOR][at]) if FLOOR in known else -math.inf
    text = result_page.head("Every network after the same time", "equal_budget.py out/starter")
    text += [LIMITS, ""]
    text += [f"![Validation PSNR over minutes of training]({out.name}.png)", ""]
    text += [f"## About one million multiply-adds per pixel and frame, {at}", ""]
    record = [row for row in networks if row["name"].endswith(RECORD)]
    text += [*markdown_table(ranked(record, classical, floor, at), HEADER), "", RANKS, ""]
    widths = [row for row in networks if row not in record]
    if widths:
        text += ["## Published widths", "", SCORED, ""]
        text += [*markdown_table([width_cells(row, floor, at) for row in widths], WIDTHS), ""]
    streams = [row for row in rows if row["kind"] == "stream"]
    if streams:
        text += [f"## Learned from the test streams themselves, {at}", "", STREAMS, ""]
        header = ("network", "MACs/px", "restoring", "parameters", "steps", "rate", *HEADER[8:])
        cells = [
            [starred(row), *size_cells(row), *score_cells(row["scores"][at]), *cost_cells(row), speed(row)]
            for row in streams
        ]
        text += [*markdown_table(cells, header), ""]
    text += ["## The same weights at other light levels, matched PSNR [dB]", ""]
    text += [*markdown_table(light_cells(rows), ("method", *(f"{light} PPP" for light in LIGHTS))), ""]
    text += [*missing_rows(ROWS, rows), *notes_on(rows)]
    write_bytes(out.with_suffix(".md"), "\n".join(text).encode())
    curves(record, widths, out.with_suffix(".png"))


STREAMS = """The test clips share the thirty minutes: every clip is restored by weights that learned from its own codes
alone, and scored at this light only. A step has one window of 16 frames. Sharp frames of a validation clip choose the
rate."""
RANKS = f"""Networks below {FLOOR} have no rank. Frames: those of which one is restored, and how many of them lie ahead.
Convolution: the reference convolution on the machine of a row, whose seconds compare with those of rows alike. Seconds
of classical methods are those of the evaluation."""
SCORED = f"A network above {FLOOR} on the validation clips is scored on test clips; a score below it there is left out."
WIDTHS = (
    "network",
    "MACs/px",
    "parameters",
    "steps",
    "rate",
    "last validation [dB]",
    "PSNR matched",
    "seconds/frame",
    "MB",
    "convolution [ms]",
)
HEADER = (
    *("rank", "method", "frames", "MACs/px", "restoring", "parameters", "steps", "rate", "PSNR matched", "PSNR"),
    *("SSIM matched", *(f"{name} px" for name in bin_names()), "seconds/frame", "MB", "convolution [ms]"),
)


def ranked(networks: list[dict[str, Any]], classical: dict[str, Any], floor: float, at: str) -> list[list[str]]:
    """Return the rows of the table of record, best first: networks with a rank, and classical methods without."""
    lines = []
    for name, lights in classical["scores"].items():
        found = lights[at]
        seconds = found["seconds_per_frame"]  # None where the method failed
        spent = ["n/a" if seconds is None else f"{seconds:.3g}", "", speed(classical)]
        lines.append((mean_of(found), ["", name, *[""] * 6, *score_cells(found), *spent]))
    order = sorted(networks, key=lambda row: -mean_of(row["scores"][at]))
    for rank, row in enumerate(order, 1):
        found = row["scores"][at]
        place = str(rank) if mean_of(found) >= floor else "none"
        cells = [place, starred(row), f"{row['window']}, {row['look_ahead']}", *size_cells(row), *score_cells(found)]
        lines.append((mean_of(found), [*cells, *cost_cells(row), speed(row)]))
    return [cells for _, cells in sorted(lines, key=lambda line: -line[0])]


def width_cells(row: dict[str, Any], floor: float, at: str) -> list[str]:
    """Return the cells of a network of published width, whose score stands there if it is above the floor."""
    found = row["scores"].get(at)
    score = interval(found["scores"]["psnr_matched"], 2) if found and mean_of(found) >= floor else "below"
    macs, _, *others = size_cells(row)
    last = row["curve"][-1]["psnr_matched"]
    validated = "n/a" if last is None else f"{last:.2f}"
    return [starred(row), macs, *others, validated, score, *cost_cells(row), speed(row)]


def mean_of(found: dict[str, Any]) -> float:
    """Return the matched PSNR [dB] of a method at a light; minus infinity if it failed."""
    value = found["scores"]["psnr_matched"]["mean"]
    return -math.inf if value is None else float(value)


def size_cells(row: dict[str, Any]) -> list[str]:
    """Return multiply-accumulates per pixel of design and restoring, parameters, steps and rate."""
    macs = (row["macs_per_pixel"], row["cost"]["restoring_macs_per_pixel"])
    return [
        *(f"{count / 1e6:.3g} M" for count in macs),
        f"{row['parameters']:,}",
        str(row["steps"]),
        f"{row['rate']:g}",
    ]


def score_cells(found: dict[str, Any]) -> list[str]:
    """Return scores with intervals, and the PSNR by motion."""
    motion = ["" if value is None else f"{value:.2f}" for value in found["psnr_by_motion"]]
    kinds = (("psnr_matched", 2), ("psnr", 2), ("ssim_matched", 3))
    return [*(interval(found["scores"][kind], digits) for kind, digits in kinds), *(motion or [""] * len(bin_names()))]


def cost_cells(row: dict[str, Any]) -> list[str]:
    """Return seconds and megabytes of a restored frame."""
    return [f"{row['cost']['seconds_per_frame']:.3g}", f"{row['cost']['peak_bytes'] / 1e6:.0f}"]


def speed(row: dict[str, Any]) -> str:
    """Return the milliseconds of the reference convolution when the row was made."""
    return f"{min(row['reference_convolution_ms']):.2f}"


def light_cells(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Return the cells of all methods at all light levels."""
    found: dict[str, Any] = {}
    for row in rows:
        if row["kind"] == "classical":
            found |= row["scores"]
        elif row["name"].endswith(RECORD) and row["kind"] == "network":
            found[row["name"]] = row["scores"]
    lights = [f"{float(light):g} PPP, 3 bit" for light in LIGHTS]
    return [
        [name, *(interval(own[light]["scores"]["psnr_matched"], 2) for light in lights)] for name, own in found.items()
    ]


def curves(record: list[dict[str, Any]], widths: list[dict[str, Any]], path: Path) -> None:
    """Draw validation PSNR over minutes: the table of record and, once they have rows, the published widths."""
    parts = [("a million multiply-adds", record)] + [("published widths", widths)] * bool(widths)
    figure = new_figure(5 * len(parts), 5.2)
    axes = figure.subplots(1, len(parts), sharey=True, squeeze=False)[0]
    for axis, (title, rows) in zip(axes, parts, strict=True):
        for i, row in enumerate(rows):
            minutes = [entry["elapsed"] / 60 for entry in row["curve"]]
            values = [entry["psnr_matched"] for entry in row["curve"]]
            axis.plot(minutes, values, marker=".", color=f"C{i % 10}", ls=("-", "--")[i // 10], label=row["name"])
        axis.set_title(title)
        axis.set_xlabel("minutes of training")
        if rows:
            axis.legend(fontsize="x-small", loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=4)
    axes[0].set_ylabel("validation PSNR after the best factor [dB]")
    write_figure(figure, path)


if __name__ == "__main__":
    sys.exit(main())
