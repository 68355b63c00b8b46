"""Networks on streams of any size: reflected in time, padded in space, equal in every mode and within memory."""

from __future__ import annotations

import os
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from golden import SMALL
from numpy import ndarray as Array
from random_codes import random_codes
from torch import Tensor, nn

from qsim.sensor.spad import BinarySPAD
from quiver.data.codes import Codes, array_codes
from quiver.model.blocks import Output
from quiver.model.config import Config
from quiver.model.presets import build
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import save
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.networks import excess, fill_network, network_title, pictures, wrap_network
from quiver.restoration.pieces import bytes_needed, cut_pieces
from quiver.restoration.restorers import restorer


class CentreFrame(nn.Module):
    """Returns the centre of its window unchanged: with any padding and tiling, the codes must come back."""

    multiple = 8

    def __init__(self) -> None:
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))
        self.seen: list[tuple[int, ...]] = []

    def forward(self, x: Tensor) -> Output:
        self.seen.append(tuple(x.shape))
        centre = x[:, 5:6]
        return Output(x, centre, centre, centre)


class WindowMean(CentreFrame):
    """Returns the mean of its window: shows which frames a window held."""

    def forward(self, x: Tensor) -> Output:
        mean = x.mean(dim=1, keepdim=True)
        return Output(x, mean, mean, mean)


def run(
    model: nn.Module, codes: Codes, options: RestoreOptions | None = None, first: int = 0, count: int | None = None
) -> Array:
    out = np.zeros((count or codes.shape[0], *codes.shape[1:]), np.float32)
    fill_network(model, codes, out, first, options or RestoreOptions(), None)
    return out


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 3, 5), (8, 10, 7), (13, 33, 18)])
def test_every_frame_of_any_size_comes_back(shape):
    codes = random_codes(*shape)
    model = CentreFrame()
    expected = codes.read(0, shape[0]) * (codes.white / 7)
    np.testing.assert_allclose(run(model, codes), expected, rtol=1e-6)
    assert all(seen[3] % 8 == seen[4] % 8 == 0 for seen in model.seen)


@pytest.mark.parametrize("frames", [1, 2, 4, 14])
def test_time_is_continued_by_reflection(frames):
    """The window of frame 0 is frames 5 4 3 2 1 0 1 2 3 4 5 (folded again where the clip is shorter)."""
    codes = random_codes(frames, 4, 4)
    period = max(1, 2 * frames - 2)
    for t in (0, frames - 1):
        folded = [min(i % period, period - i % period) for i in range(t - 5, t + 6)]
        mean = np.mean([codes.read(i, i + 1)[0] for i in folded], axis=0) * (codes.white / 7)
        np.testing.assert_allclose(run(WindowMean(), codes)[t], mean, rtol=1e-5)


def test_a_range_of_frames_equals_that_part_of_the_whole():
    codes = random_codes(14, 10, 7)
    np.testing.assert_array_equal(run(WindowMean(), codes, first=4, count=3), run(WindowMean(), codes)[4:7])
    moment = restorer("moment")
    np.testing.assert_array_equal(moment.restore(codes, 4, 7), moment.restore(codes)[4:7])


def test_modes_of_the_network():
    """Exact equals windows recomputed; streaming is another schedule; bfloat16 stays near float32."""
    torch.manual_seed(0)
    codes = random_codes(4, 16, 16)
    model = QUIVER(SMALL).eval()
    windows = run(model, codes, RestoreOptions(mode="windows"))
    np.testing.assert_allclose(run(model, codes, RestoreOptions(mode="exact")), windows, atol=2e-4)
    assert np.isfinite(run(model, codes, RestoreOptions(mode="streaming"))).all()
    low = run(model, codes, RestoreOptions(mode="windows", precision="bfloat16"))
    assert 0 < np.abs(low - windows).max() < 0.1 * codes.white


@pytest.mark.parametrize(("mode", "ahead"), [("exact", 5), ("windows", 5), ("streaming", 7)])
def test_the_stated_look_ahead_is_that_of_the_mode(mode, ahead):
    """The first restored frame is number 5: it needs frames up to 5 + look-ahead, and no others are read before it."""
    model = QUIVER(SMALL).eval()
    read = []
    method = wrap_network(model, "q", "", RestoreOptions(mode=mode, device="cpu"))

    def frames() -> Iterator[Tensor]:
        for t in range(20):
            read.append(t)
            yield torch.rand(1, 1, 16, 16)

    with torch.inference_mode():
        next(pictures(model, frames(), mode))
    assert method.look_ahead == read[-1] - 5 == ahead
    assert method.window == 5 + 1 + ahead
    assert method.device == "cpu"
    assert method.seamless == (mode != "streaming")  # its state reaches back to the first frame


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mode": "fast"}, "mode: expected one of exact, streaming, windows, got 'fast'"),
        ({"precision": "float16"}, "precision: expected one of float32, bfloat16, got 'float16'"),
        ({"memory": 0}, "memory: expected a whole number from 1, got 0"),
    ],
)
def test_bad_options_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        RestoreOptions(**changes)


