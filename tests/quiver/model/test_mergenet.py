"""MergeNet: shapes, reach, its start at the merged frame, and its weights file."""

import pytest
import torch

from quiver.model.mergenet import INPUTS, MergeNet, MergeNetConfig
from quiver.model.presets import build
from quiver.model.weights import load, save


def trained(seed=0, width=4):
    """A network whose last layer is not zero."""
    torch.manual_seed(seed)
    network = MergeNet(MergeNetConfig(width))
    torch.nn.init.normal_(network.leave.weight, std=0.1)
    return network.eval()


def test_an_untrained_network_changes_nothing():
    assert not build("mergenet")(torch.randn(1, INPUTS, 16, 24)).any()


def test_the_size_is_as_stated():
    assert 0.90e6 < sum(p.numel() for p in MergeNet().parameters()) < 0.92e6


@pytest.mark.parametrize("seed", range(6))
def test_shapes(seed):
    torch.manual_seed(seed)
    count, down, across = (int(n) for n in torch.randint(1, 6, (3,)))
    assert trained()(torch.randn(count, INPUTS, 4 * down, 4 * across)).shape == (count, 1, 4 * down, 4 * across)


def test_frames_of_a_batch_do_not_meet():
    network = trained().double()
    x = torch.randn(2, INPUTS, 16, 24).double()
    with torch.no_grad():
        assert (network(x) - torch.cat([network(x[:1]), network(x[1:])])).abs().max() < 1e-12


def test_a_pixel_depends_on_nothing_beyond_the_reach():
    network = trained()
    x = torch.randn(1, INPUTS, 96, 96)
    far = torch.ones_like(x, dtype=bool)
    far[..., 48 - network.REACH : 49 + network.REACH, 48 - network.REACH : 49 + network.REACH] = False
    with torch.no_grad():
        before = network(x)
        after = network(torch.where(far, torch.randn_like(x), x))
    assert torch.equal(before[..., 48, 48], after[..., 48, 48])
    assert not torch.equal(before[..., 4, 4], after[..., 4, 4])


def test_a_weights_file_comes_back(tmp_path):
    network = trained()
    x = torch.randn(1, INPUTS, 8, 12)
    save(network, network.config, tmp_path / "net.safetensors")
    found = load(tmp_path / "net.safetensors")
    assert isinstance(found, MergeNet)
    with torch.no_grad():
        assert torch.equal(found(x), network(x))


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"width": 0}, "must be a whole number"),
        ({"width": 1.5}, "must be a whole number"),
        ({"inputs": 5}, "inputs is 5, this version prepares 17; train such weights again"),
    ],
)
def test_a_wrong_configuration_is_refused(values, told):
    with pytest.raises(ValueError, match=told):
        MergeNetConfig(**values)
