"""Shares what programs of stored rows need: commands, the machine, and whether its cores were quiet.

    python benchmarks/rows.py     # the speed of the reference convolution, and how many cores other programs use now

Rows of a table compare networks by what they learn in a fixed time. A row that was made beside other programs got less,
so busy cores are refused before a row begins, and a row states how many cores others used while it was made.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from qsim.files import VERSION, read_json, sha256, to_json, write_bytes, write_json
from quiver.cli.train import DIVERGED

ROOT = Path(__file__).parents[1]
LIGHTS = ("3.25", "1", "9.75", "26")  # photons per pixel; training is at the first
QUIET = 0.1  # cores that other programs may use
WATCH = 3.0  # s, before a row begins
PATIENCE = 300.0  # s, for which a row waits for quiet cores
REFERENCE_RUNS = 20


@dataclass(frozen=True)
class Budget:
    """What every row gets."""

    minutes: float = 30.0
    trial_minutes: float = 5.0
    threads: int = 2
    crop: int = 80  # px; a multiple of 16
    batch: int = 2  # the published RVRT takes 8 GB a window; more windows leave slow networks too few steps
    size: str = "128x128"  # of the frames whose cost is measured

    def length(self, *, trial: bool = False) -> tuple[object, ...]:
        """Return the options of `quiver train` for where a run or a trial is made, and how long."""
        return ("--device", "cpu", "--minutes", self.trial_minutes if trial else self.minutes)


TINY = Budget(minutes=0.02, trial_minutes=0.01, threads=1, crop=32, batch=2, size="32x32")


# ---- The machine


@dataclass(frozen=True)
class Watch:
    """Processor time at one moment [s]."""

    wall: float
    everybody: float | None  # of all programs since the machine started; None: the system does not state it
    ours: float  # of this process and of its children that have ended

    @classmethod
    def now(cls) -> Watch:
        """Return the times of this moment."""
        return cls(time.monotonic(), everybodys_seconds(), sum(os.times()[:4]))

    def others(self) -> float | None:
        """Return how many cores other programs used since then; None where the system does not state it."""
        now = Watch.now()
        if now.everybody is None or self.everybody is None:
            return None
        others = now.everybody - self.everybody - (now.ours - self.ours)
        return max(0.0, others / max(now.wall - self.wall, 1e-9))


def everybodys_seconds() -> float | None:
    """Return the processor seconds of all programs since the machine started, from Linux's /proc/stat."""
    try:
        words = Path("/proc/stat").read_text().split("\n", 1)[0].split()
        user, nice, system, _idle, _waiting, interrupts, soft = (int(word) for word in words[1:8])
    except (OSError, ValueError):
        return None
    return (user + nice + system + interrupts + soft) / os.sysconf("SC_CLK_TCK")


def wait_for_quiet() -> None:
    """Wait until other programs use at most QUIET cores; `ValueError` if they still use more after PATIENCE."""
    started = time.monotonic()
    told = False
    while True:
        watch = Watch.now()
        time.sleep(WATCH)
        others = watch.others()
        if others is None or others <= QUIET:
            return
        if time.monotonic() - started > PATIENCE:
            raise ValueError(
                f"other programs use {others:.1f} cores, and a row needs quiet ones: at most {QUIET}; stop them, or "
                "give --busy for rows that are marked"
            )
        if not told:
            print(f"other programs use {others:.1f} cores; waiting up to {PATIENCE:.0f} s for quiet ones", flush=True)
            told = True


def machine() -> str:
    """Return system, processor, version of torch, and the GPU if there is one."""
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{platform.system()} {platform.machine()}, {processor()}, torch {torch.__version__}{gpu}"


def processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.processor())


def is_made(path: Path, plan: Any) -> bool:
    """Return whether a row that `store` wrote exists; `ValueError` if it was made with another plan."""
    if not path.exists():
        return False
    if read_json(path)["plan"] != json.loads(json.dumps(vars(plan))):
        raise ValueError(f"{path}: was made with other options; choose another --out")
    return True


def grow(
    path: Path,
    plan: Any,
    make: Callable[[], dict[str, Any]],
    page: Callable[[dict[str, Any]], str],
    *,
    busy: bool,
    marked_again: bool = False,
) -> None:
    """Write a row unless it exists, then the page of all rows beside it, from their contents by name.

    With `marked_again`, a row that was made beside other programs is made again where the cores must be quiet.
    `ValueError` as `is_made` and, unless `busy`, as `wait_for_quiet`.
    """
    if not is_made(path, plan) or (marked_again and not busy and not read_json(path)["quiet"]):
        if not busy:
            wait_for_quiet()
        watch = Watch.now()
        store(path, plan, watch, make())
    rows = {row.stem: read_json(row) for row in sorted(path.parent.glob("*.json"))}
    write_bytes(path.parent.with_suffix(".md"), page(rows).encode())


def store(path: Path, plan: Any, watch: Watch, row: dict[str, Any]) -> None:
    """Write a row with its plan (a record), the processor, and whether the cores were quiet since `watch`."""
    others = watch.others()
    quiet = others is not None and others <= QUIET
    write_json(path, {"plan": vars(plan), "processor": processor(), "quiet": quiet, **row})
    print(f"{path}: written", flush=True)


