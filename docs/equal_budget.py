"""Trains every network for the same time on the same clips, and writes one row per network, tables and curves.

    python docs/equal_budget.py out/starter                       # 30 minutes for each row that is missing
    python docs/equal_budget.py out/starter --rows emvd,unet      # these alone
    python docs/equal_budget.py out/tiny --tiny --out out/rows    # seconds for each row: a test of this program

A row is RESULTS/NAME.json. It is written when it is complete and made once; an interrupted one resumes from WORK. Per
row: two short trials choose the learning rate on validation clips, one run uses it, and its weights are scored on test
clips at four light levels. The row of classical methods needs no training. Nothing else may run beside it.
"""

from __future__ import annotations

import argparse
import math
import platform
import shlex
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from qsim.figures import new_figure, write_figure
from qsim.files import VERSION, read_json, write_bytes, write_json
from qsim.tables import markdown_table
from quiver.cli.options import NETWORKS
from quiver.evaluation.breakdown import bin_names

ROOT = Path(__file__).parents[1]
FORMAT = "quiver-equal-budget-1"
CLASSICAL = ("moment:3", "moment", "transform-denoise", "qbp", "qbp-bm3d")
FLOOR = "moment:3"  # a network below it is given no rank
RATES = {"nano": ("3e-3", "6e-3")}  # by Muon; all others by Adam
ADAM_RATES = ("3e-4", "1e-3")
RECORD = (0.8e6, 1.2e6)  # multiply-accumulates per pixel and frame of the table of record
LIGHTS = ("3.25", "1", "9.75", "26")  # photons per pixel; training is at the first
LIMITS = """Thirty minutes cannot tell which network is best after days of training. Large networks make fewer steps in
the same time, and recurrent ones learn late. A row states what a design gives for this budget on these clips."""


@dataclass(frozen=True)
class Budget:
    """What every row gets."""

    minutes: float = 30.0
    trial_minutes: float = 5.0
    threads: int = 2
    crop: int = 96  # px; a multiple of 16
    batch: int = 4
    size: str = "128x128"  # of the frames whose cost is measured


TINY = Budget(minutes=0.02, trial_minutes=0.01, threads=1, crop=32, batch=2, size="32x32")


def main(words: list[str] | None = None) -> int:
    args = options().parse_args(words)
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
        for name in names:
            path = args.out / f"{name}.json"
            if path.exists():
                check_row(path, budget)
                continue
            row = classical(args, budget) if name == "classical" else network(name, args, budget)
            write_json(path, row)
            print(f"{path}: written", flush=True)
    except (ValueError, OSError) as error:
        print(f"equal_budget: {error}", file=sys.stderr)
        return 2
    except subprocess.CalledProcessError as failed:
        print(f"equal_budget: stopped at '{shlex.join(failed.cmd[2:])}'; the same command resumes", file=sys.stderr)
        return failed.returncode
    write_tables(args.out)
    return 0


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="data set with splits train, val and test")
    left_out = ("bit2bit", "bit2bit-1m")  # trained on the stream that they restore
    names = ["classical", *(n for n in NETWORKS if n not in left_out and not n.endswith("-as-published"))]
    parser.add_argument("--rows", default=",".join(names), help="comma-separated (default all)")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "docs" / "results" / "equal_budget", help="folder of the rows"
    )
    parser.add_argument(
        "--work", type=Path, default=Path("out/equal_budget"), help="folder of runs, which can be deleted"
    )
    parser.add_argument("--budget-seconds", type=float, help="another budget than 30 minutes, for trying this program")
    parser.add_argument("--tiny", action="store_true", help="seconds for each row, on tiny crops")
    return parser


def check_row(path: Path, budget: Budget) -> None:
    """Raise `ValueError` if a row was made with another budget."""
    found = read_json(path).get("budget")
    if found != asdict(budget):
        raise ValueError(f"{path}: was made with {found}; now it would be {asdict(budget)}; choose another --out")


# ---- Rows


def network(name: str, args: argparse.Namespace, budget: Budget) -> dict[str, Any]:
    """Return the row of a network: trials, one run, scores and costs."""
    trials = {}
    for rate in RATES.get(name, ADAM_RATES):
        folder = args.work / f"{name}_trial_{rate}"
        train(name, rate, budget.trial_minutes, folder, args.data, budget)
        history = read_json(folder / "history.json")["history"]
        trials[rate] = history[-1]["psnr_matched"] if history else -math.inf
    rate = max(trials, key=lambda key: trials[key])
    folder = args.work / name
    train(name, rate, budget.minutes, folder, args.data, budget)
    found = read_json(folder / "history.json")
    scores = evaluate([str(folder)], args.work / f"{name}_scores", args.data, budget)
    row = common(budget, args.data)
    row |= {"name": name, "kind": "network", "rate": float(rate), "trials": {key: trials[key] for key in trials}}
    row |= {"settings": found["settings"], "curve": found["history"], "steps": found["history"][-1]["step"]}
    row |= {"parameters": parameters(folder / "best.safetensors")}
    return row | {"scores": scores[name], "cost": cost(str(folder), args.work / f"{name}_bench", budget)}


def classical(args: argparse.Namespace, budget: Budget) -> dict[str, Any]:
    """Return the row of the classical methods."""
    scores = evaluate(list(CLASSICAL), args.work / "classical_scores", args.data, budget)
    return common(budget, args.data) | {"name": "classical", "kind": "classical", "scores": scores}


