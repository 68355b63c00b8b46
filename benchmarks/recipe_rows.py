"""Trains a small QUIVER in many ways for the same time, and writes one row per way and seed, and a page.

    python benchmarks/recipe_rows.py out/starter --speeds                # seconds of a step of each way, in minutes
    python benchmarks/recipe_rows.py out/starter --speeds --rows long,crop-128   # of ways that came later
    python benchmarks/recipe_rows.py out/starter --rows quick,long       # rows that are missing, for seeds 1 and 2
    python benchmarks/recipe_rows.py out/starter --final long            # and `quick`: 30 minutes of two quiet cores
    python benchmarks/recipe_rows.py out/starter --tiny --out out/rows   # seconds for each row: a test of this program

Every row has 30 minutes of one core. That is a number of steps: the minutes over the seconds of a step, which are
measured once for all ways, in one run on quiet cores. So a row can be interrupted, and may be made beside others. A way
that came later is measured beside one that is known: its seconds are those of the machine of the first run.
Validation clips choose the recipe. Then it is compared with `quick` on the test clips, by the clock.
"""

from __future__ import annotations

import argparse
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rows import (
    QUIET,
    ROOT,
    Budget,
    Watch,
    converged,
    interval,
    keep_apart,
    machine,
    quiver,
    recipe_digest,
    scores,
    starred,
    wait_for_quiet,
)
from rows import settings_of as recorded

from qsim.files import VERSION, read_json, write_bytes, write_json
from qsim.tables import markdown_table
from quiver.host import flushed_denormals
from quiver.model.presets import build
from quiver.training.loop import make_windows
from quiver.training.optimiser import Optimiser
from quiver.training.settings import PROTOCOLS, Settings, settled
from quiver.training.system import Objective, collated
from quiver.training.systems import system_of

NETWORK = "quiver-s-1m"
MINUTES = 30.0  # of one core
SEEDS = (1, 2)
LIGHT = "3.25"
MEASURED = 2  # steps of each way, in turn
SPEEDS = "speeds.json"
CLASSICAL = "classical.json"
FINAL = "final-"  # begins the names of rows of the comparison by the clock
BESIDE = ("moment", "qbp-bm3d")  # classical methods that are scored once on the same clips
SMALL = {"crop": 32, "batch": 1, "frames": 12}  # with --tiny

Values = Mapping[str, Any]


@dataclass(frozen=True)
class Way:
    """A way to train: settings that differ from those of `quick`, one after another for shares of the run."""

    what: str
    stages: tuple[tuple[float, Values], ...]

    @classmethod
    def of(cls, what: str, **settings: Any) -> Way:
        """Return a way of one stage."""
        return cls(what, ((1.0, settings),))


LONG: dict[str, Any] = {"frames": 21, "batch": 1, "learning_rate": 3e-3}
WAYS = {
    "quick": Way.of("today's settings: 11 frames of 64 px, 8 windows a step, Muon at 6e-3, L1 at three scales"),
    "batch-2": Way.of("2 windows a step", batch=2),
    "long-4": Way.of("21 frames, of which 11 are restored; 4 windows a step, Muon at 6e-3", frames=21, batch=4),
    "long-2": Way.of("21 frames, 2 windows a step, Muon at 3e-3", **LONG | {"batch": 2}),
    "long": Way.of("21 frames, 1 window a step, Muon at 3e-3", **LONG),
    "fast": Way.of("long, Muon at 6e-3", **LONG | {"learning_rate": 6e-3}),
    "slow": Way.of("long, Muon at 1.5e-3", **LONG | {"learning_rate": 1.5e-3}),
    "adam": Way.of("long, Adam at 1e-3", **LONG | {"optimiser": "adam", "learning_rate": 1e-3}),
    "adam-slow": Way.of("long, Adam at 5e-4", **LONG | {"optimiser": "adam", "learning_rate": 5e-4}),
    "crop-48": Way.of("long, windows of 48 px", **LONG, crop=48),
    "crop-96": Way.of("long, windows of 96 px", **LONG, crop=96),
    "crop-96-fast": Way.of("long, windows of 96 px, Muon at 6e-3", **LONG | {"learning_rate": 6e-3}, crop=96),
    "crop-128": Way.of("long, windows of 128 px", **LONG, crop=128),
    "published-loss": Way.of("long, the published loss", **LONG, loss="published"),
    "paper-loss": Way.of("long, the loss of the paper's text", **LONG, loss="paper"),
    "log-mse": Way.of("long, the logarithm of the squared error", **LONG, loss="log-mse"),
    "aligned": Way.of("long, with a term for the flow", **LONG, loss="aligned"),
    "parts-10": Way.of("long, pre-denoiser and flow alone for a tenth of the steps", **LONG, pretraining=0.1),
    "parts-30": Way.of("long, the same for three tenths", **LONG, pretraining=0.3),
    "parts-60": Way.of("long, the same for six tenths", **LONG, pretraining=0.6),
    "bright-first": Way(
        "long, a third of the steps at 26 photons, then at 3.25", ((1 / 3, LONG | {"ppp": (26.0,)}), (2 / 3, LONG))
    ),
    "lights": Way.of("long, 2 to 30 photons", **LONG, ppp=(2.0, 3.25, 5.0, 9.75, 16.0, 26.0)),
    "still-crops": Way.of("long, crops that do not drift", **LONG, drift=0),
}


