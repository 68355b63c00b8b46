"""bit2bit equals its description, splits photons fairly, and both of its losses are least at the true light."""

import json

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from golden import draw
from rivals import SMALL, lively
from scipy import stats
from torch import Tensor

from quiver.model.rivals.bit2bit import (
    Bit2Bit,
    Bit2BitConfig,
    Split,
    binomial_loss,
    bit2bit_loss,
    photon_loss,
    pieces,
    split,
)


def described(state: dict[str, Tensor], x: Tensor) -> Tensor:
    """The U-Net of the description, layer by layer, from its input channels."""

    def layer(x: Tensor, place: str) -> Tensor:
        return F.conv3d(
            x, state[place + ".weight"], state[place + ".bias"], padding=state[place + ".weight"].shape[-1] // 2
        )

    def block(x: Tensor, place: str) -> Tensor:
        def normal(x: Tensor) -> Tensor:
            groups = x.view(len(x), 4, -1)
            groups = (groups - groups.mean(2, keepdim=True)) / (groups.var(2, correction=0, keepdim=True) + 1e-5).sqrt()
            weight, bias = (state[f"{place}.norm.{name}"].view(-1, 1, 1, 1) for name in ("weight", "bias"))
            return groups.view_as(x) * weight + bias

        first = normal(layer(x, f"{place}.conv1"))
        second = normal(layer(first, f"{place}.conv2")).clamp(min=0)
        return normal(layer(second, f"{place}.conv3") + first).clamp(min=0)

    skips = []
    for level in range(4):
        x = block(F.max_pool3d(x, 2) if level else x, f"down.{level}")
        skips.append(x)
    for i, skip in enumerate(skips[2::-1]):
        x = F.conv_transpose3d(x, state[f"rise.{i}.weight"], state[f"rise.{i}.bias"], stride=2)
        x = block(torch.cat([x, skip], dim=1), f"up.{i}")
    return layer(x, "leave")


def test_the_network_equals_the_description():
    network = SMALL["bit2bit"]()
    seen = 7 * draw(2, 8, 1, 8, 16)
    share = torch.tensor([0.3, 0.9]).double()
    volume = seen.transpose(1, 2)
    channels = [*(torch.sin(volume / 10**i) for i in range(10)), share.view(2, 1, 1, 1, 1).expand_as(volume)]
    with torch.no_grad():
        wanted = described(network.state_dict(), torch.cat(channels, dim=1)).transpose(1, 2)
        assert (network.output(seen, share) - wanted).abs().max() < 1e-11 * wanted.std()


def test_the_published_network_has_the_published_parameters():
    counts = {
        published: sum(p.numel() for p in Bit2Bit(Bit2BitConfig(as_published=published)).parameters())
        for published in (True, False)
    }
    assert counts == {True: 4_806_241, False: 4_806_241 + 24 * 27}  # one more input: the share


def test_start_values_are_those_of_glorot():
    network = Bit2Bit()
    weight = network.down[3].conv2.weight.detach()
    bias = network.down[3].conv2.bias
    assert float(weight.std()) == pytest.approx((2 / (2 * 192 * 27)) ** 0.5, rel=5 * (2 * weight.numel()) ** -0.5)
    assert not bias.any()


