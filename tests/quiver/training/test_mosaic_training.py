"""Tests networks on mosaics: the linear estimate, the learned end, training, stored weights and restoring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from clips import colour_clip, colour_dataset
from runs import TINY, same_weights, settings, tiny
from torch import nn
from torch.utils.data import default_collate

from qsim.sensor.colour_filter import MASKS, ColourFilter
from qsim.sensor.demosaicing import demosaic, kernels_of
from qsim.sensor.qis import QIS
from quiver.cli import main
from quiver.data.clips import open_clips
from quiver.data.codes import array_codes, stream_codes
from quiver.data.windows import Windows, WindowSettings
from quiver.model.mosaic_network import MosaicNet, MosaicNetConfig
from quiver.model.presets import on_mosaics
from quiver.model.weights import load, save
from quiver.restoration import learned_bands
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.networks import network_restorer, wrap_network
from quiver.training.loop import train
from quiver.training.mosaic_training import linear_bands
from quiver.training.systems import system_of

SENSOR = QIS(0.8, 5.0, 0.2, 3)
MASK = MASKS["rggb"]
SLOW = ("memdeblur", "rvrt")
NETWORKS = [
    pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
    for name in sorted(set(TINY) - {"student-teacher"})
]


@pytest.fixture(scope="module")
def mosaics(tmp_path_factory):
    path = tmp_path_factory.mktemp("mosaics") / "data"
    return colour_dataset(path, {"train": 1, "val": 1, "test": 1}, SENSOR, ppp=6.0, colour="rggb", name="s")


def with_random_end(network: nn.Module, mask=MASK) -> MosaicNet:
    """The network with an end whose last layer is not zero."""
    torch.manual_seed(1)
    found = on_mosaics(network, mask)
    nn.init.normal_(found.leave.weight, std=0.05)
    return found.eval()


@pytest.mark.parametrize("mask", [MASK, MASKS["quad"], MASKS["rgbw"], ("RGB",), ("RGW", "BGR")])
def test_the_linear_estimate_is_that_of_qsim(mask):
    """Of two frames with other filters each, and sides that no number of tiles fills."""
    rng = np.random.default_rng(0)
    light = rng.random((2, 11, 13))
    leaks = {"R": (0.5, 0.2, 0.1), "G": (0.05, 0.6, 0.06), "B": (0.0, 0.1, 0.5), "W": (0.6, 0.6, 0.5)}
    filters = [ColourFilter(mask), ColourFilter(mask, {letter: leaks[letter] for letter in set("".join(mask))})]
    kernels = torch.from_numpy(np.stack([kernels_of(each, 0.8) for each in filters]))
    found = linear_bands(torch.from_numpy(light), kernels).numpy()
    for i in range(2):
        np.testing.assert_allclose(found[i], demosaic(light[i], filters[i], 0.8, floor=False), atol=1e-12)


def test_places_are_split_and_joined():
    frames = torch.arange(2 * 3 * 4 * 6.0).reshape(2, 3, 4, 6)
    places = MosaicNet.split(frames, (2, 3))
    assert places.shape == (2, 18, 2, 2)
    assert torch.equal(places[:, 6 + 4], frames[:, 1, 1::2, 1::3]), "band 1, row 1, column 1"
    assert torch.equal(MosaicNet.join(places, (2, 3)), frames)


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_learns_from_mosaics(mosaics, name):
    """Untrained ends return the linear estimate of the restored places; then both parts get gradients."""
    torch.manual_seed(0)
    network = on_mosaics(tiny(name), MASK)
    system = system_of(network)
    settled = WindowSettings(frames=max(11, system.frames), crop=max(16, system.multiple))
    source = Windows(open_clips(mosaics, "train"), settled, prepare=system.prepare)
    batch = default_collate([source[0], source[1]])
    bands, first = system.restored(network, batch)
    assert bands.shape[2:] == (3, settled.crop, settled.crop)
    assert 0 <= first <= settled.frames - bands.shape[1]
    wanted = settings(mosaics, mosaics, loss=system.losses[0], crop=settled.crop, frames=settled.frames)
    system.loss(network, batch, wanted, 0.5).backward()
    moved = [part for part in ("core", "leave") if any(_moves(p) for p in getattr(network, part).parameters())]
    assert moved == ["core", "leave"]


def _moves(parameter: nn.Parameter) -> bool:
    return parameter.grad is not None and bool(parameter.grad.abs().max() > 0)


def test_training_and_restoring_agree(mosaics, tmp_path):
    """What a batch shows of a frame is what the stored weights restore, in every part of the frame."""
    clip = colour_clip(tmp_path / "c", frames=11, height=32, width=48)
    stream = clip.sense(SENSOR, ppp=6.0, colour="rggb", name="s")
    network = with_random_end(tiny("unet"))
    save(network, network.config, tmp_path / "mine.safetensors")
    again = load(tmp_path / "mine.safetensors")
    assert same_weights(network, again)
    assert again.config == network.config
    system = system_of(network)
    codes = stream_codes(stream)
    sample = {
        "codes": torch.from_numpy(codes.read(0, 11) / np.float32(7))[None, :, None],
        "white": torch.tensor([codes.white]),
        **{name: value[None] for name, value in system.prepare(codes, 0).items()},
    }
    with torch.no_grad():
        bands, first = system.restored(network, sample)
    method = network_restorer(tmp_path / "mine.safetensors", RestoreOptions())
    found = method.restore(codes, first, first + 1)
    np.testing.assert_allclose(found[0], bands[0, 0].numpy() * codes.white, rtol=1e-4, atol=1e-4)
    assert "on mosaics of RG GB" in method.description


def test_a_stream_that_begins_elsewhere_in_the_tile(monkeypatch):
    """Its bands are those of the frame around it, away from the borders; so are those of a frame in parts."""
    torch.manual_seed(0)
    network = MosaicNet(MosaicNetConfig("UNet", {"width": 4}, MASK, width=8, layers=1), tiny("unet"))
    nn.init.normal_(network.leave.weight, std=0.05)
    end = learned_bands.LearnedBands("mine", network)
    light = np.random.default_rng(0).random((70, 50)) + 0.5
    light[0] = light[:, 0] = light[1:, 1:].mean()  # both frames have the same mean
    whole = end(frames_of(light, ColourFilter(MASK)), light)
    linear = demosaic(light, ColourFilter(MASK), 0.8, floor=False)
    assert np.abs(whole - linear).max() > 0.01, "the end acts"
    monkeypatch.setattr(learned_bands, "ROWS_AT_ONCE", 5)
    np.testing.assert_allclose(end(frames_of(light, ColourFilter(MASK)), light), whole, atol=1e-5)
    cut = light[1:, 1:]
    odd = end(frames_of(cut, ColourFilter(MASK).shifted(1, 1)), cut)
    margin = 2 * network.reach + 6
    inner = (slice(None), slice(margin, -margin), slice(margin, -margin))
    assert odd[inner].size > 0
    np.testing.assert_allclose(odd[inner], whole[:, 1:, 1:][inner], atol=1e-5)


def frames_of(light, filters):
    """One frame of codes behind filters, of the size of some light."""
    return replace(array_codes(np.zeros((1, *light.shape), np.uint8), SENSOR, 1e-3), colour=filters)


@pytest.fixture(scope="module")
def run(mosaics, tmp_path_factory):
    """The folder of two steps of the command."""
    out = tmp_path_factory.mktemp("runs") / "a"
    assert main(line_of(mosaics, out)) == 0
    return out


def line_of(data, out, *more):
    own = ["--preset", "unet", "--protocol", "control", "--steps", "2", "--crop", "16", "--batch", "2"]
    return ["train", str(data), "-o", str(out), *own, "--validate-every", "2", *more]


def test_a_run_stores_weights_for_its_mask(run):
    mine = load(run / "best.safetensors")
    assert isinstance(mine, MosaicNet)
    assert mine.config.mask == MASK
    grey = array_codes(np.zeros((11, 16, 16), np.uint8), SENSOR, 1e-3)
    method = network_restorer(run / "best.safetensors", RestoreOptions())
    with pytest.raises(ValueError, match="a: was trained on mosaics of the mask RG GB, and codes has one band"):
        method.restore(grey)
    with pytest.raises(ValueError, match="a: was trained on the mask RG GB, and codes has RG WB"):
        method.restore(replace(grey, colour=ColourFilter(MASKS["rgbw"])))


@pytest.mark.slow
def test_a_run_goes_on_starts_from_weights_and_is_scored(mosaics, run, tmp_path):
    assert main(line_of(mosaics, run)) == 0, "a finished run"
    assert main(line_of(mosaics, tmp_path / "b", "--start", str(run))) == 0
    methods = f"naive,{run}"
    assert main(["evaluate", str(mosaics), "-o", str(tmp_path / "t"), "--methods", methods, "--stream", "s"]) == 0
    rows = (tmp_path / "t/rows.jsonl").read_text().splitlines()
    assert len(rows) == 2


def test_what_cannot_learn_colour_is_refused(mosaics, tiny_dataset, tmp_path):
    with pytest.raises(ValueError, match="student-teacher: learns from other windows than a mosaic has"):
        train(tiny("student-teacher"), settings(mosaics, tmp_path / "a", loss="own"), progress=False)
    own = on_mosaics(tiny("unet"), MASK)
    with pytest.raises(ValueError, match="these weights restore mosaics, and the clips have one band"):
        train(own, settings(tiny_dataset, tmp_path / "b"), progress=False)
    with pytest.raises(ValueError, match="these weights are for the mask RG GB, and the clips have RG WB"):
        on_mosaics(own, MASKS["rgbw"])
    for change, words in ({"core": "MosaicNet"}, "no network is called"), ({"mask": ("RG", "B")}, "is no tile"):
        values = {"core": "UNet", "settings": {"width": 4}, "mask": MASK} | change
        with pytest.raises(ValueError, match=words):
            _loaded(tmp_path, values)
    assert wrap_network(own, "own", "", RestoreOptions()).bands is not None


def _loaded(folder, values):
    """Weights whose description has these values."""
    network = on_mosaics(tiny("unet"), MASK)

    class Config:
        def to_dict(self):
            return values

    save(network, Config(), folder / "x.safetensors")
    return load(folder / "x.safetensors")


def test_a_configuration_states_its_tile():
    assert MosaicNetConfig("UNet").tile == (2, 2)
    assert MosaicNetConfig.from_dict(MosaicNetConfig("UNet", {"width": 4}).to_dict()).settings == {"width": 4}