def main(words: list[str] | None = None) -> int:
    args = parser().parse_args(words)
    unknown = sorted(set(args.rows.split(",")) - set(WAYS))
    if unknown:
        print(f"recipe_rows: no row is called {unknown[0]!r}; known are {', '.join(WAYS)}", file=sys.stderr)
        return 2
    try:
        args.work = keep_apart("recipe_rows", args.out, args.work, trial=args.tiny)
        args.out.mkdir(parents=True, exist_ok=True)
        if args.speeds:
            measure_speeds(args)
            return 0
        beside_them(args)
        names = args.rows.split(",") if args.final is None else ["quick", args.final]
        made = make if args.final is None else by_the_clock
        for seed in (int(text) for text in args.seeds.split(",")):
            for name in names:
                made(name, seed, args)
    except (ValueError, OSError) as error:
        print(f"recipe_rows: {error}", file=sys.stderr)
        return 2
    except subprocess.CalledProcessError as stopped:
        print(f"recipe_rows: a command failed with {stopped.returncode}; the same command resumes", file=sys.stderr)
        return stopped.returncode
    write_page(args.out)
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the options of this program."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("data", type=Path, help="data set with splits train, val and test")
    made.add_argument("--rows", default=",".join(WAYS), help="comma-separated (default all)")
    made.add_argument("--seeds", default=",".join(map(str, SEEDS)), help="comma-separated (default 1,2)")
    made.add_argument("--final", choices=WAYS, help="train this way and quick by the clock; score the test clips")
    made.add_argument("--speeds", action="store_true", help="measure the seconds of a step of each way, and end")
    made.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "recipe_rows", help="folder of the rows")
    made.add_argument("--work", type=Path, help="folder of runs, which can be deleted (default out/recipe_rows)")
    made.add_argument("--tiny", action="store_true", help="three steps for each row, on crops of 32 px")
    return made


# ---- Seconds of a step


def measure_speeds(args: argparse.Namespace) -> None:
    """Write the seconds of processor time of a step of each stage of each way: medians of steps made in turn."""
    if not args.tiny:
        wait_for_quiet()
    torch.set_num_threads(1)
    steps: dict[str, Any] = {}
    with flushed_denormals():
        for values in stages_of(args.rows.split(",")):
            settings = settings_of(values, args, out="unused", seed=0, steps=1)
            for part in (True, False) if settings.pretraining else (False,):
                steps.setdefault(cost_key(settings, part), Step(settings, part))
        taken: dict[str, list[float]] = {key: [] for key in steps}
        for _ in range(1 if args.tiny else MEASURED):
            for key, step in steps.items():
                taken[key].append(step.seconds())
                print(f"{key}: {taken[key][-1]:.2f} s", flush=True)
    found = {key: statistics.median(times) for key, times in taken.items()}
    path = args.out / SPEEDS
    before = read_json(path) if path.exists() else {"machine": machine(), "seconds": {}}
    write_json(path, before | {"seconds": joined(before["seconds"], found)})


def joined(known: Mapping[str, float], found: Mapping[str, float]) -> dict[str, float]:
    """Return known seconds with those of other steps, scaled by the steps that both measured.

    `ValueError` if there are known ones, and none was measured again.
    """
    if not known:
        return dict(found)
    shared = [known[key] / seconds for key, seconds in found.items() if key in known]
    if not shared:
        raise ValueError(f"{SPEEDS} holds speeds of another run; add a way that it knows, as in --rows long,crop-128")
    factor = statistics.median(shared)
    return {key: seconds * factor for key, seconds in found.items()} | dict(known)


def stages_of(names: list[str]) -> list[Values]:
    """Return the settings of all stages of some ways."""
    return [values for name in names for _, values in WAYS[name].stages]


def cost_key(settings: Settings, parts: bool) -> str:
    """Return what the cost of a step depends on, as text."""
    shape = f"{settings.batch} x {settings.frames} x {settings.crop} px"
    return f"{shape}, {settings.optimiser}, {settings.loss}{', parts' if parts else ''}"


