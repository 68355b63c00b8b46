"""Tests that schedules with shared work give the numbers of windows or of one pass."""

import time
from collections.abc import Callable, Iterable, Iterator

import pytest
import torch
from golden import TINY, draw, lively, network
from torch import Tensor

from quiver.model import schedules
from quiver.model.config import Config
from quiver.model.quiver import QUIVER


@torch.no_grad()
def run(schedule: Callable[[QUIVER, Iterable[Tensor]], Iterator[Tensor]], network: QUIVER, x: Tensor) -> Tensor:
    """Run a schedule on [B, T, 1, H, W] -> [B, T-10, 1, H, W]."""
    return torch.stack(list(schedule(network, x.unbind(1))), dim=1)


def test_exact_reuse_equals_windows_from_scratch():
    network = lively(TINY)
    x = draw(2, 15, 1, 16, 24)
    windows = run(schedules.windows, network, x)
    assert windows.shape == (2, 5, 1, 16, 24)
    assert float((run(schedules.exact, network, x) - windows).abs().max()) < 1e-10 * float(windows.std())


def test_streaming_equals_one_pass_over_the_clip():
    network = lively(TINY)
    x = draw(2, 15, 1, 16, 24)
    with torch.no_grad():
        whole = network(x).scale1
    assert float((run(schedules.stream, network, x) - whole).abs().max()) < 1e-10 * float(whole.std())


@pytest.mark.slow
def test_the_published_network_runs_by_every_schedule():
    network = lively(Config(16))
    x = draw(1, 13, 1, 8, 12)
    with torch.no_grad():
        whole = network(x).scale1
    windows = run(schedules.windows, network, x)
    assert float((run(schedules.stream, network, x) - whole).abs().max()) < 1e-10 * float(whole.std())
    assert float((run(schedules.exact, network, x) - windows).abs().max()) < 1e-10 * float(windows.std())


def test_streaming_is_not_the_same_as_windows():
    """The kept state and the missing zeros make a difference, which is not large."""
    network = lively(TINY)
    x = draw(1, 16, 1, 16, 24)
    windows = run(schedules.windows, network, x)
    stream = run(schedules.stream, network, x)
    difference = (windows - stream).square().mean().sqrt() / windows.std()
    assert 1e-6 < float(difference) < 0.5


@pytest.mark.parametrize("schedule", [schedules.exact, schedules.stream])
def test_frames_are_taken_one_by_one_and_denoised_once(schedule, monkeypatch):
    network = lively(TINY, torch.float32)
    taken = []
    denoised = []

    def frames() -> Iterator[Tensor]:
        for t in range(16):
            taken.append(t)
            yield draw(1, 1, 8, 8, dtype=torch.float32, seed=t)

    monkeypatch.setattr(network, "denoise", lambda x: denoised.append(1) or QUIVER.denoise(network, x))
    with torch.no_grad():
        results = schedule(network, frames())
        next(results)
        assert len(taken) <= 13
        assert len([*results]) == 16 - 10 - 1
    assert len(denoised) == 16


@pytest.mark.slow
def test_reuse_saves_the_promised_time():
    """CPU time of one thread per restored frame, width 16, 64 x 64: exact >= 1.5 times less, streaming >= 3 times."""
    network16 = network(16, torch.float32)
    x = draw(1, 26, 1, 64, 64, dtype=torch.float32)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    seconds = {}
    try:
        for schedule in (schedules.windows, schedules.exact, schedules.stream):
            run(schedule, network16, x[:, :11])
            start = time.process_time()
            run(schedule, network16, x)
            seconds[schedule] = time.process_time() - start
    finally:
        torch.set_num_threads(threads)
    assert seconds[schedules.windows] / seconds[schedules.exact] > 1.5, seconds
    assert seconds[schedules.windows] / seconds[schedules.stream] > 3, seconds
