"""RVRT equals the published one at every stage, and takes any clip.

The committed arrays begin the passes and end the network; the mistakes below reach the last of them:

    python -c "from golden import *; cut(SHARED / 'golden_rvrt.npz', DATA / 'golden_rvrt.npz',
    ['codes', 'small_t0', 'stack_backward_1_first', 'align_backward_1_flowA', 'align_backward_1_flowB', 'output_last'])"
"""

import json
import types
from pathlib import Path

import golden_rvrt
import numpy as np
import pytest
import torch
from golden import DATA, arrays_of, beyond, compare, draw, errors, fill_by_rule, golden_files, weights_by_table

from quiver.model.ops import deformable_attention
from quiver.model.rivals import rvrt, spynet
from quiver.model.rivals.rvrt import RVRT, RVRTConfig, composed, reduced

TABLE = DATA / "rvrt_state_dict.tsv"


def test_the_beginning_equals_the_published_one():
    arrays = arrays_of(DATA / "golden_rvrt.npz")
    with torch.no_grad():
        found = golden_rvrt.beginning(arrays["codes"], weights_by_table(TABLE))
    error = compare({key: value.numpy() for key, value in found.items()}, {key: arrays[key] for key in found})
    assert not beyond(error, arrays, TABLE)


@pytest.mark.slow
@pytest.mark.parametrize("path", golden_files("rvrt"), ids=str)
def test_every_stage_equals_the_published_one(path):
    error = errors("rvrt", arrays_of(path), TABLE)
    assert len(error) >= 5
    assert not beyond(error, arrays_of(path), TABLE)


@pytest.mark.slow
def test_two_clips_of_another_size_equal_the_published_numbers():
    codes = np.random.default_rng(62).integers(0, 8, (2, 4, 1, 132, 144))
    with torch.no_grad():
        output = golden_rvrt.stages({"codes": codes}, weights_by_table(TABLE))["output"]
    ours = (output.mean(), output.std(correction=0), output.flatten()[-1])
    assert ours == pytest.approx((0.5074661612, 0.3438279119, -0.0027779609), abs=1e-10)


MISTAKES = {  # module, what is written, what is written wrongly; each exactly once in the module
    "area mean": (rvrt, "(-3 / 32, 19 / 32, 19 / 32, -3 / 32)", "(1 / 4, 1 / 4, 1 / 4, 1 / 4)"),
    "flow the other way": (
        rvrt,
        "return self.spynet(first, second).unflatten(0, pairs), self.spynet(second, first)",
        "return self.spynet(second, first).unflatten(0, pairs), self.spynet(first, second)",
    ),
    "flow with zeros": (spynet, '"border"', '"zeros"'),
    "another GELU": (rvrt, "F.gelu(self.fc1(x))", 'F.gelu(self.fc1(x), approximate="tanh")'),
    "no shift": (rvrt, "SHIFT if self.shifted", "0 if self.shifted"),
    "no mask": (rvrt, "OTHER_REGION = -100.0", "OTHER_REGION = 0.0"),
    "positions transposed": (rvrt, "places[:, None] - places[None, :]", "places[None, :] - places[:, None]"),
    "block without its skip": (rvrt, "x + self.linear(shifted(", "self.linear(shifted("),
    "no last normalisation": (
        rvrt,
        'self.main["7"](self.main["5"](self.main["3"](x)))',
        'self.main["5"](self.main["3"](x))',
    ),
    "state first": (
        rvrt,
        "[*(feature[:, clip] for feature in features.values()), state]",
        "[state, *(feature[:, clip] for feature in features.values())]",
    ),
    "always the shallow features": (rvrt, "last = features[list(features)[-1]]", 'last = features["shallow"]'),
    "crossed frames not crossed": (rvrt, "(value.flip(1), guides.crossed)", "(value, guides.crossed)"),
    "sources not crossed": (
        rvrt,
        "torch.stack([x, x.flip(1)], dim=2)",
        "torch.stack([x[:, :1], x[:, 1:]], dim=2).expand(-1, 2, -1, -1, -1, -1)",
    ),
    "flow unflipped": (rvrt, "+ flows.flip(3)[", "+ flows["),
    "keys at the places of values": (
        deformable_attention,
        "return torch.cat([_attend(",
        "y, x = (p[:, :, : p.shape[2] // 2].repeat(1, 1, 2, 1, 1, 1) for p in (y, x))\n"
        "        return torch.cat([_attend(",
    ),
    "no network after alignment": (rvrt, '(result + self.mlp["1"](result))', "result"),
    "composed again": (rvrt, 'guides[direction] if turn == "2" else None', "None"),
    "guides of the other direction": (
        rvrt,
        'given = guides[direction] if turn == "2" else None',
        'given = guides["forward" if direction == "backward" else "backward"] if turn == "2" else None',
    ),
    "no activation after the shuffle": (
        rvrt,
        "F.leaky_relu(F.pixel_shuffle(self.upsampler[place](x), 2), SLOPE)",
        "F.pixel_shuffle(self.upsampler[place](x), 2)",
    ),
}
USES = {  # module: who uses its result, under which name
    rvrt: (golden_rvrt, "RVRT"),
    spynet: (rvrt, "SpyNet"),
    deformable_attention: (rvrt, "deformable_attention"),
}


