"""Networks that take clips: every frame of any clip, the same in ranges and parts."""

from __future__ import annotations

import bisect
import json
import tracemalloc
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from numpy import ndarray as Array
from random_codes import random_codes
from runs import EVERY, tiny
from torch import Tensor, nn

from qsim.sensor.qis import QIS
from quiver.cli.program import main
from quiver.data.codes import Codes, array_codes
from quiver.data.noise_table import noise_table
from quiver.model.presets import build
from quiver.model.rivals.edges import reflected
from quiver.model.weights import save
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.networks import network_restorer, wrap_network
from quiver.restoration.pieces import part_of, takes_clips

CLIPS = [name for name in EVERY if takes_clips(tiny(name))]


class Means(nn.Module):
    """Restores a frame as the mean of a window: one frame before it, and two after."""

    frames_in: ClassVar[int] = 4
    look_ahead: ClassVar[int] = 2

    def __init__(self) -> None:
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))
        self.longest = self.computed = 0

    def forward(self, frames: Tensor) -> Tensor:
        count = frames.shape[1]
        self.longest = max(self.longest, count)
        seen = frames[:, reflected(-1, count + 3, count)]
        return torch.stack([seen[:, t : t + 4].mean(dim=1) for t in range(count)], dim=1)


class Sums(Means):
    """Restores a frame as an eighth of the sum of all frames up to it: sees the complete past."""

    frames_in = property()  # type: ignore[assignment]
    look_ahead = 0

    def forward(self, frames: Tensor) -> Tensor:
        self.longest = max(self.longest, frames.shape[1])
        self.computed += frames.shape[1]
        return frames.cumsum(dim=1) / 8


def restored(network: nn.Module, codes: Codes, options: RestoreOptions | None = None, *span: int) -> Array:
    return wrap_network(network, "n", "", options or RestoreOptions()).restore(codes, *span)


def complete(network: nn.Module, codes: Codes) -> Array:
    """The network's own result for the complete clip, in photons."""
    top = np.float32(codes.sensor.levels - 1)
    frames = torch.from_numpy(codes.read(0, codes.shape[0]) / top)[None, :, None]
    known = {}
    if getattr(network, "takes_variance", False):
        known["variance"] = torch.tensor(noise_table(codes.sensor, codes.exposure))
    with torch.inference_mode():
        return network.eval()(frames, **known)[0, :, 0].numpy() * np.float32(codes.white)


@pytest.mark.parametrize("frames", [1, 3, 16, 17, 50])
def test_windows_are_those_of_the_complete_clip(frames):
    network = Means()
    codes = random_codes(frames, 5, 7)
    np.testing.assert_allclose(restored(network, codes), complete(network, codes), rtol=1e-5)
    part = part_of(network)
    assert (part.before, part.after, part.past, part.future) == (1, 2, 1, 2)
    network.longest = 0
    restored(network, codes)
    assert network.longest <= part.before + part.kept + part.after  # the memory does not grow with the clip


def test_a_range_of_frames_is_that_of_the_complete_stream():
    """Though a recurrent network sees its past from the beginning of a part on."""
    rng = np.random.default_rng(0)
    codes = random_codes(60, 4, 4)
    for network in (Means(), Sums()):
        whole = restored(network, codes)
        for _ in range(10):
            first, last = sorted(int(n) for n in rng.integers(0, 61, 2))
            if first < last:
                np.testing.assert_array_equal(restored(network, codes, None, first, last), whole[first:last])


@pytest.mark.parametrize(("frames", "computed"), [(1, 1), (24, 24), (32, 32), (33, 32 + 11), (96, 32 + 42 + 42)])
def test_a_recurrent_network_computes_only_the_past_of_parts_again(frames, computed):
    network = Sums()
    codes = random_codes(frames, 3, 4)
    restored(network, codes)
    assert network.computed == computed


@pytest.mark.parametrize("name", [name for name in CLIPS if hasattr(tiny(name), "windows")])
def test_only_the_windows_of_wanted_frames_are_computed(name, monkeypatch):
    """Frames 14 ... 18 lie in two parts; each is computed once, and as in the complete clip, bit for bit."""
    network = tiny(name).eval()
    codes = random_codes(20, 9, 14)
    computed = []
    whole = restored(network, codes)
    windows = network.windows

    def counted(frames: Tensor, **known: Tensor) -> Tensor:
        computed.append(frames.shape[1] - network.frames_in + 1)
        return windows(frames, **known)

    monkeypatch.setattr(network, "windows", counted)
    np.testing.assert_array_equal(restored(network, codes, None, 14, 19), whole[14:19])
    assert computed == [2, 3]


