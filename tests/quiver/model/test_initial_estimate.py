"""Tests that the initial estimate turns with its window, and velocities with their frames."""

import pytest
import torch
from golden import draw

from quiver.model.initial_estimate import InitialEstimate, mirrored, turned
from quiver.model.plane_sweep import aligned


@pytest.mark.parametrize("change", [turned, mirrored])
def test_velocities_turn_with_their_frames(change):
    """Turned frames aligned by turned velocities equal the turned aligned frames."""
    frames, rest = draw(2, 11, 9, 12), torch.zeros(2, 2, 9, 12, dtype=torch.float64)
    velocity = 3 * draw(2, 2, 9, 12, seed=1) - 1
    seen = change(torch.cat([frames, velocity], 1), 11)
    drawn = aligned(seen[:, :11], seen[:, 11:], change(rest, 0))
    assert torch.allclose(drawn, change(aligned(frames, velocity, rest), None), atol=1e-12)


@pytest.mark.parametrize("largest", [0.0, 7.0])
def test_an_estimate_outside_training_turns_with_its_window(largest):
    """A single correction differs, its mean over the eight symmetries does not; training uses no mean."""
    torch.manual_seed(0)
    estimate = InitialEstimate(4, largest).double().eval()
    seen, x = draw(1, 25 if largest else 11, 8, 12), 22 if largest else None
    with torch.no_grad():
        mean, own = estimate.averaged(seen), estimate.correction(seen)
        for change in (turned, mirrored):
            assert torch.allclose(estimate.averaged(change(seen, x)), change(mean, None), atol=1e-14)
            assert not torch.allclose(estimate.correction(change(seen, x)), change(own, None), atol=1e-3)
        window = list(draw(11, 1, 1, 8, 12))
        averaged = estimate(window)
        assert not torch.allclose(estimate.train()(window), averaged, atol=1e-4)
