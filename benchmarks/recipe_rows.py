"""Trains a small QUIVER in many ways for the same time, and writes one row per way and seed, and a page.

    python benchmarks/recipe_rows.py out/starter --speeds                # seconds of a step of each way, in minutes
    python benchmarks/recipe_rows.py out/starter --rows quick,long       # rows that are missing, for seeds 1 and 2
    python benchmarks/recipe_rows.py out/starter --tiny --out out/rows   # seconds for each row: a test of this program

Every row has 30 minutes of one core. That is a number of steps: the minutes over the seconds of a step, which are
measured once for all ways, in one run on quiet cores. So a row can be interrupted, and may be made beside others.
Validation clips choose the recipe. `--final` compares the best way with `quick` on the test clips.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from rows import ROOT, Budget, keep_apart, machine, quiver, recipe_digest, scores, wait_for_quiet

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
MEASURED = 3  # steps of each way, in turn
SPEEDS = "speeds.json"

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


LONG: dict[str, Any] = {"frames": 21, "batch": 1}
WAYS = {
    "quick": Way.of("today's settings: 11 frames of 64 px, 8 windows a step, Muon at 6e-3, L1 at three scales"),
    "batch-2": Way.of("2 windows a step", batch=2),
    "long-4": Way.of("21 frames, of which 11 are restored; 4 windows a step", frames=21, batch=4),
    "long-2": Way.of("the same, 2 windows a step", frames=21, batch=2),
    "long": Way.of("the same, 1 window a step", **LONG),
    "adam": Way.of("long, Adam at 1e-3", **LONG, optimiser="adam", learning_rate=1e-3),
    "adam-2": Way.of("long, Adam at 2e-3", **LONG, optimiser="adam", learning_rate=2e-3),
    "slow": Way.of("long, Muon at 3e-3", **LONG, learning_rate=3e-3),
    "fast": Way.of("long, Muon at 1.2e-2", **LONG, learning_rate=1.2e-2),
    "crop-48": Way.of("long, windows of 48 px", **LONG, crop=48),
    "crop-96": Way.of("long, windows of 96 px", **LONG, crop=96),
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
        if args.speeds:
            measure_speeds(args)
            return 0
        for seed in (int(text) for text in args.seeds.split(",")):
            for name in args.rows.split(","):
                make(name, seed, args)
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
        for values in every_stage():
            settings = settings_of(values, args, out="unused", seed=0, steps=1)
            for part in (True, False) if settings.pretraining else (False,):
                steps.setdefault(cost_key(settings, part), Step(settings, part))
        taken: dict[str, list[float]] = {key: [] for key in steps}
        for _ in range(1 if args.tiny else MEASURED):
            for key, step in steps.items():
                taken[key].append(step.seconds())
    found = {key: statistics.median(times) for key, times in taken.items()}
    write_json(args.out / SPEEDS, {"machine": machine(), "seconds": found})
    print(markdown_table(["step", "seconds"], [[key, f"{value:.2f}"] for key, value in found.items()]))


def every_stage() -> list[Values]:
    """Return the settings of all stages of all ways."""
    return [values for way in WAYS.values() for _, values in way.stages]


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
        all_values |= {"crop": 32, "batch": 1}
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
        train(values, folder, seed, steps, start, args, budget)
        told.append({"seconds": each, "steps": steps, "settings": read_json(folder / "settings.json")})
        start = folder
    assert start is not None
    scored = scores([str(start)], args.work / f"{name}-{seed}-scores", args.data, (LIGHT,), budget, "val")
    found = next(iter(next(iter(scored.values())).values()))
    row = {"quiver": VERSION, "name": name, "what": way.what, "seed": seed, "stages": told, "scores": found}
    row |= {"budget": asdict(budget), "data": args.data.name, "recipe_sha256": recipe_digest(args.data)}
    write_json(path, row | {"machine": machine()})
    print(f"{path}: written, {found['scores']['psnr_matched']['mean']:.2f} dB", flush=True)
    write_page(args.out)


def train(
    values: Values,
    folder: Path,
    seed: int,
    steps: int,
    start: Path | None,
    args: argparse.Namespace,
    budget: Budget,
) -> None:
    """Train one stage; a run that exists is resumed."""
    words = [word for name, value in values.items() for word in (f"--{name.replace('_', '-')}", as_option(value))]
    if args.tiny:
        words += ["--crop", "32", "--batch", "1"]
    begun = [] if start is None else ["--start", str(start)]
    quiver(
        *("train", args.data, "-o", folder, "--preset", NETWORK, "--device", "cpu", "--seed", seed),
        *("--steps", steps, "--validate-every", max(1, steps // 2), *words, *begun, "-q"),
        budget=budget,
    )


def as_option(value: Any) -> str:
    """Return the text of a value of an option."""
    return ",".join(f"{each:g}" for each in value) if isinstance(value, tuple) else str(value)


# ---- Page


def write_page(out: Path) -> None:
    """Write the page of all rows: each way with the mean of its seeds, the best first."""
    found = [read_json(path) for path in sorted(out.glob("*-[0-9].json"))]
    if not found:
        return
    lines = [of_way(name, rows) for name in WAYS if (rows := [row for row in found if row["name"] == name])]
    lines.sort(key=lambda line: line[0], reverse=True)
    table = markdown_table(
        ["way", "settings", "steps", "seconds/step", "each seed [dB]", "mean [dB]"], [line[1] for line in lines]
    )
    text = f"""# How a small QUIVER learns fastest

Made by `python benchmarks/recipe_rows.py out/starter`.

Each row trains `{NETWORK}` for {MINUTES:g} minutes of one core. It states the matched PSNR of the validation clips of
`starter` at {LIGHT} photons and 3 bits. The steps are {MINUTES:g} minutes over the seconds of a step, which were
measured in one run.

{table}
Machine: {"; ".join(sorted({row["machine"] for row in found}))}.
"""
    write_bytes(out.with_suffix(".md"), text.encode())


def of_way(name: str, rows: list[dict[str, Any]]) -> tuple[float, list[str]]:
    """Return the mean of a way's seeds [dB], and its line of the table."""
    values = [row["scores"]["scores"]["psnr_matched"]["mean"] for row in rows]
    stages = rows[0]["stages"]
    steps = " + ".join(str(stage["steps"]) for stage in stages)
    seconds = ", ".join(f"{stage['seconds']:.2f}" for stage in stages)
    mean = statistics.mean(values)
    each = ", ".join(f"{value:.2f}" for value in values)
    return mean, [name, WAYS[name].what, steps, seconds, each, f"{mean:.2f}"]


if __name__ == "__main__":
    sys.exit(main())