def test_cuda_is_asked_for_by_name(tmp_path: Path):
    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    network = UNet(UNetConfig(2))
    save(network, network.config, tmp_path / "w.safetensors")
    with pytest.raises(ValueError, match="device=cuda: torch finds no CUDA"):
        restorer(str(tmp_path / "w.safetensors"), RestoreOptions(device="cuda"))


MEMORY_PROGRAM = """
import numpy as np
from qsim.process import peak_memory, reset_peak
from quiver.data.codes import array_codes
from quiver.data.illumination import Illumination
from quiver.model.presets import build
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.networks import wrap_network
sensor = Illumination().device(5e-4)
codes = array_codes(np.random.default_rng(0).integers(0, 8, (1, {height}, {width}), dtype=np.uint8), sensor, 5e-4)
method = wrap_network(build("{preset}"), "{preset}", "", RestoreOptions(memory={memory}, mode="{mode}"))
before = reset_peak()
method.restore(codes)
print(peak_memory() - before)
"""


def peak_of(height: int, width: int, memory: int, mode: str, preset: str = "quiver-s") -> int:
    """Bytes that a network takes for one frame: peak of resident pages, in a separate process."""
    run = subprocess.run(
        [
            *(sys.executable, "-c"),
            MEMORY_PROGRAM.format(height=height, width=width, memory=memory, mode=mode, preset=preset),
        ],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    return int(run.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["exact", "windows"])
def test_the_memory_bound_holds(mode):
    """225 MB, little more than the smallest tile needs, for a frame that takes more in one piece."""
    tiled, whole = (peak_of(128, 128, memory, mode) for memory in (225_000_000, 1_000_000_000))
    assert tiled < 1.1 * 225_000_000 < whole


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "mode", "side"),
    [
        *(("quiver-s", mode, side) for mode in ("exact", "streaming", "windows") for side in (64, 128)),
        *(("quiver", "exact", side) for side in (32, 64)),  # its weights take more than such a frame
    ],
)
def test_a_frame_that_fits_takes_no_more_than_stated(preset, mode, side):
    """Small frames as well, of which a window could be computed together; 30 MB go to PyTorch itself."""
    stated = bytes_needed(build(preset), side, side)
    assert len(cut_pieces(build(preset), side, side, stated).tiles) == 1
    assert peak_of(side, side, stated, mode, preset) < stated + 30_000_000


def test_a_network_has_a_title():
    config = Config(channels=32)
    titles = {name: network_title(build(name)) for name in ("mergenet", "quiver-s", "unet", "emvd")}
    assert titles == {
        "mergenet": "MergeNet (mergenet)",
        "quiver-s": "QUIVER (quiver-s)",
        "unet": "U-Net",
        "emvd": "EMVD (emvd)",
    }
    assert network_title(QUIVER(config)) == "QUIVER"


def test_light_that_no_codes_can_mean_is_told():
    """A state that grows from frame to frame; light of nine times white is let pass, and on a binary SPAD more."""

    class Growing(CentreFrame):
        def __init__(self, first: float) -> None:
            super().__init__()
            self.light = first

        def forward(self, x: Tensor) -> Output:
            self.light *= 2
            picture = torch.full_like(x[:, 5:6], self.light)
            return Output(x, picture, picture, picture)

    codes = replace(random_codes(6, 8, 8), ppp=0.5)
    cpu = RestoreOptions(device="cpu")
    grown = wrap_network(Growing(1.0), "grown", "", cpu)
    for first in range(3):  # block by block, as a file is restored
        grown.restore(codes, first, first + 1)
    with pytest.warns(UserWarning, match="reaches 16 times .* above 10 times first in frame 3"):
        grown.restore(codes, 3, 4)
    grown.restore(codes, 4, 6)  # it was told
    with pytest.warns(UserWarning, match="above 10 times first in frame 0"):  # another stream is told again
        grown.restore(replace(codes, source="other"))
    assert wrap_network(Growing(9 / 64), "q", "", cpu).restore(codes).max() == pytest.approx(9 * codes.white)
    bright = replace(array_codes(np.ones((6, 8, 8), np.uint8), BinarySPAD(1.0, 0.0, 1), 1e-3), ppp=10.0)
    assert wrap_network(Growing(200 / 64), "q", "", cpu).restore(bright).max() == pytest.approx(200)  # its peak is 25
    with pytest.warns(UserWarning, match="reaches 12 times"):
        wrap_network(Growing(300 / 64), "q", "", cpu).restore(bright)


def test_frames_are_looked_at_one_by_one():
    """A film that fits no memory is a memory map: no copy of it may be made."""
    film = np.zeros((200, 256, 256), np.float32)
    tracemalloc.start()
    assert excess(random_codes(1, 4, 4), film, 0) is None
    assert tracemalloc.get_traced_memory()[1] < film.nbytes / 20
    tracemalloc.stop()
