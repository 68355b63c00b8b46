"""Trains every network for the same time on the same clips, and writes one row per network, tables and curves.

    python docs/equal_budget.py out/starter                       # 30 minutes for each row that is missing
    python docs/equal_budget.py out/starter --rows emvd,unet      # these alone
    python docs/equal_budget.py out/tiny --tiny --out out/rows    # seconds for each row: a test of this program

A row is RESULTS/NAME.json. It is written when it is complete and made once; an interrupted one resumes from WORK. Per
row: two short trials choose the learning rate on validation clips, one run uses it, and its weights are scored on test
clips at four light levels. The row of classical methods needs no training. Busy cores are refused (rows.py); --busy
makes rows there, which are marked. To make a marked row again, delete it and its folder in WORK.

The multiply-adds of record are those of the design: one more frame of a long clip (quiver/evaluation/macs.py). A second
column has those of restoring, as `quiver bench` counts them, with the frames around each part of a stream.
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

from rows import LIGHTS, TINY, Budget, check_row, interval, make_row, notes_on, options, quiver, scores

from qsim.figures import new_figure, write_figure
from qsim.files import read_json, write_bytes
from qsim.tables import markdown_table
from quiver.cli.options import NETWORKS
from quiver.evaluation.breakdown import bin_names

FORMAT = "quiver-equal-budget-2"
CLASSICAL = ("moment:3", "moment", "transform-denoise", "qbp", "qbp-bm3d", "path-merge")
FLOOR = "moment:3"  # a network below it is given no rank
RATES = {"mergenet": ("5e-4", "1.5e-3")}
RATES_OF_OTHERS = ("3e-4", "1e-3")
DIVERGED = 1  # exit code of a training whose loss became NaN or infinite
RECORD = (0.8e6, 1.2e6)  # multiply-accumulates per pixel and frame of the table of record
LIMITS = """Thirty minutes cannot tell which network is best after days of training. Large networks make fewer steps in
the same time, and recurrent ones learn late. A row states what a design gives for this budget on these clips."""


def main(words: list[str] | None = None) -> int:
    args = parser().parse_args(words)
    budget, names = TINY if args.tiny else Budget(), args.rows.split(",")
    unknown = sorted(set(names) - {"classical", *NETWORKS})
    if unknown:
        print(
            f"equal_budget: no row is called {unknown[0]!r}; known are classical, {', '.join(NETWORKS)}",
            file=sys.stderr,
        )
        return 2
    if args.budget_seconds:
        budget = Budget(args.budget_seconds / 60, args.budget_seconds / 240, budget.threads, budget.crop, budget.batch)
    args.out.mkdir(parents=True, exist_ok=True)
    try:
        for name in names:  # all that exist are checked before any is made
            if (args.out / f"{name}.json").exists():
                check_row(args.out / f"{name}.json", budget, args.data)
        for name in names:
            make = partial(classical, args, budget) if name == "classical" else partial(network, name, args, budget)
            make_row(args.out / f"{name}.json", budget, args.data, make, busy=args.busy or args.tiny)
            write_tables(args.out)
    except (ValueError, OSError) as error:
        print(f"equal_budget: {error}", file=sys.stderr)
        return 2
    except subprocess.CalledProcessError as failed:
        print(f"equal_budget: stopped at '{shlex.join(failed.cmd[2:])}'; the same command resumes", file=sys.stderr)
        return failed.returncode
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the options of this program."""
    left_out = ("bit2bit", "bit2bit-1m")  # trained on the stream that they restore
    names = ["classical", *(n for n in NETWORKS if n not in left_out and not n.endswith("-as-published"))]
    made = options(__doc__, "equal_budget", names)
    made.add_argument("--budget-seconds", type=float, help="another budget than 30 minutes, for trying this program")
    return made


# ---- Rows


