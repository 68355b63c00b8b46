"""EMVD equals the published one at every stage, knows the sensor's noise, and takes any clip.

The committed arrays are all of the full file but two:

    python -c "from golden import *; f = SHARED / 'golden_emvd.npz'; o = DATA / 'golden_emvd.npz', beyond
    cut(f, o, sorted(arrays_of(f).keys() - {'output', 'state'}))"
"""

import json
import types
from pathlib import Path

import golden_emvd
import numpy as np
import pytest
import torch
from golden import DATA, arrays_of, beyond, draw, errors, fill_by_rule, golden_files, weights_by_table

from qsim import QIS
from quiver.model.rivals import emvd
from quiver.model.rivals.emvd import EMVD, EMVDConfig, NoiseMap
from quiver.model.rivals.noise import VARIANCE, table_of

TABLE = DATA / "emvd_state_dict.tsv"


@pytest.mark.parametrize("path", golden_files("emvd"), ids=str)
def test_every_stage_equals_the_published_one(path):
    found = errors("emvd", arrays_of(path), TABLE)
    assert len(found) >= 18
    assert not beyond(found, arrays_of(path), TABLE)


def test_two_clips_of_another_size_equal_the_published_numbers():
    codes = np.random.default_rng(22).integers(0, 8, (2, 5, 1, 24, 16))
    found = golden_emvd.stages(
        {"codes": codes, "noise_ab": np.array([0.25, 0.03])},
        weights_by_table(TABLE, start=golden_emvd.START),
    )
    wanted = {
        "output": (0.3440952882, 0.4219947184, 0.2974286395),
        "state": (0.4610535533, 0.2808290905, -0.0533321954),
    }
    for key, array in (("output", found["output"].detach()), ("state", found["state"][:, 4].detach())):
        ours = (array.mean(), array.std(correction=0), array.flatten()[-1])
        assert ours == pytest.approx(wanted[key], abs=1e-10), key


def test_weights_depend_on_the_prefix_and_few_frames_have_fewer_stages():
    arrays = {"codes": np.random.default_rng(1).integers(0, 8, (3, 2, 1, 16, 8)), "noise_ab": np.array([0.1, 0.01])}
    runs = [golden_emvd.stages(arrays, weights_by_table(TABLE, prefix, golden_emvd.START)) for prefix in ("", "x.")]
    assert runs[0].keys() == {"output", "state", "output_published_ab"}
    assert runs[0]["output"].shape == (3, 2, 4, 16, 8)
    assert (runs[0]["output"] - runs[1]["output"]).abs().max() > 0.01


