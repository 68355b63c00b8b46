"""Any length, any size, tiles, ranges of frames, files that are whole or absent."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from clips import ClipMaker
from numpy import ndarray as Array
from torch import Tensor, nn

from qsim.sensor.qis import QIS
from quiver.baselines import METHODS
from quiver.data.clips import truth
from quiver.data.codes import Codes, array_codes, sensed
from quiver.data.illumination import Illumination
from quiver.evaluation import metrics
from quiver.model.blocks import Output
from quiver.model.presets import build
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import save
from quiver.restoration import restored_file
from quiver.restoration.interface import RestoreOptions, Restorer
from quiver.restoration.networks import fill_network, network_restorer
from quiver.restoration.restored_file import restore_to_file
from quiver.restoration.restorers import method_names, restorer, restorers, weights_path

EXPOSURE = 5e-4
DEFAULTS = RestoreOptions()
SENSOR = QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25)


def random_codes(frames: int, height: int, width: int, seed: int = 0) -> Codes:
    drawn = np.random.default_rng(seed).integers(0, 8, (frames, height, width), dtype=np.uint8)
    return array_codes(drawn, SENSOR, EXPOSURE)


class CentreFrame(nn.Module):
    """Returns the centre of its window untouched: whatever padding and tiling do, the codes must come back."""

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
    """The mean of its window: shows which frames a window held."""

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
    codes, model = random_codes(*shape), CentreFrame()
    expected = codes.read(0, shape[0]) * (codes.white / 7)
    np.testing.assert_allclose(run(model, codes), expected, rtol=1e-6)
    assert all(seen[3] % 8 == seen[4] % 8 == 0 for seen in model.seen)


@pytest.mark.parametrize("frames", [1, 2, 4, 14])
def test_time_is_continued_by_reflection(frames):
    """Frame 0 sees frames 5 4 3 2 1 0 1 2 3 4 5 (folded again where the clip is shorter)."""
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
    codes, model = random_codes(4, 16, 16), build("nano").eval()
    windows = run(model, codes, RestoreOptions(mode="windows"))
    np.testing.assert_allclose(run(model, codes, RestoreOptions(mode="exact")), windows, atol=2e-4)
    assert np.isfinite(run(model, codes, RestoreOptions(mode="streaming"))).all()
    low = run(model, codes, RestoreOptions(mode="windows", precision="bfloat16"))
    assert 0 < np.abs(low - windows).max() < 0.1 * codes.white


@pytest.mark.parametrize("name", METHODS)
def test_classical_methods_are_found_by_name(name):
    method = restorer(name)
    assert not method.learned
    assert method.look_ahead == (method.window - 1) // 2
    assert "frames" not in method.name


def test_a_window_after_the_colon():
    codes = random_codes(6, 4, 5)
    three = restorer("moment:3")
    assert (three.window, three.look_ahead, three.name) == (3, 1, "moment:3")
    expected = METHODS["moment"].restore(codes.read(0, 6), SENSOR, EXPOSURE, window=3)
    np.testing.assert_array_equal(three.restore(codes), expected)
    with pytest.raises(ValueError, match="as in moment:5"):
        restorer("moment:many")


def test_methods_of_one_table_have_names_of_their_own(tmp_path):
    names = [method.name for method in restorers(["all", "moment", "moment:3"])]
    assert names == [*method_names(), "moment:3"]
    network = UNet(UNetConfig(2))
    save(network, network.config, tmp_path / "nano.safetensors")
    with pytest.raises(ValueError, match=r"methods 'nano' and '.*' are both called 'nano'; rename the folder of one"):
        restorers(["all", str(tmp_path / "nano.safetensors")])


def test_the_shipped_weights_are_useful_at_once(make_clip: ClipMaker):
    """A pattern that no training saw, 1.5 px/frame: measured 6.9 dB above the best window mean; 4 dB must be there."""
    clip = make_clip(frames=15, height=64, width=72)
    codes, factor = sensed(clip, Illumination())
    target = truth(clip, factor, 0, len(clip)) / codes.white

    def psnr(name: str) -> float:
        return metrics.score(restorer(name).restore(codes) / codes.white, target).psnr_matched

    assert psnr("nano") > max(psnr(f"moment:{window}") for window in (1, 3, 5, 7, 9, 11)) + 4
    assert weights_path("nano").stat().st_size < 5e6
    card = weights_path("nano").with_suffix(".md").read_text()
    assert f"{sum(p.numel() for p in build('nano').parameters()):,} parameters" in card


def test_weights_are_found_by_file_folder_and_name(tmp_path):
    network = UNet(UNetConfig(2))
    save(network, network.config, tmp_path / "best.safetensors")
    assert weights_path(str(tmp_path)) == weights_path(str(tmp_path / "best.safetensors"))
    found = network_restorer(tmp_path / "best.safetensors", RestoreOptions(device="cpu"))
    assert found.name == tmp_path.name
    assert found.learned
    assert found.description.startswith("U-Net, weights ")
    with pytest.raises(FileNotFoundError, match="no such weights file"):
        restorer(str(tmp_path / "none.safetensors"))
    with pytest.raises(ValueError, match=r"no method 'momnt' \(did you mean 'moment'\?\); known are naive, "):
        restorer("momnt")
    (tmp_path / "young").mkdir()
    (tmp_path / "young/settings.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match=r"a training run without best\.safetensors"):
        restorer(str(tmp_path / "young"))


def test_a_restored_file_says_what_it_is(tmp_path):
    codes, path = random_codes(5, 6, 7), tmp_path / "video.npy"
    meta = restore_to_file(codes, restorer("moment"), path)
    stored = np.load(path)
    assert stored.dtype == np.float32
    np.testing.assert_array_equal(stored, restorer("moment").restore(codes))
    assert json.loads((tmp_path / "video.json").read_text()) == meta
    assert (meta["method"], meta["unit"], meta["shape"]) == ("moment", "photons", [5, 6, 7])
    assert meta["white"] == pytest.approx(8.125)


def test_a_failed_restoration_leaves_nothing(tmp_path):
    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        out[:] = np.nan

    broken = Restorer("broken", 1, 0, True, "", fill)
    with pytest.raises(ValueError, match="broken: restored frame 0 holds NaN or Inf"):
        restore_to_file(random_codes(2, 3, 4), broken, tmp_path / "video.npy")
    dying = replace(broken, fill=lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        restore_to_file(random_codes(2, 3, 4), dying, tmp_path / "video.npy")
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_restoration_goes_on(tmp_path, monkeypatch):
    """Blocks of four frames, stopped in the third: the next call starts with frame 8 and ends with the same bytes."""
    monkeypatch.setattr(restored_file, "BLOCK_FRAMES", 4)
    codes, moment, starts = random_codes(14, 5, 6), restorer("moment"), []

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        starts.append(first)
        moment.fill(codes, out, first, None)
        if len(starts) == 3:
            raise KeyboardInterrupt

    slow, path = replace(moment, fill=fill), tmp_path / "video.npy"
    with pytest.raises(KeyboardInterrupt):
        restore_to_file(codes, slow, path)
    assert not path.exists()
    restore_to_file(codes, slow, path)
    assert starts == [0, 4, 8, 8, 12]
    np.testing.assert_array_equal(np.load(path), moment.restore(codes))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["video.json", "video.npy"]

    starts.clear()
    with pytest.raises(KeyboardInterrupt):
        restore_to_file(codes, slow, path)
    restore_to_file(random_codes(14, 5, 6), replace(slow, description="another"), path)
    assert starts[3:] == [0, 4, 8, 12]  # another method does not go on with the frames of this one


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mode": "fast"}, "mode 'fast'; known are exact, streaming, windows"),
        ({"precision": "float16"}, "precision 'float16'"),
        ({"memory": 0}, "memory is a number of bytes"),
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
    with pytest.raises(ValueError, match="--device cuda: torch finds no CUDA"):
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
codes = array_codes(np.random.default_rng(0).integers(0, 8, (1, 320, 320), dtype=np.uint8), sensor, 5e-4)
method = wrap_network(build("nano"), "nano", "", RestoreOptions(memory={memory}, mode="{mode}"))
before = reset_peak()
method.restore(codes)
print(peak_memory() - before)
"""


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["exact", "windows"])
def test_the_memory_bound_holds(mode):
    """80 MB for a frame that takes more in one piece; peak of resident pages, in a process of its own."""
    tiled, whole = (
        int(
            subprocess.run(
                [sys.executable, "-c", MEMORY_PROGRAM.format(memory=memory, mode=mode)],
                capture_output=True,
                text=True,
                check=True,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            ).stdout
        )
        for memory in (80_000_000, 1_000_000_000)
    )
    assert tiled < 1.1 * 80_000_000 < whole