def network(name: str, args: argparse.Namespace, budget: Budget) -> dict[str, Any]:
    """Return the row of a network: trials, one run, scores and costs."""
    trials = {}
    for rate in RATES.get(name.removesuffix("-1m"), RATES_OF_OTHERS):
        folder = args.work / f"{name}_trial_{rate}"
        trials[rate] = trial(name, rate, folder, args.data, budget)
    rate = max(trials, key=lambda key: trials[key])
    folder = args.work / name
    train(name, rate, budget.minutes, folder, args.data, budget)
    found = read_json(folder / "history.json")
    scored = scores([str(folder)], args.work / f"{name}_scores", args.data, LIGHTS, budget)
    row = {"format": FORMAT, "name": name, "kind": "network", "rate": float(rate)}
    row |= {"trials": {key: value if math.isfinite(value) else None for key, value in trials.items()}}
    row |= {"settings": found["settings"], "curve": found["history"], "steps": found["history"][-1]["step"]}
    design = of_design(folder / "best.safetensors")
    spent = cost(str(folder), args.work / f"{name}_bench", budget)
    return row | design | {"scores": scored[name], "cost": spent}


def trial(name: str, rate: str, folder: Path, data: Path, budget: Budget) -> float:
    """Return the PSNR [dB] of the last validation of a short run; minus infinity for one that diverged."""
    try:
        train(name, rate, budget.trial_minutes, folder, data, budget)
    except subprocess.CalledProcessError as failed:
        if failed.returncode != DIVERGED:
            raise
        return -math.inf
    history = read_json(folder / "history.json")["history"]
    return float(history[-1]["psnr_matched"]) if history else -math.inf


def classical(args: argparse.Namespace, budget: Budget) -> dict[str, Any]:
    """Return the row of the classical methods."""
    scored = scores(list(CLASSICAL), args.work / "classical_scores", args.data, LIGHTS, budget)
    return {"format": FORMAT, "name": "classical", "kind": "classical", "scores": scored}


def of_design(weights: Path) -> dict[str, Any]:
    """Return the number of parameters of a weights file, and the multiply-accumulates per pixel of its design."""
    from quiver.evaluation.macs import design_macs
    from quiver.model.weights import load

    found = load(weights)
    count = sum(parameter.numel() for parameter in found.parameters())
    return {"parameters": count, "macs_per_pixel": design_macs(found.config)}


# ---- Commands


def train(name: str, rate: str, minutes: float, folder: Path, data: Path, budget: Budget) -> None:
    """Train a network, unless it is done; QUIVER with its published loss, by Adam as all others."""
    own = {
        "unet": ["control"],
        "quiver": ["control", "--loss", "published"],
        "quiver-s": ["control", "--loss", "published"],
    }
    quiver(
        *("train", data, "-o", folder, "--preset", name, "--protocol", *own.get(name.removesuffix("-1m"), ["quick"])),
        *("--minutes", minutes, "--learning-rate", rate, "--crop", budget.crop, "--batch", budget.batch),
        *("--sensor", "quiver-physical", "--ppp", LIGHTS[0], "--bits", 3, "-q"),
        budget=budget,
    )  # fmt: skip


def cost(method: str, folder: Path, budget: Budget) -> dict[str, Any]:
    """Return seconds, memory and multiply-accumulates per frame."""
    again = ["--force"] if (folder / "bench.json").exists() else []
    quiver(
        "bench",
        "--methods",
        method,
        "--modes",
        "exact",
        "--size",
        budget.size,
        "-o",
        folder,
        *again,
        "-q",
        budget=budget,
    )
    found: dict[str, Any] = read_json(folder / "bench.json")["costs"][0]
    height, width = (int(side) for side in budget.size.split("x"))
    return found | {"restoring_macs_per_pixel": 1e9 * (found["gmac_per_frame"] or math.nan) / (height * width)}


# ---- Tables


