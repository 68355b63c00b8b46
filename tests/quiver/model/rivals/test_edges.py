"""Frames beyond the edges: repeated in space, reflected in time."""

import pytest
import torch

from quiver.model.rivals.edges import pad_space, reflected


@pytest.mark.parametrize(
    ("multiple", "least", "sides"), [(1, 1, (3, 5)), (4, 1, (4, 8)), (8, 1, (8, 8)), (4, 10, (12, 12)), (2, 3, (4, 6))]
)
def test_space_is_repeated_to_multiples(multiple, least, sides):
    frames = torch.arange(30.0).view(1, 2, 1, 3, 5)
    padded = pad_space(frames, multiple, least)
    assert padded.shape == (1, 2, 1, *sides)
    assert torch.equal(padded[..., :3, :5], frames)
    assert torch.equal(padded[..., -1, -1], frames[..., -1, -1])


def test_time_runs_backwards_beyond_the_ends():
    assert reflected(-3, 9, 4) == [3, 2, 1, 0, 1, 2, 3, 2, 1]
    assert reflected(-2, 5, 1) == [0] * 5
    assert reflected(-3, 8, 2) == [1, 0, 1, 0, 1, 0, 1, 0]
