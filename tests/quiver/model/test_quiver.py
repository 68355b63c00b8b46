"""Tests QUIVER beyond the golden numbers: parts, shapes, batches, hard inputs."""

import pytest
import torch
from golden import SMALL, draw, lively, network
from torch import Tensor

from quiver.model import deformable
from quiver.model import quiver as model_module
from quiver.model.config import Config
from quiver.model.presets import PRESETS, build
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNet, UNetConfig


def test_the_width_can_be_given_by_name_or_alone():
    with torch.device("meta"):
        assert QUIVER().config == Config() == Config(channels=64)
        assert QUIVER(16).config == QUIVER(channels=16).config == QUIVER(Config(channels=16)).config
        with pytest.raises(ValueError, match="got both"):
            QUIVER(Config(), channels=16)


def test_the_parts_have_the_published_sizes():
    with torch.device("meta"):
        parts = {name: sum(p.numel() for p in part.parameters()) for name, part in QUIVER(64).named_children()}
    assert parts == {
        "denoiser": 332_929,
        "flow": 935_112,
        "noisy_features": 24_192,
        "denoised_features": 24_192,
        "alignment": 434_992,
        "fusions": 3 * 41_280,
        "cell": 27_951_904,
        "attention": 103_834_368,
        "refine4": 11_546_891,
        "refine": 11_546_891,
    }


def test_wrong_names_and_settings_say_what_is_right():
    with pytest.raises(ValueError, match="no network is called 'quivr'; known: quiver-s, quiver, mergenet, unet"):
        build("quivr")
    with pytest.raises(ValueError, match="multiple of the 16 deformable groups, got 8"):
        Config(channels=8)
    with pytest.raises(ValueError, match=r"Config\.denoiser_growth must be a whole number from 1 to 1024, got 0"):
        Config(denoiser_growth=0)
    with pytest.raises(ValueError, match=r"Config\.flow_channels must be 1 to 8 widths, got \(\)"):
        Config(flow_channels=())
    with pytest.raises(ValueError, match="QUIVER: unknown key 'chanels'"):
        Config.from_dict({"chanels": 3})
    with pytest.raises(ValueError, match="UNet: unknown key 'depth'"):
        UNetConfig.from_dict({"depth": 3})
    assert Config.from_dict(SMALL.to_dict()) == SMALL
    assert Config.from_dict(Config(32).to_dict()) == Config(32)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((1, 10, 1, 16, 16), r"T >= 11, got \(1, 10, 1, 16, 16\); pad time first"),
        ((1, 11, 3, 16, 16), r"takes \[B, T, 1, H, W\]"),
        ((1, 11, 16, 16), r"takes \[B, T, 1, H, W\]"),
        ((1, 11, 1, 15, 16), r"must be multiples of 4, got \(15, 16\); pad space first"),
        ((1, 11, 1, 16, 0), "must be multiples of 4"),
    ],
)
def test_inputs_that_do_not_fit_are_refused(shape, message):
    for refusing in (QUIVER(SMALL), QUIVER(16), UNet(UNetConfig(2)).windows):
        with pytest.raises(ValueError, match=message):
            refusing(torch.zeros(shape))


