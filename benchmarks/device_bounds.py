"""Counts what the classical methods and merging ask of a GPU: operators, bytes and matrix products. Needs no GPU.

    python benchmarks/device_bounds.py --page docs/results/device_bounds.md    # a few seconds

Every operator runs on tensors without values (the `meta` device of torch). Its bytes are those of its tensors, read or
written once. The bound takes the memory and the arithmetic of an H200 by its data sheet, and 5 us of the host for each
operator. A GPU whose caches help may need less for the bytes; sorting and scattered sums need more.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import result_page
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from qsim.sensor.devices import quiver_physical
from qsim.tables import markdown_table
from quiver.baselines import METHODS, path_merge
from quiver.baselines.batched import methods
from quiver.baselines.paths import moved_frames, path_search

BANDWIDTH = 4.8e12  # bytes/s of an H200 SXM, NVIDIA's data sheet
ARITHMETIC = 67e12  # float32 operations/s, likewise, outside of tensor cores
LAUNCH = 5e-6  # s of the host per operator, a usual value for torch
EXPOSURE = 5e-4
SIZE = (512, 1024)  # px
TOGETHER = (1, 8)  # frames that are restored at a time


class Traffic(TorchDispatchMode):
    """Counts operators, and the bytes of their tensors."""

    def __init__(self) -> None:
        super().__init__()
        self.operators = 0
        self.bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        if not func.is_view:
            self.operators += 1
            self.bytes += sum(_sizes(args)) + sum(_sizes([found]))
        return found


def _sizes(values: Any) -> list[int]:
    """Return the bytes of the tensors among values, in lists at any depth. One that is expanded counts once."""
    found = []
    for value in values:
        if isinstance(value, torch.Tensor):
            distinct = [n for n, step in zip(value.shape, value.stride(), strict=True) if step]
            found.append(int(np.prod(distinct)) * value.element_size())
        elif isinstance(value, list | tuple):
            found += _sizes(value)
    return found


def counted(name: str, frames: int) -> tuple[str, ...]:
    """Return one row of the table: a method on frames of 3 bits that are restored at a time."""
    height, width = SIZE
    window = METHODS[name].window
    codes = torch.zeros(frames + 2 * window, height, width, dtype=torch.uint8, device="meta")
    given = (codes, quiver_physical(3.25), EXPOSURE, window, range(window, window + frames), np.inf)
    for module in (path_merge, moved_frames, path_search):
        module.is_gpu = lambda device: True
    methods.METHODS[name](*given)  # makes the tables
    with torch.inference_mode(), Traffic() as traffic:
        methods.METHODS[name](*given)
    with torch.inference_mode(), FlopCounterMode(display=False) as flops:
        methods.METHODS[name](*given)
    total = flops.get_total_flops()
    kernels = max(traffic.bytes / BANDWIDTH + total / ARITHMETIC, traffic.operators * LAUNCH) / frames
    numbers = (traffic.bytes / frames / 1e9, total / frames / 1e9, 1e3 * kernels)
    return (name, str(frames), str(traffic.operators), *(f"{number:.3g}" for number in numbers))


def page() -> str:
    """Return the page."""
    table = [counted(name, frames) for name in METHODS for frames in TOGETHER]
    header = ("method", "frames at a time", "operators", "GB per frame", "GFLOP per frame", "bound [ms per frame]")
    text = result_page.head("What classical methods ask of a GPU", "device_bounds.py")
    text += [
        f"Frames of {SIZE[0]} x {SIZE[1]} px, 3 bits. Nothing here was measured on a GPU: operators run on tensors "
        "without values. The bytes of an operator are those of its tensors, read or written once. The bound is the "
        "larger of two times. The first is that of bytes and matrix products at the "
        f"{BANDWIDTH / 1e12:g} TB/s and {ARITHMETIC / 1e12:g} TFLOP/s of an H200's data sheet. The second is "
        f"{1e6 * LAUNCH:g} us of the host per operator. Sorting and scattered sums take longer than their bytes.",
        "",
    ]
    return "\n".join([*text, *markdown_table(table, header), ""])


if __name__ == "__main__":
    result_page.main(__doc__, page)
