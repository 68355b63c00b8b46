"""Every network as a restorer: hard streams, look-ahead, weights files, half precision, tiles, and the memory bound."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from golden import fill_by_rule
from numpy import ndarray as Array
from random_codes import random_codes
from runs import EVERY, tiny
from torch import nn

from quiver.data.codes import Codes
from quiver.model.names import COMPARED
from quiver.model.weights import save
from quiver.restoration.interface import RestoreOptions, Restorer
from quiver.restoration.networks import network_restorer, wrap_network
from quiver.restoration.pieces import bytes_needed, cut_pieces

FINAL_ZEROS = ("mergenet",)  # of these an untrained network changes nothing


def lively(name: str) -> nn.Module:
    """A small network with random weights, none of them zero at the start."""
    network = tiny(name)
    return (fill_by_rule(network) if name in FINAL_ZEROS else network).eval()


def method_of(name: str, **options: object) -> Restorer:
    return wrap_network(lively(name), name, "a network", RestoreOptions(**options))


def stream_of(codes: Codes, stack: Array) -> Codes:
    """Other codes of the same sensor."""
    return replace(codes, shape=stack.shape, read=lambda first, last: stack[first:last])


def hard_streams() -> dict[str, Array]:
    bright = np.zeros((3, 13, 18), np.uint8)
    bright[1, 8, 3] = 7
    return {
        "dark": np.zeros((3, 13, 18), np.uint8),
        "saturated": np.full((3, 13, 18), 7, np.uint8),
        "one bright pixel": bright,
        "every frame another level": np.arange(3, dtype=np.uint8)[:, None, None] + np.zeros((3, 13, 18), np.uint8),
        "dark and saturated by turns": np.full((3, 13, 18), 7, np.uint8) * (np.arange(3) % 2)[:, None, None],
        "one frame": np.full((1, 13, 18), 3, np.uint8),
        "one pixel": np.arange(8, dtype=np.uint8)[:, None, None],
    }


@pytest.mark.parametrize("name", EVERY)
def test_hard_streams_are_restored(name):
    method = method_of(name)
    streams = hard_streams()
    found = {kind: method.restore(stream_of(random_codes(1, 1, 1), stack)) for kind, stack in streams.items()}
    for kind, restored in found.items():
        assert restored.shape == streams[kind].shape
        assert np.isfinite(restored).all(), kind
    assert not np.array_equal(found["dark"], found["one bright pixel"])
    assert not np.array_equal(found["dark"], found["saturated"])


@pytest.mark.parametrize("name", EVERY)
def test_it_looks_ahead_as_far_as_it_says(name):
    """A frame beyond the stated future changes nothing; the description of a network of clips states the future."""
    codes = random_codes(40, 8, 8)
    method = method_of(name)
    if hasattr(tiny(name), "look_ahead"):
        assert method.description == f"a network; look-ahead {method.look_ahead} frames"
    stack = codes.read(0, 40).copy()
    stack[9 + method.look_ahead + 1 :] = 7 - stack[9 + method.look_ahead + 1 :]
    np.testing.assert_array_equal(method.restore(stream_of(codes, stack), 8, 10), method.restore(codes, 8, 10))


@pytest.mark.parametrize("name", EVERY)
def test_a_stored_network_restores_the_same(name, tmp_path):
    network = lively(name)
    codes = random_codes(3, 12, 18)
    save(network, network.config, tmp_path / "w.safetensors")
    stored = network_restorer(tmp_path / "w.safetensors", RestoreOptions())
    np.testing.assert_array_equal(stored.restore(codes), method_of(name).restore(codes))


@pytest.mark.parametrize("name", EVERY)
def test_half_precision_stays_near(name):
    codes = random_codes(3, 16, 16)
    full, low = (method_of(name, precision=p).restore(codes) for p in ("float32", "bfloat16"))
    assert 0 < np.abs(low - full).max() < 0.2 * max(codes.white, np.abs(full).max())


SLOW = ("quiver", "spk2imgnet", "rvrt")  # more than two seconds


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in EVERY])
def test_a_frame_beyond_the_memory_is_cut_exactly_or_with_a_word(name, monkeypatch):
    """Tiles change nothing, or a warning states by how much they differ and, where that is known, what avoids it."""
    monkeypatch.setattr("quiver.restoration.pieces.TILING", 0)  # a small frame would fit into it
    network = lively(name)
    codes = random_codes(2, 96, 130)
    memory = bytes_needed(network, 1, 9_000)
    assert len(cut_pieces(network, 96, 130, memory).tiles) > 1
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cut = method_of(name, memory=memory).restore(codes)
    said = [str(w.message) for w in caught if "differ where they overlap by" in str(w.message)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = method_of(name, memory=10**12).restore(codes)
        assert np.isfinite(cut).all()
        if not said:
            assert np.abs(cut - whole).max() < 1e-5 * codes.white
            return
        assert np.abs(cut - whole).max() > 0
        assert np.sqrt(np.mean((cut - whole) ** 2)) < 0.5 * codes.white
        for needed in re.findall(r"--memory (\d+)MB avoids the cut", said[0]):
            np.testing.assert_array_equal(method_of(name, memory=int(needed) * 10**6).restore(codes), whole)


MEMORY_PROGRAM = """
import warnings
import numpy as np
import torch
from qsim.process import peak_memory, reset_peak
from quiver.data.codes import array_codes
from quiver.data.illumination import Illumination
from quiver.model.presets import build
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.networks import wrap_network
warnings.simplefilter("ignore")
torch.set_num_threads(1)
sensor = Illumination().device(5e-4)
codes = array_codes(np.random.default_rng(0).integers(0, 8, (40, 256, 256), dtype=np.uint8), sensor, 5e-4)
method = wrap_network(build("{name}"), "n", "", RestoreOptions(memory={memory}))
before = reset_peak()
method.restore(codes, 16, 18)
print(peak_memory() - before)
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mergenet", *COMPARED])
def test_the_memory_bound_holds(name):
    """400 MB for frames of 256 x 256 px; peak of resident pages, in a separate process. QUIVER: test_networks.py."""
    run = subprocess.run(
        [sys.executable, "-c", MEMORY_PROGRAM.format(name=name, memory=400_000_000)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert int(run.stdout) < 1.1 * 400_000_000