def test_output_shapes_and_units():
    """The flow is in full-size pixels, on the grid of the frames."""
    out = lively(SMALL, torch.float32)(draw(2, 13, 1, 16, 24, dtype=torch.float32))
    assert out.denoised.shape == (2, 13, 1, 16, 24)
    assert out.scale1.shape == (2, 3, 1, 16, 24)
    assert out.scale2.shape == (2, 3, 1, 8, 12)
    assert out.scale4.shape == (2, 3, 1, 4, 6)
    assert [flow.shape for flow in out.flows] == [(2, 12, 2, 16 // s, 24 // s) for s in (1, 2, 4)]


def test_alignment_starts_from_the_flow_alone():
    """With offsets of zero and masks of one half the result is half a convolution of the image moved by the flow."""
    torch.manual_seed(0)
    alignment = QUIVER(SMALL).double().alignment
    previous = draw(1, 4, 8, 8)
    current = draw(1, 4, 8, 8, seed=1)
    flow = torch.zeros(1, 2, 8, 8, dtype=torch.float64)
    moved = torch.nn.functional.pad(previous[..., 1:], (0, 1))
    wanted = torch.nn.functional.conv2d(previous, alignment.weight / 2, padding=1)
    assert torch.allclose(alignment(previous, current, flow), wanted)
    flow[:, 0] = 1
    inside = (slice(None), slice(None), slice(1, -1), slice(1, -2))
    wanted = torch.nn.functional.conv2d(moved, alignment.weight / 2, padding=1)
    assert torch.allclose(alignment(previous, current, flow)[inside], wanted[inside])


def test_inference_in_small_pieces_gives_the_same_numbers(monkeypatch):
    """Frames and taps are computed one by one, as for frames that are too large."""
    network = lively(SMALL)
    x = draw(2, 12, 1, 16, 16)
    with_gradients = network(x).scale1.detach()
    monkeypatch.setattr(model_module, "CHUNK_PIXELS", 1)
    monkeypatch.setattr(deformable, "TAP_LOOP_ABOVE", 1)
    with torch.no_grad():
        assert torch.allclose(network(x).scale1, with_gradients, atol=1e-12)


def test_clips_of_a_batch_do_not_see_each_other():
    network = lively(SMALL)
    x = draw(2, 11, 1, 16, 16)
    with torch.no_grad():
        assert torch.allclose(network(x).scale1[1:], network(x[1:]).scale1, atol=1e-12)


def hard_inputs() -> dict[str, Tensor]:
    bright = torch.zeros(1, 11, 1, 16, 16)
    bright[:, 5, :, 7, 3] = 1
    return {
        "all zero": torch.zeros(1, 11, 1, 16, 16),
        "all saturated": torch.ones(1, 11, 1, 16, 16),
        "one bright pixel": bright,
        "every frame another level": torch.linspace(0, 1, 11).view(1, 11, 1, 1, 1).expand(1, 11, 1, 16, 16),
    }


@pytest.mark.parametrize("kind", list(hard_inputs()))
def test_outputs_and_gradients_are_finite(kind):
    """Constant input makes queries and keys constant or zero, where a norm has no gradient."""
    torch.manual_seed(0)
    network = QUIVER(PRESETS["quiver-s"])
    out = network(hard_inputs()[kind])
    for part in (out.denoised, out.scale1, out.scale2, out.scale4, *out.flows):
        assert torch.isfinite(part).all()
    loss = out.scale1.abs().mean() + out.scale2.abs().mean() + out.scale4.abs().mean() + out.denoised.abs().mean()
    loss.backward()
    for key, parameter in network.named_parameters():
        assert parameter.grad is not None, key
        assert torch.isfinite(parameter.grad).all(), key


def test_one_bright_pixel_is_seen():
    inputs = hard_inputs()
    network = lively(SMALL, torch.float32)
    with torch.no_grad():
        dark, bright = (network(inputs[kind]).scale1[0, 0, 0] for kind in ("all zero", "one bright pixel"))
    assert float((bright - dark).abs().max()) > 1e-3


@pytest.mark.parametrize("far", [1e3, 1e6, -1e6])
def test_flow_beyond_the_frame_is_survived(far):
    """All samples then are outside and count as zero; values and gradients are finite."""
    network = lively(SMALL, torch.float32)
    assert network.flow is not None
    with torch.no_grad():
        for level in network.flow.levels:
            level[-1].bias.fill_(far)
    out = network(draw(1, 11, 1, 16, 16, dtype=torch.float32))
    out.scale1.sum().backward()
    assert float(out.flows[0].detach().abs().min()) > 100
    assert torch.isfinite(out.scale1).all()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters() if p.grad is not None)


def test_the_smallest_frames():
    """4 x 4 pixels are one pixel at the coarsest scale."""
    out = lively(SMALL, torch.float32)(draw(1, 11, 1, 4, 4, dtype=torch.float32))
    assert out.scale4.shape[3:] == (1, 1)
    assert torch.isfinite(out.scale1).all()


@pytest.mark.parametrize(("dtype", "promised"), [(torch.bfloat16, 0.04), (torch.float16, 0.005)])
def test_half_precision_has_the_stated_error(dtype, promised):
    """RMS difference to float32 over the standard deviation, at width 16, for every output."""
    network16 = network(16, torch.float32)
    x = draw(1, 11, 1, 16, 16, dtype=torch.float32)
    with torch.no_grad():
        full = network16(x)
        with torch.autocast("cpu", dtype):
            half = network16(x)
    pairs = {key: (getattr(full, key), getattr(half, key)) for key in ("denoised", "scale4", "scale2", "scale1")}
    pairs["flow"] = full.flows[0], half.flows[0]
    for key, (a, low) in pairs.items():
        b = low.float()
        error = float((a - b).square().mean().sqrt() / a.std())
        assert 0 < error < promised, (key, error)
