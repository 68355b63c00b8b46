"""Measures training: a data set rendered on the spot, the ways of copying batches, and every network."""

from __future__ import annotations

import itertools
import os
import time
from statistics import median
from typing import Any

from folder import read, read_record, write
from job import Absent, Job
from sizes import Sizes

PRECISIONS = ("float32", "bfloat16")
PUBLISHED = ("quiver", "quiver-s")  # trained as their authors did; others by the defaults
COPIED = "quiver-s"  # the network whose batches are copied in all ways

RECIPE = """[recipe]
name = "gpu"
frames = {frames}
height = {height}
width = {width}
frame_rate = 2000.0
psnr = {psnr}
{scenes}
[[streams]]
sensor = "quiver-physical"
bits = 3
ppp = 3.25
"""
SCENES = """
[[scenes]]
family = "{family}"
seeds = {seeds}
speed = 4.0
split = "{split}"
"""


def names(sizes: Sizes) -> list[str]:
    """Return the data set, the copies, and a run for each network of the project and precision."""
    return ["data", "copies", *(f"{network}-{precision}" for network in networks() for precision in PRECISIONS)]


def networks() -> list[str]:
    """Return the networks that are trained here: those of the paper and ours, not the compared ones (rivals/)."""
    import torch  # noqa: F401  (without it nothing is trained, and no data are rendered for it)

    from quiver.model.names import PRESETS

    ours = [name for name, preset in PRESETS.items() if not preset.home.startswith("rivals.")]
    return sorted(ours, key=lambda name: (name != COPIED, name in PUBLISHED, name))


def measure(job: Job) -> list[dict[str, Any]]:
    """Return the rows of a measurement; a data set or run that is not finished resumes in the next piece."""
    if job.name == "data":
        return _data(job)
    check_data(job)
    if job.name == "copies":
        return _copies(job)
    network, _, precision = job.name.rpartition("-")
    return _run(job, network, precision)


def check_data(job: Job) -> None:
    """Raise `Absent` with the state of the data set unless it is complete: a part of it would train other weights."""
    made = read_record(job.out / "train" / "data.json") or {"state": "absent"}
    if made["state"] != "done":
        why = made.get("why") or "it is not complete"
        raise Absent(f"needs the data set, see train/data: {why}", made["state"])


class _Over(Exception):
    """The time of the measurement is over."""


def _data(job: Job) -> list[dict[str, Any]]:
    """Return the seconds per rendered frame of the data set, clip after clip in this process."""
    from qsim import backend
    from qsim.dataset import generation, recipe

    sizes = job.sizes
    spent = job.out / "data-seconds.json"
    last = time.perf_counter()
    parts = [(family, list(range(sizes.train_seeds)), "train") for family in sizes.train_families]
    parts.append((sizes.train_families[0], [sizes.train_seeds], "val"))
    scenes = "".join(SCENES.format(family=family, seeds=seeds, split=split) for family, seeds, split in parts)
    text = RECIPE.format(
        frames=sizes.train_frames,
        psnr=sizes.train_psnr,
        height=sizes.train_height,
        width=sizes.train_width,
        scenes=scenes,
    )
    seconds = read(spent) or {}  # of clips that earlier pieces made

    def note(result: Any) -> None:
        nonlocal last
        if result.state == "done":
            seconds[result.name] = time.perf_counter() - last
            last = time.perf_counter()
            write(spent, seconds)
        if job.is_over():
            raise _Over

    job.out.joinpath("data").mkdir(exist_ok=True)
    options = generation.Options(workers=0, retry=True)
    try:
        summary = generation.generate(recipe.parse(text), job.out / "data", options, on_result=note)
    except _Over:
        summary = None
    if summary is not None:
        job.stopped = False
        if summary.failed:
            name, why = next(iter(summary.failed.items()))
            raise RuntimeError(f"{len(summary.failed)} clips failed; {name}: {why}")
    each = median([value for value in seconds.values() if isinstance(value, float)] or [float("nan")])
    engine = backend.choose().backend
    frames = sizes.train_frames
    row = {
        "data set": f"{sizes.train_height} x {sizes.train_width}, {sizes.train_psnr:g} dB",
        "engine": engine,
        "clips": len(seconds),
    }
    return [row | {"s per clip": each, "frames per s": frames / each}]