def common(budget: Budget, data: Path) -> dict[str, Any]:
    """Return what all rows hold: budget, machine, and the speed of a fixed convolution."""
    return {
        "format": FORMAT,
        "quiver": VERSION,
        "budget": asdict(budget),
        "data": data.name,
        "machine": f"{platform.system()} {platform.machine()}, {processor()}, torch {torch.__version__}",
        "reference_convolution_ms": reference_convolution(budget.threads),
    }


def processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.processor())


def reference_convolution(threads: int) -> float:
    """Return the milliseconds of a 3 x 3 convolution of 64 channels at 128 x 128 px: the least of twenty."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    layer, image = torch.nn.Conv2d(64, 64, 3, padding=1), torch.zeros(1, 64, 128, 128)
    taken = []
    with torch.inference_mode():
        for _ in range(20):
            started = time.perf_counter()
            layer(image)
            taken.append(time.perf_counter() - started)
    torch.set_num_threads(before)
    return 1000 * min(taken)


def parameters(weights: Path) -> int:
    """Return the number of parameters of a weights file."""
    from quiver.model.weights import load

    return sum(parameter.numel() for parameter in load(weights).parameters())


# ---- Commands


def quiver(*words: object, budget: Budget) -> None:
    """Print and run one command of `quiver` in its own process."""
    line = [str(word) for word in (*words, "--threads", budget.threads)]
    print(f"\n$ quiver {shlex.join(line)}", flush=True)
    subprocess.run([sys.executable, "-m", "quiver", *line], check=True)


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


def evaluate(methods: list[str], folder: Path, data: Path, budget: Budget) -> dict[str, Any]:
    """Return the scores on test clips by method and light."""
    quiver(
        *("evaluate", data, "-o", folder, "--methods", ",".join(methods), "--ppp", ",".join(LIGHTS), "-q"),
        budget=budget,
    )
    found: dict[str, Any] = {}
    for line in read_json(folder / "evaluation.json")["table"]:
        kept = ("scores", "psnr_by_motion", "psnr_matched_per_frame", "seconds_per_frame", "failures")
        found.setdefault(line["method"], {})[line["light"]] = {key: line[key] for key in kept}
    return found


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
    return found | {"macs_per_pixel": 1e9 * (found["gmac_per_frame"] or math.nan) / (height * width)}


# ---- Tables


def write_tables(out: Path) -> None:
    """Write OUT.md and OUT.png from the rows that exist."""
    rows = [read_json(path) for path in sorted(out.glob("*.json"))]
    networks = [row for row in rows if row["kind"] == "network"]
    scores = ("PSNR matched", "SSIM matched", *(f"{name} px" for name in bin_names()))
    header = ("network", "MACs/px", "parameters", "steps", *scores, "s/frame", "MB")
    at = f"{float(LIGHTS[0]):g} PPP, 3 bit"
    floor = next(
        (row["scores"][FLOOR][at]["scores"]["psnr_matched"]["mean"] for row in rows if row["name"] == "classical"),
        -math.inf,
    )
    record = [row for row in networks if RECORD[0] <= row["cost"]["macs_per_pixel"] <= RECORD[1]]
    others = [row for row in networks if row not in record]
    text = ["# Every network after the same time", "", "    python docs/equal_budget.py DATA", "", LIMITS, ""]
    for title, part in (("About one million multiply-adds per pixel and frame", record), ("Other sizes", others)):
        ranked = sorted(part, key=lambda row: -psnr(row, at))
        text += [f"## {title}, {at}", "", *markdown_table([cells(row, row["name"], at) for row in ranked], header), ""]
        below = [row["name"] for row in ranked if psnr(row, at) < floor]
        text += [f"Below {FLOOR}, so without a rank: {', '.join(below)}.", ""] if below else []
    text += ["## The same weights at other light levels, matched PSNR [dB]", ""]
    text += [*markdown_table(light_cells(rows), ("method", *(f"{light} PPP" for light in LIGHTS))), ""]
    machines = sorted({f"{row['machine']}, {row['budget']['threads']} threads" for row in rows})
    text += [f"Machine: {'; '.join(machines)}.", ""]
    write_bytes(out.with_suffix(".md"), "\n".join(text).encode())
    curves(networks, out.with_suffix(".png"))


def psnr(row: dict[str, Any], light: str) -> float:
    """Return the matched PSNR [dB] of a network; minus infinity if it failed."""
    found = row["scores"][light]["scores"]["psnr_matched"]["mean"]
    return -math.inf if found is None else float(found)


def cells(row: dict[str, Any], name: str, light: str) -> list[str]:
    """Return the cells of a network."""
    found, spent = row["scores"][light], row["cost"]
    motion = ["" if value is None else f"{value:.2f}" for value in found["psnr_by_motion"]]
    return [
        *(name, f"{spent['macs_per_pixel'] / 1e6:.3g} M", f"{row['parameters']:,}", str(row["steps"])),
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


def interval(found: dict[str, Any], digits: int) -> str:
    """Return a mean with its half-width as text."""
    if found["mean"] is None:
        return "n/a"
    half = "" if found["half_width"] is None else f" ± {found['half_width']:.{digits}f}"
    return f"{found['mean']:.{digits}f}{half}"


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
