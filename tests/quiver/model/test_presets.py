"""Tests networks by name: their sizes, and the ablations of the paper."""

import pytest
import torch
from golden import FOLDED, SMALL, draw, lively

from quiver.model import schedules
from quiver.model.config import Config
from quiver.model.presets import ABLATIONS, PRESETS, ablated, build, parameter_count
from quiver.model.unet import UNet


def test_the_published_sizes_to_the_last_parameter():
    assert parameter_count(PRESETS["quiver"]) == 156_755_311
    assert parameter_count(PRESETS["quiver-s"]) == 10_866_583
    assert parameter_count(Config(channels=32)) == 40_091_487


def test_nano_fits_its_file():
    """The shipped weights may have 5 MB of float32; the control has a similar size."""
    assert 4 * parameter_count(PRESETS["nano"]) < 5e6
    assert sum(p.numel() for p in UNet().parameters()) == 911_841


def test_networks_by_name():
    network = build("nano")
    side = 2 * int(network.multiple)  # type: ignore[call-overload]
    out = network(draw(2, 12, 1, side, side + int(network.multiple), dtype=torch.float32))  # type: ignore[call-overload]
    assert out.scale1.shape == (2, 2, 1, side, side + int(network.multiple))  # type: ignore[call-overload]


@pytest.mark.parametrize("row", ABLATIONS)
@pytest.mark.parametrize("preset", ["quiver", "nano"])
def test_ablations_keep_the_capacity(preset, row):
    wanted = parameter_count(PRESETS[preset])
    assert abs(parameter_count(ablated(PRESETS[preset], row)) / wanted - 1) < 0.005


@pytest.mark.parametrize("row", ABLATIONS)
def test_ablations_lack_what_they_say(row):
    pre_denoiser, flow, multi_scale = ABLATIONS[row]
    config = ablated(FOLDED, row)
    network = lively(config)
    assert (network.denoiser is None, network.flow is None) == (not pre_denoiser, not flow)
    out = network(draw(1, 11, 1, 16, 16))
    assert (out.denoised is None, out.flow is None) == (not pre_denoiser, not flow)
    assert (out.scale2 is None, out.scale4 is None) == (not multi_scale, not multi_scale)
    assert torch.isfinite(out.scale1).all()
    x = draw(1, 13, 1, 16, 16)
    with torch.no_grad():
        windows, exact = (torch.stack(list(run(network, x.unbind(1)))) for run in (schedules.windows, schedules.exact))
    assert torch.allclose(windows, exact, atol=1e-10)


def test_an_unknown_ablation_is_named():
    assert ablated(SMALL, "all") == SMALL
    with pytest.raises(ValueError, match="no ablation is called 'some'; known: ") as raised:
        ablated(SMALL, "some")
    assert set(str(raised.value).partition("known: ")[2].split(", ")) == set(ABLATIONS)