def _settings(job: Job, network: str, precision: str) -> Any:
    """Return the settings of a run: the protocol of the network, with the sizes of this measurement."""
    from quiver.training.settings import Settings
    from quiver.training.system import protocol
    from quiver.training.systems import system_named

    sizes = job.sizes
    defaults = protocol(system_named(network), "published" if network in PUBLISHED else "quick")
    given = {"steps": sizes.steps, "validate_every": sizes.steps, "validation_windows": 4, "precision": precision}
    given |= {name: value for name, value in (("crop", sizes.crop), ("batch", sizes.batch)) if value is not None}
    folders = {"data": str(job.out / "data"), "out": str(job.out / "runs" / job.name), "network": network}
    return Settings(**dict(defaults) | folders | given)


def _workers(sizes: Sizes) -> int:
    """Return how many processes draw the batches that are copied: where the GPU computes, cores are free for them."""
    import torch

    return min(sizes.workers, len(os.sched_getaffinity(0)) - 1) if torch.cuda.is_available() else 0


def _run(job: Job, network: str, precision: str) -> list[dict[str, Any]]:
    """Return the steps per second of a run, which resumes from its folder in OUT/runs."""
    import torch

    from quiver.device import PeakMemory, pick_device
    from quiver.model.presets import build
    from quiver.training.loop import train

    settings = _settings(job, network, precision)
    kind = pick_device("auto")
    ends = [time.perf_counter()]

    def should_stop() -> bool:
        ends.append(time.perf_counter())
        return job.is_over()

    torch.manual_seed(settings.seed)
    memory = PeakMemory(kind)
    (job.out / "runs").mkdir(exist_ok=True)
    state = train(build(network), settings, device=kind, should_stop=should_stop, progress=False)
    job.stopped = not state.finished
    steps = [b - a for a, b in itertools.pairwise(ends[1:])]
    rate = 1 / median(steps) if steps else state.step / max(state.elapsed, 1e-9)
    return [
        {
            "network": network,
            "precision": precision,
            "device": kind,
            "crop": settings.crop,
            "batch": settings.batch,
            "steps": state.step,
            "steps per s": rate,
            "steps per s with validation": state.step / max(state.elapsed, 1e-9),
            "PSNR matched [dB]": state.history[-1]["psnr_matched"] if state.history else None,
            "peak memory [MB]": memory.bytes() / 1e6 if steps else None,  # not where the run was finished before
        }
    ]


def _copies(job: Job) -> list[dict[str, Any]]:
    """Return batches per second for every way of copying: pinned or not, waiting or not; and without any copy."""
    import torch
    from torch.utils.data import DataLoader

    from quiver import threads
    from quiver.data.windows import Batches
    from quiver.device import pick_device
    from quiver.model.presets import build
    from quiver.training.loop import make_windows
    from quiver.training.settings import settled

    settings, _ = settled(_settings(job, COPIED, "bfloat16"))
    workers = _workers(job.sizes)
    threads.use()
    place = torch.device(pick_device("auto"))
    model = build(COPIED).to(place).train()
    windows, _ = make_windows(settings, int(model.multiple))
    held: dict[str, torch.Tensor] = {}

    def seconds(pinned: bool, waiting: bool, copied: bool) -> float:
        loader = DataLoader(
            windows,
            batch_sampler=Batches(settings.batch, 0, job.sizes.copied_batches),
            pin_memory=pinned,
            num_workers=workers,
            multiprocessing_context="spawn" if workers else None,
        )
        ends = []
        for batch in loader if copied else [held] * job.sizes.copied_batches:
            moved = {name: batch[name].to(place, non_blocking=not waiting) for name in ("codes", "target")}
            held.update(moved)
            with torch.autocast(place.type, torch.bfloat16, enabled=place.type == "cuda"):
                output = model(moved["codes"]).scale1
            torch.nn.functional.mse_loss(output.float(), output.detach().float() * 0).backward()
            model.zero_grad(set_to_none=True)
            if place.type == "cuda":
                torch.cuda.synchronize()
            ends.append(time.perf_counter())
        return (ends[-1] - ends[0]) / (len(ends) - 1)

    ways = [("pageable, waiting", (False, True, True)), ("none: one batch stays on the device", (False, True, False))]
    if place.type == "cuda":
        ways[1:1] = [
            ("pageable, not waiting", (False, False, True)),
            ("pinned, waiting", (True, True, True)),
            ("pinned, not waiting (what training does)", (True, False, True)),
        ]
    return [
        {
            "copies of batches": name,
            "device": place.type,
            "workers": workers,
            "batches per s": 1 / seconds(*way),
        }
        for name, way in ways
    ]
