"""Tests the control: every frame of a clip from its window, reflected in time and repeated in space."""

import pytest
import torch
from golden import draw
from rivals import SMALL

from quiver.model.rivals.edges import reflected
from quiver.model.unet import UNet


def test_a_clip_is_restored_window_by_window():
    network = SMALL["unet"]()
    frames = draw(2, 7, 1, 8, 12)
    assert isinstance(network, UNet)
    order = reflected(-5, 17, 7)
    with torch.no_grad():
        restored = network(frames)
        alone = [network.body(frames[:, order[t : t + 11], 0]) for t in range(7)]
        inside = network.windows(frames[:, order])
    assert torch.equal(restored, torch.stack(alone, dim=1))
    assert torch.equal(restored, inside)


def test_odd_sides_are_repeated_and_cut():
    network = SMALL["unet"]()
    frames = draw(1, 2, 1, 7, 9)
    padded = torch.cat([frames, *[frames[..., -1:]] * 3], dim=-1)
    padded = torch.cat([padded, padded[..., -1:, :]], dim=-2)
    with torch.no_grad():
        assert torch.equal(network(frames), network(padded)[..., :7, :9])


def test_windows_refuse_short_clips_and_odd_sides():
    network = SMALL["unet"]().float()
    with pytest.raises(ValueError, match="T >= 11"):
        network.windows(torch.zeros(1, 10, 1, 8, 8))
    with pytest.raises(ValueError, match="multiples of 4"):
        network.windows(torch.zeros(1, 11, 1, 8, 9))
