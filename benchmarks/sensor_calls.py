"""Measures calls that draw codes: processor time of small and large ones, kernels per call, and what is compiled again.

    taskset -c 0 python benchmarks/sensor_calls.py > out/sensor_calls.json

Prints JSON. Every way to draw takes its turn in each round; times are medians. Each call has another key, and of
`rows` every call has another exposure and light level, too.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import torch

from qsim import Key, backend
from qsim.sensor.devices import quiver_physical
from qsim.sensor.row import Row
from qsim.sensor.spad import BinarySPAD
from quiver.data.device_codes import codes_of_rows, codes_on_device

EXPOSURE = 5e-4  # s
SENSORS = {"3 bits": quiver_physical(3.25), "1 bit": BinarySPAD(0.5, 25.0)}
SHAPES = ((1, 1, 64, 64), (1, 1, 256, 256), (1, 1, 1024, 1024), (8, 11, 64, 64))  # windows, frames, rows, columns


def ways(sensor: Any, shape: tuple[int, int, int, int]) -> dict[str, Callable[[int], Any]]:
    """Return what draws all windows of a shape by one call, of its number."""
    light = np.random.default_rng(0).uniform(0, 2 * sensor.white(EXPOSURE), shape).astype(np.float32)
    clip = light.reshape(-1, *shape[2:])
    tensor = torch.from_numpy(light)
    frames = tensor.reshape(clip.shape)

    def rows(call: int, packed: bool = False) -> Any:
        exposure = EXPOSURE * (1 + call % 7 / 10)
        described = [Row(sensor, exposure, Key(0, clip=call, frame=b), 1 + call % 5 / 10) for b in range(shape[0])]
        return codes_of_rows(tensor, described, packed)

    found: dict[str, Callable[[int], Any]] = {
        "numpy": lambda call: sensor.sample(clip, EXPOSURE, key=Key(0, call), engine="reference"),
        "sample": lambda call: sensor.sample(clip, EXPOSURE, key=Key(0, call)),
        "codes_on_device": lambda call: codes_on_device(sensor, frames, EXPOSURE, key=Key(0, call)),
        "rows": rows,
    }
    if sensor.bits == 1:
        found["rows, packed"] = partial(rows, packed=True)
    return found


def kernels(draw: Callable[[int], Any]) -> dict[str, int]:
    """Return how many kernels one call starts, and how many of them are compiled for it."""
    import drjit

    with drjit.scoped_set_flag(drjit.JitFlag.KernelHistory, True):
        drjit.kernel_history_clear()
        draw(10_000)
        found = [entry for entry in drjit.kernel_history() if entry["type"] == drjit.KernelType.JIT]
    return {"kernels": len(found), "compiled": sum(not (e["cache_hit"] or e["cache_disk"]) for e in found)}


def measured(name: str, shape: tuple[int, int, int, int], rounds: int) -> list[dict[str, Any]]:
    """Return a row for each way to draw."""
    each = ways(SENSORS[name], shape)
    seconds: dict[str, list[float]] = {way: [] for way in each}
    for call in range(-2, rounds):  # two are not counted
        for way, draw in each.items():
            started = time.process_time()
            draw(call + 2)
            if call >= 0:
                seconds[way].append(time.process_time() - started)
    pixels = int(np.prod(shape))
    return [
        {
            "sensor": name,
            "shape": list(shape),
            "by": way,
            "ms": round(1e3 * median(spent), 4),
            "ns per pixel": round(1e9 * median(spent) / pixels, 3),
            **kernels(each[way]),
        }
        for way, spent in seconds.items()
    ]


def main() -> None:
    """Print the rows of all sensors and shapes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=50, help="calls of each way; large ones a fifth")
    rounds = parser.parse_args().rounds
    engine = backend.choose().backend
    rows = []
    for name in SENSORS:
        for shape in SHAPES:
            rows += measured(name, shape, rounds if np.prod(shape) < 1 << 17 else max(3, rounds // 5))
    json.dump({"engine": engine, "rows": rows}, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