class Step:
    """One step of training, repeated: of a network of its own, on one batch that is drawn anew."""

    def __init__(self, settings: Settings, parts: bool) -> None:
        self.settings = settings
        self.share = 0.0 if parts else 1.0
        self.network = build(settings.network)
        system = system_of(self.network)
        self.windows, _ = make_windows(settings, system.side(self.network), system)
        self.objective = Objective(self.network, system.loss, settings)
        self.optimiser = Optimiser(self.network, settings.optimiser, settings.learning_rate, settings.betas)
        self.number = 0
        self.seconds()  # the first one chooses kernels

    def seconds(self) -> float:
        """Return the processor time [s] of a step."""
        began = time.process_time()
        numbers = range(self.number, self.number + self.settings.batch)
        batch = collated([self.windows[n] for n in numbers])
        self.network.zero_grad(set_to_none=True)
        self.objective(batch, self.share).backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.clip_norm)
        self.optimiser.step(1e-9)
        self.number += self.settings.batch
        return time.process_time() - began


def settings_of(values: Values, args: argparse.Namespace, *, out: str, seed: int, steps: int) -> Settings:
    """Return the settings of a stage, with their noise."""
    all_values: dict[str, Any] = {**PROTOCOLS["quick"], **values}
    if args.tiny:
        all_values |= SMALL
    made = Settings(data=str(args.data), out=out, network=NETWORK, seed=seed, steps=steps, **all_values)
    return settled(made, force=True)[0]


def seconds_of(values: Values, args: argparse.Namespace) -> float:
    """Return the seconds of a step of a stage, on the average of its steps."""
    path = args.out / SPEEDS
    if not path.exists():
        raise FileNotFoundError(f"{path}: is missing; run this program with --speeds first")
    known = read_json(path)["seconds"]
    settings = settings_of(values, args, out="unused", seed=0, steps=1)
    found = (1 - settings.pretraining) * known[cost_key(settings, False)]
    if settings.pretraining:
        found += settings.pretraining * known[cost_key(settings, True)]
    return float(found)


# ---- Rows


def beside_them(args: argparse.Namespace) -> None:
    """Score classical methods on the clips of all rows, once."""
    path = args.out / CLASSICAL
    if path.exists() or args.tiny:
        return
    found = scores(list(BESIDE), args.work / "classical", args.data, (LIGHT,), Budget(threads=1), "val")
    means = {name: next(iter(lights.values()))["scores"]["psnr_matched"]["mean"] for name, lights in found.items()}
    write_json(path, {"psnr_matched": means})


def make(name: str, seed: int, args: argparse.Namespace) -> None:
    """Make a row unless it exists: train all stages, then score the validation clips."""
    path = args.out / f"{name}-{seed}.json"
    if path.exists():
        return
    way = WAYS[name]
    budget = Budget(minutes=MINUTES, threads=1)
    start: Path | None = None
    told = []
    for number, (share, values) in enumerate(way.stages):
        each = seconds_of(values, args)
        steps = 3 if args.tiny else max(1, round(60 * MINUTES * share / each))
        folder = args.work / f"{name}-{seed}-{number}"
        if not converged(partial(train, values, folder, seed, ("--steps", steps), start, args, budget)):
            store(name, seed, told, None, args, budget)
            return
        told.append({"seconds": each, "steps": steps, "settings": recorded(folder)})
        start = folder
    assert start is not None
    scored = scores([str(start)], args.work / f"{name}-{seed}-scores", args.data, (LIGHT,), budget, "val")
    store(name, seed, told, next(iter(next(iter(scored.values())).values())), args, budget)


def by_the_clock(name: str, seed: int, args: argparse.Namespace) -> None:
    """Make a row of the comparison at equal time of two quiet cores, on the test clips, unless it exists."""
    path = args.out / f"{FINAL}{name}-{seed}.json"
    if path.exists():
        return
    budget = Budget(minutes=0.02, threads=1) if args.tiny else Budget(minutes=MINUTES, threads=2)
    if not args.tiny:
        wait_for_quiet()
    watch = Watch.now()
    start: Path | None = None
    for number, (share, values) in enumerate(WAYS[name].stages):
        folder = args.work / f"{FINAL}{name}-{seed}-{number}"
        train(values, folder, seed, ("--minutes", share * budget.minutes), start, args, budget)
        start = folder
    scored = scores([str(start)], args.work / f"{FINAL}{name}-{seed}-scores", args.data, (LIGHT,), budget)
    found = next(iter(next(iter(scored.values())).values()))
    history = read_json(start / "history.json")["history"] if start is not None else []
    row = {"name": name, "seed": seed, "what": WAYS[name].what, "steps": history[-1]["step"], "scores": found}
    others = watch.others()
    row |= {"budget": {"minutes": budget.minutes, "threads": budget.threads}}
    row |= {"data": args.data.name, "recipe_sha256": recipe_digest(args.data)}
    write_json(path, row | {"machine": machine(), "quiet": others is not None and others <= QUIET})
    write_page(args.out)


