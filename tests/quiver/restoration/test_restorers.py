"""Methods are found by name; restored files are complete or absent, and interrupted ones resume."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from clips import ClipMaker
from numpy import ndarray as Array
from random_codes import EXPOSURE, SENSOR, random_codes

from qsim.restored_video import Restored
from quiver.baselines import METHODS, batched
from quiver.baselines.batched import methods
from quiver.data.codes import Codes, sensed
from quiver.data.illumination import Illumination
from quiver.evaluation import metrics
from quiver.model.presets import build
from quiver.model.unet import UNet, UNetConfig
from quiver.model.weights import save
from quiver.restoration import restored_file
from quiver.restoration import restorers as restorers_module
from quiver.restoration.interface import RestoreOptions, Restorer
from quiver.restoration.networks import network_restorer
from quiver.restoration.restored_file import restore_to_file
from quiver.restoration.restorers import method_names, restorer, restorers, shipped_names, weights_path

DEFAULTS = RestoreOptions()


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


@pytest.mark.parametrize("name", ["moment:3", "qbp", "qbp-bm3d"])
def test_on_a_gpu_classical_methods_run_in_batches(name, monkeypatch):
    """The CPU takes the place of the GPU; results are those of the CPU's own form, but for rounding."""
    codes = random_codes(7, 20, 25)
    expected = restorer(name).restore(codes, 1, 6)
    asked = []

    def noted(*given: object, **settings: object) -> Array:
        asked.append(settings["frames"])
        return methods.restore(*given, **settings)

    monkeypatch.setattr(restorers_module, "pick_device", lambda wanted: "cuda")
    monkeypatch.setattr(restorers_module, "device_of_process", lambda kind: torch.device("cpu"))
    monkeypatch.setattr(restorers_module, "is_gpu", lambda device: True)
    monkeypatch.setattr(batched, "methods", SimpleNamespace(restore=noted))
    there = restorer(name, RestoreOptions(device="cuda", memory=10**9))
    assert there.device == "cuda"
    np.testing.assert_allclose(there.restore(codes, 1, 6), expected, atol=1e-4)
    assert asked == [range(1, 6)]


def test_methods_of_one_table_have_names_of_their_own(tmp_path):
    names = [method.name for method in restorers(["all", "moment", "moment:3"])]
    assert names == [*method_names(), "moment:3"]
    network = UNet(UNetConfig(2))
    save(network, network.config, tmp_path / "mergenet.safetensors")
    with pytest.raises(ValueError, match=r"methods 'mergenet' and '.*' are both called 'mergenet'; rename the folder"):
        restorers(["all", str(tmp_path / "mergenet.safetensors")])


def test_the_shipped_weights_are_useful_at_once(make_clip: ClipMaker):
    """A pattern that no training saw, 1.5 px/frame: measured 9.3 dB above the best window mean; 5 dB must be there."""
    clip = make_clip(frames=15, height=64, width=72)
    codes, truth = sensed(clip, Illumination())
    target = truth.video() / codes.white

    def psnr(name: str) -> float:
        return metrics.score(restorer(name).restore(codes) / codes.white, target).psnr_matched

    assert psnr("mergenet") > max(psnr(f"moment:{window}") for window in (1, 3, 5, 7, 9, 11)) + 5


@pytest.mark.parametrize("name", shipped_names())
def test_shipped_weights_are_small_and_have_a_card(name):
    assert weights_path(name).stat().st_size < 5e6
    card = weights_path(name).with_suffix(".md").read_text()
    assert f"{sum(p.numel() for p in build(name).parameters()):,} parameters" in card


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
    with pytest.raises(ValueError, match=r"no method 'fastdvd' \(did you mean 'fastdvdnet'\?\)"):
        restorer("fastdvd")
    for name in ("unet", "emvd-1m", "rvrt"):
        with pytest.raises(ValueError, match=rf"^{name}: a network without shipped weights; train it"):
            restorer(name)
    (tmp_path / "young").mkdir()
    (tmp_path / "young/settings.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match=r"a training run without best\.safetensors"):
        restorer(str(tmp_path / "young"))


def test_a_run_has_the_name_of_its_folder_from_any_folder(tmp_path, monkeypatch):
    network = UNet(UNetConfig(2))
    save(network, network.config, tmp_path / "best.safetensors")
    (tmp_path / "logs").mkdir()
    for place, given in (("", "."), ("", "best.safetensors"), ("logs", ".."), ("logs", "../best.safetensors")):
        monkeypatch.chdir(tmp_path / place)
        assert restorer(given, RestoreOptions(device="cpu")).name == tmp_path.name


def test_a_restored_file_says_what_it_is(tmp_path):
    codes = random_codes(5, 6, 7)
    path = tmp_path / "video.npy"
    info = restore_to_file(codes, restorer("moment"), path)
    stored = np.load(path)
    assert stored.dtype == np.float32
    np.testing.assert_array_equal(stored, restorer("moment").restore(codes))
    assert Restored.open(tmp_path / "video.json").info == info
    assert (info.method, info.unit, info.shape) == ("moment", "photons", (5, 6, 7))
    assert info.white == pytest.approx(8.125)


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
    codes = random_codes(14, 5, 6)
    moment = restorer("moment")
    starts = []

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        starts.append(first)
        moment.fill(codes, out, first, None)
        if len(starts) == 3:
            raise KeyboardInterrupt

    slow = replace(moment, fill=fill)
    path = tmp_path / "video.npy"
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
    assert starts[3:] == [0, 4, 8, 12]  # another method does not reuse these frames
