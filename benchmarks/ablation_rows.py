"""Repeats the paper's ablation with a QUIVER of a million parameters: six networks, two seeds, one row each.

    python benchmarks/ablation_rows.py out/starter --steps 277         # equal steps, all missing rows at once: on a GPU
    python benchmarks/ablation_rows.py out/starter --out out/rows      # 20 minutes for each row that is missing
    python benchmarks/ablation_rows.py out/tiny --tiny --out out/rows  # seconds for each row: a test of this program

A row is RESULTS/NAME-SEED.json: one of the six networks of the paper's Table 4, with one seed of weights and windows.
It is written when it is complete and made once; an interrupted one resumes from WORK. A wider recurrent cell stands for
missing parts, so all six have as many parameters. Rows of equal time need quiet cores (rows.py); --busy marks others.
Rows of equal steps do not: other programs make them late, and change nothing in them.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import result_page
import torch
from rows import (
    LIGHTS,
    TINY,
    Budget,
    check_row,
    keep_apart,
    make_row,
    notes_on,
    options,
    scores,
    starred,
)
from step_rows import Steps, refuse_busy, together

from qsim.files import read_json, write_bytes
from qsim.tables import markdown_table
from qsim.words import count
from quiver.device import pick_device
from quiver.model.config import Config
from quiver.model.presets import ABLATIONS, ablated, parameter_count
from quiver.model.quiver import QUIVER
from quiver.training.loop import Diverged, train
from quiver.training.settings import PROTOCOLS, Settings

FORMAT = "quiver-ablation-1"
MILLION = Config(channels=4, deformable_groups=4, denoiser_growth=8, flow_channels=(20, 40, 20, 10))
SEEDS = (0, 1)
RATE = 3e-4  # the lower one of benchmarks/equal_budget.py: the same for all six
LIMITS = """So short a training shows which parts help at once, not which help after days. The spread of two seeds is
the only measure of chance here: differences within it mean nothing."""


def main(words: list[str] | None = None) -> int:
    parser = options(__doc__, "ablation_rows", ABLATIONS)
    parser.add_argument("--steps", type=count, help="steps of every row, all rows at once (default: 20 minutes each)")
    args = parser.parse_args(words)
    budget = TINY if args.tiny else Budget(minutes=20.0)
    names = args.rows.split(",")
    if args.steps:
        budget = Steps(crop=budget.crop, steps=args.steps)
    unknown = sorted(set(names) - set(ABLATIONS))
    if unknown:
        print(f"ablation_rows: no row is called {unknown[0]!r}; known are {', '.join(ABLATIONS)}", file=sys.stderr)
        return 2
    todo = [(name, seed) for seed in SEEDS for name in names]
    try:
        args.work = keep_apart("ablation_rows", args.out, args.work, trial=args.tiny)
        if args.steps:
            refuse_busy(args)
            args.work = args.work / f"{args.steps}_steps"
        for path in sorted(args.out.glob("*.json")):  # they share a table
            check_row(path, budget, args.data)
        if isinstance(budget, Steps):
            makers = {f"{name}-{seed}": partial(network, name, seed, args, budget) for name, seed in todo}
            return together("ablation_rows", makers, args, budget, partial(write_table, args.out))
        for name, seed in todo:
            make = partial(network, name, seed, args, budget)
            sessions = args.work / f"{name}-{seed}_sessions.json"
            make_row(
                args.out / f"{name}-{seed}.json",
                budget,
                args.data,
                make,
                busy=args.busy or args.tiny,
                sessions=sessions,
            )
            write_table(args.out)
    except (ValueError, OSError) as error:
        print(f"ablation_rows: {error}", file=sys.stderr)
        return 2
    except Diverged as error:
        print(f"ablation_rows: {error}", file=sys.stderr)
        return 1
    except subprocess.CalledProcessError as failed:
        print(f"ablation_rows: stopped at '{shlex.join(failed.cmd[2:])}'; the same command resumes", file=sys.stderr)
        return failed.returncode
    return 0


def network(name: str, seed: int, args: argparse.Namespace, budget: Budget) -> dict[str, Any]:
    """Return the row of one network: a run and its scores. It is trained in this process."""
    config = variant(name)
    folder = args.work / f"{name}-{seed}"
    settings = Settings(
        str(args.data),
        str(folder),
        network=f"quiver of {parameter_count(config):,} parameters, {name}",
        sensor="quiver-physical",
        ppp=(float(LIGHTS[0]),),
        bits=(3,),
        crop=budget.crop,
        batch=budget.batch,
        seed=seed,
        threads=budget.threads,
        precision="float32",
        **PROTOCOLS["control"] | {"learning_rate": RATE, "loss": "published"},
        **how_long(budget),
    )
    torch.manual_seed(seed)
    train(QUIVER(config), settings, device=pick_device("auto" if isinstance(budget, Steps) else "cpu"), progress=False)
    history = read_json(folder / "history.json")["history"]
    scored = scores([str(folder)], args.work / f"{name}-{seed}_scores", args.data, LIGHTS[:1], budget)
    return {
        "format": FORMAT,
        "name": f"{name}-{seed}",
        "ablation": name,
        "seed": seed,
        "parameters": parameter_count(config),
        "rate": RATE,
        "steps": history[-1]["step"],
        "curve": history,
        "scores": next(iter(scored[folder.name].values()))["scores"],
    }


def how_long(budget: Budget) -> dict[str, Any]:
    """Return the settings that end a training: its minutes, or its steps with a validation after every fifth."""
    if not isinstance(budget, Steps):
        return {"minutes": budget.minutes}
    return {"steps": budget.steps, "validate_every": budget.interval, "workers": 1}


def variant(name: str) -> Config:
    """Return the configuration of a row."""
    return ablated(MILLION, name)


def write_table(out: Path) -> None:
    """Write OUT.md from the rows that exist: of each network the mean over its seeds and their half-spread."""
    rows = [read_json(path) for path in sorted(out.glob("*.json"))]
    table = []
    for name, parts in ABLATIONS.items():
        own = [row for row in rows if row["ablation"] == name]
        if not own:
            continue
        cells = ["yes" if part else "no" for part in parts] + [f"{own[0]['parameters']:,}"]
        cells += [", ".join(str(row["steps"]) for row in own)]
        for key, digits in (("psnr_matched", 2), ("ssim_matched", 3)):
            found = [row["scores"][key]["mean"] for row in own]
            spread = f" ± {np.ptp(found) / 2:.{digits}f}" if len(found) > 1 and None not in found else ""
            cells.append("n/a" if None in found else f"{np.mean(found):.{digits}f}{spread}")
        table.append([*cells, ", ".join(starred(row, row["seed"]) for row in own)])
    header = ("pre-denoiser", "flow", "multi-scale", "parameters", "steps", "PSNR matched", "SSIM matched", "seeds")
    steps = rows[0]["budget"].get("steps") if rows else None
    length = f" --steps {steps}" if steps else ""
    text = [
        *result_page.head("The paper's ablation with a million parameters", f"ablation_rows.py out/starter{length}"),
        *(LIMITS, "", *markdown_table(table, header), "", *notes_on(rows)),
    ]
    write_bytes(out.with_suffix(".md"), "\n".join(text).encode())


if __name__ == "__main__":
    sys.exit(main())