MISTAKES = {  # what is written, what is written wrongly; each exactly once in the module
    "high row with the other sign": (
        'taps = self.net1["weight"].view(2, 2)',
        'taps = self.net1["weight"].view(2, 2) * torch.tensor([[1], [-1]])',
    ),
    "blocks exchanged": ("for h in halves for low, high in taps", "for low, high in taps for h in halves"),
    "inverse taps transposed": (
        "low * low_taps[k] + high * high_taps[k]",
        "low * (low_taps, high_taps)[k][0] + high * (low_taps, high_taps)[k][1]",
    ),
    "no absolute value": ("(new_low - old_low).abs()", "(new_low - old_low)"),
    "order of noise and gamma": ("*coarser, new_noise]", "new_noise, *coarser]"),
    "order of the denoiser": ("[fused, *images, new_low, variance]", "[fused, new_low, *images, variance]"),
    "noise of the state": ("self.noise(new_low, table)", "self.noise(old_low, table)"),
    "not clipped": ("brightness.clamp(0, 1) * self.slope", "brightness * self.slope"),
    "gamma the other way": ("fused = torch.lerp(old, new, gamma)", "fused = torch.lerp(new, old, gamma)"),
    "gamma not squared": ("+ gamma**2 * new_noise", "+ gamma * new_noise"),
    "omega the other way": (
        "torch.lerp(result.denoised, result.fused, omega)",
        "torch.lerp(result.fused, result.denoised, omega)",
    ),
    "state is the output": ("self.cti(self.fti(result.fused))", "self.cti(self.fti(refined))"),
    "ReLU at the end": (
        "x = self.net3(F.relu(self.net2(F.relu(self.net1(x)))))",
        "x = F.relu(self.net3(F.relu(self.net2(F.relu(self.net1(x))))))",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_seen(mistake, monkeypatch):
    right, wrong = MISTAKES[mistake]
    source = Path(emvd.__file__).read_text(encoding="utf-8")
    assert source.count(right) == 1
    module = types.ModuleType("mistaken")
    exec(source.replace(right, wrong), module.__dict__)
    monkeypatch.setattr(golden_emvd, "EMVD", module.EMVD)
    found = errors("emvd", arrays_of(DATA / "golden_emvd.npz"), TABLE)
    assert max(found.values()) > 1e-2, found


def test_the_published_network_has_the_published_parameters():
    network = EMVD()
    assert sum(parameter.numel() for parameter in network.parameters()) == 41_356
    parts = {"vd": 10_881, "md1": 11_601, "md0": 11_601, "refine": 7_233}
    for name, count in parts.items():
        assert sum(parameter.numel() for parameter in getattr(network, name).parameters()) == count
    names = [line.split("\t")[0] for line in TABLE.read_text().splitlines()[1:]]
    assert list(network.state_dict()) == names


def test_the_transforms_begin_as_inverses():
    image = draw(2, 4, 16, 24)
    for as_published, limit in ((False, 1e-4), (True, 3e-3)):  # the coefficients have four digits; one has a slip
        network = EMVD(EMVDConfig(as_published=as_published)).double()
        assert (network.fti(network.ft(image)) - image).abs().max() < 1e-6
        assert (network.cti(network.ct(image)) - image).abs().max() < limit


def test_the_noise_without_a_table_is_that_of_the_papers_sensor():
    sensor = QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25)
    exposure = 1 / 2000
    photons = np.geomspace(1e-3, 40, 1000)
    mean = sensor.mean(photons, exposure) / 7
    variance = sensor.variance(photons, exposure) / 49
    table = np.interp(mean, np.linspace(0, 1, len(VARIANCE)), VARIANCE)
    assert np.abs(table - variance).max() < 0.01 * variance.max()


@pytest.mark.parametrize("scale", [0, 1, 2])
@pytest.mark.parametrize("space_to_depth", [False, True])
def test_the_noise_map_is_the_variance_of_the_band(space_to_depth, scale):
    """Binomial codes of seven draws: variance m(1 - m)/7. Tolerance: five sigma of a variance from n samples."""
    steps = np.linspace(0, 1, 201)
    config = EMVDConfig(space_to_depth=space_to_depth)
    table = torch.from_numpy(steps * (1 - steps) / 7)[None]
    network = EMVD(config).double()
    generator = torch.Generator().manual_seed(0)
    m = 0.3
    codes = (torch.rand(7, 1, 1, 1, 512, 512, generator=generator) < m).double().mean(dim=0)
    with torch.no_grad():
        low = network.bands(network.packed(codes)[:, 0])[scale][:, :4]
        level = torch.full((1, 4, 1, 1), m * 4 * 2**scale, dtype=torch.float64)
        stated = float(NoiseMap(config, scale)(level, table))
    assert float(low[:, 0].mean()) == pytest.approx(m * 4 * 2**scale, rel=0.01)
    assert float(low[:, 0].var()) == pytest.approx(stated, rel=5 * (2 / low[:, 0].numel()) ** 0.5)


def test_streaming_equals_the_clip():
    network = golden_emvd.small()
    frames = draw(1, 4, 1, 16, 24)
    with torch.no_grad():
        whole = network(frames)
        state = None
        table = table_of(None, frames)
        for t, image in enumerate(network.packed(frames).unbind(1)):
            output, state = network.step(state, image, table)
            assert torch.equal(network.unpacked(output), whole[:, t])


def test_pixels_become_channels_and_return():
    frames = draw(1, 3, 1, 19, 22)
    config = EMVDConfig(width=2, space_to_depth=True)
    network = fill_by_rule(EMVD(config)).double()
    with torch.no_grad():
        assert network(frames).shape == frames.shape
    packed = network.packed(draw(1, 3, 1, 16, 32))
    assert packed.shape == (1, 3, 4, 8, 16)
    assert torch.equal(network.unpacked(packed), draw(1, 3, 1, 16, 32))


def test_half_precision_is_close():
    network = EMVD().eval()
    frames = draw(1, 5, 1, 24, 32, dtype=torch.float32)
    with torch.no_grad():
        exact = network(frames)
        with torch.autocast("cpu", torch.bfloat16):
            close = network(frames)
    assert float((close.float() - exact).square().mean().sqrt() / exact.std()) < 0.02


def test_every_parameter_learns():
    network = golden_emvd.small()
    network(draw(1, 3, 1, 16, 16)).square().mean().backward()
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    assert not [name for name, p in network.named_parameters() if p.grad.abs().max() == 0 and "net3.bias" in name]


def test_a_configuration_survives_json():
    config = EMVDConfig(width=24, space_to_depth=True, as_published=True)
    assert EMVDConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("width", 0, "EMVDConfig.width must be a whole number from 1"),
        ("published_noise", (0.1, -1.0), "EMVDConfig.published_noise must be a number from 0"),
        ("as_published", 1, "EMVDConfig.as_published must be true or false"),
    ],
)
def test_configurations_out_of_range_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        EMVDConfig(**{field: value})
