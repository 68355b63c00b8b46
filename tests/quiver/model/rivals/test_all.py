"""Every compared network: any size, finite numbers, separate clips, look-ahead, half precision.

The networks come from tests/support/rivals.py.
"""

from dataclasses import replace

import pytest
import torch
from golden import draw
from rivals import SMALL
from torch import nn

from quiver.model.presets import made
from quiver.model.rivals.edges import reflected


@pytest.fixture(scope="module", params=SMALL)
def network(request) -> nn.Module:
    return SMALL[request.param]()


@pytest.mark.parametrize("shape", [(1, 3, 1, 19, 22), (1, 1, 1, 16, 9), (2, 2, 1, 1, 1)])
def test_any_size_gives_every_frame(network, shape):
    frames = draw(*shape)
    with torch.no_grad():
        restored = network(frames)
    assert restored.shape == shape
    assert restored.dtype == frames.dtype
    assert restored.isfinite().all()


@pytest.mark.parametrize("value", [0.0, 0.4, 1.0])
def test_constant_frames_give_finite_numbers_and_gradients(network, value):
    frames = torch.full((1, 3, 1, 9, 12), value, dtype=torch.float64)
    restored = network(frames)
    assert restored.isfinite().all()
    network.zero_grad()
    restored.square().mean().backward()
    gradients = {name: parameter.grad for name, parameter in network.named_parameters()}
    assert not [name for name, gradient in gradients.items() if gradient is not None and not gradient.isfinite().all()]
    reached = any(gradient is not None and gradient.abs().max() > 0 for gradient in gradients.values())
    assert reached or value == 0  # frames may get the brightness of their codes


def test_clips_of_a_batch_do_not_meet(network):
    frames = draw(2, 3, 1, 13, 10)
    with torch.no_grad():
        together = network(frames)
        alone = torch.cat([network(frames[:1]), network(frames[1:])])
    assert (together - alone).abs().max() < 1e-9


def test_a_frame_uses_the_declared_future(network):
    if network.look_ahead is None:
        return
    frames = draw(1, network.look_ahead + 7, 1, 8, 10)
    changed = frames.clone()
    changed[:, -1] = 1 - changed[:, -1]
    with torch.no_grad():
        differences = (network(frames) - network(changed)).abs().amax((0, 2, 3, 4))
    assert differences[5] == 0
    assert differences[6] > 0


def test_frames_beyond_the_look_ahead_need_not_be_there(network):
    """What a network with a fixed look-ahead restores as frames come is that of the complete clip."""
    if network.look_ahead is None:
        return
    frames = draw(1, network.look_ahead + 7, 1, 12, 10)
    with torch.no_grad():
        whole = network(frames)
        early = network(frames[:, : network.look_ahead + 3])
    assert (whole[:, :3] - early[:, :3]).abs().max() < 1e-12


def test_ends_of_time_are_reflections(network):
    """A network of windows gives the same for a clip that was reflected by hand."""
    if not hasattr(network, "windows"):
        return
    frames = draw(1, 4, 1, 16, 8)
    before = network.frames_in - 1 - network.look_ahead
    order = reflected(-before, 4 + network.frames_in - 1, 4)
    with torch.no_grad():
        assert torch.equal(network(frames), network.windows(frames[:, order]))


@pytest.mark.parametrize("name", SMALL)
def test_half_precision_is_close(name):
    network = SMALL[name]().float()
    frames = draw(1, 3, 1, 24, 32, dtype=torch.float32)
    with torch.no_grad():
        exact = network(frames)
        with torch.autocast("cpu", torch.bfloat16):
            close = network(frames)
    assert 0 < float((close.float() - exact).square().mean().sqrt() / exact.std()) < 0.05


TAKE_NOISE = ("emvd", "flornn", "fastdvdnet")


@pytest.mark.parametrize("name", SMALL)
def test_the_noise_of_a_sensor_reaches_the_networks_that_take_it(name):
    """Two tables give two results, a table for each clip that of the clip alone; as published there is none."""
    network = SMALL[name]()
    assert getattr(network, "takes_variance", False) == (name in TAKE_NOISE)
    if name not in TAKE_NOISE:
        return
    frames = draw(2, 4, 1, 16, 16)
    tables = torch.stack([torch.full((9,), 0.02), torch.linspace(0, 0.3, 9)]).double()
    with torch.no_grad():
        together, first, second = (network(frames, variance=table) for table in (tables, tables[0], tables[1]))
    assert (first - second).abs().max() > 1e-3 * first.std()
    assert (together - torch.stack([first[0], second[1]])).abs().max() < 1e-12
    blind = made(replace(network.config, **{"noise_map": False} if name == "fastdvdnet" else {"as_published": True}))
    assert not blind.takes_variance
    with torch.no_grad():
        assert torch.equal(*(blind.double().eval()(frames, variance=table) for table in tables))


@pytest.mark.parametrize(
    "frames",
    [
        torch.zeros(3, 1, 8, 8),
        torch.zeros(1, 3, 2, 8, 8),
        torch.zeros(1, 0, 1, 8, 8),
        torch.zeros(1, 3, 1, 8, 8, dtype=torch.uint8),
    ],
)
def test_other_shapes_and_integers_are_refused(network, frames):
    with pytest.raises(ValueError, match=r"^frames must be floating-point numbers \[B, T, 1, H, W\], got .*; give .*$"):
        network(frames)
