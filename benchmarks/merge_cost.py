"""Times merging in batches beside the plain program that it is tested against, in turn and in one run.

    python benchmarks/merge_cost.py                  # docs/results/merge_cost.md; about four minutes of quiet cores
    python benchmarks/merge_cost.py --threads 1

The plain program (tests/support/merge_reference.py) merges one window at a time in NumPy and torch. Both get the same
codes: a photograph that slides by 2 px/frame, 3 bits, 3.25 PPP. Of a stream each frame is read once; a training window
is merged from all of its eleven frames. The restored frames also pass the network that ships, and return to photons.
Runs alternate, and the first ones are not counted. Seconds are those of the processor, of all threads.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np
import result_page
import rows
import torch
from numpy import ndarray as Array
from skimage import data

from qsim.files import write_bytes
from qsim.keys import Key
from qsim.sensor.devices import quiver_physical
from qsim.tables import markdown_table
from quiver.baselines import path_merge
from quiver.baselines.domain_tables import domain_tables
from quiver.baselines.information_domain import information_domain
from quiver.model.weights import load
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.merge_inputs import merge_inputs
from quiver.restoration.merging import corrected
from quiver.restoration.restorers import PRETRAINED

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "support"))

import merge_reference as plain  # type: ignore[import-not-found]  # noqa: E402  (tests are not a package)

WINDOW = 11
STREAM = 4  # frames of a stream that are counted in one run, after those that fill its window
EXPOSURE = 5e-4
SENSOR = quiver_physical(3.25)


def codes_of(height: int, width: int, frames: int) -> Array:
    """Return codes [T, H, W] of the photograph."""
    picture = np.hstack([data.camera().astype(float)] * 2)[:height, :width]
    photons = np.stack([np.roll(picture, 2 * t, axis=1) for t in range(frames)]) * (3.25 / picture.mean())
    codes: Array = SENSOR.sample(photons, EXPOSURE, key=Key(0, 0))
    return codes


def streams(codes: Array) -> dict[str, Callable[[], float]]:
    """Return functions of both programs: the seconds of one frame of a stream, merged and made the network's inputs."""
    domain = information_domain(SENSOR, EXPOSURE)
    tables = domain_tables(domain, torch.device("cpu"))

    def seconds(stream: Callable[..., object], inputs: Callable[..., object]) -> float:
        frames = range(WINDOW // 2, WINDOW // 2 + STREAM + 1)
        merged = iter(stream(lambda t: codes[t], len(codes), domain, WINDOW, frames))  # type: ignore[call-overload]
        inputs(next(merged))
        started = time.process_time()
        for each in merged:
            inputs(each)
        return (time.process_time() - started) / STREAM

    return {
        "plain": partial(seconds, plain.stream, lambda merged: plain.merge_inputs(merged, domain)),
        "batches": partial(seconds, path_merge.stream, lambda merged: merge_inputs(merged, tables)),
    }


def restored(codes: Array) -> dict[str, Callable[[], float]]:
    """Return functions of both programs: the seconds of one restored frame of a stream, the network included."""
    network = load(PRETRAINED / "mergenet.safetensors").eval()
    domain = information_domain(SENSOR, EXPOSURE)
    tables = domain_tables(domain, torch.device("cpu"))

    def by_plain() -> float:
        merged = iter(plain.stream(lambda t: codes[t], len(codes), domain, WINDOW, range(5, 7)))
        next(merged)
        started = time.process_time()
        inputs = plain.merge_inputs(next(merged), domain)
        with torch.inference_mode():
            correction = network(inputs.channels[None])[0, 0]
        domain.inverse((inputs.phi + inputs.deviation * correction).numpy())
        return time.process_time() - started

    def by_batches() -> float:
        merged = path_merge.stream(lambda t: codes[t], len(codes), domain, WINDOW, range(5, 7))
        next(merged)
        started = time.process_time()
        corrected(network, next(merged), tables, RestoreOptions(device="cpu"))
        return time.process_time() - started

    return {"plain": by_plain, "batches": by_batches}


def windows(codes: Array) -> dict[str, Callable[[], float]]:
    """Return functions of both programs: the seconds of one training window."""
    domain = information_domain(SENSOR, EXPOSURE)
    tables = domain_tables(domain, torch.device("cpu"))
    middle = range(WINDOW // 2, WINDOW // 2 + 1)

    def seconds(stream: Callable[..., object], inputs: Callable[..., object]) -> float:
        started = time.process_time()
        inputs(next(iter(stream(lambda t: codes[t], WINDOW, domain, WINDOW, middle))))  # type: ignore[call-overload]
        return time.process_time() - started

    return {
        "plain": partial(seconds, plain.stream, lambda merged: plain.merge_inputs(merged, domain)),
        "batches": partial(seconds, path_merge.stream, lambda merged: merge_inputs(merged, tables)),
    }


def measured(programs: dict[str, Callable[[], float]], runs: int) -> dict[str, list[float]]:
    """Return the seconds of the counted runs of both programs, in turn."""
    found: dict[str, list[float]] = {name: [] for name in programs}
    for turn in range(runs + 1):
        for name, program in programs.items():
            seconds = program()
            if turn:
                found[name].append(seconds)
    return found


def page(found: dict[str, dict[str, list[float]]], threads: int, busy: bool) -> str:
    """Return the page of all that was measured."""
    table = []
    for what, both in found.items():
        before, after = (median(both[name]) for name in ("plain", "batches"))
        table.append((what, _shown(before), _shown(after), f"{before / after:.2f}"))
    text = result_page.head("What merging costs", "merge_cost.py", f" with {threads} thread{'s' * (threads > 1)}")
    text += [
        "Medians of processor time, both programs in turn; the ratio is that of the medians. The plain program looks "
        "for no camera.",
        "",
    ]
    text += [*markdown_table(table, ("what", "one by one [ms]", "in batches [ms]", "ratio")), ""]
    text += [f"Machine: {rows.machine()}.", "", *(["Measured beside other programs.", ""] if busy else [])]
    return "\n".join(text)


def _shown(seconds: float) -> str:
    return f"{1000 * seconds:.0f}"


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5, help="counted runs of each program (default 5)")
    parser.add_argument("--threads", type=int, default=2, help="threads of torch (default 2)")
    parser.add_argument("--height", type=int, default=512, help="rows of the stream, 512 at most (default)")
    parser.add_argument("--busy", action="store_true", help="measure beside other programs; the page says so")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "merge_cost.md", help="page")
    args = parser.parse_args(words)
    if args.runs < 1 or args.threads < 1 or not 16 <= args.height <= 512:
        print("merge_cost: give --runs and --threads of at least 1, and --height from 16 to 512", file=sys.stderr)
        return 2
    if not args.busy:
        rows.wait_for_quiet()
    torch.set_num_threads(args.threads)
    height = args.height
    width = 2 * height
    codes = codes_of(height, width, WINDOW + STREAM)
    found = {
        f"a frame of {height} x {width} of a stream: merged, and inputs": measured(streams(codes), args.runs),
        f"a restored frame of {height} x {width}: those, network and photons": measured(restored(codes), args.runs),
    }
    for side in (64, 96):
        window = codes_of(side, side, WINDOW)
        found[f"a training window of 11 x {side} x {side}"] = measured(windows(window), 4 * args.runs)
    text = page(found, args.threads, args.busy)
    write_bytes(args.out, text.encode())
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