def reference_convolution(threads: int) -> float:
    """Return the milliseconds of a 3 x 3 convolution of 64 channels at 128 x 128 px: the least of twenty."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    layer = torch.nn.Conv2d(64, 64, 3, padding=1)
    image = torch.zeros(1, 64, 128, 128)
    taken = []
    with torch.inference_mode():
        for _ in range(REFERENCE_RUNS):
            started = time.perf_counter()
            layer(image)
            taken.append(time.perf_counter() - started)
    torch.set_num_threads(before)
    return 1000 * min(taken)


# ---- Rows


def make_row(
    path: Path, budget: Budget, data: Path, make: Callable[[], dict[str, Any]], *, busy: bool, sessions: Path
) -> None:
    """Write one row, unless it exists. `make` returns what is its own; the rest is budget, machine and its speed.

    `ValueError` if it exists with another budget or data set, and on busy cores unless `busy`; `FileNotFoundError`
    without the data set. A row states the cores that others used, and the convolution before and after. The file
    `sessions` holds the cores that others used in every session that worked on the row: a row that was resumed is as
    quiet as the loudest of them, and not quiet if one was killed, whose load is not known.
    """
    if path.exists():
        check_row(path, budget, data)
        return
    if not data.is_dir():
        raise FileNotFoundError(f"{data}: no such data set")
    if not busy:
        wait_for_quiet()
    earlier = read_json(sessions)["cores_of_others"] if sessions.exists() else []
    sessions.parent.mkdir(parents=True, exist_ok=True)
    write_json(sessions, {"cores_of_others": [*earlier, None]})  # until this session ends
    watch = Watch.now()
    before = reference_convolution(budget.threads)
    try:
        own = make()
    finally:
        loads = [*earlier, watch.others()]
        write_json(sessions, {"cores_of_others": loads})
    others = None if None in loads else max(loads)
    row = {
        "quiver": VERSION,
        "budget": asdict(budget),
        "data": data.name,
        "recipe_sha256": recipe_digest(data),
        "machine": machine(),
        "reference_convolution_ms": [before, reference_convolution(budget.threads)],
        "cores_of_others": others,
        "quiet": others is not None and others <= QUIET,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, row | own)
    used = "an unknown number of" if others is None else f"{others:.1f}"
    print(f"{path}: written{'' if row['quiet'] else f', marked: other programs used {used} cores'}", flush=True)


def check_row(path: Path, budget: Budget, data: Path) -> None:
    """Raise `ValueError` if a row was made with another budget or on another data set.

    `FileNotFoundError` if there is no such data set.
    """
    found = read_json(path)
    wanted = {"budget": asdict(budget), "data": data.name, "recipe_sha256": recipe_digest(data)}
    for name, value in wanted.items():
        if found.get(name) != value:
            if name == "recipe_sha256" and not data.is_dir():
                raise FileNotFoundError(f"{data}: no such data set")
            raise ValueError(f"{path}: was made with {name} {found.get(name)}; now it is {value}; choose another --out")


def recipe_digest(data: Path) -> str | None:
    """Return the SHA-256 of the recipe of a data set: machines of other kinds give it other last bits of radiance."""
    path = data / "dataset.json"
    return sha256(to_json(read_json(path)["recipe"])) if path.exists() else None


def starred(row: dict[str, Any], name: object = None) -> str:
    """Return the name of a row, or what stands for it; a star marks one that was made beside other programs."""
    return str(row["name"] if name is None else name) + ("" if row["quiet"] else r"\*")


def missing_rows(names: Iterable[str], rows: list[dict[str, Any]]) -> list[str]:
    """Return lines below a table that name the rows that are not made yet; none if all are."""
    missing = ", ".join(name for name in names if name not in {row["name"] for row in rows})
    return [f"Rows that are not made yet: {missing}.", ""] if missing else []


def notes_on(rows: list[dict[str, Any]]) -> list[str]:
    """Return lines below a table: which rows were made beside other programs, the machines and their speed if known."""
    loud = [row["name"] for row in rows if not row["quiet"]]
    threads = [(row.get("budget") or row["plan"])["threads"] for row in rows]
    machines = sorted({f"{row['machine']}, {count} threads" for row, count in zip(rows, threads, strict=True)})
    speeds = [speed for row in rows for speed in row.get("reference_convolution_ms", ())]
    text = [f"\\* made beside other programs: {', '.join(loud)}.", ""] if loud else []
    span = f" Reference convolution: {min(speeds):.2f} to {max(speeds):.2f} ms." if speeds else ""
    return [*text, f"Machine: {'; '.join(machines)}.{span}", ""]


# ---- Commands


def options(text: str | None, folder: str, names: Iterable[str]) -> argparse.ArgumentParser:
    """Return the options of a program whose rows are networks; `folder` holds the rows and, elsewhere, the runs."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="data set with splits train, val and test")
    parser.add_argument("--rows", default=",".join(names), help="comma-separated (default all)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / folder, help="folder of the rows")
    parser.add_argument("--work", type=Path, help=f"folder of runs, which can be deleted (default out/{folder})")
    parser.add_argument("--tiny", action="store_true", help="seconds for each row, on tiny crops and any cores")
    parser.add_argument("--busy", action="store_true", help="make rows on busy cores too, and mark them")
    return parser


def restorer_options(text: str | None, folder: str, data: dict[str, str]) -> argparse.ArgumentParser:
    """Return the options of a program whose rows train the restorer on `data`: names of data sets, each with its help.

    `folder` holds the rows and, elsewhere, what they are made of.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, what in data.items():
        parser.add_argument(name, type=Path, help=what)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / folder, help="folder of the rows")
    parser.add_argument("--work", type=Path, help=f"windows and runs, which can be deleted (default out/{folder})")
    parser.add_argument("--workers", type=int, default=2, help="processes that draw windows (default 2)")
    parser.add_argument("--tiny", action="store_true", help="seconds for each row, on tiny windows")
    return parser


def keep_apart(folder: str, out: Path, work: Path | None = None, *, trial: bool) -> Path:
    """Return the folder of runs, another for trial rows; `ValueError` if these would stand on the page."""
    if trial and out == ROOT / "docs" / "results" / folder:
        raise ValueError("trial rows do not belong on the page; give --out")
    return work or Path("out") / (f"{folder}_trial" if trial else folder)


def quiver(*words: object, budget: Budget, problems: bool = False) -> None:
    """Print and run one command of `quiver` in its own process; `CalledProcessError` if it fails.

    With `problems`, exit code 1 is no failure: the command finished, and its results state what failed.
    """
    line = [str(word) for word in (*words, "--threads", budget.threads)]
    print(f"\n$ quiver {shlex.join(line)}", flush=True)
    done = subprocess.run([sys.executable, "-m", "quiver", *line], check=False)
    if not (problems and done.returncode == 1):
        done.check_returncode()


def scores(
    methods: list[str], folder: Path, data: Path, lights: tuple[str, ...], budget: Budget, split: str = "test"
) -> dict[str, Any]:
    """Return the scores on the clips of a split by method and light."""
    quiver(
        *("evaluate", data, "-o", folder, "--methods", ",".join(methods), "--ppp", ",".join(lights)),
        *("--split", split, "-q"),
        budget=budget,
        problems=True,
    )
    found: dict[str, Any] = {}
    for line in read_json(folder / "evaluation.json")["table"]:
        found.setdefault(line["method"], {})[line["light"]] = kept_scores(line)
    return found


def best_rate(trials: dict[str, dict[str, Any]]) -> str:
    """Return the rate whose trial has the highest PSNR; trials without one, which diverged, are last."""
    return max(trials, key=lambda rate: -math.inf if trials[rate]["psnr"] is None else trials[rate]["psnr"])


def settings_of(folder: Path) -> dict[str, Any]:
    """Return the settings of a run; of folders the names alone, as their places are those of one machine."""
    found: dict[str, Any] = read_json(folder / "settings.json")
    data = found["data"] if isinstance(found["data"], list) else [found["data"]]
    return found | {"data": [Path(name).name for name in data], "out": Path(found["out"]).name}


def converged(run: Callable[[], None]) -> bool:
    """Run a training; return False if it diverged. Other failures are raised: `CalledProcessError`."""
    try:
        run()
    except subprocess.CalledProcessError as failed:
        if failed.returncode != DIVERGED:
            raise
        return False
    return True


def cost(method: str, folder: Path, budget: Budget) -> dict[str, Any]:
    """Return seconds, memory and multiply-accumulates per frame; of QUIVER those of the first mode, exact."""
    again = ["--force"] if (folder / "bench.json").exists() else []
    words = ("--methods", method, "--device", "cpu", "--size", budget.size, "-o", folder, *again, "-q")
    quiver("bench", *words, budget=budget)
    found: dict[str, Any] = read_json(folder / "bench.json")["costs"][0]
    height, width = (int(side) for side in budget.size.split("x"))
    return found | {"restoring_macs_per_pixel": 1e9 * (found["gmac_per_frame"] or math.nan) / (height * width)}


def kept_scores(line: dict[str, Any]) -> dict[str, Any]:
    """Return what a row keeps of a line of an evaluation's table."""
    kept = ("scores", "psnr_by_motion", "psnr_matched_per_frame", "seconds_per_frame", "failures")
    return {key: line[key] for key in kept}


def interval(found: dict[str, Any], digits: int) -> str:
    """Return a mean with its half-width as text."""
    if found["mean"] is None:
        return "n/a"
    half = "" if found["half_width"] is None else f" ± {found['half_width']:.{digits}f}"
    return f"{float(found['mean']):.{digits}f}{half}"  # "inf" is text in JSON


if __name__ == "__main__":
    started = Watch.now()
    time.sleep(WATCH)
    others = started.others()
    print(f"reference convolution on two threads: {reference_convolution(2):.2f} ms")
    print("cores of other programs: " + ("not stated by this system" if others is None else f"{others:.2f}"))
