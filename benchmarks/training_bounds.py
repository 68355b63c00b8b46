"""Counts what a step of training QUIVER asks of a GPU: operators, bytes, matrix products and memory. Needs no GPU.

    python benchmarks/training_bounds.py --page docs/results/training_bounds.md    # a minute

As device_bounds.py does, each operator runs on tensors without values. Memory is that of the tensors that are kept for
the way back, of the weights, their gradients and the optimiser.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import result_page
import torch
from device_bounds import BANDWIDTH, LAUNCH, Traffic
from torch.utils.flop_counter import FlopCounterMode

from qsim.tables import markdown_table
from quiver.model.presets import build
from quiver.training.loss import PUBLISHED, training_loss

FLOAT32 = 67e12  # operations/s of an H200 SXM outside of tensor cores, NVIDIA's data sheet
BFLOAT16 = 989e12  # likewise, in tensor cores, without sparsity
EXCHANGE = 900e9  # bytes/s between its GPUs, likewise
GPUS = 8
COPIES = 4  # of the weights: themselves, gradients, two moments of the optimiser
PUBLISHED_STEPS = 48_000


@dataclass(frozen=True)
class Step:
    """A step of one process."""

    network: str
    batch: int
    frames: int
    crop: int


STEPS = (
    Step("quiver", 8, 11, 128),
    Step("quiver", 1, 11, 128),
    Step("quiver", 4, 11, 96),
    Step("quiver-s", 8, 11, 128),
    Step("quiver-s", 32, 21, 64),
    Step("quiver-s-1m", 8, 11, 64),
    Step("quiver-s-1m", 1, 21, 96),
)


@dataclass(frozen=True)
class Need:
    """What a step needs."""

    operators: int
    bytes: int
    operations: int  # of matrix products and convolutions
    memory: int  # bytes
    weights: int  # bytes

    def seconds(self, *, low: bool) -> float:
        """Return the least seconds of a step; with `low` in bfloat16, where all tensors have half of the bytes."""
        moved = self.bytes / BANDWIDTH / (2 if low else 1)
        return max(moved + self.operations / (BFLOAT16 if low else FLOAT32), self.operators * LAUNCH)

    def seconds_of_many(self, *, low: bool) -> float:
        """Return the same where GPUs exchange their gradients after each step: each sends and takes them once."""
        return self.seconds(low=low) + 2 * self.weights / EXCHANGE


def counted(step: Step) -> Need:
    """Return what a step needs, of the published loss."""
    with torch.device("meta"):
        network = build(step.network)
        codes = torch.zeros(step.batch, step.frames, 1, step.crop, step.crop)
    weights = sum(parameter.numel() * parameter.element_size() for parameter in network.parameters())
    kept: list[torch.Tensor] = []

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        kept.append(tensor)
        return tensor

    def run() -> None:
        network.zero_grad(set_to_none=True)
        loss = training_loss(network(codes), codes, PUBLISHED, first=5)
        loss.backward()

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        run()
    with Traffic() as traffic:
        run()
    with FlopCounterMode(display=False) as flops:
        run()
    storages = {tensor.untyped_storage()._cdata: tensor.untyped_storage().nbytes() for tensor in kept}
    memory = sum(storages.values()) + COPIES * weights
    return Need(traffic.operators, traffic.bytes, flops.get_total_flops(), memory, weights)


def row(step: Step) -> tuple[str, ...]:
    """Return one row of the table."""
    need = counted(step)
    shape = f"{step.batch} of {step.frames} x {step.crop} x {step.crop} px"
    amounts = (need.bytes / 1e9, need.operations / 1e12, need.memory / 1e9)
    rates = [1 / need.seconds(low=low) for low in (False, True)]
    eight = GPUS * step.batch / need.seconds_of_many(low=True)
    numbers = (*amounts, *rates, eight, PUBLISHED_STEPS / rates[0] / 3600, PUBLISHED_STEPS / rates[1] / 3600)
    return (step.network, shape, str(need.operators), *(f"{number:.3g}" for number in numbers))


def page() -> str:
    """Return the page."""
    torch.autocast = lambda *_, **__: contextlib.nullcontext()  # type: ignore[assignment,misc]  # unknown on `meta`
    header = (
        "network",
        "windows of a step",
        "operators",
        "GB",
        "TFLOP",
        "memory [GB]",
        "steps/s, float32",
        "steps/s, bfloat16",
        f"windows/s, bfloat16, {GPUS} GPUs",
        f"hours of {PUBLISHED_STEPS} steps, float32",
        "the same, bfloat16",
    )
    text = result_page.head("What training QUIVER asks of a GPU", "training_bounds.py")
    text += [
        "One step: forwards, backwards, and the published loss. Nothing here was measured on a GPU: operators run on "
        "tensors without values. Rates are bounds for operators that run one by one; fused ones (`--compile`) may be "
        "faster. The time of a step is the larger of two. "
        "The first is that of the bytes of all operators, read or written once, and of the products. The second is "
        f"{1e6 * LAUNCH:g} us of the host per operator. An H200 has {BANDWIDTH / 1e12:g} TB/s, "
        f"{FLOAT32 / 1e12:g} TFLOP/s in float32 and {BFLOAT16 / 1e12:g} TFLOP/s in bfloat16, by its data sheet. In "
        "bfloat16 all tensors are taken for half as large, as they are at most.",
        "",
        "Memory is that of float32. Four windows of 96 x 96 px took 30 GB when they were measured on a CPU. Eight GPUs "
        f"exchange their gradients at {EXCHANGE / 1e9:g} GB/s after each step, and have as many windows each.",
        "",
    ]
    return "\n".join([*text, *markdown_table([row(step) for step in STEPS], header), ""])


if __name__ == "__main__":
    result_page.main(__doc__, page)
