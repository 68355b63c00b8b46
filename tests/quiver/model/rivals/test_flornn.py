"""FloRNN equals the published one at every stage, finds its own flow, and takes any clip.

The committed arrays are what the scored frame 1 needs, and three of its stages:

    python -c "from golden import *; f = SHARED / 'golden_flornn.npz'; o = DATA / 'golden_flornn.npz', beyond
    a = arrays_of(f); a['flow_forward'] = a['flow_forward'][:, :10]; a['flow_backward'] = a['flow_backward'][:, :1]
    keys = 'codes noise_map flow_forward flow_backward brought_back_t1 output_t1 output_t1_zero_map'.split()
    np.savez_compressed(o, **{key: a[key] for key in keys})"
"""

import json
import types
from pathlib import Path

import golden_flornn
import numpy as np
import pytest
import torch
from golden import (
    DATA,
    arrays_of,
    beyond,
    compare,
    draw,
    errors,
    fill_by_rule,
    golden_files,
    slow_beyond_the_first,
    weights_by_table,
)
from torch import Tensor

from quiver.model.published_weights import load_published
from quiver.model.rivals import flornn
from quiver.model.rivals.flornn import FloRNN, FloRNNConfig, Flows, reflected_flows, warp_inside

TABLE = DATA / "flornn_state_dict.tsv"
SIZES = FloRNNConfig(width=4, blocks=2, look_ahead=3, flow_channels=(), as_published=True)


def small_weights() -> dict[str, Tensor]:
    """Weights of SIZES that let every stage contribute."""
    network = fill_by_rule(FloRNN(SIZES)).double()
    return {name: 1.5 * value for name, value in network.state_dict().items()}


