"""What a host program has set in torch and NumPy changes no restored value, and is given back."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import numpy as np
import pytest
import torch

from qsim.keys import Key
from qsim.sensor.devices import quiver_physical
from quiver import host
from quiver.baselines import METHODS
from quiver.data.codes import array_codes
from quiver.model.presets import build
from quiver.restoration.restorers import restorer

SENSOR = quiver_physical(3.25)
LIGHT = np.random.default_rng(0).uniform(0.5, 6, (12, 24, 32))
CODES = SENSOR.sample(LIGHT, 5e-4, key=Key(0, 0))


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


HOSTS = {
    "float64": lambda: default_dtype(torch.float64),
    "float16": lambda: default_dtype(torch.float16),
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "NumPy raises": lambda: np.errstate(all="raise"),
}


@pytest.fixture(scope="module")
def quiet() -> dict[str, np.ndarray]:
    return {name: _restored(name) for name in (*METHODS, "mergenet")}


def _restored(name: str) -> np.ndarray:
    return restorer(name).restore(array_codes(CODES, SENSOR, 5e-4), 4, 6)


@pytest.mark.parametrize("of_host", HOSTS)
@pytest.mark.parametrize("name", [*METHODS, "mergenet"])
@pytest.mark.filterwarnings("ignore:.*never measured")
def test_restored_values_are_those_of_a_quiet_program(quiet, name, of_host):
    with HOSTS[of_host]():
        before = torch.get_default_dtype(), torch.is_autocast_enabled("cpu")
        np.testing.assert_array_equal(_restored(name), quiet[name])
        assert (torch.get_default_dtype(), torch.is_autocast_enabled("cpu")) == before


@pytest.mark.parametrize("of_host", ["float64", "float16", "autocast"])
@pytest.mark.parametrize("name", ["mergenet", "quiver-s-1m", "emvd-1m"])
def test_a_network_is_built_of_float32(name, of_host):
    with HOSTS[of_host]():
        network = build(name)
    assert {value.dtype for value in network.parameters()} == {torch.float32}


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_functions_that_make_tensors_give_what_they_give_in_a_quiet_program(dtype):
    whole = torch.arange(7)
    makers = (
        lambda: torch.zeros(3),
        lambda: torch.arange(5),
        lambda: torch.arange(0.0, 2.0, 0.3),
        lambda: torch.tensor([1, 2]),
        lambda: torch.tensor([1, 2.5]),
        lambda: torch.tensor(np.array([1.5])),
        lambda: torch.full((2,), 3),
        lambda: torch.full((2,), 3.5),
        lambda: torch.linspace(0, 1, 7),
        lambda: whole / 3,
        lambda: torch.sqrt(whole),
        lambda: whole.double() / 3,
        lambda: torch.tensor([1.5], dtype=torch.float64),
    )
    expected = [make() for make in makers]
    with default_dtype(dtype), host.numbers():
        for make, wanted in zip(makers, expected, strict=True):
            made = make()
            assert made.dtype == wanted.dtype
            torch.testing.assert_close(made, wanted, rtol=1e-7, atol=0)


def test_other_threads_keep_the_type_of_the_host():
    """Its default is of the process: setting it for the block would change it there."""
    inside = threading.Event()
    done = threading.Event()
    found: list[torch.dtype] = []

    def other() -> None:
        inside.wait(10)
        found.append(torch.zeros(1).dtype)
        done.set()

    thread = threading.Thread(target=other)
    thread.start()
    with default_dtype(torch.float64), host.numbers():
        assert torch.zeros(1).dtype == torch.float32
        inside.set()
        done.wait(10)
    thread.join()
    assert found == [torch.float64]


def test_nothing_is_intercepted_in_a_quiet_program():
    with nullcontext(), host.numbers():
        assert torch.overrides._get_current_function_mode_stack() == []


@pytest.mark.parametrize("before", [False, True])
def test_denormal_numbers_are_what_they_were(before):
    torch.set_flush_denormal(before)
    try:
        with host.flushed_denormals():
            assert torch.tensor(5e-324, dtype=torch.float64) * 1.0 == 0.0
        assert (np.float64(5e-324) * np.float64(1.0) == 0.0) is np.bool_(before)
    finally:
        torch.set_flush_denormal(False)
