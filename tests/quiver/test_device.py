"""The device is chosen in one place; without a GPU all of it works on the CPU."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from quiver import device
from quiver.restoration.interface import RestoreOptions

CPU = torch.device("cpu")


def test_auto_is_a_gpu_where_there_is_one(monkeypatch):
    for there, kind in ((True, "cuda"), (False, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        assert device.pick_device("auto") == kind
        assert device.pick_device("cpu") == "cpu"
    with pytest.raises(ValueError, match="device=cuda: torch finds no CUDA device here; use device=cpu"):
        device.pick_device("cuda")


def test_every_process_of_torchrun_has_a_gpu_and_a_way_to_exchange(monkeypatch):
    monkeypatch.setenv("LOCAL_RANK", "3")
    assert device.device_of_process("cuda") == torch.device("cuda", 3)
    assert device.device_of_process("cpu") == CPU
    assert (device.group_backend("cuda"), device.group_backend("cpu")) == ("cpu:gloo,cuda:nccl", "gloo")


def test_tensors_that_are_there_are_not_copied():
    tensor = torch.ones(3)
    assert device.moved(tensor, CPU) is tensor


def test_random_states_of_a_machine_with_gpus_are_kept_on_one_without(monkeypatch):
    restored = []
    monkeypatch.setattr(torch.cuda, "set_rng_state_all", restored.append)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    for there in (False, True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        device.set_random_states([])
        device.set_random_states([torch.zeros(16, dtype=torch.uint8)])
        assert len(restored) == int(there)
    device.set_random_states([torch.full((16,), i, dtype=torch.uint8) for i in range(4)])  # of a machine with more
    assert [len(states) for states in restored] == [1, 1]


@pytest.mark.parametrize("resets", [True, False])
def test_the_peak_of_memory_grows_with_what_is_held(resets):
    """In a new process: another test may have held more, and not every system can reset the peak."""
    code = (
        "import torch; from quiver import device\n"
        f"if not {resets}: device.reset_peak = device.peak_memory\n"
        "freed = torch.ones(30_000_000); del freed\n"
        "memory = device.PeakMemory('cpu'); held = torch.ones(20_000_000)\n"
        "print(memory.bytes() / held.nbytes)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) > 0.9


def test_errors_that_tell_of_exhausted_memory_are_known():
    told = (
        MemoryError(),
        torch.OutOfMemoryError("no"),
        RuntimeError("CUDA error: out of memory"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:121] DefaultCPUAllocator: can't allocate memory"),
    )
    assert all(map(device.out_of_memory, told))
    assert not any(map(device.out_of_memory, (RuntimeError("no road"), ValueError("out of memory"), OSError())))


def test_working_memory_is_half_of_a_gpu_for_what_runs_there(monkeypatch):
    """What is stated holds everywhere; classical methods and merging never run on a GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (3 * 10**9, 80 * 10**9))
    assert RestoreOptions().bound() == RestoreOptions(device="cuda").bound() == 40 * 10**9
    assert RestoreOptions().bound(host=True) == 2 * 10**9
    assert RestoreOptions(device="cpu").bound() == 2 * 10**9
    for stated in (1, 3 * 10**9):
        options = RestoreOptions(memory=stated)
        assert options.bound() == options.bound(host=True) == stated
    with pytest.raises(ValueError, match="memory: expected a whole number from 1, got 0"):
        RestoreOptions(memory=0)


def test_light_of_clips_has_a_share_of_a_gpu_and_at_most_half_of_what_is_free(monkeypatch):
    gpu = torch.device("cuda", 1)
    assert device.light_memory(CPU) == 2 * 10**9
    for free, expected in ((70, 32), (10, 5)):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda place, free=free: (free * 10**9, 80 * 10**9))
        assert device.light_memory(gpu) == expected * 10**9


def test_a_reading_asks_a_gpu_when_its_values_are_needed(monkeypatch):
    """Not when it is made: the copy is begun and an event is recorded behind it."""
    done = []

    class Event:
        def record(self) -> None:
            done.append("recorded")

        def synchronize(self) -> None:
            done.append("waited")

    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(device, "is_gpu", lambda place: True)
    empty = torch.empty
    monkeypatch.setattr(torch, "empty", lambda *shape, dtype, pin_memory: empty(*shape, dtype=dtype))
    reading = device.Reading(torch.tensor([1.5, 2.0]))
    assert done == ["recorded"]
    assert reading.values() == [1.5, 2.0]
    assert done == ["recorded", "waited"]


def test_only_a_gpu_lets_its_host_run_ahead():
    assert (device.steps_ahead(CPU), device.steps_ahead(torch.device("cuda"))) == (0, device.AHEAD)