def random_inputs(batch: int, count: int, ahead: int, height: int, width: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    return {
        "codes": rng.integers(0, 8, (batch, count, 1, height, width)),
        "noise_map": rng.uniform(0, 0.3, (batch, count, 1, height, width)),
        "flow_forward": rng.normal(0, 1.5, (batch, count - 1 + ahead, 2, height, width)),
        "flow_backward": rng.normal(0, 1.5, (batch, count, 2, height, width)),
    }


def stages(arrays: dict[str, np.ndarray], weights: dict[str, Tensor]) -> dict[str, np.ndarray]:
    with torch.no_grad():
        return {key: value.numpy() for key, value in golden_flornn.stages(arrays, weights).items()}


@pytest.mark.parametrize("path", slow_beyond_the_first(golden_files("flornn")), ids=str)
def test_every_stage_equals_the_published_one(path):
    found = errors("flornn", arrays_of(path), TABLE)
    assert len(found) >= 3
    assert not beyond(found, arrays_of(path), TABLE)


def test_batches_sizes_and_frame_counts_give_all_stages():
    arrays = random_inputs(2, 4, 3, 23, 12)
    weights = small_weights()
    whole = stages(arrays, weights)
    assert len(whole) == 12
    assert whole["output"].shape == (2, 4, 3, 23, 12)
    second = stages({key: array[1:] for key, array in arrays.items()}, weights)
    assert max(compare(second, {key: value[1:] for key, value in whole.items()}).values()) < 1e-9
    scored = {**arrays, "flow_forward": arrays["flow_forward"][:, :4], "flow_backward": arrays["flow_backward"][:, :1]}
    assert np.array_equal(stages(scored, weights)["output_t1"], whole["output_t1"])


MISTAKES = {  # what is written, what is written wrongly; each exactly once in the module
    "ring of the splat empty": (
        "average_splat(self.ringed(ahead), flow)",
        "self.ringed(average_splat(ahead, flows.forward[:, i - 1]))",
    ),
    "oldest first": ("for canvas, flow in kept", "for canvas, flow in reversed(kept)"),
    "ring of zeros": ("filled = canvas.clone()", "filled = torch.zeros_like(canvas)"),
    "ring of the newest": ("filled = canvas.clone()", "filled = kept[0][0].clone()"),
    "no mask": ("(moved[:, -1:] >= VALID)", "1"),
    "border padding": ('flow, "zeros")', 'flow, "border")'),
    "state warped on the canvas": (
        "state = warp_inside(state, flows.backward[:, o - 1])",
        "state = centre(warp_inside(self.ringed(state), self.ringed(flows.backward[:, o - 1])), state.shape[-2:])",
    ),
    "order of the decoder": ("torch.cat([state, ahead], dim=1)", "torch.cat([ahead, state], dim=1)"),
    "ReLU after the sum": (
        "return x + self.conv2(F.relu(self.conv1(x)))",
        "return F.relu(x + self.conv2(F.relu(self.conv1(x))))",
    ),
    "map after the state": ("torch.cat([image, noise, state], dim=1)", "torch.cat([image, state, noise], dim=1)"),
}


@pytest.fixture(scope="module")
def right() -> dict[str, np.ndarray]:
    arrays = random_inputs(1, 4, 3, 22, 31)
    return arrays | stages(arrays, small_weights())


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_seen(mistake, monkeypatch, right):
    """The stages of a small network, equal to the published one at full size, change."""
    correct, wrong = MISTAKES[mistake]
    source = Path(flornn.__file__).read_text(encoding="utf-8")
    assert source.count(correct) == 1
    module = types.ModuleType("mistaken")
    exec(source.replace(correct, wrong), module.__dict__)
    monkeypatch.setattr(golden_flornn, "FloRNN", module.FloRNN)
    found = compare(stages(right, small_weights()), {"output_t1": right["output_t1"]})
    assert found["output_t1"] > 1e-2


def test_the_published_network_has_the_published_parameters():
    network = FloRNN(FloRNNConfig(flow_channels=()))
    counts = {name: sum(p.numel() for p in part.parameters()) for name, part in network.named_children()}
    assert counts == {"forward_rnn": 1_146_240, "backward_rnn": 1_146_240, "d": 150_912}
    names = [line.split("\t")[0] for line in TABLE.read_text().splitlines()[1:]]
    assert list(network.state_dict()) == names
    grey = FloRNN(FloRNNConfig(flow_channels=(), image_channels=1))
    assert sum(p.numel() for p in grey.parameters()) == 2_436_480
    assert sum(p.numel() for p in FloRNN().parameters()) == 2_443_392 + 935_112  # with the flow network


def test_start_values_are_small():
    weight = FloRNN().d.convs[0].weight
    assert weight.abs().max() <= 0.2
    assert float(weight.detach().std()) == pytest.approx(0.2 * (2 / (128 * 9)) ** 0.5, rel=0.01)


def test_a_clip_is_restored_from_its_reflection():
    """The call for users equals the published run on a clip that was reflected by hand."""
    network = fill_by_rule(FloRNN(SIZES)).double()
    frames = draw(1, 5, 1, 12, 15)
    generator = torch.Generator().manual_seed(1)
    flows = Flows(*(torch.randn(1, 4, 2, 12, 15, generator=generator, dtype=torch.float64) for _ in range(2)))
    order = [0, 1, 2, 3, 4, 3, 2, 1]
    forward = torch.stack([*flows.forward[0], *(flows.backward[0, i] for i in (3, 2, 1))])[None]
    assert torch.equal(reflected_flows(flows, 3).forward, forward)
    images = frames[:, order].expand(-1, -1, 3, -1, -1)
    with torch.no_grad():
        by_hand = network.restore(images, torch.zeros(1, 8, 1, 12, 15).double(), Flows(forward, flows.backward))
        assert torch.equal(network(frames, flows), by_hand.mean(dim=2, keepdim=True))


def test_one_frame_stands_still():
    flows = Flows(*(torch.zeros(1, 0, 2, 11, 12),) * 2)
    assert torch.equal(reflected_flows(flows, 3).forward, torch.zeros(1, 3, 2, 11, 12))
    network = fill_by_rule(FloRNN(SIZES)).double()
    frame = draw(1, 1, 1, 7, 12)
    with torch.no_grad():
        assert torch.equal(network(frame), network(frame, Flows(*(torch.zeros(1, 0, 2, 7, 12),) * 2)))


def test_a_warp_from_outside_gives_zero():
    image = 1 + draw(1, 2, 4, 6)
    flow = torch.tensor([0.5, 0.0]).double().view(1, 2, 1, 1).expand(1, 2, 4, 6)
    moved = warp_inside(image, flow)
    assert torch.equal(moved[..., -1], torch.zeros(1, 2, 4).double())
    assert (moved[..., :-1] - (image[..., :-1] + image[..., 1:]) / 2).abs().max() < 1e-12


def test_the_noise_map_is_the_deviation_of_the_sensor():
    """Flat frames, at the table's light: its variances; 0 as published."""
    network = FloRNN(FloRNNConfig(width=2, blocks=1)).double()
    table = torch.linspace(0.01, 0.2, 15).double()
    levels = torch.linspace(0, 1, 15).double().view(15, 1, 1, 1, 1).expand(15, 1, 1, 6, 7)
    assert (network.noise(levels, table)[:, 0, 0, 3, 3] ** 2 - table).abs().max() < 1e-7
    assert network.noise(levels, table).std(dim=(-1, -2)).max() < 1e-9
    assert not FloRNN(SIZES).noise(levels.float(), table).any()


def test_every_parameter_learns_the_flow_too():
    network = golden_flornn.small()
    network(draw(1, 4, 1, 16, 16)).square().mean().backward()
    assert not [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    assert not [name for name, p in network.named_parameters() if p.grad.abs().max() == 0]


def test_half_precision_is_close():
    network = FloRNN(FloRNNConfig(width=8, blocks=2, look_ahead=3, flow_channels=(4, 4))).eval()
    frames = draw(1, 5, 1, 24, 32, dtype=torch.float32)
    with torch.no_grad():
        flows = network.flows(frames)
        exact = network(frames)
        with torch.autocast("cpu", torch.bfloat16):
            close = network(frames, flows)
    assert float((close.float() - exact).square().mean().sqrt() / exact.std()) < 0.03


def test_published_weights_load_with_the_frozen_flow_network_left_out():
    weights = weights_by_table(TABLE, dtype=torch.float32)
    left = load_published(FloRNN(FloRNNConfig(flow_channels=())), weights | {"pwcnet.a": torch.ones(1)}, FloRNN.unused)
    assert left == ["pwcnet.a"]


def test_missing_and_misshapen_flows_are_refused():
    network = FloRNN(SIZES)
    frames = torch.zeros(1, 3, 1, 12, 12)
    with pytest.raises(ValueError, match="no flow network; give the flows"):
        network(frames)
    with pytest.raises(ValueError, match=r"flows must be \(1, 2, 2, 12, 12\) forward and backward, got"):
        network(frames, Flows(torch.zeros(1, 2, 2, 12, 12), torch.zeros(1, 3, 2, 12, 12)))


def test_a_configuration_survives_json():
    config = FloRNNConfig(width=24, flow_channels=(8, 4), as_published=True)
    assert FloRNNConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("width", 0, "FloRNNConfig.width must be a whole number from 1"),
        ("look_ahead", 0, "FloRNNConfig.look_ahead must be a whole number from 1"),
        ("border", -0.1, "FloRNNConfig.border must be a number from 0"),
        ("flow_kernel", 4, "FloRNNConfig.flow_kernel must be odd"),
        ("flow_channels", 8, "FloRNNConfig.flow_channels must be a list"),
        ("flow_channels", [8] * 9, "FloRNNConfig.flow_channels must be a list of at most 8 widths"),
        ("flow_channels", (0,), "FloRNNConfig.flow_channels must be a whole number"),
        ("as_published", 1, "FloRNNConfig.as_published must be true or false"),
    ],
)
def test_configurations_out_of_range_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        FloRNNConfig(**{field: value})