def store(
    name: str,
    seed: int,
    stages: list[dict[str, Any]],
    scored: dict[str, Any] | None,
    args: argparse.Namespace,
    budget: Budget,
) -> None:
    """Write a row and the page; `scored` is None for a run that diverged."""
    path = args.out / f"{name}-{seed}.json"
    row = {"quiver": VERSION, "name": name, "what": WAYS[name].what, "seed": seed, "stages": stages, "scores": scored}
    row |= {"budget": {"minutes": budget.minutes, "threads": budget.threads}}
    row |= {"data": args.data.name, "recipe_sha256": recipe_digest(args.data)}
    write_json(path, row | {"machine": machine()})
    print(f"{path}: written", flush=True)
    write_page(args.out)


def train(
    values: Values,
    folder: Path,
    seed: int,
    length: tuple[str, float],
    start: Path | None,
    args: argparse.Namespace,
    budget: Budget,
) -> None:
    """Train one stage for --steps or --minutes; a run that exists is resumed."""
    asked = {**values, **(SMALL if args.tiny else {})}
    words = [word for name, value in asked.items() for word in (f"--{name.replace('_', '-')}", as_option(value))]
    begun = [] if start is None else ["--start", str(start)]
    validated = ("--validate-every", max(1, int(length[1]) // 2)) if length[0] == "--steps" else ()
    quiver(
        *("train", args.data, "-o", folder, "--preset", NETWORK, "--device", "cpu", "--seed", seed),
        *(*length, *validated, *words, *begun, "-q"),
        budget=budget,
    )


def as_option(value: Any) -> str:
    """Return the text of a value of an option."""
    return ",".join(f"{each:g}" for each in value) if isinstance(value, tuple) else str(value)


# ---- Page


def write_page(out: Path) -> None:
    """Write the page of all rows: each way with the mean of its seeds, the best first."""
    rows = [read_json(path) for path in sorted(out.glob("*-[0-9].json")) if not path.name.startswith(FINAL)]
    if not rows:
        return
    lines = [of_way(name, own) for name in WAYS if (own := [row for row in rows if row["name"] == name])]
    lines.sort(key=lambda line: line[0], reverse=True)
    header = ("way", "settings", "steps", "seconds/step", "each seed [dB]", "mean [dB]")
    table = "\n".join(markdown_table([line[1] for line in lines], header))
    classical = out / CLASSICAL
    beside = read_json(classical)["psnr_matched"] if classical.exists() else {}
    told = "".join(f" `{name}` has {value:.2f} dB." for name, value in beside.items())
    text = f"""# How a small QUIVER learns fastest

Made by `python benchmarks/recipe_rows.py out/starter`.

Each row trains `{NETWORK}` for {MINUTES:g} minutes of one core. It states the matched PSNR of the validation clips of
`starter` at {LIGHT} photons and 3 bits. The steps are {MINUTES:g} minutes over the seconds of a step, which were
measured in one run.{told}

{table}
{by_the_clock_table(out)}
Machine: {"; ".join(sorted({row["machine"] for row in rows}))}.
"""
    write_bytes(out.with_suffix(".md"), text.encode())


def by_the_clock_table(out: Path) -> str:
    """Return the section of the comparison by the clock, empty without rows."""
    rows = [read_json(path) for path in sorted(out.glob(f"{FINAL}*.json"))]
    if not rows:
        return ""
    lines = []
    for row in rows:
        score = interval(row["scores"]["scores"]["psnr_matched"], 2)
        lines.append([starred(row), str(row["seed"]), str(row["steps"]), score])
    table = "\n".join(markdown_table(lines, ("way", "seed", "steps", "test clips [dB]")))
    return f"\n## At equal time of two cores, on scenes that chose nothing\n\n{table}\n"


def of_way(name: str, rows: list[dict[str, Any]]) -> tuple[float, list[str]]:
    """Return the mean of a way's seeds [dB], and its line of the table."""
    values = [-math.inf if row["scores"] is None else row["scores"]["scores"]["psnr_matched"]["mean"] for row in rows]
    stages = rows[0]["stages"]
    steps = " + ".join(str(stage["steps"]) for stage in stages)
    seconds = ", ".join(f"{stage['seconds']:.2f}" for stage in stages)
    mean = statistics.mean(values)
    each = ", ".join(in_decibels(value) for value in values)
    return mean, [name, WAYS[name].what, steps, seconds, each, in_decibels(mean)]


def in_decibels(value: float) -> str:
    """Return a score as text."""
    return "diverged" if value == -math.inf else f"{value:.2f}"


if __name__ == "__main__":
    sys.exit(main())