@pytest.mark.slow
@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_seen(mistake, monkeypatch):
    where, right, wrong = MISTAKES[mistake]
    source = Path(where.__file__).read_text(encoding="utf-8")
    assert source.count(right) == 1
    module = types.ModuleType("mistaken")
    exec(source.replace(right, wrong), module.__dict__)
    user, name = USES[where]
    monkeypatch.setattr(user, name, getattr(module, name))
    error = errors("rvrt", arrays_of(DATA / "golden_rvrt.npz"), TABLE)
    assert error["output_last"] > 1e-4, error


def test_the_published_network_has_the_published_parameters():
    network = RVRT()
    assert sum(parameter.numel() for parameter in network.parameters()) == 11_152_085
    parts = {
        "spynet": 1_440_300,
        "feat_extract": 734_076,
        "backbone.backward_1": 1_101_816,
        "backbone.forward_1": 1_288_440,
        "backbone.backward_2": 1_475_064,
        "backbone.forward_2": 1_661_688,
        "deform_align.backward_1": 454_032,
        "reconstruction": 1_292_364,
        "conv_before_upsampler": 9_280,
        "upsampler": 332_352,
        "conv_last": 577,
    }
    for name, count in parts.items():
        assert sum(parameter.numel() for parameter in network.get_submodule(name).parameters()) == count, name
    lines = [line.split("\t") for line in TABLE.read_text().splitlines()[1:]]
    sizes = {name: "x".join(str(side) for side in value.shape) for name, value in network.state_dict().items()}
    assert sizes == {name: size for name, size, *_ in lines}


def test_weights_depend_on_the_prefix_and_one_clip_has_fewer_stages():
    arrays = {"codes": np.random.default_rng(1).integers(0, 8, (1, 2, 1, 12, 40))}
    weights = [golden_rvrt.small().state_dict()]
    weights.append({name: value * 1.1 if name.startswith("conv_last") else value for name, value in weights[0].items()})
    runs = [golden_rvrt.stages(arrays, each) for each in weights]
    assert not any(key.startswith(("align", "compose", "warped", "offset")) for key in runs[0])
    assert runs[0]["output"].shape == (1, 2, 1, 12, 40)
    assert not torch.equal(runs[0]["output"], runs[1]["output"])
    assert torch.equal(runs[0]["feat_forward_2"], runs[1]["feat_forward_2"])


def test_an_odd_clip_is_reflected_at_its_end():
    network = golden_rvrt.small()
    frames = draw(1, 3, 1, 40, 36)
    with torch.no_grad():
        even = network(frames[:, [0, 1, 2, 1]])
        assert torch.equal(network(frames), even[:, :3])


def test_the_published_flow_needs_large_frames_and_gets_them():
    assert RVRT(RVRTConfig(width=6)).least == 132
    assert RVRT(RVRTConfig(width=6, flow_levels=5)).least == 4


def test_frames_are_reduced_by_blocks():
    line = torch.arange(16, dtype=torch.float64).expand(1, 1, 8, 16)
    assert reduced(line).flatten(2)[0, 0, :4].tolist() == pytest.approx([1.5, 5.5, 9.5, 13.5])
    impulse = torch.zeros(1, 1, 4, 4, dtype=torch.float64)
    impulse[..., 0, 1] = 1
    assert float(reduced(impulse)) == pytest.approx(-3 * 19 / 32**2)


def test_uniform_flows_add_up():
    steps = torch.tensor([[1.0, 0.0], [2.0, -1.0], [0.5, 3.0]]).view(1, 3, 2, 1, 1).expand(1, 3, 2, 30, 30)
    straight, crossed = (flow[0, :, :, 10, 15].tolist() for flow in composed(steps))
    assert straight == [[3.0, -1.0], [2.5, 2.0]]  # from frame 2 into 0, from 3 into 1
    assert crossed == [[2.0, -1.0], [3.5, 2.0]]  # from frame 2 into 1, from 3 into 0


def test_half_precision_is_close():
    network = fill_by_rule(RVRT(RVRTConfig(width=24, flow_levels=1))).eval()
    frames = draw(1, 4, 1, 40, 48, dtype=torch.float32)
    with torch.no_grad():
        exact = network(frames)
        with torch.autocast("cpu", torch.bfloat16):
            close = network(frames)
    assert float((close.float() - exact).square().mean().sqrt() / exact.std()) < 0.02


def test_every_parameter_learns():
    network = golden_rvrt.small()
    network(draw(1, 4, 1, 40, 36)).square().mean().backward()
    idle = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    assert idle == []
    assert not [name for name, p in network.named_parameters() if name.endswith("weight") and p.grad.abs().max() == 0]


def test_a_configuration_survives_json():
    config = RVRTConfig(width=24, flow_levels=4)
    assert RVRTConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("width", 0, "RVRTConfig.width must be a whole number from 6"),
        ("width", 20, "RVRTConfig.width must be a multiple of 6, got 20; choose 18"),
        ("flow_levels", 7, "RVRTConfig.flow_levels must be a whole number from 1 to 6"),
    ],
)
def test_configurations_out_of_range_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        RVRTConfig(**{field: value})