def write_tables(out: Path) -> None:
    """Write OUT.md and OUT.png from the rows that exist."""
    rows = [read_json(path) for path in sorted(out.glob("*.json"))]
    networks = [row for row in rows if row["kind"] == "network"]
    scores = ("PSNR matched", "SSIM matched", *(f"{name} px" for name in bin_names()))
    header = ("network", "MACs/px", "restoring", "parameters", "steps", *scores, "s/frame", "MB")
    at = f"{float(LIGHTS[0]):g} PPP, 3 bit"
    floor = next(
        (row["scores"][FLOOR][at]["scores"]["psnr_matched"]["mean"] for row in rows if row["name"] == "classical"),
        -math.inf,
    )
    record = [row for row in networks if RECORD[0] <= row["macs_per_pixel"] <= RECORD[1]]
    others = [row for row in networks if row not in record]
    text = ["# Every network after the same time", "", "    python docs/equal_budget.py DATA", "", LIMITS, ""]
    for title, part in (("About one million multiply-adds per pixel and frame", record), ("Other sizes", others)):
        ranked = sorted(part, key=lambda row: -psnr(row, at))
        text += [f"## {title}, {at}", "", *markdown_table([cells(row, at) for row in ranked], header), ""]
        below = [row["name"] for row in ranked if psnr(row, at) < floor]
        text += [f"Below {FLOOR}, so without a rank: {', '.join(below)}.", ""] if below else []
    text += ["## The same weights at other light levels, matched PSNR [dB]", ""]
    text += [*markdown_table(light_cells(rows), ("method", *(f"{light} PPP" for light in LIGHTS))), ""]
    text += notes_on(rows)
    write_bytes(out.with_suffix(".md"), "\n".join(text).encode())
    curves(networks, out.with_suffix(".png"))


def psnr(row: dict[str, Any], light: str) -> float:
    """Return the matched PSNR [dB] of a network; minus infinity if it failed."""
    found = row["scores"][light]["scores"]["psnr_matched"]["mean"]
    return -math.inf if found is None else float(found)


def cells(row: dict[str, Any], light: str) -> list[str]:
    """Return the cells of a network; a star marks one that was made on busy cores."""
    found, spent = row["scores"][light], row["cost"]
    motion = ["" if value is None else f"{value:.2f}" for value in found["psnr_by_motion"]]
    return [
        *(row["name"] + ("" if row["quiet"] else r"\*"), f"{row['macs_per_pixel'] / 1e6:.3g} M"),
        *(f"{spent['restoring_macs_per_pixel'] / 1e6:.3g} M", f"{row['parameters']:,}", str(row["steps"])),
        *(interval(found["scores"]["psnr_matched"], 2), interval(found["scores"]["ssim_matched"], 3)),
        *(motion or [""] * len(bin_names())),
        *(f"{spent['seconds_per_frame']:.3g}", f"{spent['peak_bytes'] / 1e6:.0f}"),
    ]


def light_cells(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Return the cells of all methods at all light levels."""
    found: dict[str, Any] = {}
    for row in rows:
        found |= row["scores"] if row["kind"] == "classical" else {row["name"]: row["scores"]}
    lights = [f"{float(light):g} PPP, 3 bit" for light in LIGHTS]
    return [
        [name, *(interval(own[light]["scores"]["psnr_matched"], 2) for light in lights)] for name, own in found.items()
    ]


def curves(networks: list[dict[str, Any]], path: Path) -> None:
    """Draw validation PSNR over minutes."""
    figure = new_figure(7, 4.5)
    axes = figure.subplots()
    for i, row in enumerate(networks):
        minutes = [entry["elapsed"] / 60 for entry in row["curve"]]
        values = [entry["psnr_matched"] for entry in row["curve"]]
        axes.plot(minutes, values, marker=".", color=f"C{i % 10}", ls=("-", "--")[i // 10 % 2], label=row["name"])
    axes.set_xlabel("minutes of training")
    axes.set_ylabel("validation PSNR after the best factor [dB]")
    if networks:
        figure.legend(fontsize="small", loc="outside right upper")
    write_figure(figure, path)


if __name__ == "__main__":
    sys.exit(main())
