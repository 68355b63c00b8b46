"""Chooses the device of networks, and holds all that depends on it: copies, memory, random states, process groups.

No other file of quiver names a kind of device. Torch is imported when a function needs it.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from qsim.process import peak_memory, reset_peak, resident_memory

if TYPE_CHECKING:
    import torch
    from torch import Tensor

DEVICES = ("auto", "cpu", "cuda")
HOST_MEMORY = 2_000_000_000  # bytes; working memory where none is stated and no GPU runs
LIGHT_SHARE = 0.4  # of a GPU's memory, for the light of the clips that train there
AHEAD = 2  # training steps that a host may be ahead of its GPU: enough to keep it busy


def pick_device(wanted: str) -> str:
    """Return `cpu` or `cuda`; `auto` is CUDA where there is one. `ValueError` if CUDA is wanted and missing."""
    import torch

    if wanted == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if wanted not in DEVICES:
        raise ValueError(f"device {wanted!r}; known are {', '.join(DEVICES)}")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda: torch finds no CUDA device here; use device=cpu")
    return wanted


def default_memory(kind: str) -> int:
    """Return the working memory [bytes] where none is stated: HOST_MEMORY, on a GPU half of all its memory."""
    import torch

    return int(torch.cuda.mem_get_info()[1]) // 2 if kind == "cuda" else HOST_MEMORY


def light_memory(device: torch.device) -> int:
    """Return the memory [bytes] for the light of training clips: LIGHT_SHARE of a GPU's, else HOST_MEMORY.

    Of a GPU that others use it is at most half of what is free.
    """
    import torch

    if not is_gpu(device):
        return HOST_MEMORY
    free, total = torch.cuda.mem_get_info(device)
    return min(int(LIGHT_SHARE * total), free // 2)


def environment_beside_training() -> dict[str, str]:
    """Return the environment of a renderer beside a training: the last of several GPUs; on a CPU half of the cores.

    What the user has set there stays.
    """
    import torch

    found = dict(os.environ)
    gpus = torch.cuda.device_count()
    if gpus > 1:
        found.setdefault("CUDA_VISIBLE_DEVICES", str(gpus - 1))
    if not gpus:
        found.setdefault("QSIM_THREADS", str(max(1, (os.cpu_count() or 1) // 2)))
    return found


def device_of_process(kind: str) -> torch.device:
    """Return the device of this process: under `torchrun` every process of a machine has a separate GPU."""
    import torch

    return torch.device(kind, int(os.environ.get("LOCAL_RANK", 0))) if kind == "cuda" else torch.device(kind)


def group_backend(kind: str) -> str:
    """Return the library by which processes on such devices exchange gradients; hosts exchange numbers by gloo."""
    return "cpu:gloo,cuda:nccl" if kind == "cuda" else "gloo"


def is_gpu(device: torch.device) -> bool:
    """Return whether the device is a GPU: bfloat16 is then the default of training, and batches are pinned."""
    return device.type == "cuda"


def is_host(device: torch.device) -> bool:
    """Return whether the device is the host's own processor, which can be asked for numbers at no cost."""
    return device.type == "cpu"


def moved(tensor: Tensor, device: torch.device) -> Tensor:
    """Return the tensor on the device; the copy of a pinned one does not wait for the GPU."""
    return tensor.to(device, non_blocking=tensor.is_pinned())


def steps_ahead(device: torch.device) -> int:
    """Return how many training steps the host may be ahead of the device; none where it computes them itself."""
    return AHEAD if is_gpu(device) else 0


class Reading:
    """Numbers of a device on their way to the host: nothing waits for them until `values` is called."""

    def __init__(self, numbers: Tensor) -> None:
        """Begin the copy of numbers [n]."""
        import torch

        gpu = is_gpu(numbers.device)
        self.host = torch.empty(numbers.shape, dtype=numbers.dtype, pin_memory=gpu)
        self.host.copy_(numbers, non_blocking=gpu)
        self.copied = torch.cuda.Event() if gpu else None
        if self.copied is not None:
            self.copied.record()

    def values(self) -> list[float]:
        """Return the numbers, as soon as the device has computed them; later work of it goes on."""
        if self.copied is not None:
            self.copied.synchronize()
        return list(map(float, self.host.tolist()))


def pinned(tensor: Tensor, device: torch.device) -> Tensor:
    """Return a tensor of the host in memory from which copies to this device do not wait."""
    return tensor.pin_memory() if is_gpu(device) else tensor


def wait(device: torch.device) -> None:
    """Wait until the device has finished its work, before a clock is read or another library uses its memory."""
    import torch

    if is_gpu(device):
        torch.cuda.synchronize(device)


def follow(device: torch.device) -> None:
    """Let the work of another library, in a queue of its own, begin behind what torch has started on a GPU.

    The host does not wait. Such queues follow torch's default stream, so that stream follows the current one.
    """
    import torch

    if is_gpu(device):
        torch.cuda.default_stream(device).wait_stream(torch.cuda.current_stream(device))


def random_states() -> list[Tensor]:
    """Return the states of the random generators of all GPUs; without one an empty list."""
    import torch

    return torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []


def set_random_states(states: list[Tensor]) -> None:
    """Restore what `random_states` returned, for the GPUs that are here: a run may come from a machine with more."""
    import torch

    if states and torch.cuda.is_available():
        torch.cuda.set_rng_state_all([state.cpu() for state in states[: torch.cuda.device_count()]])


def out_of_memory(error: BaseException) -> bool:
    """Return whether an error tells that memory is exhausted, of a GPU or of this machine."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    text = str(error).lower()
    return isinstance(error, RuntimeError) and ("out of memory" in text or "defaultcpuallocator" in text)


class PeakMemory:
    """Measures from its creation on the largest memory [bytes]: allocated on a GPU, else added to this process.

    A system that cannot reset its peak gives an upper bound: the peak since the process began.
    """

    def __init__(self, kind: str) -> None:
        self.gpu = kind == "cuda"
        if self.gpu:
            import torch

            torch.cuda.reset_peak_memory_stats()
        else:
            reset_peak()
        self.before = 0 if self.gpu else resident_memory()

    def bytes(self) -> int:
        """Return the peak so far."""
        if not self.gpu:
            return max(0, peak_memory() - self.before)
        import torch

        return torch.cuda.max_memory_allocated()
