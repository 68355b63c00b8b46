"""Trains QUIVER on clips that are rendered meanwhile, for the time that is left, and keeps its weights in small files.

The learning rate ends at the end of the run, so its steps must fit: they follow from a few timed steps of this machine.
A run that was stopped goes on in the next piece. OUT/keep/ has the curve and the best weights as float16, in parts of
at most PART bytes; `cat quiver-s.safetensors.*` joins them.
"""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

from folder import ROOT
from job import Absent, Job

NETWORK = "quiver-s"
PART = 16 << 20  # bytes
FOR_STEPS = 0.85  # share of the time that is left; the rest is for validations and for writing
TIMED = 20  # steps, after as many that are not timed
VALIDATIONS = 6


def names(sizes: Any) -> list[str]:
    """Return the one run."""
    import torch  # noqa: F401  (without it nothing is trained)

    return [NETWORK]


def measure(job: Job) -> list[dict[str, Any]]:
    """Return one row of the run; a run that is not finished resumes in the next piece."""
    import torch

    from quiver.data.rendering import Rendering
    from quiver.device import PeakMemory, pick_device
    from quiver.model.presets import build
    from quiver.training.loop import train

    sizes = job.sizes
    kind = pick_device("auto")
    if sizes.learn_on_gpu and kind != "cuda":
        raise Absent("a CPU would take days; needs CUDA")
    run = job.out / "learn" / "run"
    run.parent.mkdir(parents=True, exist_ok=True)
    recipe = ROOT / sizes.learn_recipe
    memory = PeakMemory(kind)
    stopped: list[bool] = []

    def should_stop() -> bool:
        stopped.append(job.is_over())
        return stopped[-1]

    with Rendering(str(recipe), job.out / "learn" / recipe.stem, "val") as rendering:
        rendering.wait()
        steps = _steps(job, run, rendering, kind)
        settings = _settings(job, run, rendering, steps)
        torch.manual_seed(settings.seed)
        state = train(
            build(NETWORK), settings, device=kind, should_stop=should_stop, progress=False, rendering=rendering
        )
        clips = len(json.loads((run / "schedule.json").read_text())["clips"])
    job.stopped = not state.finished
    keep(run, job.out / "keep")
    return [
        {
            "network": NETWORK,
            "device": kind,
            "steps": f"{state.step} of {steps}",
            "windows seen": state.step * settings.batch,
            "frames restored per window": settings.frames - 10,
            "minutes": state.elapsed / 60,
            "clips rendered": clips,
            "best PSNR matched [dB]": state.best if state.history else None,
            "peak memory [MB]": memory.bytes() / 1e6,
        }
    ]


def _settings(job: Job, run: Path, rendering: Any, steps: int, **more: Any) -> Any:
    """Return the settings of the run."""
    from quiver.training.settings import PROTOCOLS, Settings

    sizes = job.sizes
    given = {"frames": sizes.learn_frames, "batch": sizes.learn_batch, "precision": sizes.learn_precision}
    given |= {"steps": steps, "validate_every": max(1, steps // VALIDATIONS)}
    given |= {} if sizes.crop is None else {"crop": sizes.crop}
    return Settings(
        **dict(PROTOCOLS["quick"]) | {"data": str(rendering.folder), "out": str(run)} | given | more, network=NETWORK
    )


def _steps(job: Job, run: Path, rendering: Any, kind: str) -> int:
    """Return the steps of the run: those of its first piece, else as many as fit into the time that is left."""
    begun = run / "settings.json"
    if begun.is_file():
        return int(json.loads(begun.read_text())["steps"])
    import torch

    from quiver.model.presets import build
    from quiver.training.loop import train

    place = run.with_name("timed")
    shutil.rmtree(place, ignore_errors=True)
    ends: list[float] = []

    def note() -> bool:
        ends.append(time.perf_counter())
        return False

    count = min(2 * TIMED, job.sizes.steps)
    torch.manual_seed(0)
    settings = _settings(job, place, rendering, count, validation_windows=1)
    train(build(NETWORK), settings, device=kind, should_stop=note, progress=False, rendering=rendering)
    shutil.rmtree(place)
    half = len(ends) // 2
    each = (ends[-1] - ends[half]) / max(1, len(ends) - 1 - half)
    left = job.end - time.monotonic()
    return max(count, min(int(FOR_STEPS * left / max(each, 1e-9)), job.sizes.learn_steps))


def keep(run: Path, folder: Path) -> None:
    """Copy the curve of a run, and its best weights as float16 in parts that are small enough to travel."""
    from quiver.model import weights

    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    best = run / "best.safetensors"
    if not best.is_file():
        return
    content = weights.halved(best)
    for number, start in enumerate(range(0, len(content), PART)):
        (folder / f"{NETWORK}.safetensors.{number:02}").write_bytes(content[start : start + PART])
    for name in ("history.json", "schedule.json"):
        shutil.copy(run / name, folder)
