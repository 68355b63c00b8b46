"""Loading by published names: all or an error; buffers may be absent, unused entries are listed."""

import pytest
import torch
from torch import nn

from quiver.model.published_weights import load_published

STATE = {"weight": torch.ones(2, 3), "bias": torch.zeros(2), "head.weight": torch.ones(4)}


def test_unused_entries_are_listed_and_constants_stay():
    network = nn.Linear(3, 2)
    network.register_buffer("mean", torch.ones(1))
    assert load_published(network, STATE, unused=("head.",)) == ["head.weight"]
    assert torch.equal(network.weight, STATE["weight"])
    assert torch.equal(network.mean, torch.ones(1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bias": None}, "bias is missing"),
        ({"tail": torch.ones(1)}, "tail is unknown"),
        ({"bias": torch.ones(5)}, r"bias is \(5,\), expected \(2,\)"),
    ],
)
def test_other_states_are_refused_by_name(change, message):
    state = {name: value for name, value in (STATE | change).items() if value is not None}
    with pytest.raises(ValueError, match=message):
        load_published(nn.Linear(3, 2), state, unused=("head.",))
