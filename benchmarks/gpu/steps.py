"""Measures the steps of a training alone: by size of batch, compiled or not, and the share that drawing windows takes.

Light is a moving pattern, written on the spot. Multiply-adds are counted by the tool of `quiver bench`; a step takes
three times those of its forward pass. The peak is what products of square matrices reach in the same precision.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median
from typing import Any

from job import Job

NETWORK = "quiver-s"
WARM = 2  # steps that are not timed, after those that compile


def names(sizes: Any) -> list[str]:
    """Return a measurement for each precision and length of windows, one for torch.compile, and one for windows."""
    import torch  # noqa: F401  (without it nothing is trained)

    lengths = [f"batches-{frames}-{precision}" for precision in _precisions() for frames in sizes.step_frames]
    return ["windows", "operators", *lengths, "compiled"]


def _precisions() -> tuple[str, ...]:
    """Return the precisions, the default of the device first."""
    from quiver.device import pick_device

    return ("bfloat16", "float32") if pick_device("auto") == "cuda" else ("float32",)


def measure(job: Job) -> list[dict[str, Any]]:
    """Return the rows of a measurement."""
    if job.name == "windows":
        return _windows(job)
    if job.name == "operators":
        return _operators(job)
    if job.name == "compiled":
        batch = job.sizes.compiled_batch
        frames = job.sizes.step_frames[-1]
        return [_row(job, batch, frames, compile=kind) for kind in job.sizes.compiled]
    _, frames, precision = job.name.split("-")
    rows = []
    for batch in job.sizes.step_batches:
        row = _row(job, batch, int(frames), precision=precision)
        rows.append(row)
        if row["steps per s"] is None:  # memory is exhausted, and larger batches need more
            break
    return rows


class _Bench:
    """A trainer of NETWORK with random weights, and its windows."""

    def __init__(self, job: Job, batch: int, frames: int, **settings: Any) -> None:
        import torch

        from quiver.data.windows import Windows, WindowSettings
        from quiver.device import pick_device
        from quiver.model.presets import build
        from quiver.training.loop import Trainer
        from quiver.training.processes import Process
        from quiver.training.run_folder import Run
        from quiver.training.settings import PROTOCOLS, Settings
        from quiver.training.systems import system_of

        self.place = torch.device(pick_device("auto"))
        sizes = job.sizes
        given = {"steps": 10**9, "crop": sizes.step_crop, "batch": batch, "frames": frames, "optimiser": "muon"}
        asked = Settings("none", str(job.out / "none"), NETWORK, **PROTOCOLS["quick"] | given | settings)
        self.said: list[str] = []
        torch.manual_seed(0)
        network = build(NETWORK)
        self.process = Process(0, 1, self.place)
        self.trainer = Trainer(network, Run(asked), None, self.process, system_of(network), self.said.append)
        window = WindowSettings(crop=sizes.step_crop, frames=frames, drift=asked.drift)
        self.windows = Windows(clips_of_pattern(job), window)
        self.settings = asked

    def seconds(self, step: Callable[[], None], count: int) -> float:
        """Return the median of the seconds of a step, of rounds of `count` steps that the device finishes."""
        from quiver.device import wait
        from quiver.host import flushed_denormals

        found = []
        with flushed_denormals():  # as in a training
            for _ in range(WARM):
                step()
            for _ in range(3):
                wait(self.place)
                began = time.perf_counter()
                for _ in range(count):
                    step()
                wait(self.place)
                found.append((time.perf_counter() - began) / count)
        return median(found)

    def batch(self) -> dict[str, Any]:
        """Return a batch on the device."""
        from torch.utils.data import default_collate

        from quiver.training.loop import on_device

        return dict(on_device(default_collate([self.windows[n] for n in range(self.settings.batch)]), self.place))


def clips_of_pattern(job: Job) -> list[Any]:
    """Return the clips of a moving pattern, written if they are missing."""
    import numpy as np

    from qsim import Camera, Clip, ClipWriter

    sizes = job.sizes
    height = sizes.step_height
    width = sizes.step_width
    frames = max(sizes.step_frames) + 4
    t, y, x = np.ogrid[:frames, :height, :width]
    found = []
    for seed in range(2):
        path = Path(job.out / f"pattern-{seed}-{frames}x{height}x{width}")
        if not (path / "clip.json").exists():
            light = (16 + (7 * ((x - 2 * t + 5 * seed) // 3) + 5 * ((y - t) // 4)) % 64) / 64
            about = {"shape": [frames, height, width], "frame_rate": 2000.0, "exposure": 5e-4}
            about |= {"camera": asdict(Camera(8e-3, 2.8, 1.1e-6, height, width)), "scene": {"family": "moving"}}
            with ClipWriter(path, about | {"radiance_unit": "W m^-2 sr^-1"}) as writer:
                for number, frame in enumerate(light):
                    writer.add(number, frame, error=0.01)
        found.append(Clip.open(path))
    return found


def _row(job: Job, batch: int, frames: int, **settings: Any) -> dict[str, Any]:
    """Return the speed of steps on a batch that stays on the device."""
    from quiver.device import PeakMemory, out_of_memory
    from quiver.training.loop import precision_of

    bench = _Bench(job, batch, frames, **settings)
    kind = bench.place.type
    held = bench.batch()
    memory = PeakMemory(kind)
    forward = _macs(batch, frames, job.sizes.step_crop)
    precision = precision_of(bench.settings, bench.place)
    row = {"network": NETWORK, "device": kind, "precision": precision, "compile": bench.settings.compile}
    row |= {"crop": job.sizes.step_crop, "frames": frames, "batch": batch}
    try:
        each: float | None = bench.seconds(lambda: bench.trainer.step(held), job.sizes.step_count)
    except Exception as error:
        if not out_of_memory(error):
            raise
        each = None
    bench.trainer.settle()
    speeds = ("steps per s", "windows per s", "restored frames per s", "multiply-adds per restored pixel [M]")
    if each is None:
        return row | dict.fromkeys((*speeds, "TFLOP/s", "share of peak", "peak memory [MB]")) | {"note": "no memory"}
    restored = batch * (frames - 10)
    rate = 3 * 2 * forward / each
    values = (1 / each, batch / each, restored / each, forward / (restored * job.sizes.step_crop**2) / 1e6)
    row |= dict(zip(speeds, values, strict=True))
    row |= {"TFLOP/s": rate / 1e12, "share of peak": rate / _peak(bench, precision, job.sizes.peak_side)}
    return row | {"peak memory [MB]": memory.bytes() / 1e6, "note": "; ".join(bench.said)}


def _macs(batch: int, frames: int, side: int) -> int:
    """Return the multiply-adds of the forward pass of a batch."""
    from torch._subclasses.fake_tensor import FakeTensorMode

    from quiver.evaluation.macs import macs
    from quiver.model.presets import build

    with FakeTensorMode():
        return batch * macs(build(NETWORK), frames, side, side)


def _peak(bench: _Bench, precision: str, side: int) -> float:
    """Return the floating-point operations per second of products of square matrices."""
    import torch

    a = torch.rand(side, side, device=bench.place, dtype=getattr(torch, precision))
    return 2 * side**3 / bench.seconds(lambda: torch.mm(a, a), 3)


def _windows(job: Job) -> list[dict[str, Any]]:
    """Return the share of a step that drawing takes: by the device, and by the host, with the workers of a training."""
    from quiver.training.loop import batches, on_its_device
    from quiver.training.schedule import State

    sizes = job.sizes
    rows = []
    for where in ("device", "host"):
        bench = _Bench(job, sizes.window_batch, sizes.step_frames[-1], windows=where)
        held, _ = on_its_device(bench.windows, bench.settings, bench.process)
        fixed = bench.batch()
        alone = bench.seconds(lambda bench=bench, fixed=fixed: bench.trainer.step(fixed), sizes.step_count)
        drawn = None
        if held is not None:
            places = _places(held, sizes.window_batch)
            drawn = bench.seconds(lambda held=held, places=places: held.draw(places), sizes.step_count)
        source = batches(bench.windows, bench.settings, State(), bench.process, device=held)
        both = bench.seconds(lambda bench=bench, source=source: bench.trainer.step(next(source)), sizes.step_count)
        bench.trainer.settle()
        source.close()
        row = {"windows drawn by": where, "device": bench.place.type, "batch": sizes.window_batch}
        row |= {"frames": sizes.step_frames[-1], "crop": sizes.step_crop, "ms per step, one batch held": 1e3 * alone}
        row |= {"ms per step, windows drawn": 1e3 * both, "share of drawing": 1 - alone / both}
        rows.append(row | {"ms of drawing alone": None if drawn is None else 1e3 * drawn})
    return rows


def _places(held: Any, batch: int) -> dict[str, Any]:
    """Return a batch of places."""
    from torch.utils.data import default_collate

    found: dict[str, Any] = default_collate([held.places[n] for n in range(batch)])
    return found


def _operators(job: Job) -> list[dict[str, Any]]:
    """Return how many operators of torch, views left out, a step and the drawing of its windows take: launches, nearly.

    They do not depend on the number of windows or pixels, so that two small windows tell.
    """
    from torch.utils._python_dispatch import TorchDispatchMode

    from quiver.training.loop import on_its_device

    class Operators(TorchDispatchMode):
        """Counts what is asked of a device."""

        count = 0

        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            self.count += not func.is_view
            return func(*args, **(kwargs or {}))

    job.sizes = replace(job.sizes, step_crop=job.sizes.counted_crop)
    rows = []
    for frames in job.sizes.step_frames:
        bench = _Bench(job, 2, frames, windows="device")
        held, _ = on_its_device(bench.windows, bench.settings, bench.process)
        assert held is not None
        batch = held.draw(_places(held, 2))
        bench.trainer.step(batch)  # makes what the optimiser keeps
        with Operators() as of_step:
            bench.trainer.step(batch)
        with Operators() as of_drawing:
            held.draw(_places(held, 2))
        bench.trainer.settle()
        row = {"network": NETWORK, "frames": frames, "operators of a step": of_step.count}
        row |= {"operators of drawing": of_drawing.count}
        rows.append(row | {"share of drawing": of_drawing.count / (of_step.count + of_drawing.count)})
    return rows