@pytest.mark.parametrize("name", CLIPS)
@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 3, 5), (3, 10, 7)])
def test_every_frame_of_any_size_is_restored(name, shape):
    """A clip shorter than a part: the result is the network's own."""
    network = tiny(name).eval()
    codes = random_codes(*shape)
    found = restored(network, codes)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, complete(network, codes), rtol=1e-3, atol=1e-4 * codes.white)


@pytest.mark.parametrize("name", ["emvd", "flornn", "fastdvdnet"])
def test_the_noise_of_the_stream_is_that_of_its_sensor(name):
    """The same codes over the top code, of a sensor with five bits and of one with three: other noise, as stated."""
    network = tiny(name).eval()
    three = random_codes(2, 12, 16)
    five = replace(three, sensor=QIS(0.8, 1.6, 2.0, 5, gain=0.3), read=lambda a, b: three.read(a, b) * 31 // 7)
    found = restored(network, five)
    wanted = complete(network, five)
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-4 * five.white)
    network.takes_variance = False
    assert np.abs(restored(network, five) - wanted).max() > 1e-3 * five.white
    with pytest.raises(ValueError, match="does not rise with light"):
        restored(tiny(name), replace(three, sensor=QIS(0.8, 1e9, 0.2, 3)))


def test_weights_are_restored_and_scored_by_the_commands(tiny_dataset, tmp_path, capsys):
    """The file names its network; the rows and the description of the video state it."""
    network = tiny("emvd")
    save(network, network.config, tmp_path / "mine.safetensors")
    clip = tiny_dataset / "clips" / "test_0000"
    weights = str(tmp_path / "mine.safetensors")
    out = tmp_path / "out.npy"
    assert main(["restore", str(clip), "--ppp", "3.25", "--method", weights, "-o", str(out), "-q"]) == 0
    assert np.load(out).shape == (14, 36, 44)
    described = json.loads(out.with_suffix(".json").read_text())
    assert described["description"].startswith("EMVD, weights ")
    assert described["description"].endswith("; look-ahead 0 frames")
    assert main(["evaluate", str(tiny_dataset), "-o", str(tmp_path / "t"), "--methods", weights, "-q"]) == 0
    table = json.loads((tmp_path / "t/evaluation.json").read_text())
    assert [m["future"] for m in table["methods"]] == [0]
    capsys.readouterr()
    assert main(["restore", str(clip), "--ppp", "3.25", "--method", weights, "--mode", "exact", "-o", "x.npy"]) == 2
    assert "it has one mode" in capsys.readouterr().err


def test_presets_have_a_title(tmp_path):
    network = build("emvd")
    save(network, network.config, tmp_path / "w.safetensors")
    assert network_restorer(tmp_path / "w.safetensors", RestoreOptions()).description.startswith("EMVD (emvd), weights")


def test_only_a_tile_of_a_part_becomes_float32():
    """Frames of a part hold four times the bytes of their codes as float32; a tile is all that is needed at a time."""
    network = Means()
    codes = random_codes(24, 256, 256)
    whole = restored(network, codes, None, 0, 1)
    part = part_of(network)
    method = wrap_network(network, "n", "", RestoreOptions(memory=40_000_000))
    tracemalloc.start()
    try:
        with pytest.warns(UserWarning, match="cut into"):
            tiled = method.restore(codes, 0, 1)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_allclose(tiled, whole, rtol=1e-5)
    assert peak < 4 * (part.kept + part.after) * 256 * 256


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["memdeblur", "bit2bit"])
def test_a_frame_depends_on_as_many_frames_as_is_stated(name, every):
    """23 and 47 were stated: the most frames before and after, which no frame sees both of.

    Quickly the ends of what it depends on are searched by halving.
    """
    method = wrap_network(tiny(name), name, name, RestoreOptions(device="cpu"))
    codes = random_codes(56, 16, 16)
    data = codes.read(0, 56)
    frame = 20
    before = method.restore(codes, frame, frame + 1)

    def changes(t: int) -> bool:
        other = data.copy()
        other[t] = 7 - other[t]
        restored = method.restore(array_codes(other, codes.sensor, codes.exposure), frame, frame + 1)
        return not np.array_equal(restored, before)

    if every:
        count = sum(changes(t) for t in range(56))
    else:
        unchanged_from = bisect.bisect_left(range(frame, 56), True, key=lambda t: not changes(t)) + frame
        changed_from = bisect.bisect_left(range(frame), True, key=changes)
        count = unchanged_from - changed_from
    assert count == method.frames_used < method.window