def test_photons_are_split_at_random_and_none_is_lost():
    codes = torch.full((3, 4, 1, 50, 40), 6.0, dtype=torch.float64)
    parts, again = (split(codes, torch.Generator().manual_seed(5)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(parts, again, strict=True))
    assert torch.equal(parts.seen + parts.target, codes)
    for share, seen in zip(parts.share.tolist(), parts.seen, strict=True):
        deviation = (6 * share * (1 - share) / seen.numel()) ** 0.5
        assert abs(float(seen.mean()) - 6 * share) < 5 * deviation
        found = np.bincount(seen.flatten().numpy().astype(int), minlength=7)
        likely = stats.binom.pmf(np.arange(7), 6, share) * seen.numel()
        assert (np.abs(found - likely) < 5 * np.sqrt(likely + 1)).all()
    assert len(set(parts.share.tolist())) == 3


def parts_of(planes: int, seed: int = 0) -> tuple[Tensor, Split]:
    generator = torch.Generator().manual_seed(seed)
    codes = torch.randint(0, planes + 1, (2, 3, 1, 4, 5), generator=generator).double()
    return torch.randn(codes.shape, generator=generator, dtype=torch.float64), split(codes, generator)


@pytest.mark.parametrize("planes", [1, 3, 7, 100])
def test_the_binomial_loss_is_the_likelihood_of_the_target(planes):
    output, parts = parts_of(planes)
    one = 1 / (1 + np.exp(-output.numpy()))
    share = parts.share.view(2, 1, 1, 1, 1).numpy()
    left = planes - parts.seen.numpy()
    target = parts.target.numpy()
    chance = one * (1 - share) / (1 - one * share)
    ways = stats.binom.logpmf(target, left, chance) - target * np.log(chance) - (left - target) * np.log1p(-chance)
    wanted = -(stats.binom.logpmf(target, left, chance) - ways).sum() / left.sum()
    assert float(binomial_loss(output, parts, planes)) == pytest.approx(wanted, rel=1e-9)


def test_a_binary_voxel_that_gave_its_photon_does_not_count():
    output, parts = parts_of(1)
    for loss in (binomial_loss, photon_loss):
        changed = loss(torch.where(parts.seen == 1, output + 3, output), parts, 1)
        assert float(changed) == pytest.approx(float(loss(output, parts, 1)), rel=1e-12)


def test_saturated_voxels_do_not_count_for_photons():
    output, parts = parts_of(7)
    saturated = parts.seen + parts.target == 7
    assert saturated.any()
    changed = photon_loss(torch.where(saturated, output + 3, output), parts, 7)
    assert float(changed) == pytest.approx(float(photon_loss(output, parts, 7)), rel=1e-12)


def test_the_photon_loss_equals_its_description_and_ignores_brightness():
    output, parts = parts_of(7)
    wanted = 0.0
    for o, a, b in zip(output.numpy(), parts.seen.numpy(), parts.target.numpy(), strict=True):
        counts = a + b < 7
        normal = b / b.mean()
        wanted += (-(o * normal)[counts].mean() + np.log(np.exp(o)[counts].mean()) * normal[counts].mean()) / 2
    assert float(photon_loss(output, parts, 7)) == pytest.approx(wanted, rel=1e-12)
    assert float(photon_loss(output + 2, parts, 7)) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_binomial_loss_is_least_at_the_true_light(seed):
    """With the mean target of every voxel, the slope is zero at the true logit, for any share and seen photons."""
    truth, parts = parts_of(7, seed)
    share = parts.share.view(2, 1, 1, 1, 1)
    one = torch.sigmoid(truth)
    mean = parts._replace(target=(7 - parts.seen) * one * (1 - share) / (1 - one * share))
    output = truth.clone().requires_grad_()
    binomial_loss(output, mean, 7).backward()
    assert output.grad.abs().max() < 1e-12


def test_the_photon_loss_is_least_at_the_true_light():
    truth, parts = parts_of(7)
    output = truth.clone().requires_grad_()
    photon_loss(output, Split(parts.seen * 0, truth.exp() / 1e3, parts.share), 7).backward()
    assert output.grad.abs().max() < 1e-12


def test_the_binomial_law_keeps_noise_of_photon_counts():
    """As stated: for counts of mean m, the best answer is pi = m/(n - a + m p), which follows the noise of a."""
    _, parts = parts_of(7)
    share = parts.share.view(2, 1, 1, 1, 1)
    m = 2.7
    best = m / (7 - parts.seen + m * share)
    fits = best < 1
    output = torch.logit(best.clamp(max=0.999)).requires_grad_()
    binomial_loss(output, parts._replace(target=m * (1 - share) * torch.ones_like(best)), 7).backward()
    assert fits.sum() > 100
    assert output.grad[fits].abs().max() < 1e-12


@pytest.mark.parametrize("loss", [binomial_loss, photon_loss])
@pytest.mark.parametrize("code", [0.0, 7.0])
def test_black_and_saturated_clips_have_finite_losses_and_slopes(loss, code):
    output = torch.zeros(1, 2, 1, 3, 3, requires_grad=True)
    value = loss(output, split(torch.full((1, 2, 1, 3, 3), code)), 7)
    value.backward()
    assert value.isfinite()
    assert output.grad.isfinite().all()


def test_the_restored_light_has_the_units_of_the_sensor():
    frames = draw(1, 8, 1, 8, 8)
    for as_published in (False, True):
        torch.manual_seed(1)
        network = lively(Bit2Bit(Bit2BitConfig(width=4, as_published=as_published, dark=0.01)))
        with torch.no_grad():
            output = network.output(7 * frames, torch.ones(1).double())
            restored = network(frames)
        if not as_published:  # pi = 1 - exp(-(light + dark))
            assert (1 - (-restored - 0.01).exp() - torch.sigmoid(output)).abs().max() < 1e-12
            continue
        means = (restored + 0.01).mean(dim=(2, 3, 4))
        assert (means - frames.mean(dim=(2, 3, 4))).abs().max() < 1e-12
        apart = (restored + 0.01).log() - output
        assert (apart - apart.mean(dim=(3, 4), keepdim=True)).abs().max() < 1e-9


def test_long_clips_are_restored_in_pieces():
    network = SMALL["bit2bit"]()
    frames = draw(1, 50, 1, 8, 8)
    assert [(start, len(weight)) for start, weight in pieces(50)] == [(0, 32), (16, 32), (18, 32)]
    assert [start for start, _ in pieces(32)] == [0]
    assert sum(len(weight) for _, weight in pieces(3)) == 3
    with torch.no_grad():
        restored = network(frames)
        alone = [network.piece(frames[:, s : s + 32]) for s in (0, 16, 18)]
        assert torch.allclose(network(frames[:, :32]), alone[0])
    assert torch.allclose(restored[:, :16], alone[0][:, :16])
    frame = 20  # weights 12, 5, 3
    parts = [alone[0][:, 20] * 12, alone[1][:, 4] * 5, alone[2][:, 2] * 3]
    assert torch.allclose(restored[:, frame], sum(parts) / 20)


@pytest.mark.parametrize("as_published", [False, True])
def test_a_clip_is_learnt_from_itself(as_published):
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    network = Bit2Bit(Bit2BitConfig(width=4, as_published=as_published))
    light = torch.tensor([1.0, 4.0]).repeat_interleave(4).expand(1, 8, 1, 8, 8)
    codes = torch.binomial(torch.full_like(light, 7), light / 7, generator=generator)
    optimiser = torch.optim.AdamW(network.parameters(), 3e-3)
    for step in range(12):
        loss = bit2bit_loss(network, codes, torch.Generator().manual_seed(step))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    with torch.no_grad():
        restored = network(codes / 7)
    dark = restored[..., :4].mean()
    bright = restored[..., 4:].mean()
    assert float(bright) > 1.5 * float(dark)


def test_a_configuration_survives_json():
    config = Bit2BitConfig(width=12, planes=1, dark=0.1, as_published=True)
    assert Bit2BitConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("width", 2, "Bit2BitConfig.width must be a whole number from 4"),
        ("width", 6, "Bit2BitConfig.width must be a multiple of 4, got 6"),
        ("as_published", 1, "Bit2BitConfig.as_published must be true or false"),
        ("planes", 0, "Bit2BitConfig.planes must be a whole number from 1"),
        ("dark", -1.0, "Bit2BitConfig.dark must be a number from 0"),
    ],
)
def test_configurations_out_of_range_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        Bit2BitConfig(**{field: value})
