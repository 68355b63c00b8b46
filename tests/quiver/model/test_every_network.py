"""Every network makes its tensors on the device that it is on."""

import contextlib

import pytest
import torch
from runs import EVERY

from quiver.model.mergenet import INPUTS
from quiver.model.presets import WithoutValues


@pytest.mark.parametrize("name", EVERY)
def test_a_network_runs_on_any_device(name, monkeypatch):
    """On `meta`, where tensors have no values: a tensor made on the CPU, or a look at a value, is an error of torch."""
    monkeypatch.setattr(torch, "autocast", lambda *given, **named: contextlib.nullcontext())  # torch has none for it
    with torch.device("meta"), WithoutValues():
        network = EVERY[name]().eval()
    count = 11 if name == "quiver" else 4
    frames = torch.empty((1, INPUTS, 16, 24) if name == "mergenet" else (1, count, 1, 16, 24), device="meta")
    with torch.no_grad():
        restored = network(frames)
    restored = getattr(restored, "scale1", restored)
    assert restored.device.type == "meta"
    assert restored.shape == {"mergenet": (1, 1, 16, 24), "quiver": (1, 1, 1, 16, 24)}.get(name, frames.shape)


def test_a_tensor_on_another_device_would_be_noticed():
    with pytest.raises(RuntimeError, match="device"):
        torch.empty(2, 3, device="meta") + torch.zeros(2, 3)
