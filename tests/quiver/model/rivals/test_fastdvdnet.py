"""FastDVDnet equals its description, computes first results once, and knows the sensor's noise."""

import json

import pytest
import torch
import torch.nn.functional as F
from golden import draw
from rivals import lively
from torch import Tensor

from quiver.model.rivals.fastdvdnet import FastDVDnet, FastDVDnetConfig
from quiver.model.rivals.noise import deviation_map, table_of


def small(**settings: object) -> FastDVDnet:
    """A small network with some settings."""
    return lively(FastDVDnet(FastDVDnetConfig(width=4, **settings)))


def described(state: dict[str, Tensor], name: str, images: list[Tensor], maps: list[Tensor]) -> Tensor:
    """The U-Net of the description, layer by layer."""

    def plain(x: Tensor, place: str, **how: int) -> Tensor:
        return F.conv2d(x, state[f"{name}.{place}.weight"], state[f"{name}.{place}.bias"], padding=1, **how)

    def cbr(x: Tensor, part: str, i: int, **how: int) -> Tensor:
        x = plain(x, f"{part}.{i}", **how)
        norm = f"{name}.{part}.{i + 1}."
        mean = state[norm + "running_mean"]
        variance = state[norm + "running_var"]
        x = (x - mean[:, None, None]) / (variance[:, None, None] + 1e-5).sqrt()
        return (x * state[norm + "weight"][:, None, None] + state[norm + "bias"][:, None, None]).clamp(min=0)

    x = torch.cat([images[0], maps[0], images[1], maps[1], images[2], maps[2]], dim=1)
    e0 = cbr(cbr(x, "enter", 0, groups=3), "enter", 3)
    e1 = cbr(cbr(cbr(e0, "down", 0, stride=2), "down", 3), "down", 6)
    x = cbr(e1, "bottom", 0, stride=2)
    for i in (3, 6, 9, 12):
        x = cbr(x, "bottom", i)
    x = F.pixel_shuffle(plain(x, "bottom.15"), 2) + e1
    x = F.pixel_shuffle(plain(cbr(cbr(x, "rise", 0), "rise", 3), "rise.6"), 2) + e0
    return images[1] - plain(cbr(x, "leave", 0), "leave.3")


def test_a_window_equals_the_description():
    network = small()
    frames = draw(2, 5, 1, 12, 20)
    state = network.state_dict()
    images = list(frames.unbind(1))
    maps = list(deviation_map(frames, table_of(None, frames)).unbind(1))
    with torch.no_grad():
        once = [described(state, "first", images[i : i + 3], maps[i : i + 3]) for i in range(3)]
        wanted = described(state, "second", once, maps[1:4])
        found = network.windows(frames)
    assert found.shape == (2, 1, 1, 12, 20)
    assert (found[:, 0] - wanted).abs().max() < 1e-12 * wanted.std()


def test_a_clip_is_restored_window_by_window_with_first_results_computed_once():
    network = small()
    frames = draw(1, 6, 1, 8, 12)
    calls = []
    network.first.register_forward_hook(lambda *_: calls.append(1))
    order = [2, 1, 0, 1, 2, 3, 4, 5, 4, 3]
    with torch.no_grad():
        restored = network(frames)
        assert len(calls) == 8  # frames -1 ... 6
        alone = torch.cat([network.windows(frames[:, order[t : t + 5]]) for t in range(6)], dim=1)
    assert torch.equal(restored, alone)


def test_a_restored_frame_depends_on_two_frames_on_either_side():
    network = small()
    frames = draw(1, 9, 1, 8, 8)
    changed = frames.clone()
    changed[:, 4] = 1 - changed[:, 4]
    with torch.no_grad():
        apart = (network(frames) - network(changed)).abs().amax((0, 2, 3, 4))
    assert (apart > 0).tolist() == [2 <= t <= 6 for t in range(9)]


def test_the_published_network_has_the_published_parameters():
    counts = {
        noise_map: sum(p.numel() for p in FastDVDnet(FastDVDnetConfig(noise_map=noise_map)).parameters())
        for noise_map in (True, False)
    }
    assert counts == {True: 2_477_702, False: 2_476_082}
    unnormalised = FastDVDnet(FastDVDnetConfig(batch_norm=False))
    assert not [m for m in unnormalised.modules() if isinstance(m, torch.nn.BatchNorm2d)]


def test_start_values_are_those_of_he():
    weight = FastDVDnet().second.bottom[15].weight.detach()
    assert float(weight.std()) == pytest.approx((2 / (128 * 9)) ** 0.5, rel=5 * (2 * weight.numel()) ** -0.5)


def test_a_window_is_learnt():
    torch.manual_seed(0)
    network = FastDVDnet(FastDVDnetConfig(width=4))
    truth = draw(1, 1, 1, 2, 2, dtype=torch.float32)
    truth = truth.repeat_interleave(4, -1).repeat_interleave(4, -2)
    frames = (truth + 0.2 * torch.randn(1, 5, 1, 8, 8)).clamp(0, 1)
    optimiser = torch.optim.Adam(network.parameters(), 1e-2)
    losses = []
    for _ in range(12):
        loss = (network.windows(frames) - truth).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    assert losses[-1] < 0.5 * losses[0]


def test_a_configuration_survives_json():
    config = FastDVDnetConfig(width=24, batch_norm=False, noise_map=False)
    assert FastDVDnetConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("width", 1, "FastDVDnetConfig.width must be a whole number from 2"),
        ("noise_map", 1, "FastDVDnetConfig.noise_map must be true or false"),
        ("batch_norm", None, "FastDVDnetConfig.batch_norm must be true or false"),
    ],
)
def test_configurations_out_of_range_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        FastDVDnetConfig(**{field: value})
