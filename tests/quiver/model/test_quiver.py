"""QUIVER beyond the golden numbers: presets, reuse across windows, ablations, hard inputs."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import pytest
import torch
from golden import TINY, draw, fill_by_rule, network
from torch import Tensor

from quiver.model import deformable, schedules
from quiver.model import quiver as model_module
from quiver.model.config import Config
from quiver.model.folded import FoldedConfig
from quiver.model.presets import ABLATIONS, PRESETS, ablated, assemble, build, parameter_count
from quiver.model.quiver import QUIVER
from quiver.model.unet import UNet, UNetConfig

SMALL = replace(TINY, channels=4, deformable_groups=2, denoiser_growth=4, denoiser_passes=2, flow_channels=(4, 4),
                flow_kernel=3, cell_blocks=2)  # fmt: skip
FOLDED = replace(SMALL, fold=2, estimate_width=4, largest_velocity=1.0, attention_width=16, attention_temperature=4.0,
                 flow_levels=3)  # fmt: skip
BOTH = pytest.mark.parametrize("config", [SMALL, FOLDED], ids=["small", "folded"])


def lively(config: Config, dtype: torch.dtype = torch.float64) -> QUIVER:
    """Weights of natural size everywhere, so that no stage is silent."""
    network = fill_by_rule(assemble(config)).to(dtype).eval()
    assert isinstance(network, QUIVER)
    return network


@torch.no_grad()
def run(schedule: Callable[[QUIVER, Iterable[Tensor]], Iterator[Tensor]], network: QUIVER, x: Tensor) -> Tensor:
    """[B, T, 1, H, W] -> [B, T-10, 1, H, W]."""
    return torch.stack(list(schedule(network, x.unbind(1))), dim=1)


# Presets


def test_the_published_sizes_to_the_last_parameter():
    assert parameter_count(PRESETS["quiver"]) == 156_755_311
    assert parameter_count(PRESETS["quiver-s"]) == 10_866_583
    assert parameter_count(Config(channels=32)) == 40_091_487


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
        "denoiser": 332_929, "flow": 935_112, "noisy_features": 24_192, "denoised_features": 24_192,
        "alignment": 434_992, "fusions": 3 * 41_280, "cell": 27_951_904, "attention": 103_834_368,
        "refine4": 11_546_891, "refine": 11_546_891,
    }  # fmt: skip


def test_nano_fits_its_file():
    """The shipped weights may take 5 MB of float32; the control is of the same kind of size."""
    assert 4 * parameter_count(PRESETS["nano"]) < 5e6
    assert sum(p.numel() for p in UNet().parameters()) == 911_841


@pytest.mark.parametrize("name", ["nano", "unet"])
def test_networks_by_name(name):
    network = build(name)
    side = 2 * int(network.multiple)  # type: ignore[call-overload]
    out = network(draw(2, 12, 1, side, side + int(network.multiple), dtype=torch.float32))  # type: ignore[call-overload]
    assert out.scale1.shape == (2, 2, 1, side, side + int(network.multiple))  # type: ignore[call-overload]


def test_wrong_names_and_settings_say_what_is_right():
    with pytest.raises(ValueError, match="no network is called 'quivr'; known: quiver, quiver-s, nano, unet"):
        build("quivr")
    with pytest.raises(ValueError, match="multiple of the 16 deformable groups, got 8"):
        Config(channels=8)
    with pytest.raises(ValueError, match=r"Config\.flow_kernel must be odd, got 4"):
        FoldedConfig(flow_kernel=4)
    with pytest.raises(ValueError, match=r"Config\.flow_levels must be a whole number from 3 to 10, got 2"):
        FoldedConfig(flow_levels=2)
    with pytest.raises(ValueError, match=r"Config\.cell_blocks must be a whole number from 1 to 64, got 0"):
        FoldedConfig(cell_blocks=0)
    with pytest.raises(ValueError, match="no field 'chanels'"):
        Config.from_dict({"chanels": 3})
    with pytest.raises(ValueError, match="one field width, got depth"):
        UNetConfig.from_dict({"depth": 3})
    assert FoldedConfig.from_dict(FOLDED.to_dict()) == FOLDED
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
    for refusing in (assemble(SMALL), QUIVER(16), UNet(UNetConfig(2))):
        with pytest.raises(ValueError, match=message):
            refusing(torch.zeros(shape))


@BOTH
def test_output_shapes_and_units(config):
    """Flow is in full-size pixels on the grid of the frames also where they are folded."""
    out = lively(config, torch.float32)(draw(2, 13, 1, 16, 24, dtype=torch.float32))
    assert out.denoised.shape == (2, 13, 1, 16, 24)
    assert out.scale1.shape == (2, 3, 1, 16, 24)
    assert out.scale2.shape == (2, 3, 1, 8, 12)
    assert out.scale4.shape == (2, 3, 1, 4, 6)
    assert out.flow.shape == (2, 12, 2, 16, 24)


def test_an_untrained_nano_returns_about_the_mean_of_the_middle_frames():
    """Where nothing moves; the random layers add less than a fifth of the noise of one frame (rms)."""
    torch.manual_seed(0)
    network, x = build("nano"), draw(1, 1, 1, 32, 32, dtype=torch.float32).repeat(1, 11, 1, 1, 1)
    with torch.no_grad():
        out = network(x).scale1[:, 0]
    weights = network.estimate.weights.detach()
    assert float(weights.sum()) == pytest.approx(1)
    mean = torch.einsum("btchw,t->bchw", x, weights)
    assert float((out - mean).square().mean()) < 0.04 * float(x.var())


@pytest.mark.parametrize("lecun", [False, True])
@pytest.mark.parametrize("kernel", [1, 3])
def test_alignment_starts_from_the_flow_alone(kernel, lecun):
    """Offsets of zero and masks of one half: half a convolution of the image moved by the flow."""
    torch.manual_seed(0)
    alignment = assemble(replace(SMALL, deformable_kernel=kernel, lecun=lecun)).double().alignment
    previous, current, flow = draw(1, 4, 8, 8), draw(1, 4, 8, 8, seed=1), torch.zeros(1, 2, 8, 8, dtype=torch.float64)
    moved = torch.nn.functional.pad(previous[..., 1:], (0, 1))
    wanted = torch.nn.functional.conv2d(previous, alignment.weight / 2, padding=kernel // 2)
    assert torch.allclose(alignment(previous, current, flow), wanted)
    flow[:, 0] = 1
    inside = (slice(None), slice(None), slice(1, -1), slice(1, -2))
    wanted = torch.nn.functional.conv2d(moved, alignment.weight / 2, padding=kernel // 2)
    assert torch.allclose(alignment(previous, current, flow)[inside], wanted[inside])


def test_the_lecun_start_keeps_the_fused_features_alive():
    """Spread over space, four starts together: default weights leave little, as two faded signals are multiplied."""
    x, spread = draw(1, 11, 1, 32, 32, dtype=torch.float32), {False: 0.0, True: 0.0}
    for lecun in (False, True):
        for seed in range(4):
            torch.manual_seed(seed)
            started = assemble(replace(FOLDED, lecun=lecun))
            fused: list[Tensor] = []
            started.fusions[0].register_forward_hook(lambda _m, _i, out, fused=fused: fused.append(out))
            with torch.no_grad():
                started(x)
            spread[lecun] += float(fused[1].flatten(2).std(dim=2).mean())
    assert spread[True] > 10 * spread[False], spread


# The same numbers by other roads


@BOTH
def test_exact_reuse_equals_windows_from_scratch(config):
    network, x = lively(config), draw(2, 15, 1, 16, 24)
    windows = run(schedules.windows, network, x)
    assert windows.shape == (2, 5, 1, 16, 24)
    assert float((run(schedules.exact, network, x) - windows).abs().max()) < 1e-10 * float(windows.std())


@BOTH
def test_streaming_equals_one_pass_over_the_clip(config):
    network, x = lively(config), draw(2, 15, 1, 16, 24)
    with torch.no_grad():
        whole = network(x).scale1
    assert float((run(schedules.stream, network, x) - whole).abs().max()) < 1e-10 * float(whole.std())


def test_the_published_network_runs_by_every_schedule():
    network, x = lively(Config(16)), draw(1, 13, 1, 8, 12)
    with torch.no_grad():
        whole = network(x).scale1
    windows = run(schedules.windows, network, x)
    assert float((run(schedules.stream, network, x) - whole).abs().max()) < 1e-10 * float(whole.std())
    assert float((run(schedules.exact, network, x) - windows).abs().max()) < 1e-10 * float(windows.std())


def test_streaming_is_not_the_same_as_windows():
    """The carried state and the missing zeros are visible: the difference is real, and it is not large."""
    network, x = lively(SMALL), draw(1, 16, 1, 16, 24)
    windows, stream = run(schedules.windows, network, x), run(schedules.stream, network, x)
    difference = (windows - stream).square().mean().sqrt() / windows.std()
    assert 1e-6 < float(difference) < 0.5


@pytest.mark.parametrize("schedule", [schedules.exact, schedules.stream])
def test_frames_are_taken_one_by_one_and_denoised_once(schedule, monkeypatch):
    network = lively(SMALL, torch.float32)
    taken, denoised = [], []

    def frames() -> Iterator[Tensor]:
        for t in range(16):
            taken.append(t)
            yield draw(1, 1, 8, 8, dtype=torch.float32, seed=t)

    monkeypatch.setattr(network, "denoise", lambda x: denoised.append(1) or QUIVER.denoise(network, x))
    with torch.no_grad():
        results = schedule(network, frames())
        next(results)
        assert len(taken) <= 13
        assert len([*results]) == 16 - 10 - 1
    assert len(denoised) == 16


def test_inference_in_small_pieces_gives_the_same_numbers(monkeypatch):
    """Frames one by one and taps one by one, as for frames too large for one go."""
    network, x = lively(SMALL), draw(2, 12, 1, 16, 16)
    with_gradients = network(x).scale1.detach()
    monkeypatch.setattr(model_module, "CHUNK_PIXELS", 1)
    monkeypatch.setattr(deformable, "TAP_LOOP_ABOVE", 1)
    with torch.no_grad():
        assert torch.allclose(network(x).scale1, with_gradients, atol=1e-12)


@BOTH
def test_clips_of_a_batch_do_not_see_each_other(config):
    network, x = lively(config), draw(2, 11, 1, 16, 16)
    with torch.no_grad():
        assert torch.allclose(network(x).scale1[1:], network(x[1:]).scale1, atol=1e-12)


@pytest.mark.slow
def test_reuse_saves_the_promised_time():
    """CPU time of one thread per restored frame, width 16, 64 x 64: exact >= 1.5 times less, streaming >= 3 times."""
    network16, x = network(16, torch.float32), draw(1, 26, 1, 64, 64, dtype=torch.float32)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    seconds = {}
    try:
        for schedule in (schedules.windows, schedules.exact, schedules.stream):
            run(schedule, network16, x[:, :11])
            start = time.process_time()
            run(schedule, network16, x)
            seconds[schedule] = time.process_time() - start
    finally:
        torch.set_num_threads(threads)
    assert seconds[schedules.windows] / seconds[schedules.exact] > 1.5, seconds
    assert seconds[schedules.windows] / seconds[schedules.stream] > 3, seconds


# Ablations


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
    assert torch.allclose(run(schedules.windows, network, x), run(schedules.exact, network, x), atol=1e-10)


def test_an_unknown_ablation_is_named():
    assert ablated(SMALL, "all") == SMALL
    with pytest.raises(ValueError, match="no ablation is called 'some'; known: none, "):
        ablated(SMALL, "some")


# Hard inputs


def hard_inputs() -> dict[str, Tensor]:
    bright = torch.zeros(1, 11, 1, 16, 16)
    bright[:, 5, :, 7, 3] = 1
    return {
        "all zero": torch.zeros(1, 11, 1, 16, 16),
        "all saturated": torch.ones(1, 11, 1, 16, 16),
        "one bright pixel": bright,
        "every frame another level": torch.linspace(0, 1, 11).view(1, 11, 1, 1, 1).expand(1, 11, 1, 16, 16),
    }


@pytest.mark.parametrize("name", ["quiver-s", "nano"])
@pytest.mark.parametrize("kind", list(hard_inputs()))
def test_outputs_and_gradients_are_finite(name, kind):
    """Constant input makes queries and keys constant or zero, where a norm has no gradient."""
    torch.manual_seed(0)
    config = PRESETS[name]
    network = assemble(config)
    out = network(hard_inputs()[kind])
    for part in (out.denoised, out.scale1, out.scale2, out.scale4, out.flow):
        assert torch.isfinite(part).all()
    loss = out.scale1.abs().mean() + out.scale2.abs().mean() + out.scale4.abs().mean() + out.denoised.abs().mean()
    loss.backward()
    for key, parameter in network.named_parameters():
        assert parameter.grad is not None, key
        assert torch.isfinite(parameter.grad).all(), key


def test_one_bright_pixel_is_seen():
    inputs, network = hard_inputs(), lively(SMALL, torch.float32)
    with torch.no_grad():
        dark, bright = (network(inputs[kind]).scale1[0, 0, 0] for kind in ("all zero", "one bright pixel"))
    assert float((bright - dark).abs().max()) > 1e-3


@pytest.mark.parametrize("far", [1e3, 1e6, -1e6])
def test_flow_beyond_the_frame_is_survived(far):
    """Everything then comes from outside, which counts as zero: finite values and gradients."""
    network = lively(SMALL, torch.float32)
    assert network.flow is not None
    with torch.no_grad():
        for level in network.flow.levels:
            level[-1].bias.fill_(far)
    out = network(draw(1, 11, 1, 16, 16, dtype=torch.float32))
    out.scale1.sum().backward()
    assert float(out.flow.detach().abs().min()) > 100
    assert torch.isfinite(out.scale1).all()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters() if p.grad is not None)


@BOTH
def test_the_smallest_frames(config):
    """4 x 4 pixels (8 x 8 where folded) are one pixel at the coarsest scale."""
    network = lively(config, torch.float32)
    side = network.multiple
    out = network(draw(1, 11, 1, side, side, dtype=torch.float32))
    assert out.scale4.shape[3:] == (config.fold, config.fold)
    assert torch.isfinite(out.scale1).all()


@pytest.mark.parametrize(("dtype", "promised"), [(torch.bfloat16, 0.04), (torch.float16, 0.005)])
def test_half_precision_has_the_stated_error(dtype, promised):
    """RMS difference to float32 over the standard deviation, published design at width 16, every output."""
    network16, x = network(16, torch.float32), draw(1, 11, 1, 16, 16, dtype=torch.float32)
    with torch.no_grad():
        full = network16(x)
        with torch.autocast("cpu", dtype):
            half = network16(x)
    for key in ("denoised", "flow", "scale4", "scale2", "scale1"):
        a, b = getattr(full, key), getattr(half, key).float()
        error = float((a - b).square().mean().sqrt() / a.std())
        assert 0 < error < promised, (key, error)
