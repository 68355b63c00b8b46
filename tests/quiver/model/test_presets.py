"""Tests networks by name: their sizes, and the ablations of the paper."""

import pytest
import torch
from golden import SMALL, draw, lively

from quiver.model import schedules
from quiver.model.config import Config
from quiver.model.presets import ABLATIONS, PRESETS, ablated, build, parameter_count
from quiver.model.unet import UNet


def test_the_published_sizes_to_the_last_parameter():
    assert parameter_count(PRESETS["quiver"]) == 156_755_311
    assert parameter_count(PRESETS["quiver-s"]) == 10_866_583
    assert parameter_count(Config(channels=32)) == 40_091_487


def test_the_control_has_the_size_of_our_network():
    assert sum(p.numel() for p in build("mergenet").parameters()) == 914_681
    assert sum(p.numel() for p in UNet().parameters()) == 911_841


def test_networks_by_name():
    network = build("quiver-s")
    out = network(draw(2, 12, 1, 8, 12, dtype=torch.float32))
    assert out.scale1.shape == (2, 2, 1, 8, 12)


@pytest.mark.parametrize("row", ABLATIONS)
def test_ablations_keep_the_capacity(row):
    wanted = parameter_count(PRESETS["quiver"])
    assert abs(parameter_count(ablated(PRESETS["quiver"], row)) / wanted - 1) < 0.005


@pytest.mark.parametrize("row", ABLATIONS)
def test_ablations_lack_what_they_say(row):
    pre_denoiser, flow, multi_scale = ABLATIONS[row]
    config = ablated(SMALL, row)
    network = lively(config)
    assert (network.denoiser is None, network.flow is None) == (not pre_denoiser, not flow)
    out = network(draw(1, 11, 1, 16, 16))
    assert (out.denoised is None, out.flows is None) == (not pre_denoiser, not flow)
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
